"""Bodies of the avatars: their matter, their random shapes, and pools of bodies that are drawn on the device.

:class:`Flesh` has the settings and particles of one avatar in NumPy. :class:`Shapes` writes a shape to the device. A
shape takes the host some 0.1 s, so a pool of ``shape.pool`` bodies can be shaped when the world is built, from fixed
seeds; at a reset each masked environment then draws one of them, from its seed and episode, and copies its row of every
constant that depends on the shape.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import warp as wp

from piavatar_envs.avatar.avatar import Avatar
from piavatar_envs.avatar.body.asset import AvatarAsset
from piavatar_envs.avatar.body.device import BodyPoints, bone_masses
from piavatar_envs.avatar.body.muscles import attachment_rates, firmness, make_muscles
from piavatar_envs.avatar.body.sampling import ParticleSet, morph
from piavatar_envs.avatar.body.skeleton import BODY_PARTS, body_part_of_joint, joint_index
from piavatar_envs.avatar.body.soft_tissue import bone_distance, softness, velocity_lag
from piavatar_envs.avatar.body.sources import load_asset
from piavatar_envs.avatar.torque_control.controller import TorqueControl
from piavatar_envs.avatar.types import COMMANDS, DAMPING, ROOT_RATE, TONE_RATE, PoseControl
from piavatar_envs.config import (
    AvatarConfig,
    AvatarSourceConfig,
    ConfigError,
    EnvConfig,
    PoseControlConfig,
    RegionConfig,
    ShapeConfig,
)
from piavatar_envs.config import replace as changed
from piavatar_envs.core.launch_graph import LaunchGraph
from piavatar_envs.core.rng import STREAM_PARAMETERS, generator
from piavatar_envs.mpm.materials import material_index
from piavatar_envs.mpm.model import MaterialPoints
from piavatar_envs.mpm.types import Model
from piavatar_envs.sim.randomize import Parameter, Randomization

wp.set_module_options({"enable_backward": False})

NUM_PARTS = len(BODY_PARTS)
#: Gravity in which force limits in body weights are counted [m/s^2].
STANDARD_GRAVITY = 9.81
#: First number of the seeds of a pool's shapes.
POOL_SEED = 20_260
#: Arrays of :class:`~piavatar_envs.avatar.types.Body` that depend on the shape.
_OF_BODY = ("rest", "rest_joint", "rest_center", "bone_mass", "velocity_lag")


class Flesh:
    """One avatar's matter in every environment of a batch.

    Attributes:
        physics, control, shape: sections of the configuration, with the avatar's own settings merged in.
        asset, sampled: the body, and its particles in the mean shape.
        pool: bodies that episodes draw from on the device, or None.
        part: index into ``BODY_PARTS`` of every particle, shape ``(P,)`` int32.
    """

    def __init__(
        self, config: EnvConfig, avatar: AvatarConfig, asset: AvatarAsset, sampled: ParticleSet, num_envs: int
    ) -> None:
        """Shape the body.

        Raises:
            ConfigError: a region has no particles, or a shape parameter is unknown.
        """
        self.physics = changed(config.physics, avatar.physics)
        self.control = changed(config.control, avatar.control)
        self.shape = changed(config.shape, avatar.shape)
        self.avatar, self.asset, self.sampled, self.num_envs = avatar, asset, sampled, num_envs
        self.base_parameters = shape_parameters(asset, self.shape)
        self._shape_parameters = np.tile(self.base_parameters, (num_envs, 1))
        for region in avatar.regions:
            self.in_region(region)
        self.part = body_part_of_joint()[sampled.skin_joints[:, 0]].astype(np.int32)
        self._points, self._volume = self.shaped(self.base_parameters)
        if self.shape.randomize:
            self._points, self._volume = _repeat(self._points, num_envs), np.repeat(self._volume, num_envs, 0)
        self.pool: BodyPool | None = None
        self._stale = False

    @property
    def settings(self) -> tuple:
        """Settings that determine a pool of bodies: avatars for which they are equal share one."""
        return self.asset, self.physics, self.shape, self.control.soft_tissue, self.avatar.regions

    @property
    def drawn_on_host(self) -> bool:
        """Whether shapes are random and not from a pool."""
        return self.shape.randomize and self.shape.pool is None

    @property
    def points(self) -> BodyPoints:
        """Particles at nominal mass, with one row per environment where shapes are random."""
        self._refresh()
        return self._points

    @property
    def shape_parameters(self) -> np.ndarray:
        """Shape parameters of every environment, shape ``(num_envs, S)``."""
        self._refresh()
        return self._shape_parameters

    def mark_stale(self) -> None:
        """Mark the host's copy as stale, since the device may have drawn other bodies from the pool."""
        self._stale = self.pool is not None

    def _refresh(self) -> None:
        """Copy the bodies that the device has drawn, if the host's copy is stale."""
        if self._stale and self.pool is not None:
            self._stale = False
            index = self.pool.index.numpy()
            self._shape_parameters[:] = self.pool.bodies.parameters[index]
            for name in ("rest", "mass", "joints", "velocity_lag"):
                getattr(self._points, name)[:] = self.pool.bodies.tables[name][index]

    def shaped(self, parameters: np.ndarray) -> tuple[BodyPoints, np.ndarray]:
        """Return points and volumes [m^3] of one shape."""
        body, sampled = self.asset.shape(parameters), self.sampled
        rest, volume = morph(self.asset, sampled, body)
        points = BodyPoints(
            rest=rest[None],
            mass=self.masses(volume[None]),
            joints=body.joints[None],
            skin_joints=sampled.skin_joints,
            skin_weights=sampled.skin_weights,
            bone=sampled.bone,
            velocity_lag=velocity_lag(self.control.soft_tissue, self._softness(rest))[None],
        )
        return points, volume[None]

    def torque_control(self) -> TorqueControl | None:
        """Return the parameters of torque control; None under pose control.

        Raises:
            ConfigError: torque control or a held root with a decoupling of one velocity.
        """
        control = self.control
        held = control.mode != "pose" or control.root == "wrench"
        if held and self.physics.decoupling in ("paper", "none"):
            what = "root='wrench'" if control.mode == "pose" else f"mode={control.mode!r}"
            remedy = "split or no_stress" + (", or control.root=free" if control.mode == "pose" else "")
            raise ConfigError(
                f"control.{what} needs two velocities: physics.decoupling={self.physics.decoupling!r} has one; use "
                f"{remedy}"
            )
        if control.mode == "pose":
            return None
        sampled = self.sampled
        distance = bone_distance(sampled.rest_positions, sampled.bone)
        firm = firmness(sampled.skin_joints, sampled.skin_weights)
        return TorqueControl(
            muscles=make_muscles(control.joint_stiffness, control.joint_damping, control.strength),
            root_assist=control.root_assist,
            flesh_rate=attachment_rates(sampled.depth, distance, firm, *control.flesh_rate),
            firm_bones=(sampled.bone >= 0) & control.firm_bones,
            bone_contact=control.bone_contact,
        )

    def masses(self, volume: np.ndarray) -> np.ndarray:
        """Return nominal masses [kg] of particles of these volumes [m^3], shape ``(rows, P)``."""
        density = np.full(volume.shape[1], self.physics.density, np.float32)
        return (self._region_values("density", density) * volume).astype(np.float32)

    def matter(self) -> MaterialPoints:
        """Return the particles as matter, without velocity fields and sensors, which :func:`.scene.assemble` sets."""
        physics = self.physics
        matter = MaterialPoints.uniform(
            self._volume, physics.density, physics.young_modulus, physics.poisson_ratio, physics.material
        )
        young = matter.young_modulus[0]
        if physics.soft_young_modulus is not None:
            # interpolated geometrically, because stiffness varies over decades
            young = young * (physics.soft_young_modulus / physics.young_modulus) ** self._softness(self.points.rest[0])
        return replace(
            matter,
            young_modulus=self._region_values("young_modulus", young.astype(np.float32))[None],
            poisson_ratio=self._region_values("poisson_ratio", matter.poisson_ratio[0])[None],
            density=self._region_values("density", matter.density[0])[None],
            material=self._region_values("material", matter.material[0])[None],
        )

    def draw_parameters(self, rng: np.random.Generator) -> np.ndarray:
        """Return random shape parameters, but for those that the configuration fixes."""
        parameters = self.asset.sample_parameters(rng, scale=self.shape.scale)
        for name, value in self.shape.parameters.items():
            parameters[self.asset.shape_names.index(name)] = value
        return parameters

    def _softness(self, rest: np.ndarray) -> np.ndarray:
        """Return the softness of the flesh at every particle, in [0, 1]."""
        sampled = self.sampled
        return softness(rest, sampled.bone, sampled.skin_joints, sampled.skin_weights)

    def _region_values(self, name: str, values: np.ndarray) -> np.ndarray:
        """Return ``values`` with those of the regions of other material written into them, shape ``(P,)``."""
        values = values.copy()
        for region in self.avatar.regions:
            value = getattr(region, name)
            if value is not None:
                values[self.in_region(region)] = material_index(value) if name == "material" else value
        return values

    def in_region(self, region: RegionConfig) -> np.ndarray:
        """Return the mask of a region's particles, shape ``(P,)`` bool.

        Raises:
            ConfigError: the region has no particles.
        """
        joints = [joint_index(name) for name in region.joints]
        sampled = self.sampled
        inside = np.isin(sampled.skin_joints[:, 0], joints)
        if region.beyond > 0.0:
            inside &= bone_distance(sampled.rest_positions, sampled.bone) > region.beyond
        if not inside.any():
            raise ConfigError(
                f"scene.avatars: no flesh of {list(region.joints)} is beyond={region.beyond} m from the bones; use less"
            )
        return inside


def pose_control(settings: PoseControlConfig, model: Model) -> PoseControl:
    """Return the parameters of a pose controller as kernels take them."""
    rate = settings.alpha / model.control_dt
    physical = settings.shape_preservation == "physical"
    control = PoseControl()
    control.dt, control.control_dt, control.num_substeps = model.step.dt, model.control_dt, model.num_substeps
    control.command = COMMANDS[settings.command]
    control.shape_rate, control.kinematic_shape_rate = (rate, 0.0) if physical else (0.0, rate)
    control.tone_rate, control.damping = TONE_RATE * settings.tone, DAMPING
    control.free_motion = int(settings.moves_freely)
    control.gravity = model.step.gravity
    control.root_rate = ROOT_RATE if settings.root == "wrench" else 0.0
    control.max_root_force = settings.max_root_force * STANDARD_GRAVITY
    control.max_root_torque = settings.max_root_torque * STANDARD_GRAVITY
    control.release_tilt_cos = math.cos(settings.release_tilt)
    control.release_distance, control.release_height = settings.release_distance, settings.release_height
    return control


def load_avatar(settings: AvatarSourceConfig) -> AvatarAsset:
    """Return the configured body.

    Raises:
        ConfigError: the source refuses the settings, or finds no file.
    """
    try:
        return load_asset(settings.source, settings.path)
    except (OSError, TypeError, ValueError) as error:
        raise ConfigError(f"avatar: {error}") from None


def shape_parameters(asset: AvatarAsset, shape: ShapeConfig) -> np.ndarray:
    """Return the configured shape parameters, shape ``(S,)``.

    Raises:
        ConfigError: a name is unknown.
    """
    try:
        return asset.parameters(**shape.parameters)
    except ValueError as error:
        raise ConfigError(f"shape.parameters: {error}") from None


def check_shape_names(flesh: Sequence[Flesh]) -> None:
    """Refuse random shapes of bodies that have different shape parameters.

    Raises:
        ConfigError: the parameters of one would be observed under the names of another.
    """
    names = {body.asset.shape_names for body in flesh}
    if len(names) > 1 and any(body.shape.randomize for body in flesh):
        raise ConfigError("shape.randomize=True needs avatars with the same shape parameters; use one avatar.source")


def shape_ranges(flesh: Sequence[Flesh]) -> dict[str, Parameter]:
    """Return the shape parameters that episodes draw, by the names of the asset; empty where no shape is random.

    Avatars of fixed shape have these parameters as well, so that all avatars are observed alike.
    """
    found: dict[str, Parameter] = {}
    random = [body for body in flesh if body.shape.randomize]
    for index, name in enumerate(flesh[0].asset.shape_names):
        drawn = [body for body in random if name not in body.shape.parameters]
        if drawn:
            fixed = [abs(float(body.base_parameters[index])) for body in flesh if body not in drawn]
            bound = max(*(body.shape.scale for body in drawn), *fixed, 0.0)
            found[name] = Parameter(f"shape_{name}", "-", -bound, bound, f"parameter {name} of the shape")
    return found


def _repeat(points: BodyPoints, rows: int) -> BodyPoints:
    """Return the same points with a writable row for each environment."""
    repeated = {name: np.repeat(getattr(points, name), rows, 0) for name in ("rest", "mass", "joints", "velocity_lag")}
    return BodyPoints(**repeated, skin_joints=points.skin_joints, skin_weights=points.skin_weights, bone=points.bone)


@dataclass(frozen=True)
class Bodies:
    """Bodies of random shape, computed on the host.

    Attributes:
        parameters: shape parameters of every body, shape ``(K, S)``.
        tables: constants of every body by name, the first dimension over bodies, float32: those of
            :class:`~piavatar_envs.avatar.body.device.BodyPoints`, the volumes of particles [m^3], masses and centres
            of bones, the total mass [kg], and the shape parameters.
    """

    parameters: np.ndarray
    tables: dict[str, np.ndarray]

    @classmethod
    def shaped(cls, flesh: Flesh, count: int) -> Bodies:
        """Shape ``count`` bodies by the settings of ``flesh``, from seeds of their own."""
        found: dict[str, list[np.ndarray]] = defaultdict(list)
        for number in range(count):
            parameters = flesh.draw_parameters(np.random.default_rng([POOL_SEED, number]))
            points, volume = flesh.shaped(parameters)
            bone_mass, center = bone_masses(points)
            rows = {name: getattr(points, name) for name in ("rest", "mass", "joints", "velocity_lag")}
            rows |= {"volume": volume, "bone_mass": bone_mass, "rest_center": center}
            rows |= {"body_mass": points.mass.sum(1, keepdims=True), "shape": parameters[None]}
            for name, value in rows.items():
                found[name].append(value)
        parameters = np.concatenate(found["shape"])
        return cls(parameters, {name: np.concatenate(rows).astype(np.float32) for name, rows in found.items()})


class BodyPool:
    """Bodies that one avatar of a world may have, one in each environment.

    Attributes:
        bodies: what they are.
        index: which of them each environment has, shape ``(num_envs,)`` int32.
    """

    def __init__(self, bodies: Bodies, avatar: int, num_envs: int, device: str) -> None:
        self.bodies, self.avatar, self.device = bodies, avatar, device
        self.index = wp.zeros(num_envs, dtype=int, device=device)
        self._targets: list[tuple[wp.array, wp.array]] = []

    def connect(self, **targets: wp.array) -> None:
        """Set the arrays ``(num_envs, ...)`` that a draw overwrites, by the names of the tables."""
        for name, target in targets.items():
            table = wp.array(self.bodies.tables[name], dtype=target.dtype, device=self.device)
            self._targets.append((table, target))

    def record_reset(self, graph: LaunchGraph, mask: wp.array, seed: wp.array, episode: wp.array) -> None:
        """Record the launches by which the masked environments draw a body and its constants."""
        drawn = [mask, seed, episode, self.avatar, len(self.bodies.parameters)]
        graph.launch(draw_body, len(mask), drawn, [self.index])
        for table, target in self._targets:
            kernel = copy_drawn_vectors if target.dtype is wp.vec3 else copy_drawn_numbers
            graph.launch(kernel, target.shape, [mask, self.index, table], [target])


@wp.kernel
def draw_body(
    mask: wp.array(dtype=wp.bool),
    seed: wp.array(dtype=int),
    episode: wp.array(dtype=int),
    avatar: int,
    count: int,
    # out
    index: wp.array(dtype=int),
):
    """Draw one of ``count`` bodies in each masked environment; over ``(num_envs,)``."""
    e = wp.tid()
    if mask[e]:
        # randomised factors use stream indices from 0; negative ones avoid a clash
        random = generator(seed[e], episode[e], STREAM_PARAMETERS, -1 - avatar)
        index[e] = wp.randi(random, 0, count)


@wp.kernel
def copy_drawn_numbers(
    mask: wp.array(dtype=wp.bool),
    index: wp.array(dtype=int),
    table: wp.array2d(dtype=float),
    # out
    target: wp.array2d(dtype=float),
):
    """Copy the drawn rows of a table in the masked environments; over ``(num_envs, K)``."""
    e, k = wp.tid()
    if mask[e]:
        target[e, k] = table[index[e], k]


@wp.kernel
def copy_drawn_vectors(
    mask: wp.array(dtype=wp.bool),
    index: wp.array(dtype=int),
    table: wp.array2d(dtype=wp.vec3),
    # out
    target: wp.array2d(dtype=wp.vec3),
):
    """Copy the drawn rows of a table of vectors in the masked environments; over ``(num_envs, K)``."""
    e, k = wp.tid()
    if mask[e]:
        target[e, k] = table[index[e], k]


class Shapes:
    """Shapes of the avatars in every environment, drawn on the host or from pools on the device.

    Attributes:
        flesh, avatars, model, randomization: those of the world.
        of_host: indices of the avatars whose bodies are drawn on the host.
    """

    def __init__(
        self, flesh: Sequence[Flesh], avatars: Sequence[Avatar], model: Model, randomization: Randomization
    ) -> None:
        """Shape the bodies of pools; ``randomization`` must exist, as it gives each environment its own row."""
        self.flesh, self.avatars, self.model, self.randomization = flesh, avatars, model, randomization
        self._ranges, self._names = shape_ranges(flesh), flesh[0].asset.shape_names
        # (num_envs, S) for every avatar; none where no shape is random
        self._parameters = [
            wp.array(own.shape_parameters.astype(np.float32), dtype=float, device=model.device)
            for own in (flesh if self._ranges else ())
        ]
        self.of_host = [index for index, own in enumerate(flesh) if own.drawn_on_host]
        self._connect_pools()

    def draw(self, mask: wp.array, seed: wp.array, episode: wp.array) -> None:
        """Draw bodies on the host for the masked environments, from seed and episode."""
        if not self.of_host:
            return
        seeds, episodes = seed.numpy().view(np.uint32), episode.numpy()
        for env in np.flatnonzero(mask.numpy()):
            key = [int(seeds[env]), int(episodes[env])]
            for avatar in self.of_host:
                rng = np.random.default_rng([*key, avatar] if avatar else key)
                self.give(int(env), self.flesh[avatar].draw_parameters(rng), avatar)

    def give(self, env: int, parameters: np.ndarray, avatar: int = 0) -> None:
        """Replace the body of an avatar in environment ``env``, with effect from its next placement on.

        Raises:
            ValueError: shapes are fixed or come from a pool, or a parameter is out of range.
        """
        flesh, drive = self.flesh[avatar], self.avatars[avatar]
        if not flesh.shape.randomize:
            raise ValueError("shape.randomize=False, so all environments share one body; set it to True")
        if flesh.pool:
            raise ValueError(f"shape.pool={flesh.shape.pool}, so bodies are drawn from a pool; set it to None")
        points, volume = flesh.shaped(parameters)
        mass, center = bone_masses(points)
        body, particles = drive.body, self.model.particles
        own = slice(body.first, body.first + body.count)
        rows = [
            (body.rest[env], points.rest),
            (body.rest_joint[env], points.joints),
            (body.rest_center[env], center),
            (body.velocity_lag[env], points.velocity_lag),
            (body.bone_mass[env], mass),
            (particles.mass[env][own], points.mass),
            (particles.volume[env][own], volume),
        ]
        for array, value in rows:
            array.assign(np.ascontiguousarray(value[0], np.float32))
        drive.body_mass[env : env + 1].assign(points.mass.sum(1).astype(np.float32))
        self.randomization.set_nominal_mass(avatar, env, points.mass[0], mass[0])
        for name in ("rest", "mass", "joints"):
            getattr(flesh.points, name)[env] = getattr(points, name)[0]
        flesh.shape_parameters[env] = parameters
        if self._parameters:
            self._parameters[avatar][env].assign(flesh.shape_parameters[env].astype(np.float32))

    def adopt(self, avatar: int, parameters: np.ndarray) -> None:
        """Update the host's copy of bodies whose arrays were restored on the device, with their shape parameters."""
        flesh, body = self.flesh[avatar], self.avatars[avatar].body
        own = slice(body.first, body.first + body.count)
        flesh.points.rest[:], flesh.points.joints[:] = body.rest.numpy(), body.rest_joint.numpy()
        flesh.points.mass[:] = flesh.masses(self.model.particles.volume.numpy()[:, own])
        flesh.shape_parameters[:] = parameters
        if self._parameters:
            self._parameters[avatar].assign(flesh.shape_parameters.astype(np.float32))

    def mark_stale(self) -> None:
        """Mark the host's copies as stale, since the device may have drawn other bodies from pools."""
        for flesh in self.flesh:
            flesh.mark_stale()

    def _connect_pools(self) -> None:
        """Shape the bodies of pools, and connect the arrays that a draw overwrites (nominal masses)."""
        particles, known = self.model.particles, {}
        for index, (flesh, avatar) in enumerate(zip(self.flesh, self.avatars, strict=True)):
            if not flesh.shape.randomize or flesh.drawn_on_host:
                continue
            if flesh.settings not in known:
                known[flesh.settings] = Bodies.shaped(flesh, flesh.shape.pool)
            flesh.pool = BodyPool(known[flesh.settings], index, self.model.num_envs, self.model.device)
            body = avatar.body
            own = slice(body.first, body.first + body.count)
            shape = {"shape": self._parameters[index]} if self._parameters else {}
            flesh.pool.connect(
                rest=body.rest,
                joints=body.rest_joint,
                rest_center=body.rest_center,
                velocity_lag=body.velocity_lag,
                volume=particles.volume[:, own],
                **self.randomization.nominal_mass(index),
                **shape,
            )

    def drawn(self, avatar: int) -> dict[str, tuple[Parameter, wp.array]]:
        """Return the drawn parameters of an avatar's shape by name, with their values in every environment."""
        names = self._names
        return {p.name: (p, self._parameters[avatar][:, names.index(name)]) for name, p in self._ranges.items()}

    def record_reset(self, graph: LaunchGraph, mask: wp.array, seed: wp.array, episode: wp.array) -> None:
        """Record the launches by which the masked environments draw bodies from pools."""
        for flesh in self.flesh:
            if flesh.pool:
                flesh.pool.record_reset(graph, mask, seed, episode)

    def arrays(self) -> dict[str, wp.array]:
        """Return the arrays of a checkpoint by name."""
        found: dict[str, wp.array] = {}
        for index, (avatar, flesh) in enumerate(zip(self.avatars, self.flesh, strict=True)):
            if flesh.shape.randomize:
                found |= {f"body_{index}.{name}": getattr(avatar.body, name) for name in _OF_BODY}
                found[f"body_{index}.body_mass"] = avatar.body_mass
            if flesh.pool:
                found[f"body_{index}.index"] = flesh.pool.index
            if flesh.pool and self._parameters:
                found[f"body_{index}.shape"] = self._parameters[index]
        if any(flesh.shape.randomize for flesh in self.flesh):
            found |= {f"matter.{name}": getattr(self.model.particles, name) for name in ("mass", "volume")}
        return found
