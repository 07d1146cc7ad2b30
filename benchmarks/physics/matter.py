"""Small bodies of matter without an avatar, for benchmarks of the continuum and the tests of ``mpm``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import warp as wp

from piavatar_envs.core.arrays import components_of, matrix_at, store_matrix
from piavatar_envs.core.launch_graph import LaunchGraph
from piavatar_envs.mpm.colliders import Collider
from piavatar_envs.mpm.diagnostics import Totals, totals
from piavatar_envs.mpm.memory import allocate
from piavatar_envs.mpm.model import MaterialPoints, build_model, make_grid
from piavatar_envs.mpm.solver import record_begin, record_end, record_first_activation, record_substep
from piavatar_envs.mpm.types import Model, Scratch, State
from piavatar_envs.sim.prop_cores import PropCores
from piavatar_envs.sim.prop_geometry import PropPoints
from piavatar_envs.sim.props import upload_prop

wp.set_module_options({"enable_backward": False})


@wp.kernel
def push_particles(
    keep: wp.array(dtype=float),
    kick: wp.array(dtype=wp.vec3),
    # in and out
    u: wp.array2d(dtype=wp.vec3),
    C: wp.array3d(dtype=float),
):
    """Keep a share of all physical motion, and add ``kick`` [m/s] to each particle's velocity."""
    e, p = wp.tid()
    u[e, p] = keep[0] * u[e, p] + kick[p]
    store_matrix(C, e, p, keep[0] * matrix_at(C, e, p))


@dataclass
class Matter:
    """A body on a lattice, with the graph of one control step; built by :func:`build_matter`."""

    model: Model
    state: State
    scratch: Scratch
    graph: LaunchGraph
    rest: np.ndarray  # (num_particles, 3) [m]
    keep: wp.array  # (1,) see push()
    kick: wp.array  # (num_particles, 3)

    def run(self, control_steps: int = 1) -> Matter:
        """Advance by control steps."""
        for _ in range(control_steps):
            self.graph.run()
        return self

    def set(self, **arrays: np.ndarray) -> Matter:
        """Write state arrays, in double precision or not, for all environments or one for each."""
        for name, value in arrays.items():
            target, shape = getattr(self.state, name), self.state.numpy()[name].shape
            whole = np.broadcast_to(np.asarray(value, np.float32), shape)
            target.assign(components_of(whole) if name in ("C", "F") else np.ascontiguousarray(whole))
        return self

    def push(self, damping: float = 0.0, acceleration: np.ndarray | None = None) -> Matter:
        """Damp all velocities from now on at a rate [1/s] and push each particle [m/s^2]; needs ``pushed=True``."""
        dt = self.model.step.dt
        self.keep.assign(np.array([np.exp(-damping * dt)], np.float32))
        kick = np.zeros(self.rest.shape) if acceleration is None else dt * acceleration
        self.kick.assign(kick.astype(np.float32))
        return self

    def get(self, name: str, env: int = 0) -> np.ndarray:
        """Return a state array of an environment, in double precision."""
        return self.state.numpy()[name][env].astype(float)

    def totals(self, env: int = 0, **kwargs) -> Totals:
        """Return mass, momentum and energy of an environment; see :func:`piavatar_envs.mpm.diagnostics.totals`."""
        return totals(self.model, self.state, env, **kwargs)

    def of(self, field: int) -> np.ndarray:
        """Return the mask of a velocity field's particles."""
        return self.model.particles.field.numpy() == field

    @property
    def accumulators_are_clear(self) -> bool:
        """Return whether no node holds anything that a later substep would add to."""
        sums = self.scratch.accumulators
        arrays = [sums.fixed, sums.offset, sums.offset_fixed, sums.candidates]
        if self.model.path != "block":  # where sums are written, not added
            arrays.append(sums.value)
        return not any(array.numpy().any() for array in arrays)

    @property
    def failures(self) -> list[int]:
        """Return bits ``FAILURE_*`` of every environment."""
        return self.state.failure.numpy().tolist()


def lattice(lower: Sequence[float], upper: Sequence[float], spacing: float) -> np.ndarray:
    """Return the centres of the cells of edge ``spacing`` [m] that fill a box, shape ``(num_particles, 3)``."""
    counts = np.round(np.subtract(upper, lower) / spacing).astype(int)
    axes = [low + spacing * (np.arange(count) + 0.5) for low, count in zip(lower, counts, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def ball(center: Sequence[float], radius: float, spacing: float) -> np.ndarray:
    """Return the points of a lattice in a ball; a mirrored centre gives mirrored points."""
    reach = spacing * np.ceil(radius / spacing)
    points = lattice([-reach] * 3, [reach] * 3, spacing)
    return points[np.linalg.norm(points, axis=1) < radius] + center


def build_matter(
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
    retardation: float = 0.0,
    gravity: Sequence[float] = (0.0, 0.0, 0.0),
    pushed: bool = False,
    prop: PropPoints | None = None,
    planes: Sequence[tuple[Sequence[float], float, float]] = (),
    colliders: Sequence[Collider] = (),
    device: str = "cpu",
    **kwargs,
) -> Matter:
    """Build a box of matter at rest, or the points ``rest`` in it.

    With velocity fields, the contact sensors cover one control step.

    Args:
        lower: corner of the box [m]; without ``rest`` it is full.
        upper: the opposite one [m].
        spacing: of the particles [m].
        dx: of the grid [m].
        margin: of the grid around the box [m].
        rest: particles [m], shape ``(num_particles, 3)``.
        points: what each particle is made of; without it all are of the material that follows.
        young_modulus: of all particles, without ``points`` [Pa].
        poisson_ratio: likewise.
        density: likewise [kg/m^3].
        material: likewise.
        retardation: viscosity over modulus, likewise [s].
        gravity: [m/s^2].
        pushed: whether :meth:`Matter.push` has an effect.
        prop: a prop that the matter is, whose core thin colliders stop.
        planes: normal, offset [m] and friction [-] of each.
        colliders: further solids.
        device: Warp device.
        **kwargs: for ``build_model``.
    """
    if rest is None:
        rest = lattice(lower, upper, spacing)
    if points is None:
        volume = np.full(len(rest), spacing**3)
        points = MaterialPoints.uniform(volume, density, young_modulus, poisson_ratio, material, retardation)
    grid = make_grid(np.subtract(lower, margin), np.add(upper, margin), dx)
    colliders = [*(Collider.plane(*plane) for plane in planes), *colliders]
    model = build_model(points, grid, device=device, gravity=gravity, colliders=colliders, **kwargs)
    state, scratch = allocate(model)
    keep = wp.full(1, 1.0, dtype=float, device=device)
    kick = wp.zeros(len(rest), dtype=wp.vec3, device=device)
    own = [] if prop is None else [prop]
    cores = PropCores(own, [upload_prop(each, 0, device) for each in own], [0 for _ in own], model)
    graph = LaunchGraph(device)
    if "fields" in kwargs:
        record_begin(graph, model, state, scratch)
    else:  # sensors add up over control steps
        record_first_activation(graph, model, state, scratch)
    for index in range(model.num_substeps):
        cores.record_before_substep(graph, state, scratch)
        record_substep(graph, model, state, scratch, index)
        if pushed:
            graph.launch(push_particles, state.x.shape, [keep, kick], [state.u, state.C])
    record_end(graph, model, state, scratch)
    return Matter(model, state, scratch, graph, rest, keep, kick).set(x=rest)
