"""What a drive does before every MPM substep.

It fits rigid motions to the physical velocity, carries the bones by them, writes the kinematic velocity, pulls shape
and pose, and applies the root wrench.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from piavatar_envs.avatar import bone_sums, flesh, posing, rigid_fit
from piavatar_envs.avatar.injection import inject_velocity
from piavatar_envs.avatar.lanes import BLOCK
from piavatar_envs.avatar.root import lay_command_on_body, root_wrench
from piavatar_envs.avatar.skeleton import NUM_JOINTS
from piavatar_envs.avatar.types import (
    Carry,
    Command,
    DriveScratch,
    DriveState,
    Pose,
    RemovedMotion,
    RigidFit,
    RigidFits,
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
        self.command = group(
            Command,
            rotation=d.command_rotation,
            increment=s.command_increment,
            root=d.command_root,
            goal_root=d.goal_root,
        )


def record_pose(drive: AvatarDrive, program: Program, fraction: float, rotation, root, increment, out: Pose) -> None:
    """Append: the pose at ``fraction`` of a control step that starts from local ``rotation`` and ``root``."""
    inputs = [drive.body, fraction, rotation, root, increment, drive.scratch.root_increment, drive.threads]
    program.launch(posing.pose_body, (drive.model.num_envs, drive.threads), inputs, [out.rotation, out.position])


def record_drive(drive: AvatarDrive, program: Program, state: State, step: int) -> None:
    """Append what an avatar does before substep ``step`` of a control step of the ``"split"`` scheme."""
    s, d, g = drive.scratch, drive.state, drive.groups
    n, steps = drive.model.num_envs, drive.model.num_substeps
    now, after = (g.pose, g.next_pose) if step % 2 == 0 else (g.next_pose, g.pose)
    record_fit(drive, program, state)
    if step > 0:
        _record_carry(drive, program, state)
    record_pose(drive, program, (step + 1) / steps, *drive.start_pose(), s.increment, after)
    if drive.settings.tone > 0.0:
        command = (d.command_rotation, d.command_root, s.command_increment)
        record_pose(drive, program, step / steps, *command, g.command_pose)
        if step == 0:
            anchor = [s.anchor_rotation, s.anchor_translation]
            inputs = [drive.body, g.command_pose, now, drive.threads]
            program.launch(lay_command_on_body, (n, drive.threads), inputs, anchor)
            program.launch(posing.find_gaps, (n, NUM_JOINTS), [drive.tracked.position, now], [s.gap])
    program.launch(
        root_wrench,
        n,
        [drive.drive, step / steps, g.command, now, g.carry, g.whole, drive.body_mass],
        [d.let_go, d.wrench_force, d.wrench_torque, s.wrench_linear, s.wrench_angular],
    )
    _record_bones(drive, program, now, after)
    _record_flesh(drive, program, state)


def record_fit(drive: AvatarDrive, program: Program, state: State) -> None:
    """Rigid motions of bones and body, fitted to the physical velocity."""
    s, n, bones = drive.scratch, drive.model.num_envs, drive.groups.bones
    reference = drive.tracked.position
    program.launch(
        bone_sums.sum_moments,
        (n, drive.num_chunks, drive.threads),
        [drive.body, drive.model.particles, state.x, state.u, reference, state.failure, drive.threads],
        [s.moments],
        block_dim=BLOCK,
    )
    program.launch(
        rigid_fit.fit_bones,
        (n, NUM_JOINTS, drive.bone_threads),
        [drive.body, reference, s.moments, state.failure, drive.bone_threads],
        [s.bone_center, s.bone_velocity, s.bone_spin, s.bone_inertia],
        block_dim=BLOCK,
    )
    program.launch(
        rigid_fit.fit_body,
        (n, drive.threads),
        [drive.body, bones, state.failure, drive.threads],
        [s.body_center, s.body_velocity, s.body_spin, s.body_inertia],
        block_dim=BLOCK,
    )


def _record_carry(drive: AvatarDrive, program: Program, state: State) -> None:
    """Advance the carried bones and the laid command by the motion of the substep that has just been."""
    s, g, n, dt = drive.scratch, drive.groups, drive.model.num_envs, drive.model.step.dt
    program.launch(
        posing.carry_bones,
        (n, NUM_JOINTS),
        [dt, g.bones, g.whole, g.removed, state.failure],
        [s.carry_rotation, s.carry_translation, s.anchor_rotation, s.anchor_translation],
    )


def _record_bones(drive: AvatarDrive, program: Program, now: Pose, after: Pose) -> None:
    """What particles blend of their bones in the substep from ``now`` to ``after``."""
    s, g = drive.scratch, drive.groups
    anchor = [s.anchor_rotation, s.anchor_translation]
    program.launch(
        posing.write_records,
        (drive.model.num_envs, NUM_JOINTS),
        [drive.body, drive.drive, now, after, g.carry, g.bones, g.command_pose, *anchor, s.gap],
        [s.bone_record],
    )


def _record_flesh(drive: AvatarDrive, program: Program, state: State) -> None:
    """Kinematic velocity and pulls of every particle."""
    s, g, n = drive.scratch, drive.groups, drive.model.num_envs
    program.launch(
        flesh.drive_particles,
        (n, drive.num_points),
        [drive.body, drive.drive, state.x, s.bone_record, g.bones, drive.state.let_go, state.failure],
        [state.u, drive.state.motion, state.kinematic, s.pull, s.lean],
        block_dim=BLOCK,
    )
    if drive.drive.free_motion or drive.drive.root_rate > 0.0:  # a root that lets go leaves a free body
        _record_free_motion(drive, program, state)
    _record_sums(drive, program, state)
    program.launch(
        flesh.blend_corrections,
        (n, drive.threads),
        [drive.body, drive.drive, s.bone_corrections, g.bones, g.whole, s.wrench_linear, s.wrench_angular]
        + [drive.threads],
        [s.bone_change],
        block_dim=BLOCK,
    )
    program.launch(
        flesh.apply_corrections,
        (n, drive.num_points),
        [drive.body, drive.drive, state.x, s.pull, g.bones, s.bone_change, g.removed, drive.state.let_go]
        + [state.failure],
        [state.u, state.kinematic],
        block_dim=BLOCK,
    )


def _record_free_motion(drive: AvatarDrive, program: Program, state: State) -> None:
    """Take the rigid part out of the commanded motion of bodies that nothing supports."""
    s, g, n, let_go = drive.scratch, drive.groups, drive.model.num_envs, drive.state.let_go
    body, particles = drive.body, drive.model.particles
    program.launch(
        bone_sums.sum_motion,
        (n, int(bone_sums.GROUPS), drive.threads),
        [body, drive.drive, particles, state.x, state.vk, s.bone_center, let_go, state.failure, drive.threads],
        [s.corrections],
        block_dim=BLOCK,
    )
    program.launch(
        flesh.free_motion,
        (n, drive.threads),
        [drive.body, drive.drive, s.corrections, g.bones, g.whole, let_go, drive.threads],
        [s.removed_velocity, s.removed_turn, s.removed_center, s.wrench_angular],
        block_dim=BLOCK,
    )


def _record_sums(drive: AvatarDrive, program: Program, state: State) -> None:
    """Momenta of the pulls, bone by bone."""
    s, n = drive.scratch, drive.model.num_envs
    program.launch(
        bone_sums.sum_corrections,
        (n, drive.num_chunks, drive.threads),
        [drive.body, drive.model.particles, state.x, s.bone_center, s.pull, s.lean, state.failure, drive.threads],
        [s.corrections],
        block_dim=BLOCK,
    )
    program.launch(
        bone_sums.add_chunks,
        (n, NUM_JOINTS, drive.bone_threads),
        [drive.body, s.corrections, state.failure, drive.bone_threads],
        [s.bone_corrections],
        block_dim=BLOCK,
    )


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
