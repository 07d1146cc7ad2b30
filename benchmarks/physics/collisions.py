"""Bodies that meet, without a task: soft solids and the avatar's flesh, thrown, dropped and measured."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np
import warp as wp
from scipy.spatial import cKDTree

from benchmarks.physics.matter import push_particles
from piavatar_envs.avatar.body.sampling import sample_particles, spacing_for
from piavatar_envs.avatar.body.sources import load_asset
from piavatar_envs.core.launch_graph import LaunchGraph
from piavatar_envs.mpm.colliders import Collider
from piavatar_envs.mpm.diagnostics import Totals, totals
from piavatar_envs.mpm.memory import allocate
from piavatar_envs.mpm.model import Fields, MaterialPoints, build_model, make_grid
from piavatar_envs.mpm.solver import record_begin, record_end, record_substep
from piavatar_envs.sim import prop_geometry as geometry
from piavatar_envs.sim.resolution import GRID_PER_HEIGHT

#: Half the edge of a block [m].
BLOCK = (0.2, 0.2, 0.1)


def grid_spacing(resolution: str) -> float:
    """Return the grid spacing of a fidelity [m]."""
    return float(np.ptp(load_asset().mean_body().vertices[:, 2])) / GRID_PER_HEIGHT[resolution]


@dataclass(frozen=True)
class Thing:
    """Soft body of a collision: particles [m], their volumes [m^3], motion and material."""

    x: np.ndarray
    volume: np.ndarray
    velocity: Sequence[float] = (0.0, 0.0, 0.0)
    density: float = 1000.0
    young_modulus: float = 1.0e5


def ball(center: Sequence[float], resolution: str, radius: float = 0.11, mass: float | None = None, **how) -> Thing:
    """Return a ball; with a given mass [kg] its wave speed is that of flesh."""
    points = geometry.sphere(radius, spacing_for(grid_spacing(resolution)))
    density = 1000.0 if mass is None else mass / float(points.volume.sum())
    how = {"density": density, "young_modulus": 100.0 * density, **how}
    return Thing(points.rest + np.asarray(center), points.volume, **how)


def block(center: Sequence[float], resolution: str, half: Sequence[float] = BLOCK, **how) -> Thing:
    """Return a box."""
    points = geometry.box(half, spacing_for(grid_spacing(resolution)))
    return Thing(points.rest + np.asarray(center), points.volume, **how)


@lru_cache(maxsize=4)
def _flesh(resolution: str):
    return sample_particles(load_asset(), spacing_for(grid_spacing(resolution)))


def body(resolution: str, shift: Sequence[float] = (0.0, 0.0, 0.0), yaw: float = 0.0, **how) -> Thing:
    """Return the avatar's flesh in its rest pose, without control."""
    particles = _flesh(resolution)
    c, s = np.cos(yaw), np.sin(yaw)
    turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    return Thing(particles.rest_positions @ turn.T + np.asarray(shift), particles.volumes, **how)


@dataclass
class Collision:
    """Several things in one world. ``things`` are subjects 0, 1, ...; build with :func:`collide`."""

    things: Sequence[Thing]
    model: object
    state: object
    scratch: object
    owner: np.ndarray
    dx: float
    graphs: dict[str, LaunchGraph] = field(default_factory=dict)

    def run(self, steps: int, damped: bool = False) -> None:
        """Advance by control steps; ``damped`` for loading slowly."""
        for _ in range(steps):
            self.graphs["damped" if damped else "free"].run()

    def totals(self, thing: int | None = None, about: Sequence[float] = (0.0, 0.0, 0.0)) -> Totals:
        """Return momentum and energy of one thing or all."""
        select = slice(None) if thing is None else self.owner == thing
        return totals(self.model, self.state, 0, select, about)

    def positions(self, thing: int) -> np.ndarray:
        """Return particles [m]."""
        return self.state.x.numpy()[0][self.owner == thing].astype(float)

    def velocity(self, thing: int) -> np.ndarray:
        """Return the mean velocity [m/s]."""
        t = self.totals(thing)
        return t.momentum / t.mass

    def nearest(self, a: int = 0, b: int = 1) -> float:
        """Return the smallest distance between particles of two things [m]."""
        return float(cKDTree(self.positions(a)).query(self.positions(b))[0].min())

    def gap(self, a: int = 0, b: int = 1) -> float:
        """Return the gap between surfaces [m]: the smallest distance less the spacing; negative if they overlap."""
        return self.nearest(a, b) - spacing_for(self.dx)

    def penetration(self) -> float:
        """Return the sensor's depth of the deepest particle inside another thing [m]."""
        return float(self.scratch.sensors.penetration.numpy().max())

    def touched(self) -> bool:
        """Return whether impulses were exchanged in the last control step."""
        return bool(np.abs(self.scratch.sensors.part_impulse.numpy()).max() > 0.0)

    @property
    def failed(self) -> bool:
        """Return whether the simulation failed."""
        return bool(self.state.failure.numpy()[0])


def collide(
    things: Sequence[Thing],
    resolution: str,
    normals: str = "shared",
    friction: float = 0.3,
    gravity: Sequence[float] = (0.0, 0.0, 0.0),
    colliders: Sequence[Collider] = (),
    control_dt: float = 1.0 / 60.0,
    room: float = 1.0,
    device: str = "cpu",
    fastest: float = 0.0,
) -> Collision:
    """Build a world of ``things`` with a margin of ``room`` [m] around them.

    Substeps come from the waves and from ``fastest`` [m/s], so that nothing crosses more than half a grid spacing.
    """
    dx = grid_spacing(resolution)
    owner = np.repeat(np.arange(len(things)), [len(thing.x) for thing in things])

    def by_particle(name: str) -> np.ndarray:
        return np.array([getattr(thing, name) for thing in things])[owner][None].astype(np.float32)

    points = MaterialPoints.uniform(np.concatenate([thing.volume for thing in things]))
    points = MaterialPoints(
        volume=points.volume,
        density=by_particle("density"),
        young_modulus=by_particle("young_modulus"),
        poisson_ratio=points.poisson_ratio,
        material=points.material,
        field=owner,
        sensor=owner,
    )
    x = np.concatenate([thing.x for thing in things])
    speed = max(points.sound_speed(), fastest)
    model = build_model(
        points,
        make_grid(x.min(0) - room, x.max(0) + room, dx),
        device=device,
        control_dt=control_dt,
        gravity=gravity,
        colliders=colliders,
        fields=Fields(
            tuple(range(len(things))),
            friction,
            np.array([thing.density for thing in things]),
            normals=normals,
            num_sensors=len(things),
        ),
        sound_speed=speed,
    )
    state, scratch = allocate(model)
    state.x.assign(x[None].astype(np.float32))
    state.u.assign(by_particle("velocity").reshape(1, -1, 3))
    world = Collision(things, model, state, scratch, owner, dx)
    keep = wp.array([np.exp(-50.0 * model.step.dt)], dtype=float, device=device)
    kick = wp.zeros(len(x), dtype=wp.vec3, device=device)
    for name in ("free", "damped"):
        graph = world.graphs[name] = LaunchGraph(device)
        record_begin(graph, model, state, scratch)
        for index in range(model.num_substeps):
            record_substep(graph, model, state, scratch, index)
            if name == "damped":
                graph.launch(push_particles, state.x.shape, [keep, kick], [state.u, state.C])
        record_end(graph, model, state, scratch)
    return world
