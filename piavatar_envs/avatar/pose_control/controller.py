"""What a drive does before every MPM substep.

It fits rigid motions to the physical velocity, carries the bones by them, writes the kinematic velocity, pulls shape
and pose, and applies the root wrench.

The drive of an avatar: records tracking, control steps and resets as launches of a graph.

A control step starts from the pose tracked at the end of the one before. An avatar whose joints move under torques has
a :class:`~piavatar_envs.avatar.torque_control.controller.JointDrive` to do that instead.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from piavatar_envs.avatar import kinematics
from piavatar_envs.avatar import segment_sums as bone_sums
from piavatar_envs.avatar.body.device import BodyPoints, build_body
from piavatar_envs.avatar.body.skeleton import NUM_JOINTS
from piavatar_envs.avatar.pose_control import kernels as drive_stages
from piavatar_envs.avatar.pose_control import kernels as flesh
from piavatar_envs.avatar.pose_control import kernels as posing
from piavatar_envs.avatar.pose_control.injection import inject_velocity
from piavatar_envs.avatar.segment_sums import warps_of
from piavatar_envs.avatar.spawn import place_particles, reset_drive, set_in_motion
from piavatar_envs.avatar.torque_control.controller import JointDrive, JointSettings
from piavatar_envs.avatar.tracking import local_rotations, track_bones
from piavatar_envs.avatar.types import (
    Anchor,
    Bench,
    Carry,
    Command,
    DriveScratch,
    DriveSettings,
    DriveState,
    Held,
    Pose,
    RemovedMotion,
    RigidFit,
    RigidFits,
    Tracked,
    Wrench,
    vec44,
)
from piavatar_envs.core.arrays import group, vec8, vec12, vec16
from piavatar_envs.core.cuda_intrinsics import BLOCK, chunk_threads, particle_rounds, particle_threads, warp_threads
from piavatar_envs.core.launch_graph import LaunchGraph
from piavatar_envs.mpm.solver import record_begin, record_end, record_substep
from piavatar_envs.mpm.types import DECOUPLING, Model, Scratch, State

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})


if TYPE_CHECKING:
    from piavatar_envs.avatar.pose_control.controller import AvatarDrive


class Groups:
    """The scratch arrays of a drive, bundled as kernels take them."""

    def __init__(self, s: DriveScratch, d: DriveState) -> None:
        self.bones = group(
            RigidFits, center=s.bone_center, velocity=s.bone_velocity, spin=s.bone_spin, inertia=s.bone_inertia
        )
        self.whole = group(
            RigidFit, center=s.body_center, velocity=s.body_velocity, spin=s.body_spin, inertia=s.body_inertia
        )
        self.removed = group(RemovedMotion, velocity=s.removed_velocity, turn=s.removed_turn, center=s.removed_center)
        # the pose at a substep's start and at its end; they change roles every substep
        self.pose = group(Pose, rotation=s.pose_rotation, position=s.pose_position)
        self.next_pose = group(Pose, rotation=s.next_rotation, position=s.next_position)
        self.command_pose = group(Pose, rotation=s.command_pose_rotation, position=s.command_pose_position)
        self.carry = group(Carry, rotation=s.carry_rotation, translation=s.carry_translation)
        self.held = group(Held, let_go=d.let_go, wrench_force=d.wrench_force, wrench_torque=d.wrench_torque)
        self.command = group(
            Command,
            rotation=d.command_rotation,
            increment=s.command_increment,
            root=d.command_root,
            goal_root=d.goal_root,
        )

    def lay_out(self, s: DriveScratch, start: tuple[wp.array, wp.array], tracked: wp.array) -> None:
        """Make :attr:`bench`, of even and of odd substeps, for control steps that ``start`` from a pose."""
        rotation, root = start
        poses = (self.pose, self.next_pose), (self.next_pose, self.pose)
        self.bench = [
            group(
                Bench,
                start_rotation=rotation,
                start_root=root,
                increment=s.increment,
                root_increment=s.root_increment,
                command=self.command,
                tracked=tracked,
                now=now,
                after=after,
                command_pose=self.command_pose,
                carry=self.carry,
                anchor=group(Anchor, rotation=s.anchor_rotation, translation=s.anchor_translation),
                gap=s.gap,
                bones=self.bones,
                whole=self.whole,
                removed=self.removed,
                wrench=group(Wrench, linear=s.wrench_linear, angular=s.wrench_angular),
                moments=s.moments,
                record=s.bone_record,
                pull=s.pull,
                lean=s.lean,
                corrections=s.corrections,
                bone_corrections=s.bone_corrections,
                change=s.bone_change,
            )
            for now, after in poses
        ]


def record_pose(drive: AvatarDrive, graph: LaunchGraph, fraction: float, rotation, root, increment, out: Pose) -> None:
    """Append: the pose at ``fraction`` of a control step that starts from local ``rotation`` and ``root``."""
    inputs = [drive.body, fraction, rotation, root, increment, drive.scratch.root_increment, drive.threads]
    graph.launch(kinematics.pose_body, (drive.model.num_envs, drive.threads), inputs, [out.rotation, out.position])


def record_drive(drive: AvatarDrive, graph: LaunchGraph, state: State, step: int) -> None:
    """Append what an avatar does before substep ``step`` of a control step of the ``"split"`` scheme."""
    n, s, g = drive.model.num_envs, drive.scratch, drive.groups
    bench, who = g.bench[step % 2], [drive.body, drive.drive]
    if drive.in_one:
        inputs = [*who, drive.model.particles, drive.body_mass, step, state.x, state.failure]
        outputs = [bench, g.held, drive.state.motion, state.u, state.kinematic]
        graph.launch(drive_stages.drive_body, n, inputs, outputs)
        return
    chunks = (n, warps_of(drive.body.quarters, drive.threads), drive.threads)
    own = [drive.chunk_threads, state.failure, drive.threads]
    each_bone, of_bone = (n, NUM_JOINTS, drive.threads), [drive.body, state.failure, drive.threads]
    inputs = [drive.body, drive.model.particles, state.x, state.u, bench.tracked, state.failure, drive.threads]
    graph.launch(bone_sums.sum_moments, chunks, inputs, [s.moments], block_dim=BLOCK)
    if drive.chunk_threads == 0:
        graph.launch(drive_stages.fit_bones, each_bone, of_bone, [bench], block_dim=drive.threads)
    rounds = particle_rounds(drive.model.device, n * drive.num_points)
    shared = particle_threads(drive.model.device, drive.num_points, rounds)
    bones = (n, drive.threads)
    threads = drive_stages.warps_of_body(drive.model.device, n) * drive.threads
    inputs = [*who, drive.body_mass, step, drive.chunk_threads, state.failure]
    graph.launch(drive_stages.prepare_body, (n, threads), inputs, [bench, g.held], block_dim=threads)
    graph.launch(
        flesh.drive_particles,
        (n, shared),
        [*who, state.x, s.bone_record, g.bones, drive.state.let_go, state.failure],
        [state.u, drive.state.motion, state.kinematic, s.pull, s.lean],
        block_dim=BLOCK,
    )
    if drive.drive.free_motion or drive.drive.root_rate > 0.0:  # a root that lets go leaves a free body
        _record_free_motion(drive, graph, state, bench)
    inputs = [drive.body, drive.model.particles, state.x, s.bone_center, s.pull, s.lean, state.failure, drive.threads]
    graph.launch(bone_sums.sum_corrections, chunks, inputs, [s.corrections], block_dim=BLOCK)
    if drive.chunk_threads == 0:
        graph.launch(drive_stages.add_to_bones, each_bone, of_bone, [bench], block_dim=drive.threads)
    graph.launch(drive_stages.settle_body, bones, [*who, *own], [bench], block_dim=drive.threads)
    graph.launch(
        flesh.apply_corrections,
        (n, shared),
        [*who, state.x, s.pull, g.bones, s.bone_change, g.removed, drive.state.let_go, state.failure],
        [state.u, state.kinematic],
        block_dim=BLOCK,
    )


def _record_free_motion(drive: AvatarDrive, graph: LaunchGraph, state: State, bench: Bench) -> None:
    """Take the rigid part out of the commanded motion of bodies that nothing supports."""
    s, n, threads = drive.scratch, drive.model.num_envs, drive.threads
    inputs = [drive.body, drive.drive, drive.model.particles, state.x, state.vk, s.bone_center, drive.state.let_go]
    shape = (n, int(bone_sums.GROUPS), threads)
    graph.launch(
        bone_sums.sum_motion, shape, [*inputs, state.failure, threads], [s.corrections], block_dim=BLOCK
    )  # fmt: skip
    inputs = [drive.body, drive.drive, state.failure, threads]
    graph.launch(drive_stages.settle_motion, (n, threads), inputs, [bench, drive.groups.held], block_dim=BLOCK)


def record_injection(drive: AvatarDrive, graph: LaunchGraph, state: State) -> None:
    """Append the paper's drive: one injection of velocity, before the plain substeps of a control step."""
    s, g = drive.scratch, drive.groups
    record_pose(drive, graph, 1.0, *drive.start_pose(), s.increment, g.next_pose)
    graph.launch(
        posing.bone_matrices,
        (drive.model.num_envs, NUM_JOINTS),
        [drive.body, drive.model.control_dt, g.pose, g.next_pose, g.carry],
        [s.bone_from, s.bone_step],
    )
    graph.launch(
        inject_velocity,
        (drive.model.num_envs, drive.num_points),
        [drive.body, drive.drive.kinematic_shape_rate, state.x, s.bone_from, s.bone_step, state.failure],
        [state.u, state.vk],
    )


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

    def record_tracking(self, graph: LaunchGraph, state: State) -> None:
        """Append: track the bones of the particles as they are now."""
        bones = (self.model.num_envs, NUM_JOINTS)
        t = self.tracked
        graph.launch(
            track_bones,
            bones,
            [self.body, state.x, state.u, state.vk, state.failure],
            [t.rotation, t.position, t.velocity],
        )
        graph.launch(local_rotations, bones, [self.body, t.rotation], [t.local])

    def record_reset(self, graph: LaunchGraph, state: State, mask: wp.array) -> None:
        """Append: put the masked environments into the pose of ``state.command_*``, unstrained.

        They are at rest, or on their way to where :attr:`JointDrive.first` says.
        """
        n, s, d = self.model.num_envs, self.scratch, self.state
        graph.launch(
            reset_drive,
            (n, NUM_JOINTS),
            [mask, d.command_rotation, d.command_root],
            [d.goal_rotation, d.goal_root, d.let_go, d.wrench_force, d.wrench_torque],
        )
        for increment in (s.command_increment, s.root_increment):
            graph.launch(clear_vectors, increment.size, [increment.flatten()])
        record_pose(self, graph, 0.0, d.command_rotation, d.command_root, s.command_increment, self.groups.pose)
        graph.launch(
            posing.rest_matrices, (n, NUM_JOINTS), [self.body, s.pose_rotation, s.pose_position], [s.bone_from]
        )
        graph.launch(
            place_particles,
            n * self.num_points,
            [mask, self.body, s.bone_from],
            [state.x, state.u, state.C, state.F, state.kinematic, d.motion, state.failure],
        )
        if self.joints:
            self.joints.record_reset(graph, mask)
            if self.joints.first:
                self._record_motion(graph, state, mask)

    def _record_motion(self, graph: LaunchGraph, state: State, mask: wp.array) -> None:
        """Append: the masked environments' bodies, placed already, are on their way to a pose."""
        n, s = self.model.num_envs, self.scratch
        after = self.groups.next_pose
        record_pose(self, graph, 0.0, *self.joints.first, s.command_increment, after)
        graph.launch(posing.rest_matrices, (n, NUM_JOINTS), [self.body, after.rotation, after.position], [s.bone_step])
        inputs = [mask, self.body, self.model.control_dt, s.bone_step, state.x]
        graph.launch(set_in_motion, (n, self.num_points), inputs, [state.u])
        self.joints.record_motion(graph, mask, after)

    def record_begin(self, graph: LaunchGraph) -> None:
        """Append what begins a control step: from the tracked pose towards ``state.goal_*``."""
        s, d, t = self.scratch, self.state, self.tracked
        graph.launch(clear_vectors, d.wrench_force.size, [d.wrench_force])
        graph.launch(clear_vectors, d.wrench_torque.size, [d.wrench_torque])
        if self.joints:
            self.joints.record_begin(graph)
            return
        graph.launch(
            posing.begin_control,
            (self.model.num_envs, NUM_JOINTS),
            [self.drive, t.local, t.position, d.command_rotation, d.command_root, d.goal_rotation, d.goal_root],
            [s.increment, s.command_increment, s.root_increment, s.carry_rotation, s.carry_translation],
        )
        record_pose(self, graph, 0.0, *self.start_pose(), s.increment, self.groups.pose)

    def record_end(self, graph: LaunchGraph, state: State) -> None:
        """Append what ends a control step: the goal has been commanded. Where torques act, nothing is."""
        d = self.state
        if self.joints:
            self.joints.record_end(graph, state)
            return
        graph.launch(
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
    graph: LaunchGraph, avatars: Sequence[AvatarDrive], model: Model, state: State, scratch: Scratch
) -> None:
    """Append one control step of all ``avatars`` of a world through all substeps, after which they are tracked.

    They go beside each other: what one does between substeps has nothing to do with another.
    """
    world = (model, state, scratch)
    injected = model.step.decoupling in (DECOUPLING["paper"], DECOUPLING["none"])

    def drive(avatar: AvatarDrive, own: LaunchGraph, step: int) -> None:
        if avatar.joints:
            avatar.joints.record_substep(own, state, scratch, step)
        else:
            record_drive(avatar, own, state, step)

    record_begin(graph, *world, graph.branches(avatars, lambda avatar, own: avatar.record_begin(own)))
    if injected:
        graph.parallel_for_each(avatars, lambda avatar, own: record_injection(avatar, own, state))
    for step in range(model.num_substeps):
        if not injected:
            graph.parallel_for_each(avatars, partial(drive, step=step))
        record_substep(graph, *world, step)
    record_end_of_step(graph, avatars, *world)


def record_end_of_step(
    graph: LaunchGraph, avatars: Sequence[AvatarDrive], model: Model, state: State, scratch: Scratch
) -> None:
    """Append what ends a control step, when all substeps have been taken: it is sensed, and ``avatars`` are tracked."""

    def end(avatar: AvatarDrive, own: LaunchGraph) -> None:
        avatar.record_end(own, state)
        avatar.record_tracking(own, state)

    ends = graph.branches(avatars, end)
    moves = any(avatar.joints for avatar in avatars)  # these put particles in their places, and sensors ask for those
    record_end(graph, model, state, scratch, () if moves else ends)
    if moves:
        graph.parallel(*ends)


@wp.kernel
def clear_vectors(v: wp.array(dtype=wp.vec3)):
    """Zero an array of vectors inside a graph."""
    v[wp.tid()] = wp.vec3(0.0)
