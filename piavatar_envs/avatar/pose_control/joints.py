"""Joints of a posed avatar: springs that resist bending, and bones that stay together.

A commanded pose is held by the springs of torque control, ``tone`` times as stiff: a spring of stiffness ``K`` and a
damper ``D`` turn a bone relative to its parent by ``K e - D w``, with the error ``e`` of its local rotation and the
relative spin ``w`` of the physical motion. Bones of a joint do not part: their velocities at the joint are equal, but
for what closes a gap. The impulses are equal and opposite, so that the whole conserves both momenta.

As under torque control, the motion at the end of a substep is predicted from the change by contact and flesh in the
last one: without it, a damper would resist a motion that contact is going to stop, and a blocked limb would not
transmit the torque of its spring.

The change of the bones' motion in a substep is solved for exactly, with the springs implicit in time, by the
articulated-body algorithm (Featherstone, "Rigid Body Dynamics Algorithms", 2008, chapter 7): from the leaves of the
skeleton to its root, each bone with all that hangs on it becomes a mass, a coupling and an inertia, ``f = A v + B w +
p`` and ``n = B^T v + D w + q``, on which its parent acts at the joint; then the changes follow from the root to the
leaves. The rigid motion and inertia of a bone are those fitted to its flesh.
"""

from __future__ import annotations

import warp as wp

from piavatar_envs.avatar.controller import body_size, implicit_inertia, spring_error
from piavatar_envs.avatar.kinematics import bone_offset
from piavatar_envs.avatar.pose_control.bones import carried_bone
from piavatar_envs.avatar.rotation import quat_exp
from piavatar_envs.avatar.tracking import point_inertia
from piavatar_envs.avatar.types import Body, BoneMotion, Carry, Command, JointSolve, Pose, PoseControl, RigidFits
from piavatar_envs.core.arrays import vec8
from piavatar_envs.core.cuda_intrinsics import sync_threads
from piavatar_envs.mpm.types import row

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})


#: Share of a change of velocity by contact and flesh that is predicted to last; below one, so that the errors of many
#: predictions die out.
LASTING = wp.constant(0.97)


@wp.func
def inverse_or_zero(M: wp.mat33):
    """Return the inverse of a positive definite matrix; zero where it is singular."""
    trace = wp.trace(M)
    if wp.determinant(M) <= 1.0e-9 * trace * trace * trace:
        return wp.mat33()
    return wp.inverse(M)


@wp.func
def predicted_motion(bones: RigidFits, expected: BoneMotion, e: int, b: int, at: wp.vec3):
    """Return the velocity of a bone's physical motion at a point, and its spin, after contact and flesh have acted."""
    arm = at - bones.center[e, b]
    velocity = bones.velocity[e, b] + wp.cross(bones.spin[e, b], arm)
    before = expected.velocity[e, b] + wp.cross(expected.spin[e, b], arm)
    return (1.0 + LASTING) * velocity - LASTING * before, 2.0 * bones.spin[e, b] - expected.spin[e, b]


@wp.func
def joint_place(pose: Pose, carry: Carry, gap: wp.array2d(dtype=wp.vec3), e: int, b: int):
    """Return the carried rotation of a bone, and where its own joint is."""
    q, at = carried_bone(pose, carry, e, b)
    return q, at + wp.quat_rotate(q, gap[e, b])


@wp.func
def load_joint(
    body: Body,
    control: PoseControl,
    fraction: float,
    size: float,
    command: Command,
    pose: Pose,
    carry: Carry,
    gap: wp.array2d(dtype=wp.vec3),
    bones: RigidFits,
    expected: BoneMotion,
    e: int,
    b: int,
    # out
    joints: JointSolve,
):
    """Write what the joint of a bone does at the predicted motion, at ``fraction`` of the control step."""
    q, at = joint_place(pose, carry, gap, e, b)
    joints.place[e, b] = at
    if b == 0:
        return
    a = body.parent[b]
    q_parent, at_parent = joint_place(pose, carry, gap, e, a)
    part = at_parent + wp.quat_rotate(q_parent, bone_offset(body, e, b, at)) - at
    velocity, spin = predicted_motion(bones, expected, e, b, at)
    velocity_parent, spin_parent = predicted_motion(bones, expected, e, a, at)
    close = control.joint_rate / (1.0 + control.joint_rate * control.dt)
    joints.closing[e, b] = close * part - (velocity - velocity_parent)
    stiffness = size * control.stiffness[b]
    resistance = implicit_inertia(control.dt, stiffness, size * control.spring_damping[b])
    goal = command.rotation[e, b] * quat_exp(fraction * command.increment[e, b])
    error = wp.quat_rotate(q_parent, spring_error(goal, wp.quat_inverse(q_parent) * q))
    joints.push[e, b] = control.dt * stiffness * error - resistance * (spin - spin_parent)
    joints.resistance[e, b] = resistance


@wp.func
def gather_joint(body: Body, bones: RigidFits, e: int, b: int, first: int, last: int, joints: JointSolve):
    """Return the inertia of a bone, at its joint, with all that hangs on it; children are in ``first ... last - 1``.

    Returns:
        Mass, coupling, inertia, and the impulses at rest.
    """
    m = body.bone_mass[row(e, body.bone_mass.shape[0]), b]
    arm = bones.center[e, b] - joints.place[e, b]
    A = wp.diag(wp.vec3(m))
    B = -m * wp.skew(arm)
    D = bones.inertia[e, b] + point_inertia(m, arm)
    p = wp.vec3()
    q = wp.vec3()
    for c in range(first, last):
        if body.parent[c] == b:
            A += joints.mass[e, c]
            B += joints.coupling[e, c]
            D += joints.inertia[e, c]
            p += joints.linear[e, c]
            q += joints.angular[e, c]
    return A, B, D, p, q


@wp.func
def pass_to_parent(body: Body, bones: RigidFits, e: int, b: int, first: int, last: int, joints: JointSolve):
    """Write the inertia and impulses that the joint of a bone passes to its parent, at the joint of that."""
    A, B, D, p, q = gather_joint(body, bones, e, b, first, last, joints)
    J = joints.resistance[e, b]
    s = joints.push[e, b]
    c = joints.closing[e, b]
    inverse = inverse_or_zero(D + wp.diag(wp.vec3(J)))
    impulse = s - q
    through = B * inverse
    joints.inverse[e, b] = inverse
    joints.impulse[e, b] = impulse
    joints.own_coupling[e, b] = B
    A = A - through * wp.transpose(B)
    p = p + A * c + through * impulse
    B = J * through
    q = inverse * (D * s + J * q) + wp.transpose(B) * c
    D = J * (inverse * D)
    # from the bone's joint to that of its parent
    x = joints.place[e, b] - joints.place[e, body.parent[b]]
    X = wp.skew(x)
    moved = B - A * X
    joints.mass[e, b] = A
    joints.coupling[e, b] = moved
    joints.inertia[e, b] = D - wp.transpose(B) * X + X * moved
    joints.linear[e, b] = p
    joints.angular[e, b] = q + wp.cross(x, p)


@wp.func
def move_root(body: Body, bones: RigidFits, e: int, first: int, last: int, joints: JointSolve):
    """Compute the change of the motion of the pelvis, on which nothing acts but the other bones."""
    A, B, D, p, q = gather_joint(body, bones, e, 0, first, last, joints)
    light = inverse_or_zero(A)
    back = wp.transpose(B) * light
    spin = inverse_or_zero(D - back * B) * (back * p - q)
    joints.spin[e, 0] = spin
    joints.velocity[e, 0] = -(light * (p + B * spin))


@wp.func
def move_bone(body: Body, e: int, b: int, joints: JointSolve):
    """Compute the change of the motion of a bone from that of its parent."""
    a = body.parent[b]
    spin = joints.spin[e, a]
    arm = joints.place[e, b] - joints.place[e, a]
    v = joints.velocity[e, a] + wp.cross(spin, arm) + joints.closing[e, b]
    push = joints.impulse[e, b] - wp.transpose(joints.own_coupling[e, b]) * v + joints.resistance[e, b] * spin
    joints.velocity[e, b] = v
    joints.spin[e, b] = joints.inverse[e, b] * push


@wp.func
def solve_joints(
    body: Body,
    control: PoseControl,
    fraction: float,
    body_mass: float,
    command: Command,
    pose: Pose,
    carry: Carry,
    gap: wp.array2d(dtype=wp.vec3),
    bones: RigidFits,
    expected: BoneMotion,
    e: int,
    thread: int,
    threads: int,
    # out
    joints: JointSolve,
):
    """Compute the change of all bones' motion by their joints in a substep, at ``fraction`` of the control step."""
    size = body_size(body, body_mass, e)
    for b in range(thread, body.parent.shape[0], threads):
        load_joint(body, control, fraction, size, command, pose, carry, gap, bones, expected, e, b, joints)
    sync_threads(threads)
    for n in range(1, body.levels):
        level = body.levels - n
        first = body.level_start[level]
        below = body.level_start[level + 1]
        deepest = below
        if n > 1:
            deepest = body.level_start[level + 2]
        for b in range(first + thread, below, threads):
            pass_to_parent(body, bones, e, b, below, deepest, joints)
        sync_threads(threads)
    if thread == 0:
        move_root(body, bones, e, body.level_start[1], body.level_start[2], joints)
    sync_threads(threads)
    for level in range(1, body.levels):
        for b in range(body.level_start[level] + thread, body.level_start[level + 1], threads):
            move_bone(body, e, b, joints)
        sync_threads(threads)


@wp.func
def joint_change(bones: RigidFits, joints: JointSolve, e: int, b: int):
    """Return the change of a bone's motion by the joints: velocity of its centre and spin."""
    w = joints.spin[e, b]
    v = joints.velocity[e, b] + wp.cross(w, bones.center[e, b] - joints.place[e, b])
    return vec8(v[0], v[1], v[2], w[0], w[1], w[2], 0.0, 0.0)
