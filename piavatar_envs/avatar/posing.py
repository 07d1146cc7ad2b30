"""From commands to bone matrices: the kinematic pose along arcs, and the motion by which contact carries it.

Within a control step the tracked local rotations are turned by ``exp(fraction * increment)`` (arcs, not chords) and
posed by forward kinematics with fixed bone offsets, so that no joint gap enters the velocity. Increments are composed
on the right of the tracked rotations: composing on the left, as Algorithm 1 of the paper prints it, is 0.11 m off from
the second frame.
"""

from __future__ import annotations

import warp as wp

from piavatar_envs.avatar.rotation import quat_exp, quat_log, rigid_matrix, turn_about_z
from piavatar_envs.avatar.types import (
    DRIVE_REFERENCE,
    DRIVE_TARGET,
    Body,
    Carry,
    Drive,
    Pose,
    RemovedMotion,
    RigidFit,
    RigidFits,
)
from piavatar_envs.mpm.types import row

wp.set_module_options({"enable_backward": False})

I3 = wp.constant(wp.mat33(1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0))


@wp.kernel
def begin_control(
    drive: Drive,
    tracked_local: wp.array2d(dtype=wp.quat),
    tracked_position: wp.array2d(dtype=wp.vec3),
    command_rotation: wp.array2d(dtype=wp.quat),
    command_root: wp.array(dtype=wp.vec3),
    goal_rotation: wp.array2d(dtype=wp.quat),
    goal_root: wp.array(dtype=wp.vec3),
    # out
    increment: wp.array2d(dtype=wp.vec3),
    command_increment: wp.array2d(dtype=wp.vec3),
    root_increment: wp.array(dtype=wp.vec3),
    carry_rotation: wp.array2d(dtype=wp.quat),
    carry_translation: wp.array2d(dtype=wp.vec3),
):
    """What the drive adds to the tracked pose in this control step; contact has carried nothing yet."""
    e, b = wp.tid()
    step = quat_log(wp.quat_inverse(command_rotation[e, b]) * goal_rotation[e, b])
    command_increment[e, b] = step
    increment[e, b] = step
    if drive.mode == DRIVE_TARGET:
        increment[e, b] = quat_log(wp.quat_inverse(tracked_local[e, b]) * goal_rotation[e, b])
    if b == 0:
        if drive.mode == DRIVE_TARGET:
            root_increment[e] = goal_root[e] - tracked_position[e, 0]
        elif drive.mode == DRIVE_REFERENCE:
            root_increment[e] = goal_root[e] - command_root[e]
        else:
            # a commanded step forward is a step where the body faces
            turn = turn_about_z(tracked_local[e, 0] * wp.quat_inverse(command_rotation[e, 0]))
            root_increment[e] = wp.quat_rotate(turn, goal_root[e] - command_root[e])
    carry_rotation[e, b] = wp.quat(0.0, 0.0, 0.0, 1.0)
    carry_translation[e, b] = wp.vec3(0.0)


@wp.func
def pose_bone(
    body: Body,
    e: int,
    b: int,
    local: wp.quat,
    root: wp.vec3,
    rotation: wp.array2d(dtype=wp.quat),
    position: wp.array2d(dtype=wp.vec3),
):
    """Forward kinematics of one bone; its parent must have been posed."""
    parent = body.parent[b]
    if parent < 0:
        rotation[e, b] = local
        position[e, b] = root
    else:
        r = row(e, body.rest_joint.shape[0])
        offset = body.rest_joint[r, b] - body.rest_joint[r, parent]
        rotation[e, b] = wp.normalize(rotation[e, parent] * local)
        position[e, b] = position[e, parent] + wp.quat_rotate(rotation[e, parent], offset)


@wp.kernel
def pose_body(
    body: Body,
    fraction: float,
    base_rotation: wp.array2d(dtype=wp.quat),
    base_root: wp.array(dtype=wp.vec3),
    increment: wp.array2d(dtype=wp.vec3),
    root_increment: wp.array(dtype=wp.vec3),
    # out
    rotation: wp.array2d(dtype=wp.quat),
    position: wp.array2d(dtype=wp.vec3),
):
    """Pose at ``fraction`` of the control step: base local rotations turned along arcs, then forward kinematics."""
    e = wp.tid()
    root = base_root[e] + fraction * root_increment[e]
    for b in range(body.parent.shape[0]):
        local = base_rotation[e, b] * quat_exp(fraction * increment[e, b])
        pose_bone(body, e, b, local, root, rotation, position)


@wp.kernel
def carry_bones(
    dt: float,
    bones: RigidFits,
    removed: RemovedMotion,
    failure: wp.array(dtype=int),
    # in and out
    carry_rotation: wp.array2d(dtype=wp.quat),
    carry_translation: wp.array2d(dtype=wp.vec3),
):
    """Advance ``G`` by the rigid motion that the physical velocity gave each bone in the last substep.

    What was taken out of the kinematic velocity is a motion the bones did not make: it comes off first.
    """
    e, b = wp.tid()
    if failure[e] != 0:
        return
    back = I3 + dt * removed.turn[e]
    q = wp.quat_from_matrix(back) * carry_rotation[e, b]
    t = back * (carry_translation[e, b] - removed.center[e] - dt * removed.velocity[e]) + removed.center[e]
    c = bones.center[e, b]
    turn = quat_exp(dt * bones.spin[e, b])
    carry_rotation[e, b] = wp.normalize(turn * q)
    # c was reached by moving at the bone's velocity: turn about where it came from
    before = c - dt * bones.velocity[e, b]
    carry_translation[e, b] = wp.quat_rotate(turn, t - before) + c


@wp.kernel
def carry_anchor(
    dt: float,
    whole: RigidFit,
    removed: RemovedMotion,
    failure: wp.array(dtype=int),
    # in and out
    anchor_rotation: wp.array(dtype=wp.quat),
    anchor_translation: wp.array(dtype=wp.vec3),
):
    """Carry the commanded pose along with the body's own rigid motion, as the bones are."""
    e = wp.tid()
    if failure[e] != 0:
        return
    back = I3 + dt * removed.turn[e]
    q = wp.quat_from_matrix(back) * anchor_rotation[e]
    t = back * (anchor_translation[e] - removed.center[e] - dt * removed.velocity[e]) + removed.center[e]
    turn = quat_exp(dt * whole.spin[e])
    anchor_rotation[e] = wp.normalize(turn * q)
    before = whole.center[e] - dt * whole.velocity[e]
    anchor_translation[e] = wp.quat_rotate(turn, t - before) + whole.center[e]


@wp.kernel
def end_control(
    goal_rotation: wp.array2d(dtype=wp.quat),
    goal_root: wp.array(dtype=wp.vec3),
    failure: wp.array(dtype=int),
    # out
    command_rotation: wp.array2d(dtype=wp.quat),
    command_root: wp.array(dtype=wp.vec3),
):
    """The goal has been commanded."""
    e, b = wp.tid()
    if failure[e] != 0:
        return
    command_rotation[e, b] = goal_rotation[e, b]
    if b == 0:
        command_root[e] = goal_root[e]


@wp.kernel
def rest_matrices(
    body: Body,
    rotation: wp.array2d(dtype=wp.quat),
    position: wp.array2d(dtype=wp.vec3),
    # out
    bone_from: wp.array2d(dtype=wp.mat44),
):
    """Skinning matrices of a pose: rest world to world."""
    e, b = wp.tid()
    rest = body.rest_joint[row(e, body.rest_joint.shape[0]), b]
    bone_from[e, b] = rigid_matrix(rotation[e, b], rest, position[e, b])


@wp.kernel
def bone_matrices(
    body: Body,
    drive: Drive,
    pose: Pose,
    next_pose: Pose,
    carry: Carry,
    # out
    bone_from: wp.array2d(dtype=wp.mat44),
    bone_step: wp.array2d(dtype=wp.mat44),
    bone_turn: wp.array2d(dtype=wp.mat33),
):
    """Skinning matrices of the substep: where a bone is, the velocity that takes it on, how far it turns."""
    e, b = wp.tid()
    rest = body.rest_joint[row(e, body.rest_joint.shape[0]), b]
    G = carry.rotation[e, b]
    q = G * pose.rotation[e, b]
    q_next = G * next_pose.rotation[e, b]
    start = wp.quat_rotate(G, pose.position[e, b]) + carry.translation[e, b]
    end = wp.quat_rotate(G, next_pose.position[e, b]) + carry.translation[e, b]
    A = rigid_matrix(q, rest, start)
    bone_from[e, b] = A
    bone_step[e, b] = (rigid_matrix(q_next, rest, end) - A) / drive.dt
    bone_turn[e, b] = wp.quat_to_matrix(q_next * wp.quat_inverse(q))


@wp.kernel
def lean_matrices(
    body: Body,
    command: Pose,
    anchor_rotation: wp.array(dtype=wp.quat),
    anchor_translation: wp.array(dtype=wp.vec3),
    bone_from: wp.array2d(dtype=wp.mat44),
    carry: Carry,
    gap: wp.array2d(dtype=wp.vec3),
    # out
    bone_lean: wp.array2d(dtype=wp.mat44),
):
    """From the carried to the commanded bone: the commanded pose is laid on the body by the anchor.

    A bone that contact has torn off its parent is carried where the parent would have it; its way back is added.
    """
    e, b = wp.tid()
    rest = body.rest_joint[row(e, body.rest_joint.shape[0]), b]
    q = anchor_rotation[e] * command.rotation[e, b]
    at = wp.quat_rotate(anchor_rotation[e], command.position[e, b]) + anchor_translation[e]
    back = wp.quat_rotate(carry.rotation[e, b], gap[e, b])
    bone_lean[e, b] = rigid_matrix(q, rest, at - back) - bone_from[e, b]


@wp.kernel
def find_gaps(
    tracked_position: wp.array2d(dtype=wp.vec3),
    pose: Pose,
    # out
    gap: wp.array2d(dtype=wp.vec3),
):
    """How far bones are from where fixed offsets would put them, at the start of a control step."""
    e, b = wp.tid()
    gap[e, b] = tracked_position[e, b] - pose.position[e, b]
