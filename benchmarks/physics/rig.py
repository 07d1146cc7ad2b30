"""A batch of avatars without a task: posed, driven, struck and measured. What the physics benchmarks stand on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import warp as wp
from scipy.spatial.transform import Rotation

from piavatar_envs.avatar.avatar import Avatar
from piavatar_envs.avatar.body.asset import AvatarAsset
from piavatar_envs.avatar.body.device import BodyPoints
from piavatar_envs.avatar.body.sampling import ParticleSet, morph, sample_particles, spacing_for
from piavatar_envs.avatar.body.skeleton import NUM_JOINTS, PARENTS, forward_kinematics, skin
from piavatar_envs.avatar.body.sources import load_asset
from piavatar_envs.avatar.pose_control.controller import PoseController
from piavatar_envs.avatar.types import Tracked
from piavatar_envs.config import PoseControlConfig
from piavatar_envs.core.arrays import matrices_of
from piavatar_envs.core.launch_graph import LaunchGraph
from piavatar_envs.mpm.colliders import Collider
from piavatar_envs.mpm.memory import allocate
from piavatar_envs.mpm.model import MaterialPoints, build_model, make_grid
from piavatar_envs.sim.bodies import pose_control
from piavatar_envs.sim.resolution import GRID_PER_HEIGHT
from piavatar_envs.sim.world import record_control_step
from piavatar_envs.tasks.track_motion import apply_impulse

DENSITY = 1000.0
LOWER, UPPER = (-1.6, -1.6, -0.7), (1.6, 1.6, 2.6)  # room enough for bodies that come apart


@dataclass(frozen=True)
class World:
    """Settings of a batch except for its bodies and its control.

    Attributes:
        fidelity: resolution, as in the environments.
        decoupling: one of the four variants of :mod:`piavatar_envs.mpm.g2p`.
        num_substeps: a control step; None chooses them from the CFL limit.
        gravity: along -z [m/s^2].
        ground: a floor at z = 0.
        bone_rings: rings of five bone particles along every bone.
        bone_voxel: edge of the cubes that have one point of a skeleton each, over the spacing of particles.
        avatar: names and values of the body's settings, as ``(("source", "smplx"), ("path", FILE))``.
        device: Warp device.
    """

    fidelity: str = "coarse"
    decoupling: str = "split"
    num_substeps: int | None = 100
    gravity: float = 0.0
    ground: bool = False
    bone_rings: int = 4
    bone_voxel: float = 1.0
    avatar: tuple[tuple[str, str], ...] = ()
    device: str = "cpu"

    @property
    def asset(self) -> AvatarAsset:
        """The body, in all of its shapes."""
        return load_asset(**dict(self.avatar))

    def sample(self, spacing: float) -> ParticleSet:
        """Return the particles of the body's mean shape."""
        return sample_particles(self.asset, spacing, bone_rings=self.bone_rings, bone_voxel=self.bone_voxel)


class Rig:
    """``num_envs`` bodies of given shapes, at rest in the rest pose.

    Attributes:
        points: the particles (NumPy), a row per body.
        flesh: particles that track no bone, shape ``(P,)`` bool.
    """

    def __init__(self, world: World, control: PoseControlConfig, shapes: np.ndarray) -> None:
        """Build a body for each row of ``shapes`` (shape parameters, ``(num_envs, S)``) and place them."""
        self.world, self.num_envs = world, len(shapes)
        asset = self.asset = world.asset
        self.dx = float(np.ptp(asset.mean_body().vertices[:, 2])) / GRID_PER_HEIGHT[world.fidelity]
        particles = world.sample(spacing_for(self.dx))
        self.shaped = [asset.shape(parameters) for parameters in shapes]
        bodies = World(bone_rings=world.bone_rings, bone_voxel=world.bone_voxel, avatar=world.avatar)
        morphed = [_morphed(tuple(map(float, row)), spacing_for(self.dx), bodies) for row in shapes]
        volume = np.array([volumes for _, volumes in morphed])
        self.points = BodyPoints(
            rest=np.array([rest for rest, _ in morphed]),
            mass=(DENSITY * volume).astype(np.float32),
            joints=np.array([shaped.joints for shaped in self.shaped]),
            skin_joints=particles.skin_joints,
            skin_weights=particles.skin_weights,
            bone=particles.bone,
            velocity_lag=np.zeros((1, len(particles)), np.float32),
        )
        self.flesh = particles.bone < 0
        self.model = build_model(
            MaterialPoints.uniform(volume, DENSITY),
            make_grid(LOWER, UPPER, self.dx),
            num_envs=self.num_envs,
            device=world.device,
            num_substeps=world.num_substeps,
            gravity=(0.0, 0.0, -world.gravity),
            decoupling=world.decoupling,
            colliders=[Collider.plane((0.0, 0.0, 1.0), 0.0, 0.8)] if world.ground else [],
        )
        self.state, self.scratch = allocate(self.model)
        self.avatar = Avatar(self.points, 0, self.model)
        self.controller = PoseController(self.avatar, self.points, pose_control(control, self.model))
        self._record()
        self.reset()

    def _record(self) -> None:
        n, device = self.num_envs, self.model.device
        self._placed = wp.zeros(n, dtype=wp.bool, device=device)
        self._impulse = wp.zeros(n, dtype=wp.vec3, device=device)
        self._struck = wp.zeros(n, dtype=int, device=device)
        self._reset, self._step, self._strike = LaunchGraph(device), LaunchGraph(device), LaunchGraph(device)
        self.avatar.record_reset(self._reset, self.state, self._placed)
        self.avatar.record_tracking(self._reset, self.state)
        record_control_step(self._step, [self.avatar], [self.controller], self.model, self.state, self.scratch)
        self._strike.launch(
            apply_impulse,
            (n, self.points.num_points),
            [self.avatar.body, self._impulse, self._struck, self.state.failure],
            [self.state.u],
        )
        self._strike.launch(clear_impulse, n, [], [self._impulse])

    def reset(
        self, rotations: np.ndarray | None = None, shifts: np.ndarray | None = None, bodies: np.ndarray | None = None
    ) -> None:
        """Put ``bodies`` (all, or those of a mask) at rest and unstrained into a pose, by default the rest pose.

        Rotation vectors ``(num_envs, 22, 3)`` [rad], root shifts ``(num_envs, 3)`` [m].
        """
        mask = np.ones(self.num_envs, bool) if bodies is None else bodies
        rotations = np.zeros((self.num_envs, NUM_JOINTS, 3)) if rotations is None else rotations
        shifts = np.zeros((self.num_envs, 3)) if shifts is None else shifts
        drive = self.avatar.state
        for array, pose in (
            (drive.command_rotation, _quaternions(rotations)),
            (drive.command_root, (self.points.joints[:, 0] + shifts).astype(np.float32)),
        ):
            value = array.numpy()
            value[mask] = pose[mask]
            array.assign(value)
        self._placed.assign(mask)
        self._reset.run()

    def step(self, rotations: np.ndarray | None = None, shifts: np.ndarray | None = None) -> None:
        """Take a control step towards a pose: rotation vectors ``(num_envs, 22, 3)`` [rad], shifts ``(num_envs, 3)``.

        Without a pose, towards the one before.
        """
        drive = self.avatar.state
        if rotations is not None:
            drive.goal_rotation.assign(_quaternions(rotations))
            shifts = np.zeros((self.num_envs, 3)) if shifts is None else shifts
            drive.goal_root.assign((self.points.joints[:, 0] + shifts).astype(np.float32))
        self._step.run()

    def strike(self, bone: Sequence[int] | np.ndarray, impulse: np.ndarray) -> None:
        """Give a bone of every body an impulse ``(num_envs, 3)`` [N s], spread over its flesh."""
        self._struck.assign(np.asarray(bone, np.int32))
        self._impulse.assign(np.asarray(impulse, np.float32))
        self._strike.run()

    @property
    def alive(self) -> np.ndarray:
        """Return a mask ``(num_envs,)`` of bodies whose simulation has not failed."""
        return self.state.failure.numpy() == 0

    def distances(self) -> np.ndarray:
        """Return the distance of flesh to the skinned commanded pose [m], shape ``(num_envs, flesh)``."""
        drive = self.avatar.state
        local = Rotation.from_quat(drive.goal_rotation.numpy().reshape(-1, 4)).as_matrix()
        local, root = local.reshape(self.num_envs, NUM_JOINTS, 3, 3), drive.goal_root.numpy()
        return self._distances_to(local, root)

    def shape_errors(self) -> np.ndarray:
        """Return the distance of flesh to the skinned *tracked* pose [m], shape ``(num_envs, flesh)``."""
        tracked = self.avatar.tracked
        local = Rotation.from_quat(tracked.local.numpy().reshape(-1, 4)).as_matrix()
        return self._distances_to(local.reshape(self.num_envs, NUM_JOINTS, 3, 3), tracked.position.numpy()[:, 0])

    def _distances_to(self, local: np.ndarray, root: np.ndarray) -> np.ndarray:
        x, points = self.state.x.numpy(), self.points
        found = np.empty((self.num_envs, int(self.flesh.sum())))
        for env in range(self.num_envs):
            rotations, positions = forward_kinematics(local[env], root[env], points.joints[env])
            skinned = skin(
                points.rest[env][self.flesh],
                points.skin_joints[self.flesh],
                points.skin_weights[self.flesh],
                rotations,
                positions,
                points.joints[env],
            )
            found[env] = np.linalg.norm(x[env][self.flesh] - skinned, axis=1)
        return found

    def pose_errors(self) -> dict[str, np.ndarray]:
        """Return errors of the tracked pose against the commanded one, by Kabsch.

        ``root_rotation`` [rad] and ``root_translation`` [m] of shape ``(num_envs,)``; ``relative_rotation`` [rad] and
        ``relative_translation`` [m] of every joint in its parent's frame, shape ``(num_envs, 21)``.
        """
        tracked, drive, n = self.avatar.tracked, self.avatar.state, self.num_envs

        def rotation(array: wp.array) -> Rotation:
            return Rotation.from_quat(array.numpy().reshape(-1, 4).astype(float))

        error = (rotation(tracked.local).inv() * rotation(drive.goal_rotation)).magnitude().reshape(n, NUM_JOINTS)
        position = tracked.position.numpy()[:, 0].astype(float)
        return {
            "root_rotation": error[:, 0],
            "root_translation": np.linalg.norm(position - drive.goal_root.numpy(), axis=1),
            "relative_rotation": error[:, 1:],
            "relative_translation": joint_gaps(tracked, self.points.joints),
        }

    def strain(self) -> np.ndarray:
        """Return the mean distance of the deformation gradient to the nearest rotation, shape ``(num_envs,)``.

        ``|F - R|`` rather than ``|F - I|``: a free body that is struck turns, and a turn is not strain.
        """
        F = matrices_of(self.state.F).astype(float)
        squared = np.linalg.eigvalsh(np.swapaxes(F, 2, 3) @ F)
        return np.linalg.norm(np.sqrt(np.maximum(squared, 0.0)) - 1.0, axis=2).mean(1)


def joint_gaps(tracked: Tracked, joints: np.ndarray) -> np.ndarray:
    """Return the distance of joints from their places on the parents' bones [m], shape ``(num_envs, 21)``.

    Args:
        tracked: bones as the particles have them.
        joints: of the bodies at rest [m], shape ``(1 or num_envs, 22, 3)``.
    """
    position, parents = tracked.position.numpy().astype(float), np.asarray(PARENTS)[1:]
    world = Rotation.from_quat(tracked.rotation.numpy().reshape(-1, 4).astype(float)).as_matrix()
    world = world.reshape(len(position), NUM_JOINTS, 3, 3)
    # where a joint sits in its parent's frame, against the fixed offset of the skeleton
    offset = np.einsum("ebji,ebj->ebi", world[:, parents], position[:, 1:] - position[:, parents])
    return np.linalg.norm(offset - (joints[:, 1:] - joints[:, parents]), axis=2)


@lru_cache(maxsize=64)
def _morphed(parameters: tuple[float, ...], spacing: float, world: World) -> tuple[np.ndarray, np.ndarray]:
    """Return rest positions [m] and volumes [m^3] of a shape's particles; all variants use the same bodies."""
    return morph(world.asset, world.sample(spacing), world.asset.shape(parameters))


@wp.kernel
def clear_impulse(impulse: wp.array(dtype=wp.vec3)):
    """Clear the impulse, so that it acts once."""
    impulse[wp.tid()] = wp.vec3(0.0)


def _quaternions(rotations: np.ndarray) -> np.ndarray:
    """Return Warp's ``xyzw`` quaternions ``(..., 4)`` of rotation vectors ``(..., 3)``."""
    return Rotation.from_rotvec(rotations.reshape(-1, 3)).as_quat().astype(np.float32).reshape(*rotations.shape[:-1], 4)
