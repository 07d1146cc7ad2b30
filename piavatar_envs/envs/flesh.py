"""The flesh of one avatar of a world: its settings, its particles and its shapes, in NumPy."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from piavatar_envs.avatar.asset import AvatarAsset
from piavatar_envs.avatar.body import BodyPoints
from piavatar_envs.avatar.joint_drive import JointSettings
from piavatar_envs.avatar.muscles import attachment_rates, firmness, make_muscles
from piavatar_envs.avatar.sampling import ParticleSet, morph
from piavatar_envs.avatar.settings import DriveSettings
from piavatar_envs.avatar.skeleton import BODY_PARTS, body_part_of_joint, joint_index
from piavatar_envs.avatar.soft_tissue import bone_distance, inert_share, softness
from piavatar_envs.envs.bodies import BodyPool
from piavatar_envs.envs.config import AvatarConfig, ConfigError, DriveConfig, EnvConfig, RegionConfig, ShapeConfig
from piavatar_envs.envs.config import replace as changed
from piavatar_envs.envs.observations import Parameter
from piavatar_envs.mpm.build import MaterialPoints
from piavatar_envs.mpm.materials import material_index

NUM_PARTS = len(BODY_PARTS)


def drive_settings(d: DriveConfig) -> DriveSettings:
    """The drive's parameters of a configuration."""
    return DriveSettings(
        mode=d.drive,
        tone=d.tone,
        alpha=d.alpha,
        shape_preservation=d.shape_preservation,
        root=d.root,
        free_motion=d.moves_freely,
        max_force=d.max_force_weight,
        max_torque=d.max_torque_weight,
        max_tilt=d.let_go_tilt,
        max_horizontal_error=d.let_go_distance,
        max_height_error=d.let_go_height,
    )


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
        physics, drive, shape: the environment's sections with the avatar's own settings laid over them.
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
        self.drive = changed(config.drive, avatar.drive)
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
        return self.physics, self.shape, self.drive.soft_tissue, self.avatar.regions

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
            inert=inert_share(self.drive.soft_tissue, self._softness(rest))[None],
        )
        return points, volume[None]

    def joint_settings(self) -> JointSettings | None:
        """How its joints are driven; None where its pose is.

        Raises:
            ConfigError: torques, or a root that is held, with a scheme of one velocity.
        """
        d = self.drive
        held = d.control != "pose" or d.root == "wrench"
        if held and self.physics.decoupling in ("paper", "none"):
            what = "root='wrench'" if d.control == "pose" else f"control={d.control!r}"
            remedy = "split or no_stress" + (", or drive.root=free" if d.control == "pose" else "")
            raise ConfigError(
                f"drive.{what} needs two velocities: physics.decoupling={self.physics.decoupling!r} has one; use "
                f"{remedy}"
            )
        if d.control == "pose":
            return None
        sampled = self.sampled
        distance = bone_distance(sampled.rest_positions, sampled.bone)
        firm = firmness(sampled.skin_joints, sampled.skin_weights)
        return JointSettings(
            muscles=make_muscles(d.joint_stiffness, d.joint_damping, d.strength),
            assist=d.root_assist,
            attachment=attachment_rates(sampled.depth, distance, firm, *d.flesh_rate),
            firm=(sampled.bone >= 0) & d.firm_bones,
            solid=d.bone_contact,
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
