"""What turns the joints in a substep: springs, muscles with their limits, tissue that resists; implicit in time.

The impulse of a spring ``K`` and a damper ``D`` over a substep depends on the velocity at its end. The joints know what
they themselves will change, ``d``; what else will (contact, weight, flesh) is not known yet when they act. It is taken
to be what it was in the last substep, ``c``, and the impulse is

    dt K e - A (v + d),   v = qdot + c,   A = dt D + dt^2 K.

Without this a limb that is blocked transmits ``M / (M + A)`` of its torque only: its damper resists a motion that
contact will take away, and a light foot under a strong damper could not push. With it the torque of a blocked limb goes
to ``K e`` as ``(A / (M + A))^n`` goes to zero, and that of a free one is unchanged.

Muscles have limits. Where the solution asks more of a joint than it has, the joint gives what it has, no longer a
spring then, and all are solved for once more, so that the others know. (Cutting the impulses alone lets light limbs
blow up.)
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import warp as wp

from piavatar_envs.avatar.joint_motion import part_of, set_part
from piavatar_envs.avatar.mass_matrix import NUM_DOF
from piavatar_envs.avatar.rotation import quat_log, short_of_pi, torque_of_vector
from piavatar_envs.avatar.types import Body, Pose
from piavatar_envs.mpm.types import group, row

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})

#: What limits nothing.
UNBOUNDED = 1.0e30
#: Inertia of a joint that does not move: much more than any body has [kg m^2].
LOCK = 1.0e6
#: Damping of a joint at the end of its range, over the stiffness of that end [s].
STOP_TIME = wp.constant(0.03)


@wp.struct
class Springs:
    """Springs and dampers: of the pelvis' place, then of all joints, ``(1 or num_envs, 1 + bones)``.

    Those of the pelvis, ``[:, :2]``, act from outside: a body that nobody holds has none. Those of the others are
    muscles, which have their limits.
    """

    stiffness: wp.array2d(dtype=float)  # [N/m], then [N m/rad]
    damping: wp.array2d(dtype=float)  # [N s/m], then [N m s/rad]


@wp.struct
class Target:
    """Where springs pull to, and torques besides; ``(num_envs, bones)`` and ``(num_envs,)``."""

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
    """What resists passively: a little always, much where a joint leaves its range; ``(bones,)``."""

    damping: wp.array(dtype=float)  # [N m s/rad]
    stop: wp.array(dtype=float)  # stiffness beyond the range [N m/rad]
    lower: wp.array(dtype=wp.vec3)  # range of the rotation vector relative to the rest pose [rad]
    upper: wp.array(dtype=wp.vec3)
    lock: wp.array(dtype=float)  # inertia of what does not move at all, else 0 [kg m^2]


def make_strength(lower: np.ndarray, upper: np.ndarray, rows: int, device: str) -> Strength:
    """Limits of the torques, each ``(22, 3)`` [N m], and a factor of 1 on them in ``rows`` rows."""
    return group(
        Strength,
        lower=wp.array(lower.astype(np.float32), dtype=wp.vec3, device=device),
        upper=wp.array(upper.astype(np.float32), dtype=wp.vec3, device=device),
        factor=wp.full(rows, 1.0, dtype=float, device=device),
    )


def make_tissue(
    damping: np.ndarray, stop: np.ndarray, lower: np.ndarray, upper: np.ndarray, locked: Sequence[int], device: str
) -> Tissue:
    """What resists passively.

    Args:
        damping: of all joints, shape ``(22,)`` [N m s/rad].
        stop: stiffness beyond their ranges, shape ``(22,)`` [N m/rad].
        lower: of the ranges of the rotation vectors, shape ``(22, 3)`` [rad].
        upper: likewise.
        locked: joints that do not move: what they carry belongs to their parents.
        device: Warp device.
    """
    lock = np.zeros(len(damping))
    lock[list(locked)] = LOCK
    numbers = {"damping": damping, "stop": stop, "lock": lock}
    arrays = {name: wp.array(v.astype(np.float32), dtype=float, device=device) for name, v in numbers.items()}
    for name, bound in (("lower", lower), ("upper", upper)):
        arrays[name] = wp.array(bound.astype(np.float32), dtype=wp.vec3, device=device)
    return group(Tissue, **arrays)


@wp.func
def implicit_inertia(dt: float, stiffness: float, damping: float):
    """``A = dt D + dt^2 K``: what a spring and a damper, implicit in time, add to the mass."""
    return dt * damping + dt * dt * stiffness


@wp.func
def resistance(tissue: Tissue, stop: float, b: int):
    """Damping of tissue, with that of the end of the range where the joint is beyond it [N m s/rad]."""
    return tissue.damping[b] + STOP_TIME * stop


@wp.func
def above(body: Body, rotation: wp.array2d(dtype=wp.quat), e: int, b: int):
    """Rotation of what a bone hangs on; the pelvis hangs on the world."""
    if b == 0:
        return wp.quat(0.0, 0.0, 0.0, 1.0)
    return rotation[e, body.parent[b]]


@wp.func
def beyond(local: wp.quat, lower: wp.vec3, upper: wp.vec3):
    """Rotation vector back into the range [rad]; zero within it.

    A corner of the box may be further than half a turn from its middle, where rotation vectors jump and a stop would
    push on: the range ends before.
    """
    v = quat_log(local)
    return short_of_pi(wp.max(lower, wp.min(v, upper))) - v


@wp.func
def stopping_torque(local: wp.quat, lower: wp.vec3, upper: wp.vec3):
    """Torque of the end of the range, over its stiffness, in the frame of what the joint hangs on [rad].

    What it takes from a joint, it gives back: it is the gradient of half the square of :func:`beyond`.
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
    """Whether a joint is beyond its range, and ``A`` of muscles and tissue; ``n`` is 0 for the pelvis' place."""
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
    set_part(diagonal, into, 3 * n, wp.vec3(value))


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
    """Impulse of a joint if the joints themselves changed nothing, of muscles and of all.

    A torque of the pelvis, which would come from outside, is not asked for.
    """
    r = row(e, springs.stiffness.shape[0])
    K = springs.stiffness[r, n]
    v = part_of(q, e, 3 * n) + part_of(outside, e, 3 * n)
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
    set_part(muscle, e, 3 * n, active)
    set_part(impulse, e, 3 * n, active + passive)


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
    """Where a muscle would give more than it has, let it give that, whatever moves: then the answer is 1, else 0.

    ``left`` is ``A``, of which all is ``rest``, without the spring that was cut. Who asks ``again`` leaves those as
    they are that have been.
    """
    limited = float(0.0)
    r = row(e, springs.stiffness.shape[0])
    A = implicit_inertia(dt, springs.stiffness[r, n], springs.damping[r, n])
    if again and (left[e, 3 * n] != rest or A == 0.0):
        return limited
    if n > 1:
        before = part_of(muscle, e, 3 * n)
        frame = above(body, pose.rotation, e, n - 1)
        limit = dt * strength.factor[row(e, strength.factor.shape[0])]
        own = wp.quat_rotate_inv(frame, before - A * part_of(change, row_of_change, 3 * n))
        cut = wp.max(limit * strength.lower[n - 1], wp.min(own, limit * strength.upper[n - 1]))
        if wp.length_sq(cut - own) > 0.0:
            rest -= A
            limited = 1.0
            set_part(impulse, e, 3 * n, part_of(impulse, e, 3 * n) - before + wp.quat_rotate(frame, cut))
    set_part(left, e, 3 * n, wp.vec3(rest))
    return limited


@wp.func
def find_given(
    left: wp.array2d(dtype=float),
    change: wp.array2d(dtype=float),
    row_of_change: int,
    e: int,
    thread: int,
    threads: int,
    # in and out
    impulse: wp.array2d(dtype=float),
):
    """The impulses that joints and pelvis really get, implicit as they are."""
    for i in range(thread, NUM_DOF, threads):
        impulse[e, i] = impulse[e, i] - left[e, i] * change[row_of_change, i]
