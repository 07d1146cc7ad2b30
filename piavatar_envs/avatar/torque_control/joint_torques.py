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

import numpy as np
import warp as wp

from piavatar_envs.avatar.rotation import quat_log, torques_of_vector
from piavatar_envs.avatar.torque_control.joint_motion import set_triple, triple_of
from piavatar_envs.avatar.torque_control.joint_tissue import (
    Tissue,
    above,
    tissue_damping,
    tissue_pull,
    tissue_stiffness,
)
from piavatar_envs.avatar.torque_control.mass_matrix import NUM_DOF
from piavatar_envs.avatar.types import Body, Pose
from piavatar_envs.core.structs import make_struct
from piavatar_envs.mpm.types import row

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})


#: A bound that is never reached.
UNBOUNDED = 1.0e30


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


def make_strength(lower: np.ndarray, upper: np.ndarray, rows: int, device: str) -> Strength:
    """Upload limits of the torques, each ``(22, 3)`` [N m], with a factor of 1 on them in ``rows`` rows."""
    return make_struct(
        Strength,
        lower=wp.array(lower.astype(np.float32), dtype=wp.vec3, device=device),
        upper=wp.array(upper.astype(np.float32), dtype=wp.vec3, device=device),
        factor=wp.full(rows, 1.0, dtype=float, device=device),
    )


@wp.func
def implicit_inertia(dt: float, stiffness: float, damping: float):
    """Return ``A = dt D + dt^2 K``: the inertia of a spring and a damper, implicit in time."""
    return dt * damping + dt * dt * stiffness


@wp.func
def implicit_diagonal(
    body: Body,
    dt: float,
    target: Target,
    springs: Springs,
    tissue: Tissue,
    bend: wp.array2d(dtype=wp.vec3),
    e: int,
    n: int,
    into: int,
    # out
    stiffness: wp.array2d(dtype=float),
    diagonal: wp.array2d(dtype=float),
):
    """Write ``A``, and the stiffness of the tissue in it; ``n`` 0 is the pelvis' position, joints follow."""
    r = row(e, springs.stiffness.shape[0])
    value = implicit_inertia(dt, springs.stiffness[r, n], springs.damping[r, n])
    if n > 1:
        b = n - 1
        factor = target.factor[row(e, target.factor.shape[0])]
        K = tissue_stiffness(tissue, bend, factor, e, b)
        stiffness[e, b] = K
        value += implicit_inertia(dt, K, tissue_damping(tissue, K, factor, b)) + tissue.lock[b]
    set_triple(diagonal, into, 3 * n, wp.vec3(value))


@wp.func
def joint_impulse(
    body: Body,
    dt: float,
    pose: Pose,
    target: Target,
    springs: Springs,
    tissue: Tissue,
    bend: wp.array2d(dtype=wp.vec3),
    stiffness: wp.array2d(dtype=float),
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
            factor = target.factor[row(e, target.factor.shape[0])]
            push += factor * target.torque[e, b]
            pull = torques_of_vector(bend[e, b]) * tissue_pull(tissue, bend, factor, e, b)
            passive = dt * wp.quat_rotate(frame, pull)
            damping = tissue_damping(tissue, stiffness[e, b], factor, b)
            passive -= implicit_inertia(dt, stiffness[e, b], damping) * v
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
