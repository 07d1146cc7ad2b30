"""Stops at the ends of the joints' ranges: unilateral constraints of the implicit solve for the joints' velocity.

The range of a joint bounds the three components of its rotation vector ``v``, and its length. A bound along the axis
``a`` holds at the end of a substep if the joint's spin ``w`` relative to its parent, in the world's axes, satisfies

    n . w <= (bound - a . v) / dt,   n = A a,   A = R J_l(v)^-T,

with the rotation ``R`` of the parent and the left Jacobian ``J_l`` of SO(3)
(:func:`~piavatar_envs.avatar.rotation.torques_of_vector`); ``A^T w`` is the rate of ``v``. Where the solution breaks a
bound, the joint is held along ``n``: an inertia ``mu n n^T``, :data:`HOLD` times that of what the joint moves, is added
to the matrix, and ``mu n`` times the allowed change to the right-hand side. The system is factorized and solved again,
so that all joints respond to all stops at once, and a blow on a limb reaches the trunk in the same substep. A stop that
pulls is released, and the next solution is computed without it (an active-set method; Nocedal & Wright, "Numerical
Optimization", 2006, ch. 16.5). The first solutions may hold and release a joint alternately; later ones leave it loose
once it is released, so that they come to an end.

Stops act between a bone and its parent, do not rebound, and keep momentum.
"""

from __future__ import annotations

import warp as wp

from piavatar_envs.avatar.rotation import MAX_ANGLE, quat_exp, quat_log, torques_of_vector
from piavatar_envs.avatar.torque_control.joint_motion import set_triple, triple_of
from piavatar_envs.avatar.torque_control.joint_tissue import Tissue, above, beyond
from piavatar_envs.avatar.torque_control.tree_cholesky import Pattern
from piavatar_envs.avatar.types import Body, Pose

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})


#: Inertia of a stop over that of what the joint moves: single precision resolves the rest beside it.
HOLD = wp.constant(1000.0)
#: Bounds exceeded by less are kept [rad/s].
_TOLERANCE = wp.constant(1.0e-3)
#: A joint beyond its range comes back by this share of the excess in a substep, at no more than this speed [rad/s].
_BACK_SHARE, _BACK_SPEED = wp.constant(0.2), wp.constant(2.0)
#: Bounds of a joint: its three components, and the angle. Each has two bits of its joint's number in ``held``.
_BOUNDS = wp.constant(4)
_UPPER, _LOWER, _LOOSE = wp.constant(1), wp.constant(2), wp.constant(3)
_FAR = wp.constant(1.0e6)


@wp.struct
class Stops:
    """Stops that hold joints in the solution at hand; ``(num_envs, bones)``."""

    held: wp.array2d(dtype=int)  # two bits a bound: which of its two ends holds the joint, or that it is loose
    inertia: wp.array2d(dtype=wp.mat33)  # added to the joint's block of the matrix [kg m^2]
    impulse: wp.array2d(dtype=wp.vec3)  # added to the right-hand side [N m s]


@wp.func
def allowed_rate(way: float, per_time: float):
    """Return the greatest rate towards an end that is ``way`` [rad] away: negative where it has been passed.

    ``per_time`` is one over a substep [1/s].
    """
    return wp.max(wp.where(way < 0.0, _BACK_SHARE, 1.0) * per_time * way, -_BACK_SPEED)


@wp.func
def end_that_holds(rate: float, high: float, low: float, before: int, final: bool):
    """Return the end that holds a joint turning at ``rate``, allowed from ``low`` to ``high`` [rad/s]; 0 for none.

    ``before`` held it in the solution that has the rate. Held by an end, it exceeds the allowed rate a little; where it
    does not, the end pulls. A joint that a ``final`` solution releases stays loose.
    """
    if before == _UPPER and rate >= high:
        return _UPPER
    if before == _LOWER and rate <= low:
        return _LOWER
    if before == _LOOSE or (before != 0 and final):
        return _LOOSE
    if before == 0 and rate > high + _TOLERANCE:
        return _UPPER
    if before == 0 and rate < low - _TOLERANCE:
        return _LOWER
    return 0


@wp.func
def joint_inertia(pattern: Pattern, matrix: wp.array2d(dtype=float), diagonal: float, e: int, n: int):
    """Return the mean inertia that triple ``n`` moves, with the implicit ``diagonal`` [kg m^2]."""
    trace = float(0.0)
    for i in range(3):
        trace += matrix[e, pattern.entry[3 * n + i]]
    return trace / 3.0 + diagonal


@wp.func
def hold_joint(
    body: Body,
    dt: float,
    pose: Pose,
    tissue: Tissue,
    inertia: float,
    q: wp.array2d(dtype=float),
    outside: wp.array2d(dtype=float),
    change: wp.array2d(dtype=float),
    row_of_change: int,
    final: bool,
    e: int,
    b: int,
    # in and out
    stops: Stops,
    right: wp.array2d(dtype=float),
) -> float:
    """Find the ends that hold a joint; return 1 if they are others than in the solution ``change``, else 0.

    ``right`` is the right-hand side of the next solution.
    """
    frame = above(body, pose.rotation, e, b)
    v = quat_log(wp.quat_inverse(frame) * pose.rotation[e, b])
    angle = wp.length(v)
    A = wp.quat_to_matrix(frame) * torques_of_vector(v)
    spin = triple_of(q, e, 3 + 3 * b) + triple_of(outside, e, 3 + 3 * b)
    before = spin * A
    after = (spin + triple_of(change, row_of_change, 3 + 3 * b)) * A
    per_time = 1.0 / dt
    old = stops.held[e, b]
    held = int(0)
    block = wp.mat33()  # in the components of v
    impulse = wp.vec3()
    for i in range(_BOUNDS):
        axis = wp.vec3()
        low = -_FAR
        high = MAX_ANGLE - angle
        if i < 3:
            axis[i] = 1.0
            low = -allowed_rate(v[i] - tissue.lower[b][i], per_time)
            high = tissue.upper[b][i] - v[i]
        elif angle > 0.5 * MAX_ANGLE:
            axis = v / angle
        high = allowed_rate(high, per_time)
        end = end_that_holds(wp.dot(axis, after), high, low, (old >> (2 * i)) & 3, final)
        held = held | (end << (2 * i))
        if end != 0 and end != _LOOSE:
            block += wp.outer(axis, axis)
            impulse += (wp.where(end == _UPPER, high, low) - wp.dot(axis, before)) * axis
    block = (HOLD * inertia) * (A * block * wp.transpose(A))
    impulse = (HOLD * inertia) * (A * impulse)
    set_triple(right, e, 3 + 3 * b, triple_of(right, e, 3 + 3 * b) + impulse - stops.impulse[e, b])
    stops.held[e, b] = held
    stops.inertia[e, b] = block
    stops.impulse[e, b] = impulse
    return wp.where(held != old, 1.0, 0.0)


@wp.func
def release_joints(e: int, bones: int, thread: int, threads: int, stops: Stops):
    """Release all joints, before the first solution of a substep."""
    for b in range(thread, bones, threads):
        stops.held[e, b] = 0
        stops.inertia[e, b] = wp.mat33()
        stops.impulse[e, b] = wp.vec3()


@wp.func
def finish_stops(
    change: wp.array2d(dtype=float),
    row_of_change: int,
    e: int,
    bones: int,
    thread: int,
    threads: int,
    stops: Stops,
    # in and out
    impulse: wp.array2d(dtype=float),
):
    """Compute the impulses of the stops at the end of the substep: what they add to ``impulse`` but for the change."""
    for b in range(thread, bones, threads):
        taken = stops.inertia[e, b] * triple_of(change, row_of_change, 3 + 3 * b)
        set_triple(impulse, e, 3 + 3 * b, triple_of(impulse, e, 3 + 3 * b) - taken)


@wp.func
def stay_in_range(
    body: Body,
    time: float,
    pose: Pose,
    tissue: Tissue,
    row: int,
    e: int,
    b: int,
    # in and out
    q: wp.array2d(dtype=float),
):
    """Shorten the turn of a joint in ``time`` at the spin ``q[row]`` [rad/s], so that it does not leave its range."""
    frame = above(body, pose.rotation, e, b)
    local = wp.quat_inverse(frame) * pose.rotation[e, b]
    turn = time * wp.quat_rotate_inv(frame, triple_of(q, row, 3 + 3 * b))
    v = quat_log(quat_exp(turn) * local)
    off = beyond(quat_log(local), tissue.lower[b], tissue.upper[b])
    back = beyond(v, tissue.lower[b], tissue.upper[b])
    if wp.length_sq(back) > wp.length_sq(off):
        kept = quat_log(quat_exp(v + back - off) * wp.quat_inverse(local))
        set_triple(q, row, 3 + 3 * b, wp.quat_rotate(frame, kept) / time)
