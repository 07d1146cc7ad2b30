"""Root of a posed avatar: a bounded wrench in place of balance, alignment of the command, and unsupported bodies.

A pose-controlled avatar does not balance itself; a six-degree-of-freedom wrench holds the commanded root instead. It is
a rigid acceleration field over the whole body (no sag), with gravity fed forward and an implicit critically damped PD
``a = (w^2 (e - dt V) - 2 w V) / (1 + 2 w dt + w^2 dt^2)``. It is released until the next reset once the body has been
pushed too far.

Commanded motion changes the momentum of the body, which the wrench gives too. With ``bound_motion`` the whole is
bounded: an impulse beyond the bound comes back to the body as a recoil of its physical velocity, and is given later in
the control step, as far as the bound allows.

Commanded motion of a body that nothing supports must carry neither momentum nor angular momentum. When its root is
released, a body keeps the momenta that commanded motion has had until then.
"""

from __future__ import annotations

import warp as wp

from piavatar_envs.avatar.controller import critical_pull
from piavatar_envs.avatar.rotation import finite_turn, quat_exp, quat_log
from piavatar_envs.avatar.tracking import kabsch_rotation, spin_of
from piavatar_envs.avatar.types import (
    Anchor,
    Body,
    Carry,
    Command,
    Pose,
    PoseControl,
    RemovedMotion,
    RigidFit,
    RigidFits,
    RootState,
    Wrench,
)
from piavatar_envs.core.arrays import vec8, vec12, vec16
from piavatar_envs.core.cuda_intrinsics import sum_threads6, sum_threads12, sum_threads16
from piavatar_envs.mpm.types import row

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})


@wp.func
def is_free(control: PoseControl, released: int):
    """Return whether nothing supports a body, so that commanded motion must carry no momentum."""
    return control.free_motion != 0 or released != 0


@wp.func
def axial(K: wp.mat33):
    """Return ``sum a x b`` of ``K = sum a b^T``."""
    return wp.vec3(K[1, 2] - K[2, 1], K[2, 0] - K[0, 2], K[0, 1] - K[1, 0])


@wp.func
def clamp_length(v: wp.vec3, limit: float):
    """Return ``v``, shortened to ``limit`` if it is longer."""
    return v * wp.min(1.0, limit / wp.max(wp.length(v), 1.0e-12))


@wp.func
def hold_root(
    control: PoseControl,
    fraction: float,
    command: Command,
    pose: Pose,
    carry: Carry,
    whole: RigidFit,
    mass: float,
    e: int,
    # in and out
    root: RootState,
    # out
    wrench: Wrench,
):
    """Run :func:`pull_root` for the pelvis of a kinematic pose that contact has carried."""
    G = carry.rotation[e, 0]
    q = G * pose.rotation[e, 0]
    at = wp.quat_rotate(G, pose.position[e, 0]) + carry.translation[e, 0]
    pull_root(
        control, fraction, fraction == 0.0, command, q, at, whole.velocity[e], whole.spin[e], whole.inertia[e], mass, e,
        root, wrench,
    )  # fmt: skip


@wp.func
def pull_root(
    control: PoseControl,
    fraction: float,
    begins: bool,
    command: Command,
    q: wp.quat,
    at: wp.vec3,
    velocity: wp.vec3,
    spin: wp.vec3,
    inertia: wp.mat33,
    mass: float,
    e: int,
    # in and out
    root: RootState,
    # out
    wrench: Wrench,
):
    """Compute the pull of the root, or release it beyond its limits; a control step ``begins`` without debt.

    ``q`` and ``at`` are rotation and place of the pelvis when a ``fraction`` of the control step is over; velocity,
    spin and inertia are those of the whole body.
    """
    wrench.force[e] = wp.vec3(0.0)
    wrench.torque[e] = wp.vec3(0.0)
    if begins:
        wrench.owed[e] = wp.vec3(0.0)
        wrench.owed_turn[e] = wp.vec3(0.0)
    if control.root_rate <= 0.0:
        return
    q_command = command.rotation[e, 0] * quat_exp(fraction * command.increment[e, 0])
    error = command.root[e] + fraction * (command.goal_root[e] - command.root[e]) - at
    up = wp.vec3(0.0, 0.0, 1.0)
    tilt_cos = wp.dot(wp.quat_rotate(q, up), wp.quat_rotate(q_command, up))
    horizontal = wp.sqrt(error[0] * error[0] + error[1] * error[1])
    if (
        tilt_cos < control.release_tilt_cos
        or horizontal > control.release_distance
        or wp.abs(error[2]) > control.release_height
    ):
        root.released[e] = 1
    if root.released[e] != 0:
        return
    a = critical_pull(control.root_rate, control.dt, error, velocity) - control.gravity
    turn = critical_pull(control.root_rate, control.dt, quat_log(q_command * wp.quat_inverse(q)), spin)
    wrench.force[e] = clamp_length(mass * a, control.max_root_force * mass)
    wrench.torque[e] = clamp_length(inertia * turn, control.max_root_torque * mass)


@wp.func
def share_within(control: PoseControl, pull: wp.vec3, need: wp.vec3, limit: float):
    """Return the share in [0, 1] of ``need`` that is given: what ``pull``, which is within the limit, leaves room for.

    It is all where the limit does not bound commanded motion.
    """
    if control.bound_motion == 0:
        return 1.0
    n = wp.max(wp.length_sq(need), 1.0e-12)
    along = wp.dot(pull, need)
    room = wp.max(limit * limit - wp.length_sq(pull), 0.0)
    return wp.clamp((wp.sqrt(along * along + n * room) - along) / n, 0.0, 1.0)


@wp.func
def root_change(
    body: Body,
    control: PoseControl,
    mass: float,
    jumps: wp.array2d(dtype=vec8),
    bones: RigidFits,
    removed: RemovedMotion,
    whole: RigidFit,
    e: int,
    thread: int,
    threads: int,
    # in and out
    wrench: Wrench,
    root: RootState,
):
    """Return the change of velocity and spin of the whole body by the root, and accumulate the mean of its force.

    ``jumps`` are the changes of momentum as commanded, before any rigid part was taken out.
    """
    dt = control.dt
    if control.root_rate <= 0.0:
        return wp.vec3(), dt * removed.acceleration[e]
    P = wp.vec3()
    L = wp.vec3()
    for c in range(thread, body.chunk_bone.shape[0], threads):
        s = jumps[e, c]
        p = wp.vec3(s[0], s[1], s[2])
        P += p
        L += wp.vec3(s[3], s[4], s[5]) + wp.cross(bones.center[e, body.chunk_bone[c]] - whole.center[e], p)
    s = sum_threads6(vec8(P[0], P[1], P[2], L[0], L[1], L[2], 0.0, 0.0), threads)
    P = wp.vec3(s[0], s[1], s[2]) - mass * removed.velocity[e]
    L = wp.vec3(s[3], s[4], s[5]) - removed.turning[e]
    return answer_motion(
        control, mass, whole.inertia[e], P, L, P + wrench.owed[e], L + wrench.owed_turn[e], e, thread, wrench, root
    )


@wp.func
def answer_motion(
    control: PoseControl,
    mass: float,
    inertia: wp.mat33,
    P: wp.vec3,
    L: wp.vec3,
    need: wp.vec3,
    need_turn: wp.vec3,
    e: int,
    thread: int,
    # in and out
    wrench: Wrench,
    root: RootState,
):
    """Return the change of velocity and spin by the root where commanded motion has changed by ``P`` and ``L``.

    These are a momentum [N s] and an angular momentum about the centre [N m s]. The root gives its pull, and what it
    can of the impulses ``need`` and ``need_turn``; what it cannot give comes back to the body.
    """
    dt = control.dt
    force = wp.vec3()
    torque = wp.vec3()
    if root.released[e] == 0:
        force = dt * wrench.force[e]
        share = share_within(control, force, need, dt * mass * control.max_root_force)
        force += share * need
        need *= 1.0 - share
        torque = dt * wrench.torque[e]
        share = share_within(control, torque, need_turn, dt * mass * control.max_root_torque)
        torque += share * need_turn
        need_turn *= 1.0 - share
    V = (force - P) / mass
    W = spin_of(inertia, torque - L)
    if not (wp.isfinite(V) and wp.isfinite(W)):
        return wp.vec3(), wp.vec3()  # the MPM substep flags the failure
    if thread == 0:
        wrench.owed[e] = need
        wrench.owed_turn[e] = need_turn
        root.wrench_force[e] = root.wrench_force[e] + force / control.control_dt
        root.wrench_torque[e] = root.wrench_torque[e] + torque / control.control_dt
    return V, W


@wp.func
def bone_place(body: Body, pose: Pose, e: int, b: int):
    """Return the centre of mass of a bone in a pose [m]."""
    arm = body.rest_center[row(e, body.bone_mass.shape[0]), b] - body.rest_joint[row(e, body.rest_joint.shape[0]), b]
    return pose.position[e, b] + wp.quat_rotate(pose.rotation[e, b], arm)


@wp.func
def lay_command(
    body: Body,
    command: Pose,
    pose: Pose,
    e: int,
    thread: int,
    threads: int,
    # out
    anchor: Anchor,
):
    """Fit the rigid motion from the commanded to the tracked pose: Kabsch over the bones' centres of mass."""
    r = row(e, body.bone_mass.shape[0])
    m = float(0.0)
    x = wp.vec3()
    y = wp.vec3()
    for b in range(thread, body.parent.shape[0], threads):
        w = body.bone_mass[r, b]
        m += w
        x += w * bone_place(body, pose, e, b)
        y += w * bone_place(body, command, e, b)
    s = sum_threads12(vec12(m, x[0], x[1], x[2], y[0], y[1], y[2], 0.0, 0.0, 0.0, 0.0, 0.0), threads)
    mean = wp.vec3(s[1], s[2], s[3]) / s[0]
    mean_command = wp.vec3(s[4], s[5], s[6]) / s[0]
    H = wp.mat33()
    for b in range(thread, body.parent.shape[0], threads):
        at = bone_place(body, pose, e, b) - mean
        H += body.bone_mass[r, b] * wp.outer(at, bone_place(body, command, e, b) - mean_command)
    # fmt: off
    t = sum_threads12(
        vec12(H[0, 0], H[0, 1], H[0, 2], H[1, 0], H[1, 1], H[1, 2], H[2, 0], H[2, 1], H[2, 2], 0.0, 0.0, 0.0), threads
    )
    # fmt: on
    if thread == 0:
        H = wp.mat33(t[0], t[1], t[2], t[3], t[4], t[5], t[6], t[7], t[8])
        q = wp.normalize(wp.quat_from_matrix(kabsch_rotation(H)))
        anchor.rotation[e] = q
        anchor.translation[e] = mean - wp.quat_rotate(q, mean_command)


@wp.func
def free_motion(
    body: Body,
    control: PoseControl,
    corrections: wp.array2d(dtype=vec12),
    bones: RigidFits,
    whole: RigidFit,
    e: int,
    thread: int,
    threads: int,
    # out
    removed: RemovedMotion,
):
    """Compute the rigid part that is subtracted from the commanded motion of an unsupported body.

    The kinematic step, as a whole, is moved back by the rigid motion that leaves it without momentum and angular
    momentum: ``vk' = y + A (r + dt y)`` with ``y = vk - V`` and ``sum m r x vk' = 0``. As the inertia
    changes, a spinning body keeps its angular momentum instead of its spin (a skater drawing in the arms).
    """
    r = row(e, body.bone_mass.shape[0])
    m = float(0.0)
    for b in range(thread, body.parent.shape[0], threads):
        m += body.bone_mass[r, b]
    P = wp.vec3()
    K = wp.mat33()
    for c in range(thread, body.chunk_bone.shape[0], threads):
        s = corrections[e, c]
        p = wp.vec3(s[0], s[1], s[2])
        P += p
        K += wp.mat33(s[3], s[4], s[5], s[6], s[7], s[8], s[9], s[10], s[11])
        K += wp.outer(bones.center[e, body.chunk_bone[c]] - whole.center[e], p)
    # fmt: off
    t = sum_threads16(
        vec16(
            m, P[0], P[1], P[2], K[0, 0], K[0, 1], K[0, 2], K[1, 0], K[1, 1], K[1, 2], K[2, 0], K[2, 1], K[2, 2],
            0.0, 0.0, 0.0,
        ),
        threads,
    )
    # fmt: on
    if thread > 0:
        return
    K = wp.mat33(t[4], t[5], t[6], t[7], t[8], t[9], t[10], t[11], t[12])
    I = whole.inertia[e]
    second = wp.diag(wp.vec3(0.5 * wp.trace(I))) - I
    A = wp.mat33()
    w = wp.vec3()
    moment = K
    for _ in range(5):  # each iteration reduces the error by a factor of dt |w|
        w -= spin_of(I, axial(moment))
        A = finite_turn(w, control.dt)
        moment = K + (control.dt * K + second) * wp.transpose(A)
    removed.velocity[e] = wp.vec3(t[1], t[2], t[3]) / t[0]
    removed.turn[e] = A
    removed.center[e] = whole.center[e]
    removed.turning[e] = axial(K)
    W = whole.spin[e]
    removed.acceleration[e] = -spin_of(I, wp.trace(moment) * W - moment * W)
