"""Commanded motion of bodies that nothing supports: it must carry neither momentum nor angular momentum."""

from __future__ import annotations

import warp as wp

from piavatar_envs.avatar.lanes import sum_threads16
from piavatar_envs.avatar.rigid_fit import spin_of
from piavatar_envs.avatar.rotation import finite_turn
from piavatar_envs.avatar.types import Body, Drive, RemovedMotion, RigidFit, RigidFits, Wrench, vec12, vec16
from piavatar_envs.mpm.types import row

wp.set_module_options({"enable_backward": False})


@wp.func
def is_free(drive: Drive, let_go: int):
    """Whether nothing supports a body: commanded motion must then carry no momentum."""
    return drive.free_motion != 0 or let_go != 0


@wp.func
def axial(K: wp.mat33):
    """``sum a x b`` from ``K = sum a b^T``."""
    return wp.vec3(K[1, 2] - K[2, 1], K[2, 0] - K[0, 2], K[0, 1] - K[1, 0])


@wp.func
def free_motion(
    body: Body,
    drive: Drive,
    corrections: wp.array2d(dtype=vec12),
    bones: RigidFits,
    whole: RigidFit,
    e: int,
    thread: int,
    threads: int,
    # out
    removed: RemovedMotion,
    # in and out
    wrench: Wrench,
):
    """What a body without support takes out of commanded motion: a body cannot push itself off nothing.

    The kinematic step, as a whole, is moved back by the rigid motion that leaves it without momentum and angular
    momentum: ``vk' = y + A (r + dt y)`` with ``y = vk - V`` and ``sum m r x vk' = 0``. And as the inertia changes, a
    spinning body keeps its angular momentum, not its spin (a skater who draws in the arms).
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
    for _ in range(5):  # each turn of the loop gains a factor of dt |w|
        w -= spin_of(I, axial(moment))
        A = finite_turn(w, drive.dt)
        moment = K + (drive.dt * K + second) * wp.transpose(A)
    removed.velocity[e] = wp.vec3(t[1], t[2], t[3]) / t[0]
    removed.turn[e] = A
    removed.center[e] = whole.center[e]
    W = whole.spin[e]
    wrench.angular[e] = wrench.angular[e] - spin_of(I, wp.trace(moment) * W - moment * W)
