"""The drive of an avatar: records tracking, control steps and resets as launches of a program.

A control step starts from the pose tracked at the end of the one before. An avatar whose joints move under torques has
a :class:`~piavatar_envs.avatar.joint_drive.JointDrive` to do that instead.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields
from functools import partial

import numpy as np
import warp as wp

from piavatar_envs.avatar import posing
from piavatar_envs.avatar.body import BodyPoints, build_body
from piavatar_envs.avatar.joint_drive import JointDrive, JointSettings
from piavatar_envs.avatar.kabsch import local_rotations, track_bones
from piavatar_envs.avatar.lanes import chunk_threads, warp_threads
from piavatar_envs.avatar.settings import DriveSettings
from piavatar_envs.avatar.skeleton import NUM_JOINTS
from piavatar_envs.avatar.spawn import place_particles, reset_drive, set_in_motion
from piavatar_envs.avatar.substeps import Groups, record_drive, record_injection, record_pose
from piavatar_envs.avatar.types import DriveScratch, DriveState, Tracked, vec8, vec12, vec16, vec44
from piavatar_envs.mpm.program import Program
from piavatar_envs.mpm.solver import record_begin, record_end, record_substep
from piavatar_envs.mpm.types import DECOUPLING, Model, Scratch, State

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})


class AvatarDrive:
    """One avatar in every environment of a batch.

    Attributes:
        state: what a checkpoint holds.
        tracked: the bones as Kabsch sees them.
        joints: what turns the joints where torques do; None where the pose is driven.
    """

    def __init__(
        self,
        points: BodyPoints,
        first: int,
        model: Model,
        settings: DriveSettings,
        joints: JointSettings | None = None,
    ) -> None:
        self.model, self.settings = model, settings
        self.body = build_body(points, first, model.device)
        self.drive = settings.kernel_parameters(model)
        self.body_mass = wp.array(points.mass.sum(1).astype(np.float32), dtype=float, device=model.device)
        self.num_points = points.num_points
        self.num_chunks = self.body.chunk_bone.shape[0]
        self.threads = warp_threads(model.device)
        most_chunks = int(np.diff(self.body.chunk_start.numpy()).max())
        self.chunk_threads = chunk_threads(model.device, most_chunks)
        self.in_one = wp.get_device(model.device).is_cpu
        self.state = self._allocate(DriveState)
        self.tracked = self._allocate(Tracked)
        self.scratch = self._allocate(DriveScratch)
        self.groups = Groups(self.scratch, self.state)
        self.groups.lay_out(self.scratch, self.start_pose(), self.tracked.position)
        for rotation in (self.state.command_rotation, self.state.goal_rotation, self.tracked.rotation):
            rotation.fill_(wp.quat_identity())
        self.joints = JointDrive(points, self, joints) if joints else None

    def _allocate(self, cls):
        """Zeroed arrays for a dataclass of arrays, by the name's ending."""
        n, bones = self.model.num_envs, (self.model.num_envs, NUM_JOINTS)
        special = {
            "let_go": (n, int),
            "local": (bones, wp.quat),
            "motion": ((n, self.num_points), wp.vec3),
            "command_root": (n, wp.vec3),
            "goal_root": (n, wp.vec3),
            "root_increment": (n, wp.vec3),
            "anchor_rotation": (n, wp.quat),
            "anchor_translation": (n, wp.vec3),
            "moments": ((n, self.num_chunks), vec16),
            "corrections": ((n, self.num_chunks), vec12),
            "bone_inertia": (bones, wp.mat33),
            "body_inertia": (n, wp.mat33),
            "bone_from": (bones, wp.mat44),
            "bone_step": (bones, wp.mat44),
            "bone_record": (bones, vec44),
            "bone_corrections": (bones, vec12),
            "bone_change": (bones, vec8),
            "removed_turn": (n, wp.mat33),
            "pull": ((n, self.num_points), wp.vec3),
            "lean": ((n, self.num_points), wp.vec3),
        }
        per_env = ("body_", "wrench_", "removed_")
        arrays = {}
        for field in fields(cls):
            shape, dtype = special.get(field.name, (n if field.name.startswith(per_env) else bones, None))
            if dtype is None:
                dtype = wp.quat if field.name.endswith("rotation") else wp.vec3
            arrays[field.name] = wp.zeros(shape, dtype=dtype, device=self.model.device)
        return cls(**arrays)

    def record_tracking(self, program: Program, state: State) -> None:
        """Append: track the bones of the particles as they are now."""
        bones = (self.model.num_envs, NUM_JOINTS)
        t = self.tracked
        program.launch(
            track_bones,
            bones,
            [self.body, state.x, state.u, state.vk, state.failure],
            [t.rotation, t.position, t.velocity],
        )
        program.launch(local_rotations, bones, [self.body, t.rotation], [t.local])

    def record_reset(self, program: Program, state: State, mask: wp.array) -> None:
        """Append: put the masked environments into the pose of ``state.command_*``, unstrained.

        They are at rest, or on their way to where :attr:`JointDrive.first` says.
        """
        n, s, d = self.model.num_envs, self.scratch, self.state
        program.launch(
            reset_drive,
            (n, NUM_JOINTS),
            [mask, d.command_rotation, d.command_root],
            [d.goal_rotation, d.goal_root, d.let_go, d.wrench_force, d.wrench_torque],
        )
        for increment in (s.command_increment, s.root_increment):
            program.launch(clear_vectors, increment.size, [increment.flatten()])
        record_pose(self, program, 0.0, d.command_rotation, d.command_root, s.command_increment, self.groups.pose)
        program.launch(
            posing.rest_matrices, (n, NUM_JOINTS), [self.body, s.pose_rotation, s.pose_position], [s.bone_from]
        )
        program.launch(
            place_particles,
            n * self.num_points,
            [mask, self.body, s.bone_from],
            [state.x, state.u, state.C, state.F, state.kinematic, d.motion, state.failure],
        )
        if self.joints:
            self.joints.record_reset(program, mask)
            if self.joints.first:
                self._record_motion(program, state, mask)

    def _record_motion(self, program: Program, state: State, mask: wp.array) -> None:
        """Append: the masked environments' bodies, placed already, are on their way to a pose."""
        n, s = self.model.num_envs, self.scratch
        after = self.groups.next_pose
        record_pose(self, program, 0.0, *self.joints.first, s.command_increment, after)
        program.launch(
            posing.rest_matrices, (n, NUM_JOINTS), [self.body, after.rotation, after.position], [s.bone_step]
        )
        inputs = [mask, self.body, self.model.control_dt, s.bone_step, state.x]
        program.launch(set_in_motion, (n, self.num_points), inputs, [state.u])
        self.joints.record_motion(program, mask, after)

    def record_begin(self, program: Program) -> None:
        """Append what begins a control step: from the tracked pose towards ``state.goal_*``."""
        s, d, t = self.scratch, self.state, self.tracked
        program.launch(clear_vectors, d.wrench_force.size, [d.wrench_force])
        program.launch(clear_vectors, d.wrench_torque.size, [d.wrench_torque])
        if self.joints:
            self.joints.record_begin(program)
            return
        program.launch(
            posing.begin_control,
            (self.model.num_envs, NUM_JOINTS),
            [self.drive, t.local, t.position, d.command_rotation, d.command_root, d.goal_rotation, d.goal_root],
            [s.increment, s.command_increment, s.root_increment, s.carry_rotation, s.carry_translation],
        )
        record_pose(self, program, 0.0, *self.start_pose(), s.increment, self.groups.pose)

    def record_end(self, program: Program, state: State) -> None:
        """Append what ends a control step: the goal has been commanded. Where torques act, nothing is."""
        d = self.state
        if self.joints:
            self.joints.record_end(program, state)
            return
        program.launch(
            posing.end_control,
            (self.model.num_envs, NUM_JOINTS),
            [d.goal_rotation, d.goal_root, state.failure],
            [d.command_rotation, d.command_root],
        )

    def start_pose(self) -> tuple[wp.array, wp.array]:
        """Pose that a control step starts from: local rotations and root position."""
        if self.settings.mode == "reference":
            return self.state.command_rotation, self.state.command_root
        return self.tracked.local, self.tracked.position[:, 0]


def record_control_step(
    program: Program, avatars: Sequence[AvatarDrive], model: Model, state: State, scratch: Scratch
) -> None:
    """Append one control step of all ``avatars`` of a world through all substeps, after which they are tracked.

    They go beside each other: what one does between substeps has nothing to do with another.
    """
    world = (model, state, scratch)
    injected = model.step.decoupling in (DECOUPLING["paper"], DECOUPLING["none"])

    def drive(avatar: AvatarDrive, own: Program, step: int) -> None:
        if avatar.joints:
            avatar.joints.record_substep(own, state, scratch, step)
        else:
            record_drive(avatar, own, state, step)

    record_begin(program, *world, program.branches(avatars, lambda avatar, own: avatar.record_begin(own)))
    if injected:
        program.fork_each(avatars, lambda avatar, own: record_injection(avatar, own, state))
    for step in range(model.num_substeps):
        if not injected:
            program.fork_each(avatars, partial(drive, step=step))
        record_substep(program, *world, step)
    record_end_of_step(program, avatars, *world)


def record_end_of_step(
    program: Program, avatars: Sequence[AvatarDrive], model: Model, state: State, scratch: Scratch
) -> None:
    """Append what ends a control step, when all substeps have been taken: it is sensed, and ``avatars`` are tracked."""

    def end(avatar: AvatarDrive, own: Program) -> None:
        avatar.record_end(own, state)
        avatar.record_tracking(own, state)

    ends = program.branches(avatars, end)
    moves = any(avatar.joints for avatar in avatars)  # these put particles in their places, and sensors ask for those
    record_end(program, model, state, scratch, () if moves else ends)
    if moves:
        program.fork(*ends)


@wp.kernel
def clear_vectors(v: wp.array(dtype=wp.vec3)):
    """Zero an array of vectors inside a program."""
    v[wp.tid()] = wp.vec3(0.0)
