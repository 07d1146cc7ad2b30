"""Model of a simulation: velocity fields, material points, grid, time step and path, from NumPy to the device."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import warp as wp

from piavatar_envs.mpm.bspline import BLOCK
from piavatar_envs.mpm.colliders import Collider, make_boundaries
from piavatar_envs.mpm.cuda.block_grid import MOST_LISTED, MOST_PARTICLES, largest_partition, suits_block_path
from piavatar_envs.mpm.cuda.tiled_p2g import plan_tiles
from piavatar_envs.mpm.materials import lame_parameters, material_index
from piavatar_envs.mpm.memory import bound_active_blocks, check_memory, choose_activation_interval
from piavatar_envs.mpm.retention import retained_share
from piavatar_envs.mpm.thin_colliders import thin_colliders
from piavatar_envs.mpm.types import (
    CFL_STABLE,
    DECOUPLING,
    PATHS,
    Contact,
    Grid,
    Model,
    Particles,
    Step,
)

wp.set_module_options({"enable_backward": False})


#: Most velocity fields: one bit of an int32 each, without the sign.
MAX_FIELDS = 31
#: Gap between the surfaces of two bodies below which they are in contact [grid spacings].
BODY_CONTACT_GATE = 0.15


@dataclass(frozen=True)
class Fields:
    """Velocity fields of a world; the default is a single body.

    Attributes:
        subject: subject of each field, counted from 0, the fields of a subject next to each other, its trunk first.
        friction: Coulomb coefficient of every pair of fields, shape ``(F, F)`` or one number.
        density: reference density of each field's matter [kg/m^3], shape ``(F,)`` or one number.
        gate: gap between the surfaces of two fields below which they are in contact [grid spacings]; from 3 on any.
        normals: ``"shared"`` (one normal a pair) or ``"own"`` (the paper's rule, which loses momentum).
        num_sensors: rows of the contact sensor that particles refer to.
        apart: fields that never merge with the trunk of their subject, such as garments; their density is their own.
    """

    subject: Sequence[int] = (0,)
    friction: np.ndarray | float = 0.0
    density: np.ndarray | float = 1000.0
    gate: float = BODY_CONTACT_GATE
    normals: str = "shared"
    num_sensors: int = 0
    apart: Sequence[int] = ()

    @property
    def num_fields(self) -> int:
        """Number of velocity fields."""
        return len(self.subject)

    @property
    def num_subjects(self) -> int:
        """Number of subjects."""
        return max(self.subject) + 1

    def check(self) -> None:
        """Check subjects, coefficients and densities.

        Raises:
            ValueError: too many fields, subjects out of order, a negative friction, an unknown rule for normals, or
                fields of one subject with different reference densities.
        """
        if self.num_fields > MAX_FIELDS:
            raise ValueError(
                f"{self.num_fields} velocity fields exceed {MAX_FIELDS}; use fewer subjects, or self_contact=False"
            )
        steps = np.diff(np.array([-1, *self.subject]))
        if not np.isin(steps, (0, 1)).all() or self.subject[0] != 0:
            raise ValueError(f"subjects of the fields {list(self.subject)} must be 0, 1, ... in order")
        if not np.all(np.asarray(self.friction) >= 0.0):
            raise ValueError(f"friction={np.min(self.friction):g} between bodies must not be negative")
        density = np.broadcast_to(np.asarray(self.density, float), (self.num_fields,))
        merging = ~np.isin(np.arange(self.num_fields), self.apart)
        for subject in range(self.num_subjects):
            own = density[(np.array(self.subject) == subject) & merging]
            if np.ptp(own) > 0.0:
                raise ValueError(
                    f"density={own.tolist()} of the fields of subject {subject}: fields that grow together share one "
                    f"reference density"
                )
        if self.normals not in ("shared", "own"):
            raise ValueError(f"normals={self.normals!r} must be 'shared' or 'own'")
        if not (np.isfinite(self.gate) and self.gate >= 0.0):
            raise ValueError(f"gate={self.gate} must be a gap of at least 0 grid spacings")

    def upload(self, dx: float, rows: int, device: str) -> Contact:
        """Return the kernel argument, with ``rows`` (1 or ``num_envs``) copies of densities and coefficients.

        Raises:
            ValueError: see :meth:`check`.
        """
        self.check()
        count = self.num_fields
        friction = np.broadcast_to(np.asarray(self.friction, np.float32), (rows, count, count)).reshape(rows, -1)
        density = np.broadcast_to(np.asarray(self.density, np.float32), (rows, count))
        contact = Contact()
        contact.num_fields, contact.num_subjects = count, self.num_subjects
        contact.own_normals = int(self.normals == "own")
        contact.gate = self.gate * dx
        trunk = [self.subject.index(subject) for subject in self.subject]
        contact.subject = wp.array(np.array(self.subject, np.int32), dtype=int, device=device)
        contact.trunk = wp.array(np.array(trunk, np.int32), dtype=int, device=device)
        contact.friction = wp.array(np.ascontiguousarray(friction), dtype=float, device=device)
        contact.density = wp.array(np.ascontiguousarray(density), dtype=float, device=device)
        return contact


@dataclass(frozen=True)
class MaterialPoints:
    """Matter to simulate, in NumPy. Arrays have shape ``(1 or num_envs, num_particles)`` unless stated otherwise.

    Attributes:
        volume: rest volume [m^3].
        density: rest density [kg/m^3].
        young_modulus: Young's modulus [Pa].
        poisson_ratio: Poisson's ratio.
        material: index of the constitutive model, see :func:`piavatar_envs.mpm.materials.material_index`.
        retardation: viscosity over modulus [s]; zero for all if not given.
        field: velocity field, shape ``(num_particles,)`` int; the first for all if not given.
        seam: 1 where fields of a subject merge, shape ``(num_particles,)``; nowhere if not given.
        sensor: row of the contact sensor, -1 for none, shape ``(num_particles,)`` int; none if not given.
    """

    volume: np.ndarray
    density: np.ndarray
    young_modulus: np.ndarray
    poisson_ratio: np.ndarray
    material: np.ndarray
    retardation: np.ndarray | None = None
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
        retardation: float = 0.0,
    ) -> MaterialPoints:
        """Return points of one material; ``volume`` [m^3] has shape ``([1 or num_envs,] num_particles)``."""
        volume = np.atleast_2d(np.asarray(volume, np.float32))
        one = np.ones((1, volume.shape[1]), np.float32)
        index = np.full(one.shape, material_index(material), np.int32)
        return cls(volume, density * one, young_modulus * one, poisson_ratio * one, index, retardation * one)

    @property
    def fields(self) -> np.ndarray:
        """Velocity field of every particle, shape ``(num_particles,)`` int."""
        return np.zeros(self.num_particles, int) if self.field is None else self.field

    @property
    def retardations(self) -> np.ndarray:
        """Viscosity over modulus of every particle [s], shape ``(1 or num_envs, num_particles)``."""
        return np.zeros((1, self.num_particles)) if self.retardation is None else self.retardation

    @property
    def num_particles(self) -> int:
        """Particles of one environment."""
        return self.volume.shape[1]

    def sound_speed(self) -> float:
        """Return the speed of the fastest elastic wave, ``sqrt((lam + 2 mu) / rho)`` [m/s]."""
        return float(self._sound_speeds().max())

    def fastest(self) -> tuple[int, float]:
        """Return the particle in which elastic waves are fastest, and its Young's modulus [Pa]."""
        speeds = self._sound_speeds()
        row, particle = np.unravel_index(speeds.argmax(), speeds.shape)
        return int(particle), float(np.broadcast_to(self.young_modulus, speeds.shape)[row, particle])

    def limiting_speed(self, dx: float, factor: float = 1.0) -> float:
        """Return the speed of the elastic wave whose limit of the time step is that of viscous matter [m/s].

        It is 0 without viscosity, where :meth:`sound_speed` alone limits the time step.

        Viscosity shortens the limit ``2 / w`` of a mode of frequency ``w`` and damping ratio ``z = w retardation / 2``
        to ``(2 / w) (sqrt(1 + z^2) - z)`` (Belytschko, Liu & Moran, "Nonlinear Finite Elements for Continua and
        Structures", 2000, chapter 6). The fastest mode of the grid is the one that ``CFL_STABLE`` keeps stable.

        Args:
            dx: grid spacing [m].
            factor: on the speeds of elastic waves.
        """
        speed = factor * self._sound_speeds()
        ratio = self.retardations * speed / (CFL_STABLE * dx)
        return float(np.where(ratio > 0.0, speed * (np.sqrt(1.0 + ratio**2) + ratio), 0.0).max())

    def _sound_speeds(self) -> np.ndarray:
        mu, lam = lame_parameters(self.young_modulus, self.poisson_ratio)
        return np.sqrt((lam + 2.0 * mu) / self.density)


def choose_num_substeps(control_dt: float, dx: float, sound_speed: float, cfl: float = 0.5) -> int:
    """Return the fewest substeps per control step with ``sound_speed * dt <= cfl * dx``."""
    return max(1, math.ceil(control_dt * sound_speed / (cfl * dx) - 1.0e-9))


def check_num_substeps(
    num_substeps: int, control_dt: float, dx: float, sound_speed: float, limiting_speed: float = 0.0
) -> None:
    """Check the stability of the time step.

    Args:
        num_substeps: substeps of a control step.
        control_dt: control step [s].
        dx: grid spacing [m].
        sound_speed: fastest elastic wave [m/s].
        limiting_speed: that of :meth:`MaterialPoints.limiting_speed`; 0 for matter without viscosity [m/s].

    Raises:
        ValueError: there is no substep, or ``sound_speed * dt / dx``, or the same with the limiting speed, exceeds the
            largest stable value.
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
    if dt * limiting_speed > CFL_STABLE * dx:
        limit = CFL_STABLE * dx / limiting_speed
        raise ValueError(
            f"sim_dt={dt:.3g} s exceeds the limit {limit:.3g} s of matter of this viscosity (dx={dx:.3g} m); use "
            f"num_substeps >= {choose_num_substeps(control_dt, dx, limiting_speed, CFL_STABLE)}, or less viscosity"
        )


def make_grid(lower: Sequence[float], upper: Sequence[float], dx: float) -> Grid:
    """Return a grid in which particles may move freely in the box ``lower`` to ``upper`` [m].

    Raises:
        ValueError: the box is empty, or has more nodes than 32-bit indices address with a margin.
    """
    lower, upper = np.asarray(lower, float), np.asarray(upper, float)
    if not (np.all(np.isfinite([lower, upper])) and np.all(upper > lower) and dx > 0.0):
        raise ValueError(f"empty domain: lower={lower.tolist()}, upper={upper.tolist()} m, dx={dx} m")
    nodes = np.ceil((upper - lower) / dx).astype(int) + 4  # two nodes of margin for the stencil on each side
    if nodes.prod() >= 2**30:
        raise ValueError(f"{nodes.prod():.3g} grid nodes exceed 2^30; use a dx larger than {dx} m or a smaller domain")
    grid = Grid()
    grid.origin = wp.vec3(*(lower - 2.0 * dx))
    grid.dx, grid.inv_dx = dx, 1.0 / dx
    grid.nodes = wp.vec3i(*nodes.tolist())
    grid.blocks = wp.vec3i(*(-(-nodes // BLOCK)).tolist())
    grid.num_blocks = int(np.prod(-(-nodes // BLOCK)))
    return grid


def check_points(points: MaterialPoints, num_envs: int, fields: Fields) -> None:
    """Check volumes, densities, fields and the number of rows.

    Raises:
        ValueError: a volume or density is not positive, an array has neither one row nor one per environment, or a
            particle refers to a velocity field that does not exist.
    """
    if points.field is not None and not (points.field.min() >= 0 and points.field.max() < fields.num_fields):
        raise ValueError(f"field={points.field.max()} of a particle: there are {fields.num_fields} velocity fields")
    for name in ("volume", "density", "young_modulus", "poisson_ratio", "material", "retardations"):
        array = getattr(points, name)
        if len(array) not in (1, num_envs):
            raise ValueError(f"{name} has {len(array)} rows; give it 1 or {num_envs}, one per environment")
    for name, array in (("volume", points.volume), ("density", points.density)):
        bad = array[~(array > 0.0)]
        if bad.size:
            raise ValueError(f"{name}={bad[0]:g} must be positive: a particle without mass cannot move")
    bad = points.retardations[~(points.retardations >= 0.0)]
    if bad.size:
        raise ValueError(f"retardation={bad[0]:g} s must not be negative: viscosity cannot add energy")


def build_model(
    points: MaterialPoints,
    grid: Grid,
    *,
    num_envs: int = 1,
    device: str = "cpu",
    control_dt: float = 1.0 / 30.0,
    num_substeps: int | None = None,
    reference_substeps: int | None = None,
    cfl: float = 0.5,
    gravity: Sequence[float] = (0.0, 0.0, -9.81),
    decoupling: str = "split",
    colliders: Sequence[Collider] = (),
    fields: Fields | None = None,
    sound_speed: float | None = None,
    limiting_speed: float | None = None,
    max_active_blocks: int | None = None,
    rest: np.ndarray | None = None,
    path: str | None = None,
    more_bytes: int = 0,
) -> Model:
    """Return the constants of a simulation on ``device``.

    Args:
        points: matter.
        grid: background grid.
        control_dt: control step [s].
        num_envs: environments.
        device: Warp device.
        gravity: [m/s^2].
        colliders: analytic colliders.
        fields: velocity fields; a single body if not given.
        decoupling: a key of ``DECOUPLING``.
        num_substeps: substeps of a control step; from the CFL limit if not given.
        reference_substeps: substeps whose damping of short waves further substeps keep, see
            :mod:`piavatar_envs.mpm.retention`; each substep damps them if not given.
        cfl: Courant number ``c dt / dx`` of that choice.
        sound_speed: elastic wave speed to design for [m/s], where parameters will be randomised.
        limiting_speed: speed of :meth:`MaterialPoints.limiting_speed` to design for, likewise [m/s].
        max_active_blocks: most active blocks of an environment, over all fields; enough for any state if not given.
        rest: positions at rest [m], shape ``(P, 3)``, from which tiles of large bodies are made compact.
        path: one of ``PATHS``; if not given, ``"block"`` on a GPU whose shared memory holds an environment's grid, else
            ``"tiled"`` on a GPU of compute capability 7.0 or more, else ``"plain"``.
        more_bytes: memory that an environment needs besides, which must be free as well.

    Raises:
        ValueError: bad material, unstable time step, a path that the device does not support, or too little memory.
    """
    if decoupling not in DECOUPLING:
        raise ValueError(f"unknown decoupling {decoupling!r}; use one of {', '.join(DECOUPLING)}")
    fields = fields or Fields()
    check_points(points, num_envs, fields)
    sound_speed = max(points.sound_speed(), sound_speed or 0.0)
    limiting_speed = max(points.limiting_speed(grid.dx), limiting_speed or 0.0)
    if num_substeps is None:
        num_substeps = choose_num_substeps(
            control_dt, grid.dx, max(sound_speed, cfl / CFL_STABLE * limiting_speed), cfl
        )
    check_num_substeps(num_substeps, control_dt, grid.dx, sound_speed, limiting_speed)
    mu, lam = lame_parameters(points.young_modulus, points.poisson_ratio)
    max_active_blocks = bound_active_blocks(max_active_blocks, points.fields, grid, fields.num_fields)
    path = choose_path(path, device, points.fields, max_active_blocks, decoupling)
    layout = max_active_blocks, device, fields.num_fields, grid.num_blocks, path
    share = retained_shares(points.fields, fields, num_substeps, reference_substeps, decoupling)
    if share is not None:
        more_bytes += 48 * points.num_particles
    check_memory(num_envs, points.num_particles, *layout, more_bytes=more_bytes)
    thin = thin_colliders(colliders, grid.dx)
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
        particles=upload_points(points, mu, lam, rest if path == "tiled" else None, grid.dx, device),
        boundaries=make_boundaries(colliders, fields.num_fields, num_envs, device),
        contact=fields.upload(grid.dx, num_envs, device),
        num_substeps=num_substeps,
        reference_substeps=reference_substeps,
        control_dt=control_dt,
        sound_speed=sound_speed,
        moving_boundaries=any(collider.moves or collider.kinematic for collider in colliders),
        num_sensors=fields.num_sensors,
        max_active_blocks=max_active_blocks,
        activation_interval=choose_activation_interval(path, points.fields),
        path=path,
        thin_colliders=wp.array(thin, dtype=int, device=device) if thin else None,
        retained_share=None if share is None else wp.array(share, dtype=float, device=device),
    )


def retained_shares(
    field: np.ndarray, fields: Fields, num_substeps: int, reference: int | None, decoupling: str
) -> np.ndarray | None:
    """Return the share that particles of velocity fields ``field`` retain, shape ``(num_particles,)``; None for none.

    Substeps beyond the ``reference`` retain it, with the ``"split"`` decoupling. Fields apart, such as garments, retain
    nothing.
    """
    if reference is None or num_substeps <= reference or decoupling != "split":
        return None
    share = retained_share(num_substeps / reference)
    return np.where(np.isin(field, fields.apart), 0.0, share).astype(np.float32)


def choose_path(path: str | None, device: str, field: np.ndarray, max_active_blocks: int, decoupling: str) -> str:
    """Return the path of P2G and G2P for particles of velocity fields ``field`` on a device.

    Raises:
        ValueError: the path does not exist, or not on this device or for that size.
    """
    target = wp.get_device(device)
    matches = target.is_cuda and target.arch >= 70
    # the block path has no gradient of the kinematic velocity
    fits = decoupling != "paper" and suits_block_path(device, field, max_active_blocks)
    if path is None:
        return "block" if fits else "tiled" if matches else "plain"
    if path not in PATHS:
        raise ValueError(f"unknown path {path!r}; use one of {', '.join(PATHS)}")
    if path != "plain" and not matches:
        raise ValueError(f"path={path!r} needs a GPU of compute capability 7.0 or more; {target} takes 'plain'")
    if path == "block" and not fits:
        raise ValueError(
            f"path='block' needs a GPU with 227 KiB of shared memory a CUDA block, at most {MOST_PARTICLES} "
            f"particles per body (here {largest_partition(field)}), {MOST_LISTED} in all ({len(field)}), few active "
            f"blocks ({max_active_blocks}) and another decoupling than 'paper' ({decoupling!r}); {target} takes "
            f"{('tiled' if matches else 'plain')!r}"
        )
    return path


def upload_points(
    points: MaterialPoints, mu: np.ndarray, lam: np.ndarray, rest: np.ndarray | None, dx: float, device: str
) -> Particles:
    """Upload per-particle constants; ``rest`` and ``dx`` as for :func:`piavatar_envs.mpm.cuda.tiled_p2g.plan_tiles`."""
    particles, count = Particles(), points.num_particles

    def upload(value, dtype):
        scalar = np.int32 if dtype is int else np.float32
        return wp.array(np.ascontiguousarray(value, scalar), dtype=dtype, device=device)

    mass = points.volume * points.density
    particles.mass = upload(mass, float)
    particles.share = upload(mass[0] / mass[0].sum(), float)
    particles.volume, particles.mu, particles.lam = upload(points.volume, float), upload(mu, float), upload(lam, float)
    particles.retardation = upload(points.retardations, float)
    particles.material = upload(points.material, int)
    particles.field = upload(points.fields, int)
    particles.tiles = wp.array(plan_tiles(points.fields, rest, dx), dtype=wp.vec2i, device=device)
    particles.seam = upload(np.zeros(count) if points.seam is None else points.seam, float)
    particles.sensor = upload(np.full(count, -1) if points.sensor is None else points.sensor, int)
    return particles
