"""A soft prop among the particles: placed at reset, tracked as the rigid body it nearly is, made lighter or heavier.

The soft props of a world: where they start, how heavy they are, where they are now.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from itertools import permutations

import numpy as np
import warp as wp
from scipy.spatial.transform import Rotation

from piavatar_envs.avatar.tracking import kabsch_rotation, point_inertia, spin_of
from piavatar_envs.config import ColliderConfig, ConfigError, PropConfig
from piavatar_envs.core.arrays import store_matrix
from piavatar_envs.core.launch_graph import LaunchGraph
from piavatar_envs.mpm.materials import lame_parameters
from piavatar_envs.mpm.model import MaterialPoints
from piavatar_envs.mpm.types import Kinematic, Model, Particles, State, row
from piavatar_envs.sim.prop_geometry import PropPoints
from piavatar_envs.sim.scene import Domain

wp.set_module_options({"enable_backward": False})


@wp.struct
class Prop:
    """Constants of one prop, which occupies particles ``first ... first + count`` of each environment."""

    first: int
    count: int
    rest: wp.array(dtype=wp.vec3)  # (count,) about the centre of mass [m]


@wp.struct
class PropMatter:
    """What a prop is made of at its nominal density."""

    density: float  # [kg/m^3]
    mu: float  # shear modulus [Pa]
    lam: float  # first Lame parameter [Pa]


@dataclass
class PropState:
    """Tracked props, each of shape ``(num_envs, num_props)``; quaternions are Warp's ``xyzw``."""

    position: wp.array  # centre of mass [m]
    rotation: wp.array  # rest frame to world
    velocity: wp.array  # of the centre of mass [m/s]
    spin: wp.array  # angular velocity [rad/s]
    deformation: wp.array  # root mean square distance of the matter from the fitted rest shape [m]

    @classmethod
    def allocate(cls, num_envs: int, num_props: int, device: str) -> PropState:
        """At the origin, at rest."""
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
        """A copy of every array on the host."""
        return {field.name: getattr(self, field.name).numpy().copy() for field in fields(self)}


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
    """Particles of prop ``index`` in the masked environments into rigid motion, unstrained; over ``(E, count)``.

    Materials are isotropic, so the deformation gradient of a turned prop may as well be the identity.
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
    """Mass-weighted rigid fit to prop ``index``, over ``(E,)``. A failed environment keeps its last.

    One thread sums in order: the result does not depend on the schedule.
    """
    e = wp.tid()
    if failure[e] != 0:
        return
    r = row(e, particles.mass.shape[0])
    origin = x[e, prop.first]  # sums about a point of the prop lose fewer digits than about the world's origin
    mass = float(0.0)
    mx = wp.vec3()
    mv = wp.vec3()
    for p in range(prop.count):
        q = prop.first + p
        m = particles.mass[r, q]
        mass += m
        mx += m * (x[e, q] - origin)
        mv += m * (u[e, q] + vk[e, q])
    c = origin + mx / mass
    V = mv / mass
    H = wp.mat33()
    I = wp.mat33()
    L = wp.vec3()
    for p in range(prop.count):
        q = prop.first + p
        m = particles.mass[r, q]
        d = x[e, q] - c
        H += m * wp.outer(d, prop.rest[p])
        I += point_inertia(m, d)
        L += m * wp.cross(d, u[e, q] + vk[e, q] - V)
    R = kabsch_rotation(H)
    square = float(0.0)
    for p in range(prop.count):
        q = prop.first + p
        square += particles.mass[r, q] * wp.length_sq(x[e, q] - c - R * prop.rest[p])
    position[e, index] = c
    rotation[e, index] = wp.normalize(wp.quat_from_matrix(R))
    velocity[e, index] = V
    spin[e, index] = spin_of(I, L)
    deformation[e, index] = wp.sqrt(square / mass)


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
    """Give a prop a density ``(E,)`` [kg/m^3] in the masked environments; over ``(E, count)``.

    Its moduli follow, so that the wave speed ``sqrt((lam + 2 mu) / rho)``, and with it the largest stable time step,
    stays. ``mass``, ``mu`` and ``lam`` need a row for every environment.
    """
    e, p = wp.tid()
    if not mask[e]:
        return
    q = prop.first + p
    ratio = density[e] / matter.density
    mass[e, q] = density[e] * volume[row(e, volume.shape[0]), q]
    mu[e, q] = ratio * matter.mu
    lam[e, q] = ratio * matter.lam


#: How far a prop may reach out of the domain when it begins [grid spacings]: the grid holds it, and walls push it back.
OVERLAP = 0.5


class PropSet:
    """Props of every environment; arrays are ``(num_envs, num_props)``, quaternions Warp's ``xyzw``.

    Attributes:
        names: of the props.
        points: their particles (NumPy).
        state: where they are, as Kabsch sees them; recomputed whenever particles have moved.
        spawn: where a reset puts them; the scene's poses, until a task's reset writes others for masked environments.
        density: that a reset gives them [kg/m^3], likewise.
        mass: of each at its density in the scene [kg].
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
        """Upload.

        Args:
            configs: of the props.
            points: their particles.
            matter: their material.
            first: first particle of each.
            fields_of: velocity field of each.
            model: constants of the world.
        """
        self.names = tuple(config.name for config in configs)
        self.points, self.model, self.fields_of = tuple(points), model, tuple(fields_of)
        n, device = model.num_envs, model.device
        self.state = PropState.allocate(n, max(1, len(configs)), device)
        self.spawn = PropState.allocate(n, max(1, len(configs)), device)
        self.props: list[Prop] = []
        self.matter: list[PropMatter] = []
        for index in range(len(configs)):
            prop = Prop()
            prop.first, prop.count = int(first[index]), len(points[index].rest)
            prop.rest = wp.array(points[index].rest, dtype=wp.vec3, device=device)
            self.props.append(prop)
            nominal = PropMatter()
            nominal.density = float(matter[index].density[0, 0])
            mu, lam = lame_parameters(matter[index].young_modulus[0, 0], matter[index].poisson_ratio[0, 0])
            nominal.mu, nominal.lam = float(mu), float(lam)
            self.matter.append(nominal)
        self.mass = np.array([m.density * p.volume.sum() for m, p in zip(self.matter, points, strict=True)])
        self.volume = np.array([float(p.volume.sum()) for p in points])
        density = np.array([[m.density for m in self.matter] or [1.0]], np.float32)
        self.density = wp.array(np.repeat(density, n, 0), dtype=float, device=device)
        for name, pad in (("position", 0.0), ("velocity", 0.0), ("spin", 0.0)):
            rows = np.array([getattr(config, name) for config in configs] or [[pad] * 3], np.float32)
            getattr(self.spawn, name).assign(np.repeat(rows[None], n, 0))
        turns = np.array([config.rotation for config in configs] or [[1.0, 0.0, 0.0, 0.0]], np.float64)
        turns = np.roll(turns / np.linalg.norm(turns, axis=1, keepdims=True), -1, axis=1).astype(np.float32)
        self.spawn.rotation.assign(np.repeat(turns[None], n, 0))

    def __len__(self) -> int:
        return len(self.names)

    def index(self, name: str) -> int:
        """Column of the prop ``name``.

        Raises:
            ValueError: there is no such prop.
        """
        if name not in self.names:
            raise ValueError(f"there is no prop {name!r}; there are {', '.join(self.names) or 'none'}")
        return self.names.index(name)

    def record_reset(self, graph: LaunchGraph, state: State, mask: wp.array) -> None:
        """Append: give the props of the masked environments their density, and put them where ``spawn`` says."""
        particles, n = self.model.particles, self.model.num_envs
        for index, (prop, matter) in enumerate(zip(self.props, self.matter, strict=True)):
            graph.launch(
                scale_density,
                (n, prop.count),
                [mask, prop, self.density[:, index], matter, particles.volume],
                [particles.mass, particles.mu, particles.lam],
            )
            column = self.fields_of[index]
            graph.launch(copy_masked, n, [mask, self.density[:, index]], [self.model.contact.density[:, column]])
            self.record_place(graph, state, mask, index)

    def record_place(self, graph: LaunchGraph, state: State, mask: wp.array, index: int) -> None:
        """Append: put prop ``index`` of the masked environments where ``spawn`` says, unstrained; its matter stays.

        In the middle of an episode, before the physics of a step, this throws or takes away a prop.
        """
        prop, spawn = self.props[index], self.spawn
        graph.launch(
            place_prop,
            (self.model.num_envs, prop.count),
            [mask, prop, index, spawn.position, spawn.rotation, spawn.velocity, spawn.spin],
            [state.x, state.u, state.C, state.F, state.kinematic],
        )

    def record_tracking(self, graph: LaunchGraph, state: State) -> None:
        """Append: track the props as their particles are now."""
        s = self.state
        for index, prop in enumerate(self.props):
            graph.launch(
                track_prop,
                self.model.num_envs,
                [prop, index, self.model.particles, state.x, state.u, state.vk, state.failure],
                [s.position, s.rotation, s.velocity, s.spin, s.deformation],
            )

    def arrays(self) -> dict[str, wp.array]:
        """Arrays of a checkpoint, by name; none without props."""
        if not self.names:
            return {}
        found = {f"props.{field.name}": getattr(self.state, field.name) for field in fields(self.state)}
        found["props.density"] = self.density
        found["contact.density"] = self.model.contact.density
        return found | {f"matter.{name}": getattr(self.model.particles, name) for name in ("mass", "mu", "lam")}


def check_places(
    domain: Domain,
    dx: float,
    configs: Sequence[PropConfig],
    points: Sequence[PropPoints],
    places: Mapping[str, Sequence[Sequence[float]]],
) -> None:
    """Refuse props that would begin outside the domain, where their first step is their last.

    Args:
        domain: where particles may go.
        dx: grid spacing [m].
        configs: of the props, turned as they begin.
        points: their particles.
        places: of their centres of mass [m], by name.

    Raises:
        ConfigError: a prop would reach out of the domain; or a name is no prop's.
    """
    solids = {config.name: (config, solid.rest) for config, solid in zip(configs, points, strict=True)}
    box = np.array([domain.lower, domain.upper])
    for name, centres in places.items():
        if name not in solids:
            raise ConfigError(f"there is no prop {name!r} to be placed; there are {', '.join(solids) or 'none'}")
        config, rest = solids[name]
        turned = _turned(config, rest)
        reach = np.array([turned.min(0), turned.max(0)])
        for centre in centres:
            inside = (centre + reach[0] >= box[0] - OVERLAP * dx) & (centre + reach[1] <= box[1] + OVERLAP * dx)
            if not inside.all():
                _refuse_place(name, centre, int(np.argmin(inside)), box, box - reach)


def turn_of(config: PropConfig | ColliderConfig) -> Rotation:
    """How a thing is turned as it begins."""
    return Rotation.from_quat(np.roll(config.rotation, -1))


def _turned(config: PropConfig, rest: np.ndarray) -> np.ndarray:
    """Particles of a prop about its centre of mass as it begins [m], shape ``(P, 3)``."""
    return turn_of(config).apply(rest)


def check_apart(dx: float, configs: Sequence[PropConfig], points: Sequence[PropPoints]) -> None:
    """Refuse props of which one would begin with its middle in another: they would fly apart.

    Args:
        dx: grid spacing [m].
        configs: of the props.
        points: their particles.

    Raises:
        ConfigError: there are such.
    """
    turned = [_turned(config, solid.rest) for config, solid in zip(configs, points, strict=True)]
    for (one, _), (other, rest) in permutations(zip(configs, turned, strict=True), 2):
        middle = np.subtract(one.position, other.position)
        if one.name != other.name and np.linalg.norm(rest - middle, axis=1).min() < dx:  # names are checked elsewhere
            at = [round(float(value), 3) for value in one.position]
            raise ConfigError(
                f"prop {one.name!r} would begin at {at} m, inside of {other.name!r}; place them side by side"
            )


def _refuse_place(name: str, centre: Sequence[float], axis: int, box: np.ndarray, room: np.ndarray) -> None:
    """Say that a prop at ``centre`` reaches out of ``box`` along ``axis``; ``room`` is for its centre [m]."""
    along, at = "xyz"[axis], [round(float(value), 3) for value in centre]
    low, high = room[:, axis]
    remedy = f"place it with {along} in [{low:.3g}, {high:.3g}] m" if low <= high else "make it smaller"
    raise ConfigError(
        f"prop {name!r} would begin at {at} m and reach out of the domain, which ends at "
        f"{along}={box[0, axis]:.3g} and {box[1, axis]:.3g} m; {remedy}"
    )


@wp.kernel
def copy_masked(
    mask: wp.array(dtype=wp.bool),
    value: wp.array(dtype=float),
    # out
    target: wp.array(dtype=float),
):
    """Copy the masked environments' values."""
    e = wp.tid()
    if mask[e]:
        target[e] = value[e]
