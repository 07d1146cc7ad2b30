"""The root: a bounded wrench that stands in for balance in pose control, and the anchor of the commanded pose.

A pose-controlled avatar does not balance itself; a six-degree-of-freedom wrench holds the commanded root instead. It is
a rigid acceleration field over the whole body (no sag), with gravity fed forward and an implicit critically damped PD
``a = (w^2 (e - dt V) - 2 w V) / (1 + 2 w dt + w^2 dt^2)``. It is bounded, and it lets go for good (until reset) once
the body has been knocked too far: pushes are survived or not.
"""

from __future__ import annotations

import warp as wp

from piavatar_envs.avatar.critical_damping import critical_pull
from piavatar_envs.avatar.rotation import quat_exp, quat_log
from piavatar_envs.avatar.tracking import kabsch_rotation
from piavatar_envs.avatar.types import Anchor, Body, Carry, Command, Drive, Held, Pose, RigidFit, Wrench
from piavatar_envs.core.arrays import vec12
from piavatar_envs.core.cuda_intrinsics import sum_threads12
from piavatar_envs.mpm.types import row

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})


@wp.func
def clamp_length(v: wp.vec3, limit: float):
    """``v``, shortened to ``limit`` if it is longer."""
    return v * wp.min(1.0, limit / wp.max(wp.length(v), 1.0e-12))


@wp.func
def hold_root(
    drive: Drive,
    fraction: float,
    command: Command,
    pose: Pose,
    carry: Carry,
    whole: RigidFit,
    mass: float,
    e: int,
    # in and out
    held: Held,
    # out
    wrench: Wrench,
):
    """Acceleration of the body by the root wrench in this substep; its mean over the control step is accumulated."""
    wrench.linear[e] = wp.vec3(0.0)
    wrench.angular[e] = wp.vec3(0.0)
    if drive.root_rate <= 0.0:
        return
    G = carry.rotation[e, 0]
    q = G * pose.rotation[e, 0]
    at = wp.quat_rotate(G, pose.position[e, 0]) + carry.translation[e, 0]
    q_command = command.rotation[e, 0] * quat_exp(fraction * command.increment[e, 0])
    error = command.root[e] + fraction * (command.goal_root[e] - command.root[e]) - at
    up = wp.vec3(0.0, 0.0, 1.0)
    tilt_cos = wp.dot(wp.quat_rotate(q, up), wp.quat_rotate(q_command, up))
    horizontal = wp.sqrt(error[0] * error[0] + error[1] * error[1])
    if (
        tilt_cos < drive.max_tilt_cos
        or horizontal > drive.max_horizontal_error
        or wp.abs(error[2]) > drive.max_height_error
    ):
        held.let_go[e] = 1
    if held.let_go[e] != 0:
        return
    I = whole.inertia[e]
    a = critical_pull(drive.root_rate, drive.dt, error, whole.velocity[e]) - drive.gravity
    a = clamp_length(a, drive.max_force)
    torque = I * critical_pull(drive.root_rate, drive.dt, quat_log(q_command * wp.quat_inverse(q)), whole.spin[e])
    torque = clamp_length(torque, drive.max_torque * mass)
    if not (wp.isfinite(a) and wp.isfinite(torque)):
        return  # the body has blown up; the substep will say so
    wrench.linear[e] = a
    wrench.angular[e] = wp.inverse(I) * torque
    share = 1.0 / float(drive.num_substeps)
    held.wrench_force[e] = held.wrench_force[e] + share * mass * a
    held.wrench_torque[e] = held.wrench_torque[e] + share * torque


@wp.func
def bone_place(body: Body, pose: Pose, e: int, b: int):
    """Where a pose has the centre of mass of a bone."""
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
    """Best rigid motion from the commanded to the tracked pose: Kabsch over the bones' centres of mass."""
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
