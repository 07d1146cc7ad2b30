"""From NumPy to device: choose the grid and the time step, refuse what cannot run, allocate."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import warp as wp

from piavatar_envs.mpm.materials import lame_parameters, material_index
from piavatar_envs.mpm.stencil import BLOCK
from piavatar_envs.mpm.types import DECOUPLING, Boundaries, Grid, Model, Particles, Scratch, State, Step, vec8

#: Largest stable ``c dt / dx`` that was measured (0.84 to 1.04, less near incompressibility).
CFL_STABLE = 0.84


@dataclass(frozen=True)
class MaterialPoints:
    """Matter to simulate, in NumPy. Every array has shape ``(1 or num_envs, num_particles)``.

    Attributes:
        volume: rest volume [m^3].
        density: rest density [kg/m^3].
        young_modulus: Young's modulus [Pa].
        poisson_ratio: Poisson's ratio.
        material: index of the constitutive model, see :func:`piavatar_envs.mpm.materials.material_index`.
    """

    volume: np.ndarray
    density: np.ndarray
    young_modulus: np.ndarray
    poisson_ratio: np.ndarray
    material: np.ndarray

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
    return grid


def make_boundaries(planes: Sequence[tuple[Sequence[float], float, float]], device: str) -> Boundaries:
    """Half-spaces ``dot(normal, x) >= offset`` from ``(normal, offset [m], friction)``.

    Raises:
        ValueError: a normal is zero or a friction coefficient negative.
    """
    rows, frictions = [], []
    for normal, offset, friction in planes:
        length = float(np.linalg.norm(normal))
        if not (length > 0.0 and friction >= 0.0):
            raise ValueError(f"bad boundary: normal={normal} must not be zero, friction={friction} not negative")
        rows.append([*(np.asarray(normal) / length), offset / length])
        frictions.append(friction)
    boundaries = Boundaries()
    boundaries.count = len(rows)
    boundaries.plane = wp.array(np.array(rows or [[0.0, 0.0, 1.0, -1e6]], np.float32), dtype=wp.vec4, device=device)
    boundaries.friction = wp.array(np.array(frictions or [0.0], np.float32), dtype=float, device=device)
    return boundaries


def check_points(points: MaterialPoints, num_envs: int) -> None:
    """Refuse matter without mass and arrays that fit no environment.

    Raises:
        ValueError: a volume or density is not positive, or an array has neither one row nor one an environment.
    """
    for name, array in vars(points).items():
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
    planes: Sequence[tuple[Sequence[float], float, float]] = (),
) -> Model:
    """Constants of a simulation on ``device``.

    ``num_substeps`` is chosen from the CFL limit unless given.

    Raises:
        ValueError: bad material, unstable time step, or more memory than the device has.
    """
    if decoupling not in DECOUPLING:
        raise ValueError(f"unknown decoupling {decoupling!r}; use one of {', '.join(DECOUPLING)}")
    check_points(points, num_envs)
    sound_speed = points.sound_speed()
    if num_substeps is None:
        num_substeps = choose_num_substeps(control_dt, grid.dx, sound_speed, cfl)
    check_num_substeps(num_substeps, control_dt, grid.dx, sound_speed)
    mu, lam = lame_parameters(points.young_modulus, points.poisson_ratio)
    num_particles = points.volume.shape[1]
    nodes = int(np.prod(np.asarray(grid.nodes)))
    check_memory(num_envs, num_particles, nodes, device)

    particles = Particles()
    for name, value in (("mass", points.volume * points.density), ("volume", points.volume), ("mu", mu), ("lam", lam)):
        setattr(particles, name, wp.array(np.ascontiguousarray(value, np.float32), dtype=float, device=device))
    particles.material = wp.array(np.ascontiguousarray(points.material, np.int32), dtype=int, device=device)
    step = Step()
    step.dt = control_dt / num_substeps
    step.gravity = wp.vec3(*gravity)
    step.decoupling = DECOUPLING[decoupling]
    return Model(
        num_envs=num_envs,
        num_particles=num_particles,
        device=device,
        grid=grid,
        step=step,
        particles=particles,
        boundaries=make_boundaries(planes, device),
        num_substeps=num_substeps,
        control_dt=control_dt,
        sound_speed=sound_speed,
    )


def estimate_bytes(num_envs: int, num_particles: int, num_nodes: int) -> int:
    """Device memory of state and scratch [bytes]: 108 B a particle, 78 B a node."""
    return num_envs * (num_particles * (3 * 12 + 2 * 36) + num_nodes * (2 * 32 + 12 + 2))


def check_memory(num_envs: int, num_particles: int, num_nodes: int, device: str) -> None:
    """Refuse a batch that does not fit.

    Raises:
        ValueError: the estimate exceeds the free memory of a CUDA device.
    """
    target = wp.get_device(device)
    if not target.is_cuda:
        return
    need = estimate_bytes(num_envs, num_particles, num_nodes)
    if need > target.free_memory:
        fits = int(num_envs * target.free_memory / need)
        raise ValueError(
            f"{num_envs} environments need {need / 2**30:.1f} GiB, {target} has {target.free_memory / 2**30:.1f} GiB "
            f"free; use num_envs <= {fits} or a coarser fidelity"
        )


def allocate(model: Model) -> tuple[State, Scratch]:
    """Zeroed state (identity deformation) and scratch."""
    particles, nodes = (model.num_envs, model.num_particles), (model.num_envs, model.num_nodes)

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
        node_sum=zeros(nodes, vec8),
        node_offset=zeros(nodes, wp.vec3),
        node_velocity=zeros(nodes, vec8),
        block_active=zeros((2, model.num_envs, model.num_blocks), wp.int8),
        boundary_impulse=zeros(model.num_envs, wp.vec3),
    )
    return state, scratch
