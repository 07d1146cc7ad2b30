"""Support of a posed body whose joints resist contact: the root's wrench, and the momentum of commanded motion.

Commanded motion changes the momentum of a body (:mod:`piavatar_envs.avatar.torque_control.commanded_motion`). As under
plain pose control the root gives it, and holds and carries the body by a rigid motion of all particles
(:mod:`piavatar_envs.avatar.pose_control.root`). What the root does not give comes back to the body as the opposite
rigid motion, so that the whole keeps both momenta: all of it where nothing holds the root, or where commanded motion is
set to carry none.
"""

from __future__ import annotations

import warp as wp

from piavatar_envs.avatar.pose_control.root import answer_motion, pull_root
from piavatar_envs.avatar.torque_control.commanded_motion import CommandedMotion
from piavatar_envs.avatar.torque_control.workspace import TorqueWorkspace
from piavatar_envs.avatar.tracking import fit_moments, moments_of
from piavatar_envs.avatar.types import Body, PoseControl, RootState, Wrench
from piavatar_envs.core.arrays import number_at, set_vector, vec8, vec16, vector_at
from piavatar_envs.core.cuda_intrinsics import (
    BLOCK,
    first_particle,
    sum_threads6,
    sum_threads16,
    threads_of_environment,
)
from piavatar_envs.mpm.types import Particles, row

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})

#: Groups of threads that share the particles of a body.
GROUPS = wp.constant(16)


@wp.struct
class Support:
    """Rigid motion of a body in a substep, and the sums that it follows from, about the pelvis joint at its start."""

    moments: wp.array2d(dtype=vec16)  # (num_envs, GROUPS) of the particles' velocity but for the commanded part
    momenta: wp.array2d(dtype=vec8)  # (num_envs, GROUPS) momentum as commanded, and angular momentum
    changes: wp.array2d(dtype=vec8)  # (num_envs, GROUPS) changes of both in this substep
    motion: wp.array(dtype=vec8)  # (num_envs,) velocity at the pelvis [m/s] and spin [rad/s] that the root adds
    load: wp.array(dtype=float)  # (count,) weight and support over mass and gravity; empty unless bones bear the flesh


@wp.func
def momenta_of(m: float, arm: wp.vec3, v: wp.vec3):
    """Return momentum and angular momentum of a mass."""
    p = m * v
    l = wp.cross(arm, p)
    return vec8(p[0], p[1], p[2], l[0], l[1], l[2], 0.0, 0.0)


@wp.kernel
def sum_body(
    body: Body,
    particles: Particles,
    x: wp.array2d(dtype=wp.vec3),
    u: wp.array2d(dtype=wp.vec3),
    vk: wp.array2d(dtype=wp.vec3),
    failure: wp.array(dtype=int),
    threads: int,
    w: TorqueWorkspace,
    motion: CommandedMotion,
    # out
    support: Support,
):
    """Sum the moments of a body and its change of momentum as commanded, over ``(num_envs, GROUPS, threads)``."""
    e, group, thread = wp.tid()
    if failure[e] != 0:
        return
    r = row(e, particles.mass.shape[0])
    center = w.pelvis[e]
    total = vec16()
    whole = vec8()
    change = vec8()
    for p in range(group * threads + thread, body.count, GROUPS * threads):
        n = body.first + p
        arm = vector_at(x, e, n) - center
        m = number_at(particles.mass, r, n)
        commanded = vector_at(w.commanded, e, p)
        total += moments_of(m, arm, vector_at(u, e, n) + vector_at(vk, e, n) - commanded)
        whole += momenta_of(m, arm, commanded)
        change += momenta_of(m, arm, vector_at(motion.change, e, p))
    total = sum_threads16(total, threads)
    whole = sum_threads6(whole, threads)
    change = sum_threads6(change, threads)
    if thread == 0:
        support.moments[e, group] = total
        support.momenta[e, group] = whole
        support.changes[e, group] = change


@wp.kernel
def support_body(
    control: PoseControl,
    fraction: float,
    begins: int,
    failure: wp.array(dtype=int),
    # in and out
    w: TorqueWorkspace,
    motion: CommandedMotion,
    wrench: Wrench,
    root: RootState,
    support: Support,
):
    """Compute the rigid motion that the root adds to a body, over ``num_envs``.

    The pose is that at the end of the substep, when a ``fraction`` of the control step is over.
    """
    e = wp.tid()
    if failure[e] != 0:
        return
    s = vec16()
    whole = vec8()
    change = vec8()
    for group in range(GROUPS):
        s += support.moments[e, group]
        whole += support.momenta[e, group]
        change += support.changes[e, group]
    own = fit_moments(s)
    mass = own.mass
    center = own.center
    pull_root(
        control, fraction, begins != 0, motion.command, w.pose.rotation[e, 0], w.pose.position[e, 0], own.velocity,
        own.spin, own.inertia, mass, e, root, wrench,
    )  # fmt: skip
    P = wp.vec3(whole[0], whole[1], whole[2])
    moved = w.pose.position[e, 0] - w.pelvis[e]
    motion.momenta[e, 0] = P
    motion.momenta[e, 1] = wp.vec3(whole[3], whole[4], whole[5]) - wp.cross(moved, P)
    recoil = wp.vec3(motion.recoil[e, 0], motion.recoil[e, 1], motion.recoil[e, 2])
    turn = wp.vec3(motion.recoil[e, 3], motion.recoil[e, 4], motion.recoil[e, 5])
    P = wp.vec3(change[0], change[1], change[2])
    L = wp.vec3(change[3], change[4], change[5]) - wp.cross(center, P)
    P += mass * (recoil + wp.cross(turn, center))
    L += own.inertia * turn
    need = P + wrench.owed[e]
    need_turn = L + wrench.owed_turn[e]
    if control.free_motion != 0 or control.root_rate <= 0.0:
        need = wp.vec3(0.0)
        need_turn = wp.vec3(0.0)
    V, W = answer_motion(control, mass, own.inertia, P, L, need, need_turn, e, 0, wrench, root)
    V -= wp.cross(W, center)
    support.motion[e] = vec8(V[0], V[1], V[2], W[0], W[1], W[2], 0.0, 0.0)


@wp.kernel(launch_bounds=(BLOCK, 10))
def move_body(
    body: Body,
    control: PoseControl,
    x: wp.array2d(dtype=wp.vec3),
    released: wp.array(dtype=int),
    failure: wp.array(dtype=int),
    w: TorqueWorkspace,
    support: Support,
    # in and out
    u: wp.array2d(dtype=wp.vec3),
):
    """Add the motion of :func:`support_body` to all particles, over ``(num_envs, particle_threads)``.

    Where bones bear the flesh, they get its weight, and the flesh loses its support.
    """
    i, _ = wp.tid()
    threads = threads_of_environment(x.shape[0])
    own = first_particle(i, threads)
    e = own[0]
    if failure[e] != 0:
        return
    s = support.motion[e]
    V = wp.vec3(s[0], s[1], s[2])
    W = wp.vec3(s[3], s[4], s[5])
    center = w.pelvis[e]
    loaded = support.load.shape[0] > 0 and released[e] == 0
    p = own[1]
    while p < body.count:
        n = body.first + p
        v = vector_at(u, e, n) + V + wp.cross(W, vector_at(x, e, n) - center)
        if loaded:
            v += (control.dt * support.load[p]) * control.gravity
        set_vector(u, e, n, v)
        p += threads
