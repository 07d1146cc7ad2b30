"""Soft props of a world: their particles and matter, their motion after a reset, and their tracked rigid motion."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
import warp as wp
from scipy.spatial.transform import Rotation

from piavatar_envs.avatar.tracking import fit_moments, kabsch_rotation, moments_of
from piavatar_envs.config import ColliderConfig, ConfigError, PhysicsConfig, PropConfig
from piavatar_envs.config.schema import LEAST_DENSITY, MOST_DENSITY
from piavatar_envs.core.arrays import store_matrix, vec16
from piavatar_envs.core.launch_graph import LaunchGraph
from piavatar_envs.mpm.materials import lame_parameters, retardation_time
from piavatar_envs.mpm.model import MaterialPoints
from piavatar_envs.mpm.types import Kinematic, Model, Particles, State, row
from piavatar_envs.sim import prop_geometry as geometry
from piavatar_envs.sim.prop_geometry import PropPoints

wp.set_module_options({"enable_backward": False})


def prop_points(prop: PropConfig, spacing: float) -> PropPoints:
    """Fill a prop's solid with particles of this ``spacing`` [m].

    Raises:
        ConfigError: the size or the file does not fit the shape, or the solid is too thin.
    """
    sizes = {"sphere": 1, "box": 3, "capsule": 2, "mesh": 1}
    if len(prop.size) != sizes[prop.shape]:
        raise ConfigError(
            f"prop {prop.name}: size={list(prop.size)} must be {sizes[prop.shape]} numbers for a {prop.shape}"
        )
    if prop.file is not None and prop.shape != "mesh":
        raise ConfigError(f"prop {prop.name}: file={prop.file!r} is for shape='mesh', not {prop.shape!r}")
    try:
        if prop.shape == "mesh":
            if prop.file is None:
                raise ValueError("shape='mesh' needs a file")
            return geometry.mesh(prop.file, spacing, scale=prop.size[0])
        if prop.shape == "box":
            return geometry.box(prop.size, spacing)
        return getattr(geometry, prop.shape)(*prop.size, spacing)
    except (ValueError, OSError) as error:
        raise ConfigError(f"prop {prop.name}: {error}") from None


def prop_matter(prop: PropConfig, points: PropPoints, physics: PhysicsConfig) -> MaterialPoints:
    """Return the matter of a prop; without a configured modulus its waves are as fast as the flesh's.

    Raises:
        ConfigError: the mass is too small or too great for the size.
    """
    volume = float(points.volume.sum())
    density = prop.density if prop.mass is None else prop.mass / volume
    if not LEAST_DENSITY <= density <= MOST_DENSITY:
        raise ConfigError(
            f"prop {prop.name!r}: mass={prop.mass:.3g} kg in {volume:.3g} m^3 is a density of {density:.3g} kg/m^3, "
            f"which must be in [{LEAST_DENSITY:g}, {MOST_DENSITY:g}]; use a mass in "
            f"[{LEAST_DENSITY * volume:.3g}, {MOST_DENSITY * volume:.3g}] kg, or another size"
        )
    young = prop.young_modulus
    if young is None:
        # equal P-wave modulus over density
        young = physics.young_modulus * density / physics.density
        young *= _wave_factor(physics.poisson_ratio) / _wave_factor(prop.poisson_ratio)
    mu, _ = lame_parameters(young, prop.poisson_ratio)
    retardation = float(retardation_time(prop.viscosity, prop.damping_ratio, mu))
    return MaterialPoints.uniform(points.volume, density, young, prop.poisson_ratio, prop.material, retardation)


def _wave_factor(poisson_ratio: float) -> float:
    """Return the P-wave modulus over Young's modulus."""
    return (1.0 - poisson_ratio) / ((1.0 + poisson_ratio) * (1.0 - 2.0 * poisson_ratio))


def turn_of(config: PropConfig | ColliderConfig) -> Rotation:
    """Return the initial rotation of a prop or collider."""
    return Rotation.from_quat(np.roll(config.rotation, -1))


@wp.struct
class Prop:
    """Constants of a prop, whose particles are ``first ... first + count`` of each environment."""

    first: int
    count: int
    rest: wp.array(dtype=wp.vec3)  # (count,) about the centre of mass [m]


@wp.struct
class PropMatter:
    """Matter of a prop at its nominal density."""

    density: float  # [kg/m^3]
    mu: float  # shear modulus [Pa]
    lam: float  # first Lame parameter [Pa]


def upload_prop(points: PropPoints, first: int, device: str) -> Prop:
    """Upload the constants of a prop whose particles begin at index ``first``."""
    prop = Prop()
    prop.first, prop.count = int(first), len(points.rest)
    prop.rest = wp.array(points.rest, dtype=wp.vec3, device=device)
    return prop


def nominal_matter(matter: MaterialPoints) -> PropMatter:
    """Return the nominal density and moduli of a prop."""
    nominal = PropMatter()
    nominal.density = float(matter.density[0, 0])
    mu, lam = lame_parameters(matter.young_modulus[0, 0], matter.poisson_ratio[0, 0])
    nominal.mu, nominal.lam = float(mu), float(lam)
    return nominal


@dataclass
class PropState:
    """Tracked props: live arrays, each of shape ``(num_envs, num_props)``; quaternions are Warp's ``xyzw``."""

    position: wp.array  # centre of mass [m]
    rotation: wp.array  # rest frame to world
    velocity: wp.array  # of the centre of mass [m/s]
    spin: wp.array  # angular velocity [rad/s]
    deformation: wp.array  # root mean square distance of the matter from the fitted rest shape [m]

    @classmethod
    def allocate(cls, num_envs: int, num_props: int, device: str) -> PropState:
        """Allocate props at the origin and at rest."""
        shape = (num_envs, num_props)
        upright = np.tile(np.array([0.0, 0.0, 0.0, 1.0], np.float32), (*shape, 1))
        return cls(
            position=wp.zeros(shape, dtype=wp.vec3, device=device),
            rotation=wp.array(upright, dtype=wp.quat, shape=shape, device=device),
            velocity=wp.zeros(shape, dtype=wp.vec3, device=device),
            spin=wp.zeros(shape, dtype=wp.vec3, device=device),
            deformation=wp.zeros(shape, dtype=float, device=device),
        )

    def numpy(self) -> dict[str, np.ndarray]:
        """Return copies of all arrays on the host."""
        return {field.name: getattr(self, field.name).numpy().copy() for field in fields(self)}

    def assign(self, configs: Sequence[PropConfig]) -> None:
        """Set the configured motion of the props in every environment."""
        if not configs:
            return
        turns = np.array([config.rotation for config in configs], np.float64)
        turns = np.roll(turns / np.linalg.norm(turns, axis=1, keepdims=True), -1, axis=1)
        motion = {name: [getattr(config, name) for config in configs] for name in ("position", "velocity", "spin")}
        for name, values in (motion | {"rotation": turns}).items():
            array = getattr(self, name)
            array.assign(np.repeat(np.array(values, np.float32)[None], len(array), 0))


class PropSet:
    """Props of every environment; arrays are ``(num_envs, num_props)``, quaternions Warp's ``xyzw``.

    Attributes:
        names: of the props.
        points: their particles (NumPy).
        state: their tracked rigid motion, updated by :meth:`record_tracking`.
        initial: their motion after a reset: the scene's, until the reset of a task overwrites it.
        density: their density after a reset [kg/m^3], likewise.
        mass: mass of each at its density in the scene [kg].
        volume: volume of each [m^3].
    """

    def __init__(
        self,
        configs: Sequence[PropConfig],
        points: Sequence[PropPoints],
        matter: Sequence[MaterialPoints],
        first: Sequence[int],
        fields_of: Sequence[int],
        model: Model,
    ) -> None:
        """Upload the constants of the props.

        Args:
            configs: settings of each prop.
            points: particles of each.
            matter: matter of each.
            first: index of the first particle of each.
            fields_of: velocity field of each.
            model: constants of the world.
        """
        self.names = tuple(config.name for config in configs)
        self.points, self.model, self.fields_of = tuple(points), model, tuple(fields_of)
        n, device = model.num_envs, model.device
        self.props = [upload_prop(own, begin, device) for own, begin in zip(points, first, strict=True)]
        self.matter = [nominal_matter(own) for own in matter]
        self.volume = np.array([float(own.volume.sum()) for own in points])
        self.mass = np.array([m.density * own.volume.sum() for m, own in zip(self.matter, points, strict=True)])
        density = np.array([[m.density for m in self.matter] or [1.0]], np.float32)
        self.density = wp.array(np.repeat(density, n, 0), dtype=float, device=device)
        self.state = PropState.allocate(n, max(1, len(configs)), device)
        self.initial = PropState.allocate(n, max(1, len(configs)), device)
        self.initial.assign(configs)

    def __len__(self) -> int:
        return len(self.names)

    def index(self, name: str) -> int:
        """Return the column of the prop ``name``.

        Raises:
            ValueError: there is no such prop.
        """
        if name not in self.names:
            raise ValueError(f"there is no prop {name!r}; use one of {', '.join(self.names) or 'none'}")
        return self.names.index(name)

    def record_reset(self, graph: LaunchGraph, state: State, mask: wp.array) -> None:
        """Record the launches that set density and motion of the masked environments' props."""
        for index in range(len(self.props)):
            self.record_density(graph, mask, index)
            self.record_place(graph, state, mask, index)

    def record_density(self, graph: LaunchGraph, mask: wp.array, index: int) -> None:
        """Record the launches that give prop ``index`` of the masked environments the mass of its density."""
        prop, particles, n = self.props[index], self.model.particles, self.model.num_envs
        density = self.density[:, index]
        inputs = [mask, prop, density, self.matter[index], particles.volume]
        graph.launch(scale_density, (n, prop.count), inputs, [particles.mass, particles.mu, particles.lam])
        graph.launch(copy_masked, n, [mask, density], [self.model.contact.density[:, self.fields_of[index]]])

    def record_place(
        self, graph: LaunchGraph, state: State, mask: wp.array, index: int, start: PropState | None = None
    ) -> None:
        """Record the launch that sets prop ``index`` of the masked environments in motion, unstrained.

        Within an episode, before the physics of a step, this throws a prop or removes it from play.

        Args:
            graph: to append to.
            state: of the particles.
            mask: environments in which it is placed.
            index: of the prop.
            start: its motion; that after a reset if not given.
        """
        prop, start = self.props[index], start or self.initial
        graph.launch(
            place_prop,
            (self.model.num_envs, prop.count),
            [mask, prop, index, start.position, start.rotation, start.velocity, start.spin],
            [state.x, state.u, state.C, state.F, state.kinematic],
        )

    def record_tracking(self, graph: LaunchGraph, state: State) -> None:
        """Record the launches that fit a rigid motion to the particles of each prop."""
        s = self.state
        for index, prop in enumerate(self.props):
            graph.launch(
                track_prop,
                self.model.num_envs,
                [prop, index, self.model.particles, state.x, state.u, state.vk, state.failure],
                [s.position, s.rotation, s.velocity, s.spin, s.deformation],
            )

    def arrays(self) -> dict[str, wp.array]:
        """Return the arrays of a checkpoint by name; empty without props."""
        if not self.names:
            return {}
        found = {f"props.{field.name}": getattr(self.state, field.name) for field in fields(self.state)}
        found["props.density"] = self.density
        found["contact.density"] = self.model.contact.density
        return found | {f"matter.{name}": getattr(self.model.particles, name) for name in ("mass", "mu", "lam")}


@wp.kernel
def place_prop(
    mask: wp.array(dtype=wp.bool),
    prop: Prop,
    index: int,
    position: wp.array2d(dtype=wp.vec3),
    rotation: wp.array2d(dtype=wp.quat),
    velocity: wp.array2d(dtype=wp.vec3),
    spin: wp.array2d(dtype=wp.vec3),
    # out
    x: wp.array2d(dtype=wp.vec3),
    u: wp.array2d(dtype=wp.vec3),
    C: wp.array3d(dtype=float),
    F: wp.array3d(dtype=float),
    driven: Kinematic,
):
    """Set prop ``index`` of the masked environments in rigid motion, unstrained; over ``(num_envs, count)``.

    Materials are isotropic, so the deformation gradient of a turned prop can be the identity.
    """
    e, p = wp.tid()
    if not mask[e]:
        return
    arm = wp.quat_rotate(rotation[e, index], prop.rest[p])
    q = prop.first + p
    x[e, q] = position[e, index] + arm
    u[e, q] = velocity[e, index] + wp.cross(spin[e, index], arm)
    store_matrix(C, e, q, wp.skew(spin[e, index]))
    store_matrix(F, e, q, wp.identity(n=3, dtype=float))
    driven.vk[e, q] = wp.vec3(0.0)
    driven.spin[e, q] = wp.vec3(0.0)


@wp.func
def add_moments(
    prop: Prop,
    particles: Particles,
    x: wp.array2d(dtype=wp.vec3),
    u: wp.array2d(dtype=wp.vec3),
    vk: wp.array2d(dtype=wp.vec3),
    e: int,
    share: int,
    shares: int,
):
    """Sum moments and the correlation with the rest shape over one of ``shares`` of a prop's particles.

    Both are about the prop's first particle and relative to its velocity, because sums about the world's origin, or of
    the velocity of a fast prop, lose more digits.
    """
    r = row(e, particles.mass.shape[0])
    origin = x[e, prop.first]
    base = u[e, prop.first] + vk[e, prop.first]
    moments = vec16()
    correlation = wp.mat33()
    for p in range(share, prop.count, shares):
        q = prop.first + p
        m = particles.mass[r, q]
        d = x[e, q] - origin
        moments += moments_of(m, d, u[e, q] + vk[e, q] - base)
        correlation += m * wp.outer(d, prop.rest[p])
    return moments, correlation


@wp.func
def fit_prop(
    prop: Prop,
    x: wp.array2d(dtype=wp.vec3),
    u: wp.array2d(dtype=wp.vec3),
    vk: wp.array2d(dtype=wp.vec3),
    e: int,
    moments: vec16,
):
    """Return the rigid motion of a prop in the world, by its ``moments`` of :func:`add_moments`."""
    motion = fit_moments(moments)
    motion.center += x[e, prop.first]
    motion.velocity += u[e, prop.first] + vk[e, prop.first]
    return motion


@wp.kernel
def track_prop(
    prop: Prop,
    index: int,
    particles: Particles,
    x: wp.array2d(dtype=wp.vec3),
    u: wp.array2d(dtype=wp.vec3),
    vk: wp.array2d(dtype=wp.vec3),
    failure: wp.array(dtype=int),
    # out
    position: wp.array2d(dtype=wp.vec3),
    rotation: wp.array2d(dtype=wp.quat),
    velocity: wp.array2d(dtype=wp.vec3),
    spin: wp.array2d(dtype=wp.vec3),
    deformation: wp.array2d(dtype=float),
):
    """Fit a rigid motion to prop ``index``, weighted by mass; over ``(num_envs,)``.

    A failed environment keeps its last fit. One thread sums in order, so that the result is reproducible.
    """
    e = wp.tid()
    if failure[e] != 0:
        return
    moments, correlation = add_moments(prop, particles, x, u, vk, e, 0, 1)
    motion = fit_prop(prop, x, u, vk, e, moments)
    c = motion.center
    R = kabsch_rotation(correlation)
    r = row(e, particles.mass.shape[0])
    square = float(0.0)
    for p in range(prop.count):
        q = prop.first + p
        square += particles.mass[r, q] * wp.length_sq(x[e, q] - c - R * prop.rest[p])
    position[e, index] = c
    rotation[e, index] = wp.normalize(wp.quat_from_matrix(R))
    velocity[e, index] = motion.velocity
    spin[e, index] = motion.spin
    deformation[e, index] = wp.sqrt(square / motion.mass)


@wp.kernel
def scale_density(
    mask: wp.array(dtype=wp.bool),
    prop: Prop,
    density: wp.array(dtype=float),
    matter: PropMatter,
    volume: wp.array2d(dtype=float),
    # out
    mass: wp.array2d(dtype=float),
    mu: wp.array2d(dtype=float),
    lam: wp.array2d(dtype=float),
):
    """Set the density ``(num_envs,)`` [kg/m^3] of a prop in the masked environments; over ``(num_envs, count)``.

    Moduli and viscosity scale with density, which keeps the wave speed ``sqrt((lam + 2 mu) / rho)``, damping ratios and
    thus the largest stable time step. ``mass``, ``mu`` and ``lam`` need a row for every environment.
    """
    e, p = wp.tid()
    if not mask[e]:
        return
    q = prop.first + p
    ratio = density[e] / matter.density
    mass[e, q] = density[e] * volume[row(e, volume.shape[0]), q]
    mu[e, q] = ratio * matter.mu
    lam[e, q] = ratio * matter.lam


@wp.kernel
def copy_masked(
    mask: wp.array(dtype=wp.bool),
    value: wp.array(dtype=float),
    # out
    target: wp.array(dtype=float),
):
    """Copy the values of the masked environments; over ``(num_envs,)``."""
    e = wp.tid()
    if mask[e]:
        target[e] = value[e]
