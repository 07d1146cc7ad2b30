"""Bodies of the avatars in NumPy: settings, shape, particles and matter of one avatar.

:mod:`piavatar_envs.sim.shapes` draws random shapes and writes them to the device.
"""

from __future__ import annotations

import math
from collections import defaultdict
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import warp as wp

from piavatar_envs.avatar.body import sampling
from piavatar_envs.avatar.body.asset import AvatarAsset
from piavatar_envs.avatar.body.device import BodyPoints, bone_masses
from piavatar_envs.avatar.body.flesh import attachment_rates, bone_distance, firmness, softness, velocity_lag
from piavatar_envs.avatar.body.flesh_stiffness import kept_stiffness
from piavatar_envs.avatar.body.groups import flesh_of
from piavatar_envs.avatar.body.muscles import LOCKED_JOINTS, Muscles, make_muscles
from piavatar_envs.avatar.body.passive import passive_moments
from piavatar_envs.avatar.body.pose_correctives import COARSEST, pose_correctives
from piavatar_envs.avatar.body.sampling import ParticleSet, morph
from piavatar_envs.avatar.body.skeleton import BODY_PARTS, NUM_JOINTS, body_part_of_joint, joint_index
from piavatar_envs.avatar.body.sources import load_asset
from piavatar_envs.avatar.torque_control.controller import TorqueControl
from piavatar_envs.avatar.torque_control.joint_tissue import JointTissue
from piavatar_envs.avatar.torque_control.joint_torques import UNBOUNDED
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
from piavatar_envs.core.result_cache import digest_of, kept
from piavatar_envs.mpm.materials import lame_parameters, material_index, retardation_time
from piavatar_envs.mpm.model import MaterialPoints
from piavatar_envs.mpm.types import Model

NUM_PARTS = len(BODY_PARTS)
#: Gravity in which force limits in body weights are counted [m/s^2].
STANDARD_GRAVITY = 9.81
#: Rate of the pull that holds flesh at the bone where joints resist under pose control [1/s].
BONE_RATE = 1000.0
#: First number of the seeds of a pool's shapes.
POOL_SEED = 20_260
#: Arrays of :class:`~piavatar_envs.avatar.body.device.BodyPoints` that depend on the shape.
_OF_POINTS = ("rest", "mass", "joints", "velocity_lag")


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


class Flesh:
    """One avatar's matter in every environment of a batch.

    Attributes:
        physics, control, shape: sections of the configuration, with the avatar's own settings merged in.
        asset, sampled: the body, and its particles in the mean shape.
        part: index into ``BODY_PARTS`` of every particle, shape ``(P,)`` int32.
        height: of the particles of the configured shape at rest [m].
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
        self._regions = [self.in_region(region) for region in avatar.regions]
        self.part = body_part_of_joint()[sampled.skin_joints[:, 0]].astype(np.int32)
        self._correctives = pose_correctives(asset, sampled) if self.keeps_volume else None
        self._points, self._volume = self.shaped(self.base_parameters)
        self.height = float(np.ptp(self._points.rest[0][:, 2]))
        if self.shape.randomize:
            self._points, self._volume = _repeat(self._points, num_envs), np.repeat(self._volume, num_envs, 0)
        self._pool: tuple[Bodies, wp.array] | None = None
        self._stale = False

    @property
    def settings(self) -> tuple:
        """Settings that determine a pool of bodies: avatars for which they are equal share one."""
        return self.asset, self.physics, self.shape, self.control.soft_tissue, self.avatar.regions

    @property
    def keeps_volume(self) -> bool:
        """Return whether the rest pose is corrected: not in the paper's schemes, nor for particles too coarse."""
        fine = self.sampled.spacing < COARSEST * float(np.ptp(self.asset.vertices[:, 2]))
        return fine and self.physics.decoupling not in ("paper", "none")

    @property
    def drawn_on_host(self) -> bool:
        """Whether shapes are random and not from a pool."""
        return self.shape.randomize and self.shape.pool is None

    @property
    def drawn_from_pool(self) -> bool:
        """Whether episodes draw one of a pool of bodies, on the device."""
        return self.shape.randomize and self.shape.pool is not None

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

    def connect_pool(self, bodies: Bodies, index: wp.array) -> None:
        """Set the pool of bodies, and the device array ``(num_envs,)`` of those that the environments have drawn."""
        self._pool = bodies, index

    def mark_stale(self) -> None:
        """Mark the host's copy as stale, since the device may have drawn other bodies from the pool."""
        self._stale = self._pool is not None

    def _refresh(self) -> None:
        """Copy the bodies that the device has drawn, if the host's copy is stale."""
        if self._stale and self._pool is not None:
            self._stale = False
            bodies, index = self._pool[0], self._pool[1].numpy()
            self._shape_parameters[:] = bodies.parameters[index]
            for name in _OF_POINTS:
                getattr(self._points, name)[:] = bodies.tables[name][index]

    def shaped(self, parameters: np.ndarray) -> tuple[BodyPoints, np.ndarray]:
        """Return points and volumes [m^3] of one shape."""
        sampled = self.sampled
        # random shapes are too many to keep
        keep = np.array_equal(parameters, self.base_parameters)
        joints, rest, volume = _shape_particles(self.asset, sampled, tuple(parameters), keep)
        lag = velocity_lag(self.control.soft_tissue, self._softness(rest))
        lag = np.where(sampled.bone < 0, self._region_values("soft_tissue", lag), lag)  # bones miss nothing
        points = BodyPoints(
            rest=rest[None],
            mass=self.masses(volume[None]),
            joints=joints[None],
            skin_joints=sampled.skin_joints,
            skin_weights=sampled.skin_weights,
            bone=sampled.bone,
            velocity_lag=lag[None],
            correctives=self._correctives,
        )
        return points, volume[None]

    def shaped_pool(self) -> Bodies:
        """Return ``shape.pool`` random bodies, from seeds of their own."""
        found: dict[str, list[np.ndarray]] = defaultdict(list)
        for number in range(self.shape.pool):
            parameters = self.draw_parameters(np.random.default_rng([POOL_SEED, number]))
            points, volume = self.shaped(parameters)
            bone_mass, center = bone_masses(points)
            rows = {name: getattr(points, name) for name in _OF_POINTS}
            rows |= {"volume": volume, "bone_mass": bone_mass, "rest_center": center}
            rows |= {"body_mass": points.mass.sum(1, keepdims=True), "shape": parameters[None]}
            for name, value in rows.items():
                found[name].append(value)
        parameters = np.concatenate(found["shape"])
        return Bodies(parameters, {name: np.concatenate(rows).astype(np.float32) for name, rows in found.items()})

    def torque_control(self) -> TorqueControl | None:
        """Return the parameters of joints that move or resist by torques; None where flesh alone resists.

        Raises:
            ConfigError: torque control, joints that resist, or a held root with a decoupling of one velocity; settings
                that have no effect where joints resist.
        """
        control = self.control
        posed = isinstance(control, PoseControlConfig)
        self._refuse_one_velocity()
        if posed and control.resistance == "flesh":
            return None
        if posed:
            self._refuse_what_joints_lack()
            muscles, rates = make_muscles(), (control.alpha / self.physics.control_dt, BONE_RATE)
            regions = [
                None if region.alpha is None else (region.alpha / self.physics.control_dt, BONE_RATE)
                for region in self.avatar.regions
            ]
        else:
            muscles = make_muscles(control.joint_stiffness, control.joint_damping, control.strength)
            rates, regions = control.flesh_rate, [region.flesh_rate for region in self.avatar.regions]
        return TorqueControl(
            muscles=muscles,
            root_assist=0.0 if posed else control.root_assist,
            flesh_rate=self._attachment(rates, regions),
            firm_bones=(self.sampled.bone >= 0) & (posed or control.firm_bones),
            links=self.sampled.links,
            bone_contact=posed or control.bone_contact,
            tissue=self._tissue(muscles),
        )

    def _refuse_one_velocity(self) -> None:
        """Refuse control that needs two velocities with a decoupling of one."""
        control = self.control
        posed = isinstance(control, PoseControlConfig)
        resists = posed and control.resistance == "joints"
        held = not posed or resists or control.root != "free"
        if held and self.physics.decoupling in ("paper", "none"):
            what = f"root={control.root!r}" if posed else f"mode={control.mode!r}"
            remedy = "split or no_stress" + (", or control.root=free" if posed else "")
            if resists:
                what, remedy = "resistance='joints'", "split or no_stress, or control.resistance=flesh"
            raise ConfigError(
                f"control.{what} needs two velocities: physics.decoupling={self.physics.decoupling!r} has one; use "
                f"{remedy}"
            )

    def _refuse_what_joints_lack(self) -> None:
        """Refuse settings of pose control that have no meaning where joints resist."""
        control, lacking = self.control, "cannot be combined with control.resistance='joints'"
        if control.command == "target":
            raise ConfigError(f"control.command='target' {lacking}; use increment or reference")
        if control.shape_preservation == "kinematic":
            raise ConfigError(f"control.shape_preservation='kinematic' {lacking}; use physical")
        if control.soft_tissue > 0.0 or any(region.soft_tissue for region in self.avatar.regions):
            raise ConfigError(f"control.soft_tissue {lacking}; use 0")

    def _tissue(self, muscles: Muscles) -> JointTissue:
        """Return the passive resistance of the joints; under commanded motion, only their damping."""
        control = self.control
        locked = [joint_index(name) for name in LOCKED_JOINTS]
        if isinstance(control, PoseControlConfig):
            everywhere = np.full((NUM_JOINTS, 3), UNBOUNDED)
            return JointTissue(muscles.tissue_damping, -everywhere, everywhere, locked)
        sampled, matter, points = self.sampled, self.matter(), self._points
        mu, lam = lame_parameters(matter.young_modulus[0], matter.poisson_ratio[0])
        body = points.rest[0], self._volume[0], points.joints[0]
        stiffness = kept_stiffness(*body, sampled.links, sampled.skin_joints, sampled.skin_weights, mu, lam)
        ranges = muscles.range_lower, muscles.range_upper
        flesh = control.flesh_resistance * stiffness
        return JointTissue(muscles.tissue_damping, *ranges, locked, passive_moments(), flesh)

    def _attachment(self, whole: tuple[float, float], regions: list[tuple[float, float] | None]) -> np.ndarray:
        """Return the rates of the pulls that hold flesh to bones [1/s], ``(P,)``, from those at skin and bone."""
        sampled = self.sampled
        distance = bone_distance(sampled.rest_positions, sampled.bone)
        firm = firmness(sampled.skin_joints, sampled.skin_weights)
        rates = attachment_rates(sampled.depth, distance, firm, *whole)
        for own, inside in zip(regions, self._regions, strict=True):
            if own is not None:
                of_region = attachment_rates(sampled.depth, distance, np.zeros(len(sampled)), *own)
                rates = np.where(inside, of_region, rates)
        return rates

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
        young = self._region_values("young_modulus", young.astype(np.float32))
        poisson = self._region_values("poisson_ratio", matter.poisson_ratio[0])
        viscosity = self._region_values("viscosity", np.full(len(young), physics.viscosity))
        damping = self._region_values("damping_ratio", np.full(len(young), physics.damping_ratio))
        mu, _ = lame_parameters(young, poisson)
        return replace(
            matter,
            young_modulus=young[None],
            poisson_ratio=poisson[None],
            retardation=retardation_time(viscosity, damping, mu)[None],
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
        for region, inside in zip(self.avatar.regions, self._regions, strict=True):
            value = getattr(region, name)
            if value is not None:
                values[inside] = material_index(value) if name == "material" else value
        return values

    def in_region(self, region: RegionConfig) -> np.ndarray:
        """Return the mask of a region's particles, shape ``(P,)`` bool.

        Raises:
            ConfigError: the region has no particles, or the file has no such group.
        """
        sampled = self.sampled
        inside = np.ones(len(sampled), bool)
        if region.joints:
            inside &= np.isin(sampled.skin_joints[:, 0], [joint_index(name) for name in region.joints])
        if region.group is not None:
            try:
                inside &= flesh_of(self.asset, sampled, region.group)
            except ValueError as error:
                raise ConfigError(f"scene.avatars: {error}") from None
        if region.beyond > 0.0:
            inside &= bone_distance(sampled.rest_positions, sampled.bone) > region.beyond
        if region.depth is not None:
            inside &= sampled.depth <= region.depth
        if not inside.any():
            what = [] if region.group is None else [f"group {region.group!r}"]
            what += [str(list(region.joints))] if region.joints else []
            where = [] if region.depth is None else [f"within depth={region.depth} m of the skin"]
            where += [f"beyond={region.beyond} m from the bones"] if region.beyond > 0.0 else []
            raise ConfigError(
                f"scene.avatars: no particle of {' and '.join(what + where)}; use other joints, a greater depth, less "
                f"beyond or a finer body: its particles are {1e3 * sampled.spacing:.0f} mm apart"
            )
        return inside

    def shape_rates(self, model: Model) -> np.ndarray:
        """Return rates of physical and of kinematic shape preservation [1/s], ``(P, 2)``; no rows if all are alike.

        That is the form that :class:`~piavatar_envs.avatar.pose_control.controller.PoseController` takes.
        """
        alpha = self._region_values("alpha", np.full(len(self.sampled), self.control.alpha))
        if (alpha == self.control.alpha).all():
            return np.zeros((0, 2), np.float32)
        kinds = np.array([self.control.shape_preservation == kind for kind in ("physical", "kinematic")])
        return (alpha[:, None] / model.control_dt * kinds).astype(np.float32)


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
    control.root_rate = ROOT_RATE if settings.root != "free" else 0.0
    control.bones_bear = int(settings.root == "weight")
    control.max_root_force = settings.max_root_force * STANDARD_GRAVITY
    control.max_root_torque = settings.max_root_torque * STANDARD_GRAVITY
    control.bound_motion = int(settings.bound_motion)
    control.release_tilt_cos = math.cos(settings.release_tilt)
    control.release_distance, control.release_height = settings.release_distance, settings.release_height
    return control


@lru_cache(maxsize=4)
def _shape_particles(
    asset: AvatarAsset, sampled: ParticleSet, parameters: tuple[float, ...], keep: bool
) -> tuple[np.ndarray, ...]:
    """Return joints, rest positions and volumes of a shape, read-only: avatars and groups of environments share them.

    See :meth:`AvatarAsset.shape` and :func:`~piavatar_envs.avatar.body.sampling.morph`.
    """
    body = asset.shape(parameters)

    def compute() -> dict[str, np.ndarray]:
        return dict(zip(("rest", "volume"), morph(asset, sampled, body), strict=True))

    digest = digest_of([asset.vertices, asset.faces, body, sampled], [sampling]) if keep else ""
    moved = kept("shape", digest, compute, f"shaping the flesh of {asset.name}") if keep else compute()
    arrays = (body.joints, moved["rest"], moved["volume"])
    for array in arrays:
        array.setflags(write=False)
    return arrays


def load_avatar(settings: AvatarSourceConfig) -> AvatarAsset:
    """Return the configured body.

    Raises:
        ConfigError: the source refuses the settings, or finds no file.
    """
    try:
        return load_asset(settings.source, **settings.settings)
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


def _repeat(points: BodyPoints, rows: int) -> BodyPoints:
    """Return the same points with a writable row for each environment."""
    repeated = {name: np.repeat(getattr(points, name), rows, 0) for name in _OF_POINTS}
    shared = {name: getattr(points, name) for name in ("skin_joints", "skin_weights", "bone", "correctives")}
    return BodyPoints(**repeated, **shared)
