"""Small bodies of matter for the tests of the material point method."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pytest
import warp as wp

from piavatar_envs.mpm.boundaries import Collider
from piavatar_envs.mpm.build import MaterialPoints, build_model, make_grid
from piavatar_envs.mpm.diagnostics import Totals, totals
from piavatar_envs.mpm.fields import CONTACT_GATE, Fields
from piavatar_envs.mpm.matrices import components_of, matrix_at, store_matrix
from piavatar_envs.mpm.memory import allocate
from piavatar_envs.mpm.program import Program
from piavatar_envs.mpm.solver import record_begin, record_end, record_marks, record_substep
from piavatar_envs.mpm.types import Model, Scratch, State

wp.set_module_options({"enable_backward": False})


@wp.kernel
def push_particles(
    keep: wp.array(dtype=float),
    kick: wp.array(dtype=wp.vec3),
    # in and out
    u: wp.array2d(dtype=wp.vec3),
    C: wp.array3d(dtype=float),
):
    e, p = wp.tid()
    u[e, p] = keep[0] * u[e, p] + kick[p]
    store_matrix(C, e, p, keep[0] * matrix_at(C, e, p))


@dataclass
class Simulation:
    """A body on a lattice, with the program of one control step."""

    model: Model
    state: State
    scratch: Scratch
    program: Program
    rest: np.ndarray  # (num_particles, 3) [m]
    keep: wp.array  # (1,) see push()
    kick: wp.array  # (num_particles, 3)

    def run(self, control_steps: int = 1) -> Simulation:
        for _ in range(control_steps):
            self.program.run()
        return self

    def set(self, **arrays: np.ndarray) -> Simulation:
        """Write state arrays, in double precision or not, for all environments or one for each."""
        for name, value in arrays.items():
            target, shape = getattr(self.state, name), self.state.numpy()[name].shape
            whole = np.broadcast_to(np.asarray(value, np.float32), shape)
            target.assign(components_of(whole) if name in ("C", "F") else np.ascontiguousarray(whole))
        return self

    def push(self, damping: float = 0.0, acceleration: np.ndarray | None = None) -> Simulation:
        """From now on damp all velocities at a rate [1/s] and push each particle [m/s^2]; needs ``pushed=True``."""
        dt = self.model.step.dt
        self.keep.assign(np.array([np.exp(-damping * dt)], np.float32))
        kick = np.zeros(self.rest.shape) if acceleration is None else dt * acceleration
        self.kick.assign(kick.astype(np.float32))
        return self

    def get(self, name: str, env: int = 0) -> np.ndarray:
        return self.state.numpy()[name][env].astype(float)

    def totals(self, env: int = 0, **kwargs) -> Totals:
        return totals(self.model, self.state, env, **kwargs)

    def of(self, field: int) -> np.ndarray:
        """Mask of a velocity field's particles."""
        return self.model.particles.field.numpy() == field

    @property
    def sums_are_clear(self) -> bool:
        sums = self.scratch.sums
        arrays = [sums.fixed, sums.offset, sums.offset_fixed]
        if self.model.scatter != "shared":  # whose sums are written, not added up
            arrays.append(sums.value)
        return not any(array.numpy().any() for array in arrays)

    @property
    def failures(self) -> list[int]:
        return self.state.failure.numpy().tolist()


def lattice(lower: Sequence[float], upper: Sequence[float], spacing: float) -> np.ndarray:
    """Centres of the cells of edge ``spacing`` [m] that fill a box, shape ``(num_particles, 3)``."""
    counts = np.round(np.subtract(upper, lower) / spacing).astype(int)
    axes = [low + spacing * (np.arange(count) + 0.5) for low, count in zip(lower, counts, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


@pytest.fixture(scope="session")
def simulate(device: str) -> Callable[..., Simulation]:
    """Builds a box of matter, or the points ``rest`` in it; what it does not know goes to ``build_model``.

    With velocity fields, the contact sensors tell of one control step.
    """

    def build(
        lower: Sequence[float] = (-0.1, -0.1, -0.1),
        upper: Sequence[float] = (0.1, 0.1, 0.1),
        spacing: float = 0.025,
        dx: float = 0.05,
        margin: float = 0.5,
        rest: np.ndarray | None = None,
        points: MaterialPoints | None = None,
        young_modulus: float = 1.0e5,
        poisson_ratio: float = 0.3,
        density: float = 1000.0,
        material: str = "neo_hookean",
        gravity: Sequence[float] = (0.0, 0.0, 0.0),
        pushed: bool = False,
        planes: Sequence[tuple[Sequence[float], float, float]] = (),
        **kwargs,
    ) -> Simulation:
        if rest is None:
            rest = lattice(lower, upper, spacing)
        if points is None:
            volume = np.full(len(rest), spacing**3)
            points = MaterialPoints.uniform(volume, density, young_modulus, poisson_ratio, material)
        grid = make_grid(np.subtract(lower, margin), np.add(upper, margin), dx)
        colliders = [Collider.plane(*plane) for plane in planes]
        model = build_model(points, grid, device=device, gravity=gravity, colliders=colliders, **kwargs)
        state, scratch = allocate(model)
        keep = wp.full(1, 1.0, dtype=float, device=device)
        kick = wp.zeros(len(rest), dtype=wp.vec3, device=device)
        program = Program(device)
        if "fields" in kwargs:
            record_begin(program, model, state, scratch)
        else:  # sensors add up over control steps
            record_marks(program, model, state, scratch)
        for index in range(model.num_substeps):
            record_substep(program, model, state, scratch, index)
            if pushed:
                program.launch(push_particles, state.x.shape, [keep, kick], [state.u, state.C])
        record_end(program, model, state, scratch)
        return Simulation(model, state, scratch, program, rest, keep, kick).set(x=rest)

    return build


def ball(center: Sequence[float], radius: float, spacing: float) -> np.ndarray:
    """Points of a lattice in a ball, those of a mirrored centre mirrored."""
    reach = spacing * np.ceil(radius / spacing)
    points = lattice([-reach] * 3, [reach] * 3, spacing)
    return points[np.linalg.norm(points, axis=1) < radius] + center


@pytest.fixture(scope="session")
def meet(simulate) -> Callable[..., Simulation]:
    """Builds boxes and balls with velocities, each a subject and a row of the contact sensor of its own.

    A body is ``{"box": (lower, upper)}`` or ``{"ball": (center, radius)}`` and may have a ``velocity`` [m/s] and a
    ``density`` [kg/m^3]; its Young's modulus is ``stiffness * density``, so that all have the same speed of sound.
    """

    def build(
        bodies: Sequence[dict],
        friction: np.ndarray | float = 0.0,
        gate: float = CONTACT_GATE,
        normals: str = "shared",
        spacing: float = 0.025,
        stiffness: float = 100.0,
        domain: Sequence[Sequence[float]] = ((-1.0, -0.8, -0.8), (1.0, 0.8, 0.8)),
        **kwargs,
    ) -> Simulation:
        parts = [lattice(*b["box"], spacing) if "box" in b else ball(*b["ball"], spacing) for b in bodies]
        counts = [len(part) for part in parts]
        density = np.array([body.get("density", 1000.0) for body in bodies])
        fields = Fields(tuple(range(len(bodies))), friction, density, gate, normals, len(bodies))
        field = np.repeat(np.arange(len(bodies)), counts)
        points = replace(
            MaterialPoints.uniform(np.full(len(field), spacing**3)),
            density=density[None, field],
            young_modulus=stiffness * density[None, field],
            field=field,
            sensor=field,
        )
        scene = {"rest": np.concatenate(parts), "points": points, "fields": fields, "margin": 0.0}
        sim = simulate(*domain, **scene, **kwargs)
        velocity = np.array([body.get("velocity", (0.0, 0.0, 0.0)) for body in bodies])
        return sim.set(u=velocity[field])

    return build
