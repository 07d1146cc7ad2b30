"""What the joints of an environment do between two passes over its particles, in a launch each.

On a GPU an environment has a CUDA block, so that nothing is launched for what one warp does in a few microseconds: two
warps build the mass matrix, and a factor each; one does all else. On a CPU it is one thread.

There are two of what particles do to the joints, flesh that is pulled and what the joints take over, and two factors of
the mass matrix, with locked joints alone and with all that is implicit. Both of a kind are in one array: the first of
all environments, then the second.
"""

from __future__ import annotations

import warp as wp

from piavatar_envs.avatar.cholesky import Pattern, factorize, fetch_factor, keep_factor, solve, solve_both
from piavatar_envs.avatar.joint_momentum import balance, gather_bones, gather_other, pass_down
from piavatar_envs.avatar.joint_motion import add_change, go_on, move_joints, part_of, spread_motion
from piavatar_envs.avatar.joint_torques import (
    Springs,
    Strength,
    Target,
    Tissue,
    find_given,
    implicit_diagonal,
    joint_impulse,
    limit_torque,
)
from piavatar_envs.avatar.lanes import meet_threads, sum_threads
from piavatar_envs.avatar.mass_matrix import BONES, compose_mass, room_of_records
from piavatar_envs.avatar.mass_pairs import Pairs
from piavatar_envs.avatar.rotation import rigid_matrix
from piavatar_envs.avatar.types import Body, Pose, vec8, vec12, vec16
from piavatar_envs.avatar.warp_cholesky import ROOM, room_of_warp
from piavatar_envs.mpm.shared_memory import meet
from piavatar_envs.mpm.types import row

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})

WARP = wp.constant(32)
#: The pelvis' place, then all joints.
PARTS = wp.constant(1 + int(BONES))
_ROOM = wp.constant(ROOM)


@wp.struct
class JointBench:
    """What the joints work on in a substep; rows are environments', where there are two of a kind twice as many."""

    pose: Pose
    velocity: wp.array2d(dtype=float)  # (num_envs, 69) as in JointState
    outside: wp.array2d(dtype=float)
    # the mass matrix
    pair_sums: wp.array2d(dtype=vec12)  # (num_envs, chunks of pairs)
    records: wp.array(dtype=vec16)
    pattern: Pattern
    matrix: wp.array3d(dtype=float)  # (num_envs, 69, 69)
    diagonals: wp.array2d(dtype=float)  # (2 num_envs, 69) what factors have besides
    factors: wp.array2d(dtype=float)  # (2 num_envs, entries)
    cut: wp.array2d(dtype=float)  # (1, entries) factor where muscles reach their limits; on a CPU
    stop: wp.array2d(dtype=float)  # (num_envs, bones) stiffness beyond the range [N m/rad]
    # what particles have
    moments: wp.array2d(dtype=vec16)  # (num_envs, chunks)
    other_moments: wp.array2d(dtype=vec12)
    bones: wp.array2d(dtype=vec16)  # (num_envs, bones)
    linear: wp.array2d(dtype=wp.vec3)  # (2 num_envs, bones)
    angular: wp.array2d(dtype=wp.vec3)
    momentum: wp.array2d(dtype=float)  # (2 num_envs, 69)
    shares: wp.array2d(dtype=float)  # (2 num_envs, 69) changes of the velocity: the joints' own, what is taken over
    # what the joints do
    muscle: wp.array2d(dtype=float)  # (num_envs, 69) impulses
    impulse: wp.array2d(dtype=float)
    left: wp.array2d(dtype=float)  # (num_envs, 69) diagonal without muscles that have reached their limits
    # what particles get
    place: wp.array2d(dtype=wp.mat44)  # (num_envs, bones) from rest to where bones are
    leaving: wp.array2d(dtype=vec8)  # (num_envs, bones) motion that leaves the physical velocity
    moving: wp.array2d(dtype=vec8)  # (num_envs, bones) motion of the joints
    pelvis: wp.array(dtype=wp.vec3)  # (num_envs,) joint about which these are motions [m]


@wp.struct
class Support:
    """What the springs of the pelvis do to the body, summed over substeps; ``(num_envs,)``."""

    force: wp.array(dtype=wp.vec3)  # [N], if the sum is over a control step that has begun with zero
    torque: wp.array(dtype=wp.vec3)  # [N m]


@wp.func
def place_bones(body: Body, e: int, thread: int, threads: int, w: JointBench):
    """Matrices that take the bones from rest to where they are."""
    r = row(e, body.rest_joint.shape[0])
    for b in range(thread, BONES, threads):
        w.place[e, b] = rigid_matrix(w.pose.rotation[e, b], body.rest_joint[r, b], w.pose.position[e, b])


@wp.func
def begin(body: Body, e: int, thread: int, threads: int, w: JointBench):
    """Motion and places of the bones, as passes over particles read them."""
    spread_motion(body, w.pose.position, w.velocity, e, e, thread, threads, w.moving)
    place_bones(body, e, thread, threads, w)


@wp.func
def find_shares(
    body: Body, velocities: int, into: int, e: int, thread: int, threads: int, room: wp.uint64, w: JointBench
):
    """The shares ``dq = M^-1 J^T m v`` that the joints can take of one or two velocities, from the bones' momenta.

    One alone is share ``into`` of the environment, 0 or 1; two are both.
    """
    n = w.pose.position.shape[0]
    meet_threads(threads)
    for which in range(thread, velocities, threads):
        pass_down(body, w.pose.position, e, which * n + e, w.linear, w.angular, w.momentum)
    fetch_factor(w.factors, e, threads, room)
    if velocities > 1:
        solve_both(w.pattern, w.factors, e, w.momentum, e, n + e, thread, threads, room, w.shares)
    else:
        solve(w.pattern, w.factors, e, w.momentum, e, into * n + e, thread, threads, room, w.shares)


@wp.func
def pull_bones(body: Body, e: int, thread: int, threads: int, w: JointBench):
    """The joints get what the pull of the flesh has taken from the particles, with exactly its momentum."""
    spread_motion(body, w.pose.position, w.shares, e, e, thread, threads, w.moving)
    none = wp.vec3(0.0)
    balance(w.pose.position, w.bones, 1.0, none, none, w.moving, e, thread, threads, w.shares)
    add_change(w.shares, e, e, thread, threads, w.velocity, w.outside)


@wp.func
def turn_joints(
    body: Body,
    dt: float,
    target: Target,
    springs: Springs,
    tissue: Tissue,
    strength: Strength,
    e: int,
    thread: int,
    threads: int,
    room: wp.uint64,
    w: JointBench,
):
    """Springs, torques and tissue change the velocity of the joints."""
    driven = w.pose.position.shape[0] + e
    meet_threads(threads)
    for k in range(thread, PARTS, threads):
        joint_impulse(
            body, dt, w.pose, target, springs, tissue, w.stop, w.velocity, w.outside, e, k, w.muscle, w.impulse
        )
    fetch_factor(w.factors, driven, threads, room)
    solve(w.pattern, w.factors, driven, w.impulse, e, e, thread, threads, room, w.shares)
    limited = float(0.0)
    for k in range(thread, PARTS, threads):
        rest = w.diagonals[driven, 3 * k]
        limited += limit_torque(
            body, dt, w.pose, springs, strength, w.muscle, rest, w.shares, e, k, w.impulse, w.left
        )  # fmt: skip
    meet_threads(threads)
    if sum_threads(limited, threads) > 0.0:
        factorize(w.pattern, w.matrix, w.left, e, e, threads, room, 0, w.cut)
        solve(w.pattern, w.cut, 0, w.impulse, e, e, thread, threads, room, w.shares)
    find_given(w.left, w.shares, e, thread, threads, w.impulse)
    spread_motion(body, w.pose.position, w.shares, e, e, thread, threads, w.moving)
    support = part_of(w.impulse, e, 0)
    moment = part_of(w.impulse, e, 3)
    balance(w.pose.position, w.bones, 0.0, support, moment, w.moving, e, thread, threads, w.shares)


@wp.kernel
def build_mass(
    body: Body,
    pairs: Pairs,
    dt: float,
    springs: Springs,
    tissue: Tissue,
    failure: wp.array(dtype=int),
    threads: int,
    # in and out
    w: JointBench,
):
    """The mass matrix, its factors and where the bones are, over ``(num_envs, threads)``; a CUDA block has one."""
    e, thread = wp.tid()
    if failure[e] != 0:
        return
    records = room_of_records(w.records, 0)
    compose_mass(body, pairs, w.pair_sums, w.pose.position, records, e, thread, threads, w.matrix)
    n = failure.shape[0]
    for k in range(thread, PARTS, threads):
        implicit_diagonal(body, dt, w.pose, springs, tissue, e, k, n + e, w.stop, w.diagonals)
    place_bones(body, e, thread, threads, w)
    meet()
    lanes = wp.min(threads, WARP)
    warp = thread // lanes
    room = room_of_records(w.records, warp * _ROOM)  # records are not needed any more
    for which in range(warp, 2, threads // lanes):
        system = which * n + e
        factorize(w.pattern, w.matrix, w.diagonals, e, system, lanes, room, system, w.factors)
        keep_factor(lanes, room, system, w.factors)


@wp.kernel
def fit_pose(
    body: Body,
    share: float,
    failure: wp.array(dtype=int),
    threads: int,
    # in and out
    w: JointBench,
):
    """Fit the pose to the particles, by a ``share``; over ``(num_envs, threads)``, a warp a CUDA block."""
    e, thread = wp.tid()
    if failure[e] != 0:
        return
    gather_other(body, w.other_moments, e, e, thread, threads, w.linear, w.angular)
    find_shares(body, 1, 0, e, thread, threads, room_of_warp(), w)
    spread_motion(body, w.pose.position, w.shares, e, e, thread, threads, w.moving)
    move_joints(body, share, w.moving, e, thread, threads, w.pose.rotation, w.pose.position)
    begin(body, e, thread, threads, w)


@wp.kernel
def begin_substep(
    body: Body,
    failure: wp.array(dtype=int),
    threads: int,
    # in and out
    w: JointBench,
):
    """:func:`begin` where the pose has not been fitted; launched likewise."""
    e, thread = wp.tid()
    if failure[e] == 0:
        begin(body, e, thread, threads, w)


@wp.kernel
def act(
    body: Body,
    dt: float,
    per_time: float,
    velocities: int,
    target: Target,
    springs: Springs,
    tissue: Tissue,
    strength: Strength,
    failure: wp.array(dtype=int),
    threads: int,
    # in and out
    support: Support,
    w: JointBench,
):
    """Take over what joints can of ``velocities``, of a pull before the last one; let them turn; move the pose on.

    ``per_time`` is the share of an impulse in the support [1/s]. Launched as :func:`fit_pose`.
    """
    e, thread = wp.tid()
    if failure[e] != 0:
        return
    room = room_of_warp()
    taken = failure.shape[0] + e
    gather_bones(body, w.moments, e, thread, threads, w.bones, w.linear, w.angular)
    if velocities > 1:
        gather_other(body, w.other_moments, e, taken, thread, threads, w.linear, w.angular)
    find_shares(body, velocities, 2 - velocities, e, thread, threads, room, w)
    if velocities > 1:
        pull_bones(body, e, thread, threads, w)
    add_change(w.shares, taken, e, thread, threads, w.velocity, w.outside)
    turn_joints(body, dt, target, springs, tissue, strength, e, thread, threads, room, w)
    go_on(w.shares, w.outside, taken, e, thread, threads, w.velocity, w.shares)
    spread_motion(body, w.pose.position, w.shares, taken, e, thread, threads, w.leaving)
    spread_motion(body, w.pose.position, w.velocity, e, e, thread, threads, w.moving)
    if thread == 0:
        w.pelvis[e] = w.pose.position[e, 0]
        support.force[e] = support.force[e] + per_time * part_of(w.impulse, e, 0)
        support.torque[e] = support.torque[e] + per_time * part_of(w.impulse, e, 3)
    move_joints(body, dt, w.moving, e, thread, threads, w.pose.rotation, w.pose.position)
