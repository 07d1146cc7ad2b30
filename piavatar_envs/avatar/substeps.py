"""What a drive does before every MPM substep.

It fits rigid motions to the physical velocity, carries the bones by them, writes the kinematic velocity, pulls shape
and pose, and applies the root wrench.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import warp as wp

from piavatar_envs.avatar import bone_sums, drive_stages, flesh, kinematics, posing
from piavatar_envs.avatar.injection import inject_velocity
from piavatar_envs.avatar.lanes import BLOCK, particle_rounds, particle_threads
from piavatar_envs.avatar.quarters import warps_of
from piavatar_envs.avatar.skeleton import NUM_JOINTS
from piavatar_envs.avatar.types import (
    Anchor,
    Bench,
    Carry,
    Command,
    DriveScratch,
    DriveState,
    Held,
    Pose,
    RemovedMotion,
    RigidFit,
    RigidFits,
    Wrench,
)
from piavatar_envs.mpm.program import Program
from piavatar_envs.mpm.types import State, group

if TYPE_CHECKING:
    from piavatar_envs.avatar.drive import AvatarDrive


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


def record_pose(drive: AvatarDrive, program: Program, fraction: float, rotation, root, increment, out: Pose) -> None:
    """Append: the pose at ``fraction`` of a control step that starts from local ``rotation`` and ``root``."""
    inputs = [drive.body, fraction, rotation, root, increment, drive.scratch.root_increment, drive.threads]
    program.launch(kinematics.pose_body, (drive.model.num_envs, drive.threads), inputs, [out.rotation, out.position])


def record_drive(drive: AvatarDrive, program: Program, state: State, step: int) -> None:
    """Append what an avatar does before substep ``step`` of a control step of the ``"split"`` scheme."""
    n, s, g = drive.model.num_envs, drive.scratch, drive.groups
    bench, who = g.bench[step % 2], [drive.body, drive.drive]
    if drive.in_one:
        inputs = [*who, drive.model.particles, drive.body_mass, step, state.x, state.failure]
        outputs = [bench, g.held, drive.state.motion, state.u, state.kinematic]
        program.launch(drive_stages.drive_body, n, inputs, outputs)
        return
    chunks = (n, warps_of(drive.body.quarters, drive.threads), drive.threads)
    own = [drive.chunk_threads, state.failure, drive.threads]
    each_bone, of_bone = (n, NUM_JOINTS, drive.threads), [drive.body, state.failure, drive.threads]
    inputs = [drive.body, drive.model.particles, state.x, state.u, bench.tracked, state.failure, drive.threads]
    program.launch(bone_sums.sum_moments, chunks, inputs, [s.moments], block_dim=BLOCK)
    if drive.chunk_threads == 0:
        program.launch(drive_stages.fit_bones, each_bone, of_bone, [bench], block_dim=drive.threads)
    rounds = particle_rounds(drive.model.device, n * drive.num_points)
    shared = particle_threads(drive.model.device, drive.num_points, rounds)
    bones = (n, drive.threads)
    threads = drive_stages.warps_of_body(drive.model.device, n) * drive.threads
    inputs = [*who, drive.body_mass, step, drive.chunk_threads, state.failure]
    program.launch(drive_stages.prepare_body, (n, threads), inputs, [bench, g.held], block_dim=threads)
    program.launch(
        flesh.drive_particles,
        (n, shared),
        [*who, state.x, s.bone_record, g.bones, drive.state.let_go, state.failure],
        [state.u, drive.state.motion, state.kinematic, s.pull, s.lean],
        block_dim=BLOCK,
    )
    if drive.drive.free_motion or drive.drive.root_rate > 0.0:  # a root that lets go leaves a free body
        _record_free_motion(drive, program, state, bench)
    inputs = [drive.body, drive.model.particles, state.x, s.bone_center, s.pull, s.lean, state.failure, drive.threads]
    program.launch(bone_sums.sum_corrections, chunks, inputs, [s.corrections], block_dim=BLOCK)
    if drive.chunk_threads == 0:
        program.launch(drive_stages.add_to_bones, each_bone, of_bone, [bench], block_dim=drive.threads)
    program.launch(drive_stages.settle_body, bones, [*who, *own], [bench], block_dim=drive.threads)
    program.launch(
        flesh.apply_corrections,
        (n, shared),
        [*who, state.x, s.pull, g.bones, s.bone_change, g.removed, drive.state.let_go, state.failure],
        [state.u, state.kinematic],
        block_dim=BLOCK,
    )


def _record_free_motion(drive: AvatarDrive, program: Program, state: State, bench: Bench) -> None:
    """Take the rigid part out of the commanded motion of bodies that nothing supports."""
    s, n, threads = drive.scratch, drive.model.num_envs, drive.threads
    inputs = [drive.body, drive.drive, drive.model.particles, state.x, state.vk, s.bone_center, drive.state.let_go]
    shape = (n, int(bone_sums.GROUPS), threads)
    program.launch(
        bone_sums.sum_motion, shape, [*inputs, state.failure, threads], [s.corrections], block_dim=BLOCK
    )  # fmt: skip
    inputs = [drive.body, drive.drive, state.failure, threads]
    program.launch(drive_stages.settle_motion, (n, threads), inputs, [bench, drive.groups.held], block_dim=BLOCK)


def record_injection(drive: AvatarDrive, program: Program, state: State) -> None:
    """Append the paper's drive: one injection of velocity, before the plain substeps of a control step."""
    s, g = drive.scratch, drive.groups
    record_pose(drive, program, 1.0, *drive.start_pose(), s.increment, g.next_pose)
    program.launch(
        posing.bone_matrices,
        (drive.model.num_envs, NUM_JOINTS),
        [drive.body, drive.model.control_dt, g.pose, g.next_pose, g.carry],
        [s.bone_from, s.bone_step],
    )
    program.launch(
        inject_velocity,
        (drive.model.num_envs, drive.num_points),
        [drive.body, drive.drive.kinematic_shape_rate, state.x, s.bone_from, s.bone_step, state.failure],
        [state.u, state.vk],
    )
