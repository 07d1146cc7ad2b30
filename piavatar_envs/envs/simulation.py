"""The physical world of an environment: bodies, grid and drive for a whole batch, without tasks or rewards."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
import warp as wp

from piavatar_envs.avatar.asset import AvatarAsset, load_body
from piavatar_envs.avatar.body import BodyPoints, bone_masses
from piavatar_envs.avatar.drive import AvatarDrive, clear_vectors
from piavatar_envs.avatar.sampling import ParticleSet, morph, sample_particles, spacing_for
from piavatar_envs.avatar.settings import DriveSettings
from piavatar_envs.avatar.soft_tissue import inert_share, softness
from piavatar_envs.envs.config import EnvConfig
from piavatar_envs.mpm.build import MaterialPoints, allocate, build_model, make_grid
from piavatar_envs.mpm.program import Program

#: Grid spacings in a standing mean body, by fidelity; "fine" is the paper's scale, about 1 cm.
GRID_PER_HEIGHT: dict[str, float] = {"tiny": 12.0, "coarse": 32.0, "medium": 64.0, "fine": 166.0}


@dataclass(frozen=True)
class Domain:
    """Box in which particles may move [m]; leaving it is a failure.

    The default holds a body with outstretched limbs wherever its root may be before it lets go.
    """

    lower: tuple[float, float, float] = (-1.6, -1.6, -0.3)
    upper: tuple[float, float, float] = (1.6, 1.6, 2.6)


def drive_settings(config: EnvConfig) -> DriveSettings:
    """The drive's parameters of a configuration."""
    d = config.drive
    return DriveSettings(
        mode=d.drive,
        tone=d.tone,
        alpha=d.alpha,
        shape_preservation=d.shape_preservation,
        root=d.root,
        free_motion=d.free_motion,
        max_force=d.max_force_weight,
        max_torque=d.max_torque_weight,
        max_tilt=d.let_go_tilt,
        max_horizontal_error=d.let_go_distance,
        max_height_error=d.let_go_height,
    )


class Simulation:
    """One avatar in each of ``num_envs`` worlds.

    Attributes:
        model: constants of the continuum.
        state: particles; scratch: grid.
        avatar: the drive.
        shape_parameters: of every environment, shape ``(num_envs, S)``.
    """

    def __init__(
        self,
        config: EnvConfig,
        num_envs: int = 1,
        device: str = "cpu",
        domain: Domain | None = None,
        planes: Sequence[tuple[Sequence[float], float, float]] | None = None,
        asset: AvatarAsset | None = None,
    ) -> None:
        """Build and allocate; nothing is placed until the first reset.

        Args:
            config: resolution, material, drive and shape.
            num_envs: worlds in the batch.
            device: Warp device, ``"cpu"`` or ``"cuda:0"``.
            domain: where particles may go.
            planes: boundaries as ``(normal, offset [m], friction)``; the ground if not given.
            asset: the body; the embedded one if not given.

        Raises:
            ValueError: an unknown device, an unstable time step, a batch that does not fit.
        """
        self.config, self.num_envs, self.device = config, num_envs, check_device(device)
        self.asset = asset or load_body()
        self.mean_body = self.asset.mean_body()
        physics = config.physics
        self.dx = float(np.ptp(self.mean_body.vertices[:, 2])) / GRID_PER_HEIGHT[physics.fidelity]
        self.particles: ParticleSet = sample_particles(self.asset, spacing_for(self.dx))
        self.base_parameters = self.asset.parameters(**config.shape.parameters)
        self.shape_parameters = np.tile(self.base_parameters, (num_envs, 1))
        points, volume = self._points(self.base_parameters)
        if config.shape.randomize:
            points, volume = _repeat(points, num_envs), np.repeat(volume, num_envs, 0)
        self.points = points
        matter = MaterialPoints.uniform(
            volume, physics.density, physics.young_modulus, physics.poisson_ratio, physics.material
        )
        if physics.soft_young_modulus is not None:
            # geometric between the two: stiffness varies over decades
            ratio = (physics.soft_young_modulus / physics.young_modulus) ** self._softness(points.rest[0])[None]
            matter = replace(matter, young_modulus=(matter.young_modulus * ratio).astype(np.float32))
        domain = domain or Domain()
        self.model = build_model(
            matter,
            make_grid(domain.lower, domain.upper, self.dx),
            num_envs=num_envs,
            device=self.device,
            control_dt=physics.control_dt,
            num_substeps=physics.num_substeps,
            cfl=physics.cfl,
            gravity=(0.0, 0.0, -physics.gravity),
            decoupling=physics.decoupling,
            planes=[((0.0, 0.0, 1.0), 0.0, physics.friction)] if planes is None else planes,
        )
        self.state, self.scratch = allocate(self.model)
        self.avatar = AvatarDrive(points, 0, self.model, drive_settings(config))

    @property
    def rest_joints(self) -> np.ndarray:
        """Rest joint positions [m], shape ``(1 or num_envs, 22, 3)``."""
        return self.points.joints

    def _points(self, parameters: np.ndarray) -> tuple[BodyPoints, np.ndarray]:
        """Points and volumes [m^3] of one shape."""
        shaped = self.asset.shape(parameters)
        rest, volume = morph(self.asset, self.particles, shaped)
        sampled = self.particles
        points = BodyPoints(
            rest=rest[None],
            mass=(self.config.physics.density * volume[None]).astype(np.float32),
            joints=shaped.joints[None],
            skin_joints=sampled.skin_joints,
            skin_weights=sampled.skin_weights,
            bone=sampled.bone,
            inert=inert_share(self.config.drive.soft_tissue, self._softness(rest))[None],
        )
        return points, volume[None]

    def _softness(self, rest: np.ndarray) -> np.ndarray:
        """How soft the flesh is at every particle, in [0, 1]."""
        sampled = self.particles
        return softness(rest, sampled.bone, sampled.skin_joints, sampled.skin_weights)

    def set_shape(self, env: int, parameters: np.ndarray) -> None:
        """Give environment ``env`` another body; takes effect when it is placed again.

        Raises:
            ValueError: the configuration has one shape for all environments, or a parameter is out of range.
        """
        if not self.config.shape.randomize:
            raise ValueError("all environments share one body; set shape.randomize=True to give each its own")
        points, volume = self._points(parameters)
        mass, center = bone_masses(points)
        body, particles = self.avatar.body, self.model.particles
        rows = [
            (body.rest, points.rest),
            (body.rest_joint, points.joints),
            (body.rest_center, center),
            (body.inert, points.inert),
            (body.bone_mass, mass),
            (particles.mass, points.mass),
            (particles.volume, volume),
        ]
        for array, value in rows:
            array[env].assign(np.ascontiguousarray(value[0], np.float32))
        self.avatar.body_mass[env : env + 1].assign(points.mass.sum(1).astype(np.float32))
        self.points.rest[env], self.points.mass[env], self.points.joints[env] = (
            points.rest[0],
            points.mass[0],
            points.joints[0],
        )
        self.shape_parameters[env] = parameters

    def adopt_shapes(self, parameters: np.ndarray) -> None:
        """Make the host's copy follow bodies whose arrays were restored on the device, with their shape parameters."""
        body, particles = self.avatar.body, self.model.particles
        self.points.rest[:], self.points.joints[:] = body.rest.numpy(), body.rest_joint.numpy()
        self.points.mass[:] = particles.mass.numpy()
        self.shape_parameters[:] = parameters

    def record_reset(self, program: Program, mask: wp.array) -> None:
        """Append: place the masked environments in their commanded pose and track them."""
        self.avatar.record_reset(program, self.state, mask)
        self.avatar.record_tracking(program, self.state)

    def record_control_step(self, program: Program) -> None:
        """Append: one control step towards the avatar's goal, then track."""
        program.launch(clear_vectors, self.num_envs, [self.scratch.boundary_impulse])
        self.avatar.record_control_step(program, self.state, self.scratch)
        self.avatar.record_tracking(program, self.state)

    def arrays(self) -> dict[str, wp.array]:
        """Every array of a checkpoint, by name."""
        groups = {"particles": self.state, "drive": self.avatar.state, "tracked": self.avatar.tracked}
        found = {
            f"{group}.{field.name}": getattr(value, field.name)
            for group, value in groups.items()
            for field in fields(value)
        }
        if self.config.shape.randomize:
            body, particles = self.avatar.body, self.model.particles
            found |= {
                f"body.{n}": getattr(body, n) for n in ("rest", "rest_joint", "rest_center", "bone_mass", "inert")
            }
            found |= {f"matter.{n}": getattr(particles, n) for n in ("mass", "volume")}
            found["body.body_mass"] = self.avatar.body_mass
        return found


def check_device(device: str) -> str:
    """Name of an available Warp device.

    Raises:
        ValueError: there is no such device.
    """
    try:
        return str(wp.get_device(device).alias)
    except (ValueError, RuntimeError) as error:
        available = ", ".join(d.alias for d in wp.get_devices())
        raise ValueError(f"device={device!r} is not available ({error}); use one of {available}") from None


def _repeat(points: BodyPoints, rows: int) -> BodyPoints:
    """The same points with a writable row for each environment."""
    repeated = {name: np.repeat(getattr(points, name), rows, 0) for name in ("rest", "mass", "joints", "inert")}
    return BodyPoints(**repeated, skin_joints=points.skin_joints, skin_weights=points.skin_weights, bone=points.bone)
