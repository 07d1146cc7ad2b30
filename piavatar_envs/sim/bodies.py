"""A pool of bodies: random shapes that are worked out beforehand, so that episodes can draw them on the device.

To shape a body takes the host a good part of a second. A pool of ``shape.pool`` bodies is shaped when the world is
built, from seeds of its own, alike for every batch; at a reset each masked environment draws one of them from its seed
and episode, and its row of every constant that depends on the shape is copied from the pool's tables.

The flesh of one avatar of a world: its settings, its particles and its shapes, in NumPy.

Bodies of random shape: what follows from a shape on the device, given by the host or drawn from a pool.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from piavatar_envs.avatar.avatar import Avatar
from piavatar_envs.avatar.body.asset import AvatarAsset
from piavatar_envs.avatar.body.device import BodyPoints, bone_masses
from piavatar_envs.avatar.body.muscles import attachment_rates, firmness, make_muscles
from piavatar_envs.avatar.body.sampling import ParticleSet, morph
from piavatar_envs.avatar.body.skeleton import BODY_PARTS, body_part_of_joint, joint_index
from piavatar_envs.avatar.body.soft_tissue import bone_distance, inert_share, softness
from piavatar_envs.avatar.body.sources import load_asset
from piavatar_envs.avatar.torque_control.controller import JointSettings
from piavatar_envs.avatar.types import DriveSettings
from piavatar_envs.config import (
    AvatarConfig,
    AvatarSourceConfig,
    ConfigError,
    ControlConfig,
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


if TYPE_CHECKING:
    from piavatar_envs.sim.bodies import Flesh


#: First number of the seeds of a pool's shapes.
POOL_SEED = 20_260


@dataclass(frozen=True)
class Bodies:
    """Bodies of an avatar's settings, worked out on the host.

    Attributes:
        parameters: shape parameters of every body, shape ``(K, S)``.
        tables: constants of every body by name, the first dimension over bodies, float32: what
            :class:`~piavatar_envs.avatar.body.device.BodyPoints` holds of a shape, the particles' volumes [m^3], what
            follows for bones, the whole mass [kg], and the shape parameters again.
    """

    parameters: np.ndarray
    tables: dict[str, np.ndarray]

    @classmethod
    def shaped(cls, flesh: Flesh, count: int) -> Bodies:
        """``count`` bodies as the settings of ``flesh`` draw them."""
        found: dict[str, list[np.ndarray]] = defaultdict(list)
        for number in range(count):
            parameters = flesh.draw_parameters(np.random.default_rng([POOL_SEED, number]))
            points, volume = flesh.shaped(parameters)
            bone_mass, center = bone_masses(points)
            rows = {name: getattr(points, name) for name in ("rest", "mass", "joints", "inert")}
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
        """Say which arrays ``(num_envs, ...)`` shall follow, by the names of the tables."""
        for name, target in targets.items():
            table = wp.array(self.bodies.tables[name], dtype=target.dtype, device=self.device)
            self._targets.append((table, target))

    def record_reset(self, graph: LaunchGraph, mask: wp.array, seed: wp.array, episode: wp.array) -> None:
        """Append: the masked environments draw a body, and their constants follow."""
        drawn = [mask, seed, episode, self.avatar, len(self.bodies.parameters)]
        graph.launch(draw_body, len(mask), drawn, [self.index])
        for table, target in self._targets:
            kernel = take_vectors if target.dtype is wp.vec3 else take_numbers
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
    """One of ``count`` bodies for each masked environment."""
    e = wp.tid()
    if mask[e]:
        # factors draw from the indices from zero on
        random = generator(seed[e], episode[e], STREAM_PARAMETERS, -1 - avatar)
        index[e] = wp.randi(random, 0, count)


@wp.kernel
def take_numbers(
    mask: wp.array(dtype=wp.bool),
    index: wp.array(dtype=int),
    table: wp.array2d(dtype=float),
    # out
    target: wp.array2d(dtype=float),
):
    """Rows of a table into those of the masked environments."""
    e, k = wp.tid()
    if mask[e]:
        target[e, k] = table[index[e], k]


@wp.kernel
def take_vectors(
    mask: wp.array(dtype=wp.bool),
    index: wp.array(dtype=int),
    table: wp.array2d(dtype=wp.vec3),
    # out
    target: wp.array2d(dtype=wp.vec3),
):
    """Rows of a table of vectors into those of the masked environments."""
    e, k = wp.tid()
    if mask[e]:
        target[e, k] = table[index[e], k]


NUM_PARTS = len(BODY_PARTS)


def drive_settings(control: ControlConfig) -> DriveSettings:
    """Return the parameters of a drive; those of commanded poses are the defaults under torques."""
    d = control if isinstance(control, PoseControlConfig) else PoseControlConfig()
    return DriveSettings(
        mode=d.command,
        tone=d.tone,
        alpha=d.alpha,
        shape_preservation=d.shape_preservation,
        root=d.root,
        free_motion=d.moves_freely,
        max_force=d.max_root_force,
        max_torque=d.max_root_torque,
        max_tilt=d.release_tilt,
        max_horizontal_error=d.release_distance,
        max_height_error=d.release_height,
    )


def load_avatar(settings: AvatarSourceConfig) -> AvatarAsset:
    """Return the body that the settings name.

    Raises:
        ConfigError: the source refuses them, or finds no file.
    """
    try:
        return load_asset(settings.source, settings.path)
    except (OSError, TypeError, ValueError) as error:
        raise ConfigError(f"avatar: {error}") from None


def shape_parameters(asset: AvatarAsset, shape: ShapeConfig) -> np.ndarray:
    """Those of the body as it is configured, shape ``(S,)``.

    Raises:
        ConfigError: there is no shape parameter of that name.
    """
    try:
        return asset.parameters(**shape.parameters)
    except ValueError as error:
        raise ConfigError(f"shape.parameters: {error}") from None


class Flesh:
    """One avatar's matter in every environment of a batch.

    Attributes:
        physics, control, shape: the environment's sections with the avatar's own settings laid over them.
        asset, sampled: the body, and its particles in the mean shape.
        pool: bodies that episodes draw from on the device, or None.
        part: index into ``BODY_PARTS`` of every particle, shape ``(P,)`` int32.
    """

    def __init__(
        self, config: EnvConfig, avatar: AvatarConfig, asset: AvatarAsset, sampled: ParticleSet, num_envs: int
    ) -> None:
        """Shape the body.

        Raises:
            ConfigError: a region holds nothing, or there is no shape parameter of that name.
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
        self._behind = False

    @property
    def settings(self) -> tuple:
        """All that decides which bodies are drawn: avatars with equal settings have equal ones."""
        return self.asset, self.physics, self.shape, self.control.soft_tissue, self.avatar.regions

    @property
    def drawn_on_host(self) -> bool:
        """Whether shapes are random and not from a pool."""
        return self.shape.randomize and self.shape.pool is None

    @property
    def points(self) -> BodyPoints:
        """Its particles in its nominal mass and its shapes; a row an environment where shapes are random."""
        self._catch_up()
        return self._points

    @property
    def shape_parameters(self) -> np.ndarray:
        """Of every environment, shape ``(num_envs, S)``."""
        self._catch_up()
        return self._shape_parameters

    def fall_behind(self) -> None:
        """The device may have drawn other bodies from the pool: look there when the host wants to know."""
        self._behind = self.pool is not None

    def _catch_up(self) -> None:
        if self._behind and self.pool is not None:
            self._behind = False
            index = self.pool.index.numpy()
            self._shape_parameters[:] = self.pool.bodies.parameters[index]
            for name in ("rest", "mass", "joints", "inert"):
                getattr(self._points, name)[:] = self.pool.bodies.tables[name][index]

    def shaped(self, parameters: np.ndarray) -> tuple[BodyPoints, np.ndarray]:
        """Points and volumes [m^3] of one shape."""
        body, sampled = self.asset.shape(parameters), self.sampled
        rest, volume = morph(self.asset, sampled, body)
        points = BodyPoints(
            rest=rest[None],
            mass=self.masses(volume[None]),
            joints=body.joints[None],
            skin_joints=sampled.skin_joints,
            skin_weights=sampled.skin_weights,
            bone=sampled.bone,
            inert=inert_share(self.control.soft_tissue, self._softness(rest))[None],
        )
        return points, volume[None]

    def joint_settings(self) -> JointSettings | None:
        """How its joints are driven; None where its pose is.

        Raises:
            ConfigError: torques, or a root that is held, with a scheme of one velocity.
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
        return JointSettings(
            muscles=make_muscles(control.joint_stiffness, control.joint_damping, control.strength),
            assist=control.root_assist,
            attachment=attachment_rates(sampled.depth, distance, firm, *control.flesh_rate),
            firm=(sampled.bone >= 0) & control.firm_bones,
            solid=control.bone_contact,
        )

    def masses(self, volume: np.ndarray) -> np.ndarray:
        """Nominal masses [kg] of particles of these volumes [m^3], shape ``(rows, P)``."""
        density = np.full(volume.shape[1], self.physics.density, np.float32)
        return (self._region_values("density", density) * volume).astype(np.float32)

    def matter(self) -> MaterialPoints:
        """Its particles as matter; velocity fields and sensors are the world's business."""
        physics = self.physics
        matter = MaterialPoints.uniform(
            self._volume, physics.density, physics.young_modulus, physics.poisson_ratio, physics.material
        )
        young = matter.young_modulus[0]
        if physics.soft_young_modulus is not None:
            # geometric between the two: stiffness varies over decades
            young = young * (physics.soft_young_modulus / physics.young_modulus) ** self._softness(self.points.rest[0])
        return replace(
            matter,
            young_modulus=self._region_values("young_modulus", young.astype(np.float32))[None],
            poisson_ratio=self._region_values("poisson_ratio", matter.poisson_ratio[0])[None],
            density=self._region_values("density", matter.density[0])[None],
            material=self._region_values("material", matter.material[0])[None],
        )

    def draw_parameters(self, rng: np.random.Generator) -> np.ndarray:
        """A random shape; parameters named in the configuration are kept."""
        parameters = self.asset.sample_parameters(rng, scale=self.shape.scale)
        for name, value in self.shape.parameters.items():
            parameters[self.asset.shape_names.index(name)] = value
        return parameters

    def _softness(self, rest: np.ndarray) -> np.ndarray:
        """How soft the flesh is at every particle, in [0, 1]."""
        sampled = self.sampled
        return softness(rest, sampled.bone, sampled.skin_joints, sampled.skin_weights)

    def _region_values(self, name: str, values: np.ndarray) -> np.ndarray:
        """``values`` with those of the regions of other material written into them, shape ``(P,)``."""
        values = values.copy()
        for region in self.avatar.regions:
            value = getattr(region, name)
            if value is not None:
                values[self.in_region(region)] = material_index(value) if name == "material" else value
        return values

    def in_region(self, region: RegionConfig) -> np.ndarray:
        """Which particles a region holds, shape ``(P,)`` bool.

        Raises:
            ConfigError: no particle lies in the region.
        """
        joints = [joint_index(name) for name in region.joints]
        sampled = self.sampled
        inside = np.isin(sampled.skin_joints[:, 0], joints)
        if region.beyond > 0.0:
            inside &= bone_distance(sampled.rest_positions, sampled.bone) > region.beyond
        if not inside.any():
            raise ConfigError(f"scene.avatars: no flesh of {region.joints} is {region.beyond} m from the bones")
        return inside


def check_shape_names(flesh: Sequence[Flesh]) -> None:
    """Refuse random shapes of bodies that have different shape parameters.

    Raises:
        ConfigError: the parameters of one would be observed under the names of another.
    """
    names = {body.asset.shape_names for body in flesh}
    if len(names) > 1 and any(body.shape.randomize for body in flesh):
        raise ConfigError("shape.randomize=True needs avatars with the same shape parameters; use one avatar.source")


def shape_ranges(flesh: Sequence[Flesh]) -> dict[str, Parameter]:
    """What episodes draw of the avatars' shapes, by the names of the asset; empty where no shape is random.

    An avatar whose own shape is fixed has these parameters, too.
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
    """The same points with a writable row for each environment."""
    repeated = {name: np.repeat(getattr(points, name), rows, 0) for name in ("rest", "mass", "joints", "inert")}
    return BodyPoints(**repeated, skin_joints=points.skin_joints, skin_weights=points.skin_weights, bone=points.bone)


#: What follows from a shape, of :class:`~piavatar_envs.avatar.types.Body`.
_OF_BODY = ("rest", "rest_joint", "rest_center", "bone_mass", "inert")


class Shapes:
    """Shapes of the avatars in every environment.

    Attributes:
        flesh, avatars, model, randomization: of the world.
        of_host: avatars whose bodies are drawn on the host.
    """

    def __init__(
        self, flesh: Sequence[Flesh], avatars: Sequence[Avatar], model: Model, randomization: Randomization
    ) -> None:
        """Shape the bodies of pools, when the factors have given what varies rows of its own."""
        self.flesh, self.avatars, self.model, self.randomization = flesh, avatars, model, randomization
        self._ranges, self._names = shape_ranges(flesh), flesh[0].asset.shape_names
        #: of every avatar, (num_envs, S); none where no shape is random
        self._parameters = [
            wp.array(own.shape_parameters.astype(np.float32), dtype=float, device=model.device)
            for own in (flesh if self._ranges else ())
        ]
        self.of_host = [index for index, own in enumerate(flesh) if own.drawn_on_host]
        self._connect_pools()

    def draw(self, mask: wp.array, seed: wp.array, episode: wp.array) -> None:
        """Bodies for the masked environments, from seed and episode, for avatars whose bodies are drawn on the host."""
        if not self.of_host:
            return
        seeds, episodes = seed.numpy().view(np.uint32), episode.numpy()
        for env in np.flatnonzero(mask.numpy()):
            key = [int(seeds[env]), int(episodes[env])]
            for avatar in self.of_host:
                rng = np.random.default_rng([*key, avatar] if avatar else key)
                self.give(int(env), self.flesh[avatar].draw_parameters(rng), avatar)

    def give(self, env: int, parameters: np.ndarray, avatar: int = 0) -> None:
        """Give an avatar of environment ``env`` another body; takes effect when it is placed again.

        Raises:
            ValueError: the configuration has one shape for all environments, or a pool of them, or a parameter is out
                of range.
        """
        flesh, drive = self.flesh[avatar], self.avatars[avatar]
        if not flesh.shape.randomize:
            raise ValueError("all environments share one body; set shape.randomize=True to give each its own")
        if flesh.pool:
            raise ValueError(f"bodies are drawn from a pool of {flesh.shape.pool}; set shape.pool=None to give others")
        points, volume = flesh.shaped(parameters)
        mass, center = bone_masses(points)
        body, particles = drive.body, self.model.particles
        own = slice(body.first, body.first + body.count)
        rows = [
            (body.rest[env], points.rest),
            (body.rest_joint[env], points.joints),
            (body.rest_center[env], center),
            (body.inert[env], points.inert),
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
        """Make the host's copy follow bodies whose arrays were restored on the device, with their shape parameters."""
        flesh, body = self.flesh[avatar], self.avatars[avatar].body
        own = slice(body.first, body.first + body.count)
        flesh.points.rest[:], flesh.points.joints[:] = body.rest.numpy(), body.rest_joint.numpy()
        flesh.points.mass[:] = flesh.masses(self.model.particles.volume.numpy()[:, own])
        flesh.shape_parameters[:] = parameters
        if self._parameters:
            self._parameters[avatar].assign(flesh.shape_parameters.astype(np.float32))

    def fall_behind(self) -> None:
        """The device may have drawn other bodies from pools: the host looks there when it wants to know."""
        for flesh in self.flesh:
            flesh.fall_behind()

    def _connect_pools(self) -> None:
        """Shape the bodies of pools, and say what follows them; masses that a factor scales follow nominally."""
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
                inert=body.inert,
                volume=particles.volume[:, own],
                **self.randomization.nominal_mass(index),
                **shape,
            )

    def drawn(self, avatar: int) -> dict[str, tuple[Parameter, wp.array]]:
        """Parameters of an avatar's shape by name, with their values in every environment; those that may differ."""
        names = self._names
        return {p.name: (p, self._parameters[avatar][:, names.index(name)]) for name, p in self._ranges.items()}

    def record_draws(self, graph: LaunchGraph, mask: wp.array, seed: wp.array, episode: wp.array) -> None:
        """Append: the masked environments draw bodies from pools."""
        for flesh in self.flesh:
            if flesh.pool:
                flesh.pool.record_reset(graph, mask, seed, episode)

    def arrays(self) -> dict[str, wp.array]:
        """Arrays of a checkpoint, by name."""
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
