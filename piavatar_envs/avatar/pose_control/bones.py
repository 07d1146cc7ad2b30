"""Kinematic pose of the bones within a control step, and the motion by which contact carries the bones.

Within a control step the tracked local rotations are turned by ``exp(fraction * increment)`` (arcs, not chords) and
posed by forward kinematics with fixed bone offsets, so that no joint gap enters the velocity. Increments are composed
on the right of the tracked rotations, not on the left as Algorithm 1 of the paper prints it.
"""

from __future__ import annotations

import warp as wp

from piavatar_envs.avatar.rotation import finite_turn, quat_exp, quat_log, rigid_matrix, turn_about_z
from piavatar_envs.avatar.skinning import LEAN, PLACE, SPIN, STEP, TURN, VELOCITY, store_record
from piavatar_envs.avatar.types import (
    COMMAND_REFERENCE,
    COMMAND_TARGET,
    Anchor,
    Body,
    Carry,
    Pose,
    PoseControl,
    RemovedMotion,
    RigidFit,
    RigidFits,
    vec44,
)
from piavatar_envs.mpm.types import row

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})


@wp.kernel
def begin_control(
    control: PoseControl,
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
    """Compute the increments of this control step over ``(num_envs, bones)``; contact has carried nothing yet."""
    e, b = wp.tid()
    step = quat_log(wp.quat_inverse(command_rotation[e, b]) * goal_rotation[e, b])
    command_increment[e, b] = step
    increment[e, b] = step
    if control.command == COMMAND_TARGET:
        increment[e, b] = quat_log(wp.quat_inverse(tracked_local[e, b]) * goal_rotation[e, b])
    if b == 0:
        if control.command == COMMAND_TARGET:
            root_increment[e] = goal_root[e] - tracked_position[e, 0]
        elif control.command == COMMAND_REFERENCE:
            root_increment[e] = goal_root[e] - command_root[e]
        else:
            # a commanded step forward is a step where the body faces
            turn = turn_about_z(tracked_local[e, 0] * wp.quat_inverse(command_rotation[e, 0]))
            root_increment[e] = wp.quat_rotate(turn, goal_root[e] - command_root[e])
    carry_rotation[e, b] = wp.quat(0.0, 0.0, 0.0, 1.0)
    carry_translation[e, b] = wp.vec3(0.0)


@wp.kernel
def end_control(
    goal_rotation: wp.array2d(dtype=wp.quat),
    goal_root: wp.array(dtype=wp.vec3),
    failure: wp.array(dtype=int),
    # out
    command_rotation: wp.array2d(dtype=wp.quat),
    command_root: wp.array(dtype=wp.vec3),
):
    """Make the goal the commanded pose, over ``(num_envs, bones)``."""
    e, b = wp.tid()
    if failure[e] != 0:
        return
    command_rotation[e, b] = goal_rotation[e, b]
    if b == 0:
        command_root[e] = goal_root[e]


I3 = wp.constant(wp.mat33(1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0))


@wp.func
def carried(
    e: int, dt: float, removed: RemovedMotion, c: wp.vec3, velocity: wp.vec3, spin: wp.vec3, q: wp.quat, t: wp.vec3
):
    """Return the rigid motion ``(q, t)`` after a substep in which a body moved and its centre reached ``c``.

    The motion that was removed from the kinematic velocity has not happened, so it is subtracted first.
    """
    back = I3 + dt * removed.turn[e]
    q_back = wp.quat_from_matrix(back) * q
    t_back = back * (t - removed.center[e] - dt * removed.velocity[e]) + removed.center[e]
    turn = quat_exp(dt * spin)
    # the centre reached c by moving at the velocity: turn about its previous position
    before = c - dt * velocity
    return wp.normalize(turn * q_back), wp.quat_rotate(turn, t_back - before) + c


@wp.func
def carry_bone(
    dt: float,
    bones: RigidFits,
    removed: RemovedMotion,
    e: int,
    b: int,
    # in and out
    carry: Carry,
):
    """Advance ``G`` of a bone by the motion of the physical velocity."""
    q, t = carried(
        e, dt, removed, bones.center[e, b], bones.velocity[e, b], bones.spin[e, b],
        carry.rotation[e, b], carry.translation[e, b],
    )  # fmt: skip
    carry.rotation[e, b] = q
    carry.translation[e, b] = t


@wp.func
def carry_anchor(
    dt: float,
    whole: RigidFit,
    removed: RemovedMotion,
    e: int,
    # in and out
    anchor: Anchor,
):
    """Advance the alignment of the command by the body's own motion."""
    q, t = carried(
        e, dt, removed, whole.center[e], whole.velocity[e], whole.spin[e], anchor.rotation[e], anchor.translation[e]
    )
    anchor.rotation[e] = q
    anchor.translation[e] = t


@wp.func
def carried_bone(pose: Pose, carry: Carry, e: int, b: int):
    """Return the rotation of a bone in a pose and the position of its joint, carried by contact."""
    G = carry.rotation[e, b]
    return G * pose.rotation[e, b], wp.quat_rotate(G, pose.position[e, b]) + carry.translation[e, b]


@wp.func
def write_record(
    body: Body,
    control: PoseControl,
    pose: Pose,
    next_pose: Pose,
    carry: Carry,
    bones: RigidFits,
    command: Pose,
    anchor: Anchor,
    gap: wp.array2d(dtype=wp.vec3),
    e: int,
    b: int,
    # out
    record: wp.array2d(dtype=vec44),
):
    """Write the record of a bone that particles blend: its place, step, turn, physical motion and lean.

    The lean leads from the carried to the commanded bone, which the anchor aligns with the body. The kinematic pose has
    fixed offsets between joints, so for a bone that contact has moved off its joint the tracked gap is subtracted.
    """
    q, at = carried_bone(pose, carry, e, b)
    q_next, at_next = carried_bone(next_pose, carry, e, b)
    rest = body.rest_joint[row(e, body.rest_joint.shape[0]), b]
    A = rigid_matrix(q, rest, at)
    turn = finite_turn(quat_log(q_next * wp.quat_inverse(q)) / control.dt, control.dt)
    step = (at_next - at) / control.dt - turn * at
    lean = wp.mat44()
    if control.tone_rate > 0.0:
        goal = wp.quat_rotate(anchor.rotation[e], command.position[e, b]) + anchor.translation[e]
        back = wp.quat_rotate(carry.rotation[e, b], gap[e, b])
        lean = rigid_matrix(anchor.rotation[e] * command.rotation[e, b], rest, goal - back) - A
    spin = bones.spin[e, b]
    velocity = bones.velocity[e, b] - wp.cross(spin, bones.center[e, b] - bones.center[e, 0])
    s = vec44()
    for i in range(3):
        for j in range(4):
            s[PLACE + 4 * i + j] = A[i, j]
            s[LEAN + 4 * i + j] = lean[i, j]
        for j in range(3):
            s[TURN + 3 * i + j] = turn[i, j]
        s[STEP + i] = step[i]
        s[VELOCITY + i] = velocity[i]
        s[SPIN + i] = spin[i]
    store_record(record, e, b, s)
