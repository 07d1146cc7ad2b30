"""Commanded motion of an articulated body: a reference that moves, in which the joints have a velocity of their own.

The bones follow a commanded motion as their pose is: every joint turns at the rate of its command, whatever contact has
made of the pose. Springs, dampers, contact and flesh act on the *deviation* from that motion, a generalised velocity
like any other. The velocity of a particle has three parts, ``v = u + J qdot + vc``, with the deviation ``qdot`` and the
commanded velocity ``vc``. The substep of :mod:`piavatar_envs.avatar.torque_control.articulated_body` runs for the first
two. Then the pose is moved on as commanded, along arcs, and ``vc`` is the chord between the skinned places of a
particle before and after. So a body that nothing touches follows its command to round-off, however light its limbs are
and however fast they move: the forces that this takes, ``m dvc / dt``, are given to every particle. Their sum is the
caller's to account for, as :mod:`piavatar_envs.avatar.pose_control.support` does. A body that nothing supports recoils:
the pelvis takes the opposite momenta, as part of the deviation.

The pose that moves as commanded takes the deviation along: joints keep their velocities, and what ``J qdot`` changes by
is given to the particles with the commanded motion.

A joint's error, ``target local^-1``, does not change when both turn by the same rotation on their right: commanded
motion loads no spring. Displacements of the rest pose that suit the commanded pose belong to ``vc``.
"""

from __future__ import annotations

import warp as wp

from piavatar_envs.avatar.kinematics import pose_bones
from piavatar_envs.avatar.rotation import quat_exp, quat_log
from piavatar_envs.avatar.skinning import blend_changes, blend_places, blend_steps, motion_at
from piavatar_envs.avatar.torque_control.flesh_coupling import chord, pulled_rest
from piavatar_envs.avatar.torque_control.joint_momentum import balance, gather_sums
from piavatar_envs.avatar.torque_control.joint_motion import blended_motion, set_triple, spread_motion
from piavatar_envs.avatar.torque_control.joint_tissue import above
from piavatar_envs.avatar.torque_control.mass_matrix import BONES
from piavatar_envs.avatar.torque_control.stages import WARP, begin, place_bones
from piavatar_envs.avatar.torque_control.workspace import TorqueWorkspace
from piavatar_envs.avatar.types import Body, Command
from piavatar_envs.core.arrays import set_vector, store_triple, vec8, vector_at, vector_from
from piavatar_envs.core.cuda_intrinsics import (
    BLOCK,
    first_particle,
    place_in_block,
    sync_threads,
    threads_of_environment,
)
from piavatar_envs.mpm.types import Kinematic

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})


@wp.struct
class CommandedMotion:
    """Commanded motion of a body in a control step and in a substep."""

    command: Command
    root_increment: wp.array(dtype=wp.vec3)  # (num_envs,) of the pelvis in the control step [m]
    # the pose of the bones before they move as commanded
    local: wp.array2d(dtype=wp.quat)  # (num_envs, bones) against their parents
    before: wp.array2d(dtype=wp.quat)  # (num_envs, bones) in the world
    root: wp.array(dtype=wp.vec3)  # (num_envs,) [m]
    # (num_envs, bones) places before and after, relative to the pelvis joint at the start of the substep
    start: wp.array2d(dtype=wp.mat44)
    end: wp.array2d(dtype=wp.mat44)
    moving: wp.array2d(dtype=vec8)  # (num_envs, bones) rigid motions of the deviation before, about the pelvis joint
    turn: wp.array2d(dtype=vec8)  # (num_envs, bones) spin in the first three components [rad/s]
    change: wp.array2d(dtype=wp.vec3)  # (num_envs, particles) of the commanded velocity in this substep [m/s]
    # recoil of a body that nothing supports
    released: wp.array(dtype=int)  # (num_envs,) nonzero once the root is no longer held
    # (num_envs, 2) momentum of the commanded velocity [N s], and angular momentum about the pelvis joint [N m s]
    momenta: wp.array2d(dtype=wp.vec3)
    field: wp.array2d(dtype=vec8)  # (num_envs, bones) rigid motions of the bones as commanded
    recoil: wp.array2d(dtype=float)  # (num_envs, 6) change of the pelvis' velocity in this substep


@wp.kernel
def aim_joints(
    fraction: float,
    per_time: float,
    motion: CommandedMotion,
    failure: wp.array(dtype=int),
    # out
    target: wp.array2d(dtype=wp.quat),
    w: TorqueWorkspace,
):
    """Set target and commanded velocity of every joint when a ``fraction`` of the control step is over.

    ``per_time`` is one over its time [1/s]. Over ``(num_envs, bones)``.
    """
    e, b = wp.tid()
    if failure[e] != 0:
        return
    turn = motion.command.increment[e, b]
    target[e, b] = motion.command.rotation[e, b] * quat_exp(fraction * turn)
    set_triple(w.reference, e, 3 + 3 * b, per_time * wp.quat_rotate(w.pose.rotation[e, b], turn))
    if b == 0:
        set_triple(w.reference, e, 0, per_time * motion.root_increment[e])


@wp.kernel
def recoil(
    body: Body,
    free: int,
    failure: wp.array(dtype=int),
    # in and out
    motion: CommandedMotion,
    w: TorqueWorkspace,
):
    """Give bodies that nothing supports the rigid motion that takes back what commanded motion changes of momentum.

    Those are all bodies if ``free`` is 1, else those whose root has been released. The motion is exact but for the
    curvature of the bones' paths in a substep. Launched as :func:`follow_command`, between the sums over particles and
    the solution for the joints.
    """
    i, _ = wp.tid()
    at = place_in_block(i, WARP)
    e = at[0]
    thread = at[1]
    threads = at[2]
    if failure[e] != 0:
        return
    for k in range(thread, 6, threads):
        motion.recoil[e, k] = 0.0
    if free == 0 and motion.released[e] == 0:
        return
    n = failure.shape[0]
    gather_sums(body.chunk_bone, w.moments, w.other_moments, e, e, n + e, 3 * n + e, w.bones, w.linear, w.angular)
    spread_motion(body, w.pose.position, w.reference, e, e, thread, threads, motion.field)
    before = motion.momenta[e, 0]
    turning = motion.momenta[e, 1]
    balance(w.pose.position, w.bones, 0.0, before, turning, motion.field, e, e, thread, threads, motion.recoil)
    sync_threads(threads)
    for k in range(thread, 6, threads):
        w.velocity[e, k] = w.velocity[e, k] + motion.recoil[e, k]


@wp.kernel
def follow_command(
    body: Body,
    dt: float,
    fraction: float,
    failure: wp.array(dtype=int),
    # in and out
    motion: CommandedMotion,
    w: TorqueWorkspace,
):
    """Move the bones as commanded in a substep, a ``fraction`` of the control step.

    Over ``(num_envs, WARP)``, a CUDA block for each environment.
    """
    i, _ = wp.tid()
    at = place_in_block(i, WARP)
    e = at[0]
    thread = at[1]
    threads = at[2]
    if failure[e] != 0:
        return
    place_bones(body, w.pose, w.pelvis[e], e, thread, threads, motion.start)
    for b in range(thread, BONES, threads):
        q = w.pose.rotation[e, b]
        motion.before[e, b] = q
        motion.moving[e, b] = w.moving[e, b]
        motion.local[e, b] = wp.quat_inverse(above(body, w.pose.rotation, e, b)) * q
    if thread == 0:
        motion.root[e] = w.pose.position[e, 0]
    sync_threads(threads)
    pose_bones(
        body, fraction, motion.local, motion.root, motion.command.increment, motion.root_increment, e, thread, threads,
        w.pose.rotation, w.pose.position,
    )  # fmt: skip
    sync_threads(threads)
    for b in range(thread, BONES, threads):
        spin = quat_log(w.pose.rotation[e, b] * wp.quat_inverse(motion.before[e, b])) / dt
        motion.turn[e, b] = vec8(spin[0], spin[1], spin[2], 0.0, 0.0, 0.0, 0.0, 0.0)
    place_bones(body, w.pose, w.pelvis[e], e, thread, threads, motion.end)
    begin(body, e, thread, threads, w)


@wp.func
def blended_at(record: wp.array2d(dtype=vec8), e: int, skin: wp.array(dtype=wp.vec4), p: int, arm: wp.vec3):
    """Return the velocity of the bones' blended motion at ``arm`` from their reference point [m/s]."""
    return motion_at(blend_changes(record, e, skin, p), arm)


@wp.kernel(launch_bounds=(BLOCK, 6))
def split_commanded(
    body: Body,
    dt: float,
    elapsed: float,
    elapsed_after: float,
    x: wp.array2d(dtype=wp.vec3),
    failure: wp.array(dtype=int),
    # in and out
    motion: CommandedMotion,
    w: TorqueWorkspace,
    u: wp.array2d(dtype=wp.vec3),
    driven: Kinematic,
):
    """Run :func:`.flesh_coupling.split_velocity` for the deviation, and add the commanded velocity to ``vk``.

    Shares ``elapsed`` and ``elapsed_after`` of the control step are over before and after the substep.
    """
    i, _ = wp.tid()
    threads = threads_of_environment(x.shape[0])
    own = first_particle(i, threads)
    e = own[0]
    if failure[e] != 0:
        return
    p = own[1]
    center = w.pelvis[e]
    before = motion.root[e] - center
    after = w.pose.position[e, 0] - center
    while p < body.count:
        n = body.first + p
        arm = vector_at(x, e, n) - center
        total = vector_at(u, e, n)
        way = vector_at(driven.spin, e, n)
        apart = vector_from(driven.vk, body.first + body.alone, e, n)
        steps = blend_steps(w.steps, e, body.skin, p)
        rest = pulled_rest(body, elapsed, e, p, w)
        spin = wp.vec3(steps[6], steps[7], steps[8])
        vk = chord(arm, blend_places(w.end, e, body.skin, p, rest), way, spin, dt)
        total += blended_motion(steps, arm) + apart
        way += dt * wp.cross(spin, way)
        start = blend_places(motion.start, e, body.skin, p, rest)
        end = blend_places(motion.end, e, body.skin, p, pulled_rest(body, elapsed_after, e, p, w))
        turn = blend_changes(motion.turn, e, body.skin, p)
        turning = wp.vec3(turn[0], turn[1], turn[2])
        commanded = chord(start - way, end, way, turning, dt)
        # the deviation turns with the pose, too
        now = blended_at(w.moving, e, body.skin, p, end - way - after)
        carried = commanded - now + blended_at(motion.moving, e, body.skin, p, start - way - before)
        set_vector(motion.change, e, p, commanded - vector_at(w.commanded, e, p))
        set_vector(w.commanded, e, p, carried)
        spin += turning + (0.5 * dt) * wp.cross(turning, spin)
        store_triple(u, driven.vk, driven.spin, e, n, total - vk, vk + commanded, spin, True)
        p += threads
