"""From NumPy to device: choose the grid and the time step, refuse what cannot run, allocate."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import warp as wp

from piavatar_envs.mpm.boundaries import Collider, make_boundaries
from piavatar_envs.mpm.fields import Fields
from piavatar_envs.mpm.materials import lame_parameters, material_index
from piavatar_envs.mpm.stencil import BLOCK
from piavatar_envs.mpm.types import (
    DECOUPLING,
    Grid,
    Model,
    Nodes,
    Particles,
    Scratch,
    Sensors,
    State,
    Step,
    group,
    vec8,
)

#: Largest stable ``c dt / dx`` that was measured (0.84 to 1.04, less near incompressibility).
CFL_STABLE = 0.84


@dataclass(frozen=True)
class MaterialPoints:
    """Matter to simulate, in NumPy. Arrays have shape ``(1 or num_envs, num_particles)`` unless said otherwise.

    Attributes:
        volume: rest volume [m^3].
        density: rest density [kg/m^3].
        young_modulus: Young's modulus [Pa].
        poisson_ratio: Poisson's ratio.
        material: index of the constitutive model, see :func:`piavatar_envs.mpm.materials.material_index`.
        field: velocity field, shape ``(num_particles,)`` int; the first for all if not given.
        seam: 1 where fields of a subject grow together, shape ``(num_particles,)``; nowhere if not given.
        sensor: row of the contact sensor, -1 for none, shape ``(num_particles,)`` int; none if not given.
    """

    volume: np.ndarray
    density: np.ndarray
    young_modulus: np.ndarray
    poisson_ratio: np.ndarray
    material: np.ndarray
    field: np.ndarray | None = None
    seam: np.ndarray | None = None
    sensor: np.ndarray | None = None

    @classmethod
    def uniform(
        cls,
        volume: np.ndarray,
        density: float = 1000.0,
        young_modulus: float = 1.0e5,
        poisson_ratio: float = 0.3,
        material: str = "neo_hookean",
    ) -> MaterialPoints:
        """One material for all particles; ``volume`` [m^3] has shape ``([1 or num_envs,] num_particles)``."""
        volume = np.atleast_2d(np.asarray(volume, np.float32))
        one = np.ones((1, volume.shape[1]), np.float32)
        index = np.full(one.shape, material_index(material), np.int32)
        return cls(volume, density * one, young_modulus * one, poisson_ratio * one, index)

    @property
    def num_particles(self) -> int:
        """Particles of one environment."""
        return self.volume.shape[1]

    def sound_speed(self) -> float:
        """Fastest elastic wave ``sqrt((lam + 2 mu) / rho)`` [m/s]."""
        mu, lam = lame_parameters(self.young_modulus, self.poisson_ratio)
        return float(np.sqrt((lam + 2.0 * mu) / self.density).max())


def choose_num_substeps(control_dt: float, dx: float, sound_speed: float, cfl: float = 0.5) -> int:
    """Fewest substeps a control step with ``sound_speed * dt <= cfl * dx``."""
    return max(1, math.ceil(control_dt * sound_speed / (cfl * dx) - 1.0e-9))


def check_num_substeps(num_substeps: int, control_dt: float, dx: float, sound_speed: float) -> None:
    """Refuse a time step that is known to be unstable.

    Raises:
        ValueError: there is no substep, or ``sound_speed * dt / dx`` exceeds the largest stable value.
    """
    if num_substeps < 1:
        raise ValueError(f"num_substeps={num_substeps} must be at least 1")
    dt = control_dt / num_substeps
    if dt * sound_speed > CFL_STABLE * dx:
        limit = CFL_STABLE * dx / sound_speed
        raise ValueError(
            f"sim_dt={dt:.3g} s exceeds the CFL limit {limit:.3g} s (dx={dx:.3g} m, c={sound_speed:.3g} m/s); "
            f"use num_substeps >= {choose_num_substeps(control_dt, dx, sound_speed, CFL_STABLE)}"
        )


def make_grid(lower: Sequence[float], upper: Sequence[float], dx: float) -> Grid:
    """Grid whose particles may move freely in the box ``lower`` to ``upper`` [m].

    Raises:
        ValueError: the box is empty, or its nodes' records take more bytes than Warp's 32-bit strides can count.
    """
    lower, upper = np.asarray(lower, float), np.asarray(upper, float)
    if not (np.all(np.isfinite([lower, upper])) and np.all(upper > lower) and dx > 0.0):
        raise ValueError(f"empty domain: lower={lower.tolist()}, upper={upper.tolist()} m, dx={dx} m")
    nodes = np.ceil((upper - lower) / dx).astype(int) + 4  # two nodes of margin for the stencil on each side
    if nodes.prod() >= 2**26:  # of 32 bytes each
        raise ValueError(f"{nodes.prod():.3g} grid nodes exceed 2^26; use a dx larger than {dx} m or a smaller domain")
    grid = Grid()
    grid.origin = wp.vec3(*(lower - 2.0 * dx))
    grid.dx, grid.inv_dx = dx, 1.0 / dx
    grid.nodes = wp.vec3i(*nodes.tolist())
    grid.blocks = wp.vec3i(*(-(-nodes // BLOCK)).tolist())
    grid.num_nodes = int(nodes.prod())
    return grid


def check_points(points: MaterialPoints, num_envs: int, fields: Fields) -> None:
    """Refuse matter without mass and arrays that fit no environment.

    Raises:
        ValueError: a volume or density is not positive, an array has neither one row nor one an environment, or a
            particle is of a velocity field that there is not.
    """
    if points.field is not None and not (points.field.min() >= 0 and points.field.max() < fields.num_fields):
        raise ValueError(f"field={points.field.max()} of a particle: there are {fields.num_fields} velocity fields")
    for name in ("volume", "density", "young_modulus", "poisson_ratio", "material"):
        array = getattr(points, name)
        if len(array) not in (1, num_envs):
            raise ValueError(f"{name} has {len(array)} rows; give it 1 or {num_envs}, one an environment")
    for name, array in (("volume", points.volume), ("density", points.density)):
        bad = array[~(array > 0.0)]
        if bad.size:
            raise ValueError(f"{name}={bad[0]:g} must be positive: a particle without mass cannot move")


def build_model(
    points: MaterialPoints,
    grid: Grid,
    *,
    num_envs: int = 1,
    device: str = "cpu",
    control_dt: float = 1.0 / 30.0,
    num_substeps: int | None = None,
    cfl: float = 0.5,
    gravity: Sequence[float] = (0.0, 0.0, -9.81),
    decoupling: str = "split",
    colliders: Sequence[Collider] = (),
    fields: Fields | None = None,
    sound_speed: float | None = None,
) -> Model:
    """Constants of a simulation on ``device``.

    ``num_substeps`` is chosen from the CFL limit unless given; the limit comes from the points, or from
    ``sound_speed`` [m/s] where parameters will be randomised.

    Raises:
        ValueError: bad material, unstable time step, or more memory than the device has.
    """
    if decoupling not in DECOUPLING:
        raise ValueError(f"unknown decoupling {decoupling!r}; use one of {', '.join(DECOUPLING)}")
    fields = fields or Fields()
    check_points(points, num_envs, fields)
    sound_speed = max(points.sound_speed(), sound_speed or 0.0)
    if num_substeps is None:
        num_substeps = choose_num_substeps(control_dt, grid.dx, sound_speed, cfl)
    check_num_substeps(num_substeps, control_dt, grid.dx, sound_speed)
    mu, lam = lame_parameters(points.young_modulus, points.poisson_ratio)
    check_memory(num_envs, points.num_particles, grid.num_nodes, device, fields.num_fields)
    step = Step()
    step.dt = control_dt / num_substeps
    step.gravity = wp.vec3(*gravity)
    step.decoupling = DECOUPLING[decoupling]
    return Model(
        num_envs=num_envs,
        num_particles=points.num_particles,
        device=device,
        grid=grid,
        step=step,
        particles=upload_points(points, mu, lam, device),
        boundaries=make_boundaries(colliders, fields.num_fields, num_envs, device),
        contact=fields.upload(grid.dx, num_envs, device),
        num_substeps=num_substeps,
        control_dt=control_dt,
        sound_speed=sound_speed,
        moving_boundaries=any(collider.moves or collider.kinematic for collider in colliders),
        num_sensors=fields.num_sensors,
    )


def upload_points(points: MaterialPoints, mu: np.ndarray, lam: np.ndarray, device: str) -> Particles:
    """Per-particle constants on the device."""
    particles, count = Particles(), points.num_particles

    def upload(value, dtype):
        scalar = np.int32 if dtype is int else np.float32
        return wp.array(np.ascontiguousarray(value, scalar), dtype=dtype, device=device)

    particles.mass = upload(points.volume * points.density, float)
    particles.volume, particles.mu, particles.lam = upload(points.volume, float), upload(mu, float), upload(lam, float)
    particles.material = upload(points.material, int)
    particles.field = upload(np.zeros(count) if points.field is None else points.field, int)
    particles.seam = upload(np.zeros(count) if points.seam is None else points.seam, float)
    particles.sensor = upload(np.full(count, -1) if points.sensor is None else points.sensor, int)
    return particles


def estimate_bytes(num_envs: int, num_particles: int, num_nodes: int, num_fields: int = 1) -> int:
    """Device memory of state and scratch [bytes]: 108 B a particle, 77 B a node, 105 B where there are more fields."""
    node = 2 * 32 + 12 + 1 + (16 + 12 if num_fields > 1 else 0)
    return num_envs * (num_particles * (3 * 12 + 2 * 36) + num_fields * num_nodes * node)


def check_memory(num_envs: int, num_particles: int, num_nodes: int, device: str, num_fields: int = 1) -> None:
    """Refuse a batch that does not fit.

    Raises:
        ValueError: the estimate exceeds the free memory of a CUDA device.
    """
    target = wp.get_device(device)
    if not target.is_cuda:
        return
    need = estimate_bytes(num_envs, num_particles, num_nodes, num_fields)
    if need > target.free_memory:
        fits = int(num_envs * target.free_memory / need)
        raise ValueError(
            f"{num_envs} environments need {need / 2**30:.1f} GiB, {target} has {target.free_memory / 2**30:.1f} GiB "
            f"free; use num_envs <= {fits} or a coarser fidelity"
        )


def allocate(model: Model) -> tuple[State, Scratch]:
    """Zeroed state (identity deformation) and scratch."""
    particles = (model.num_envs, model.num_particles)
    nodes = (model.num_envs, model.contact.num_fields * model.num_nodes)
    shared = nodes if model.contact.num_fields > 1 else (1, 1)

    def zeros(shape, dtype):
        return wp.zeros(shape, dtype=dtype, device=model.device)

    identity = np.broadcast_to(np.eye(3, dtype=np.float32), (*particles, 3, 3))
    state = State(
        x=zeros(particles, wp.vec3),
        u=zeros(particles, wp.vec3),
        C=zeros(particles, wp.mat33),
        F=wp.array(np.ascontiguousarray(identity), dtype=wp.mat33, device=model.device),
        vk=zeros(particles, wp.vec3),
        failure=zeros(model.num_envs, int),
    )
    scratch = Scratch(
        nodes=Nodes(
            sum=zeros(nodes, vec8),
            offset=zeros(nodes, wp.vec3),
            velocity=zeros(nodes, vec8),
            facing=zeros(shared, wp.vec3),
        ),
        block_fields=zeros((2, model.num_envs, model.num_blocks), int),
        sensors=allocate_sensors(model, zeros(shared, wp.vec4)),
    )
    return state, scratch


def allocate_sensors(model: Model, node: wp.array) -> Sensors:
    """Zeroed contact sensors; ``node`` are their records at the nodes."""
    n, subjects = model.num_envs, model.contact.num_subjects

    def zeros(shape, dtype):
        return wp.zeros(shape, dtype=dtype, device=model.device)

    return group(
        Sensors,
        boundary_impulse=zeros((n, subjects), wp.vec3),
        pair_impulse=zeros((n, subjects * subjects), wp.vec3),
        part_impulse=zeros((n, max(1, model.num_sensors), subjects), wp.vec3),
        node=node,
        penetration=zeros((n, subjects), float),
    )
