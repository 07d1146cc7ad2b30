"""Torques of springs, muscles and tissue on the joints, implicit in time.

The symbols are those of :mod:`piavatar_envs.avatar.torque_control.articulated_body`. The impulse of a spring ``K`` and
a damper ``D`` over a substep depends on the velocity at its end. The change ``d`` by the joints themselves is solved
for; the change by contact, weight and flesh is predicted to be that of the last substep, ``c``. The impulse is

    dt K e - A (v + d),   v = qdot + c,   A = dt D + dt^2 K.

Without ``c`` a blocked limb would transmit only ``M / (M + A)`` of its torque, because its damper would resist a motion
that contact is going to stop. With it the torque of a blocked limb approaches ``K e`` as ``(A / (M + A))^n`` over ``n``
substeps, and that of a free limb is unchanged.

Where the solution exceeds the strength of a joint, the joint applies its greatest torque instead of a spring, and the
system is solved again, so that all other joints respond to it.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import warp as wp

from piavatar_envs.avatar.rotation import quat_log, short_of_pi, torque_of_vector
from piavatar_envs.avatar.torque_control.joint_motion import set_triple, triple_of
from piavatar_envs.avatar.torque_control.mass_matrix import NUM_DOF
from piavatar_envs.avatar.types import Body, Pose
from piavatar_envs.core.structs import make_struct
from piavatar_envs.mpm.types import row

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})


#: A bound that is never reached.
UNBOUNDED = 1.0e30
#: Inertia of a locked joint, far above that of any body [kg m^2].
LOCK = 1.0e6
#: Damping over stiffness of the stop at the end of a joint's range [s].
STOP_TIME = wp.constant(0.03)


@wp.struct
class Springs:
    """Springs and dampers: of the pelvis' position, then of all joints, ``(1 or num_envs, 1 + bones)``.

    Those of the pelvis, ``[:, :2]``, are external support: an unsupported body has none. The others are muscles,
    limited by :class:`Strength`.
    """

    stiffness: wp.array2d(dtype=float)  # [N/m], then [N m/rad]
    damping: wp.array2d(dtype=float)  # [N s/m], then [N m s/rad]


@wp.struct
class Target:
    """Target pose of the springs, and additional torques; ``(num_envs, bones)`` and ``(num_envs,)``."""

    rotation: wp.array2d(dtype=wp.quat)  # local; of the pelvis in the world
    root: wp.array(dtype=wp.vec3)  # of the pelvis joint [m]
    torque: wp.array2d(dtype=wp.vec3)  # about the axes of the rest pose, as the parent has turned them [N m]
    factor: wp.array(dtype=float)  # (1 or num_envs,) on the torques [-]


@wp.struct
class Strength:
    """Greatest torques of the joints about the axes of the rest pose, as the parent has turned them; ``(bones,)``."""

    lower: wp.array(dtype=wp.vec3)  # [N m], not positive
    upper: wp.array(dtype=wp.vec3)  # [N m], not negative
    factor: wp.array(dtype=float)  # (1 or num_envs,) on both [-]


@wp.struct
class Tissue:
    """Passive resistance of the joints: slight damping, and stiff stops at the ends of their ranges; ``(bones,)``."""

    damping: wp.array(dtype=float)  # [N m s/rad]
    stop: wp.array(dtype=float)  # stiffness beyond the range [N m/rad]
    lower: wp.array(dtype=wp.vec3)  # range of the rotation vector relative to the rest pose [rad]
    upper: wp.array(dtype=wp.vec3)
    lock: wp.array(dtype=float)  # inertia of locked joints, else 0 [kg m^2]


def make_strength(lower: np.ndarray, upper: np.ndarray, rows: int, device: str) -> Strength:
    """Upload limits of the torques, each ``(22, 3)`` [N m], with a factor of 1 on them in ``rows`` rows."""
    return make_struct(
        Strength,
        lower=wp.array(lower.astype(np.float32), dtype=wp.vec3, device=device),
        upper=wp.array(upper.astype(np.float32), dtype=wp.vec3, device=device),
        factor=wp.full(rows, 1.0, dtype=float, device=device),
    )


def make_tissue(
    damping: np.ndarray, stop: np.ndarray, lower: np.ndarray, upper: np.ndarray, locked: Sequence[int], device: str
) -> Tissue:
    """Upload the passive resistance of the joints.

    Args:
        damping: of all joints, shape ``(22,)`` [N m s/rad].
        stop: stiffness beyond their ranges, shape ``(22,)`` [N m/rad].
        lower: of the ranges of the rotation vectors, shape ``(22, 3)`` [rad].
        upper: likewise.
        locked: joints that do not move: the bones beyond them are rigid extensions of their parents.
        device: Warp device.
    """
    lock = np.zeros(len(damping))
    lock[list(locked)] = LOCK
    numbers = {"damping": damping, "stop": stop, "lock": lock}
    arrays = {name: wp.array(v.astype(np.float32), dtype=float, device=device) for name, v in numbers.items()}
    for name, bound in (("lower", lower), ("upper", upper)):
        arrays[name] = wp.array(bound.astype(np.float32), dtype=wp.vec3, device=device)
    return make_struct(Tissue, **arrays)


@wp.func
def implicit_inertia(dt: float, stiffness: float, damping: float):
    """Return ``A = dt D + dt^2 K``: the inertia of a spring and a damper, implicit in time."""
    return dt * damping + dt * dt * stiffness


@wp.func
def resistance(tissue: Tissue, stop: float, b: int):
    """Return the damping of tissue, with that of the ``stop`` where the joint is beyond its range [N m s/rad]."""
    return tissue.damping[b] + STOP_TIME * stop


@wp.func
def above(body: Body, rotation: wp.array2d(dtype=wp.quat), e: int, b: int):
    """Return the rotation of a bone's parent; the pelvis has the world as its parent."""
    if b == 0:
        return wp.quat(0.0, 0.0, 0.0, 1.0)
    return rotation[e, body.parent[b]]


@wp.func
def beyond(local: wp.quat, lower: wp.vec3, upper: wp.vec3):
    """Return the change of the rotation vector that leads back into the range [rad]; zero within it.

    The range ends before half a turn, even at the corners of the box: there rotation vectors jump, and a stop would
    push outwards.
    """
    v = quat_log(local)
    return short_of_pi(wp.max(lower, wp.min(v, upper))) - v


@wp.func
def stopping_torque(local: wp.quat, lower: wp.vec3, upper: wp.vec3):
    """Return the torque of the stop over its stiffness, in the frame of the parent [rad].

    It is conservative: the gradient of half the square of :func:`beyond`.
    """
    return torque_of_vector(quat_log(local), beyond(local, lower, upper))


@wp.func
def implicit_diagonal(
    body: Body,
    dt: float,
    pose: Pose,
    springs: Springs,
    tissue: Tissue,
    e: int,
    n: int,
    into: int,
    # out
    stop: wp.array2d(dtype=float),
    diagonal: wp.array2d(dtype=float),
):
    """Write ``A``, and the stop stiffness (0 within the range); ``n`` 0 is the pelvis' position, joints follow."""
    r = row(e, springs.stiffness.shape[0])
    value = implicit_inertia(dt, springs.stiffness[r, n], springs.damping[r, n])
    if n > 1:
        b = n - 1
        local = wp.quat_inverse(pose.rotation[e, body.parent[b]]) * pose.rotation[e, b]
        stiff = float(0.0)
        if wp.length(beyond(local, tissue.lower[b], tissue.upper[b])) > 0.0:
            stiff = tissue.stop[b]
        stop[e, b] = stiff
        value += implicit_inertia(dt, stiff, resistance(tissue, stiff, b)) + tissue.lock[b]
    set_triple(diagonal, into, 3 * n, wp.vec3(value))


@wp.func
def joint_impulse(
    body: Body,
    dt: float,
    pose: Pose,
    target: Target,
    springs: Springs,
    tissue: Tissue,
    stop: wp.array2d(dtype=float),
    q: wp.array2d(dtype=float),
    outside: wp.array2d(dtype=float),
    e: int,
    n: int,
    # out
    muscle: wp.array2d(dtype=float),
    impulse: wp.array2d(dtype=float),
):
    """Write the impulses of a joint at ``d = 0``: of muscles alone, and with tissue.

    Actions apply no torque to the pelvis.
    """
    r = row(e, springs.stiffness.shape[0])
    K = springs.stiffness[r, n]
    v = triple_of(q, e, 3 * n) + triple_of(outside, e, 3 * n)
    active = wp.vec3()
    passive = wp.vec3()
    if n == 0:
        active = dt * K * (target.root[e] - pose.position[e, 0])
    else:
        b = n - 1
        frame = above(body, pose.rotation, e, b)
        local = wp.quat_inverse(frame) * pose.rotation[e, b]
        push = K * quat_log(target.rotation[e, b] * wp.quat_inverse(local))
        if b > 0:
            push += target.factor[row(e, target.factor.shape[0])] * target.torque[e, b]
            stiff = stop[e, b]
            passive = dt * stiff * wp.quat_rotate(frame, stopping_torque(local, tissue.lower[b], tissue.upper[b]))
            passive -= implicit_inertia(dt, stiff, resistance(tissue, stiff, b)) * v
        active = dt * wp.quat_rotate(frame, push)
    active -= implicit_inertia(dt, K, springs.damping[r, n]) * v
    set_triple(muscle, e, 3 * n, active)
    set_triple(impulse, e, 3 * n, active + passive)


@wp.func
def limit_torque(
    body: Body,
    dt: float,
    pose: Pose,
    springs: Springs,
    strength: Strength,
    muscle: wp.array2d(dtype=float),
    rest: float,
    change: wp.array2d(dtype=float),
    row_of_change: int,
    again: bool,
    e: int,
    n: int,
    # in and out
    impulse: wp.array2d(dtype=float),
    left: wp.array2d(dtype=float),
) -> float:
    """Limit a muscle's impulse to its strength; return 1 if it was limited, else 0.

    ``left`` gets the implicit diagonal ``rest``, reduced by the ``A`` of a spring that was limited. With ``again``,
    joints already limited are skipped.
    """
    limited = float(0.0)
    r = row(e, springs.stiffness.shape[0])
    A = implicit_inertia(dt, springs.stiffness[r, n], springs.damping[r, n])
    if again and (left[e, 3 * n] != rest or A == 0.0):
        return limited
    if n > 1:
        before = triple_of(muscle, e, 3 * n)
        frame = above(body, pose.rotation, e, n - 1)
        limit = dt * strength.factor[row(e, strength.factor.shape[0])]
        own = wp.quat_rotate_inv(frame, before - A * triple_of(change, row_of_change, 3 * n))
        cut = wp.max(limit * strength.lower[n - 1], wp.min(own, limit * strength.upper[n - 1]))
        if wp.length_sq(cut - own) > 0.0:
            rest -= A
            limited = 1.0
            set_triple(impulse, e, 3 * n, triple_of(impulse, e, 3 * n) - before + wp.quat_rotate(frame, cut))
    set_triple(left, e, 3 * n, wp.vec3(rest))
    return limited


@wp.func
def final_impulses(
    left: wp.array2d(dtype=float),
    push: wp.array2d(dtype=float),
    change: wp.array2d(dtype=float),
    row_of_change: int,
    e: int,
    thread: int,
    threads: int,
    # in and out
    impulse: wp.array2d(dtype=float),
):
    """Compute the impulses of joints and pelvis at the end of the substep: subtract ``left`` times the change.

    Those of external forces, ``push``, which may have no rows, are subtracted too.
    """
    for i in range(thread, NUM_DOF, threads):
        impulse[e, i] = impulse[e, i] - left[e, i] * change[row_of_change, i]
        if push.shape[0] > 0:
            impulse[e, i] = impulse[e, i] - push[e, i]
