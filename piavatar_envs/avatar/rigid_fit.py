"""Rigid motion of bones and of the whole body, fitted to the physical velocity.

A fit is mass- and skinning-weighted least squares, so the blended field ``sum_b w_b (V_b + Omega_b x (x - c_b))`` has
exactly the linear and angular momentum of the velocity it was fitted to, bone by bone. Everything the drive gives back
or takes away goes through such fields, which is why it keeps momentum.

The particles' sums are :mod:`piavatar_envs.avatar.bone_sums`; ``threads`` threads share the chunks of a bone, or the
bones of a body.
"""

from __future__ import annotations

import warp as wp

from piavatar_envs.avatar.lanes import sum_threads12, sum_threads16
from piavatar_envs.avatar.types import Body, RigidFit, RigidFits, vec12, vec16
from piavatar_envs.mpm.types import row

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})


@wp.func
def spin_of(inertia: wp.mat33, angular_momentum: wp.vec3):
    """Angular velocity ``I^-1 L``; zero where the inertia is singular."""
    det = wp.determinant(inertia)
    trace = inertia[0, 0] + inertia[1, 1] + inertia[2, 2]
    if det <= 1.0e-9 * trace * trace * trace:
        return wp.vec3(0.0)
    return wp.inverse(inertia) * angular_momentum


@wp.func
def symmetric(diag: wp.vec3, off: wp.vec3):
    """Symmetric matrix with the diagonal ``xx, yy, zz`` and beside it ``yz, zx, xy``."""
    # fmt: off
    return wp.mat33(
        diag[0], off[2], off[1],
        off[2], diag[1], off[0],
        off[1], off[0], diag[2],
    )
    # fmt: on


@wp.func
def point_inertia(mass: float, d: wp.vec3):
    """Inertia of a point mass at ``d``."""
    return wp.diag(wp.vec3(mass * wp.dot(d, d))) - mass * wp.outer(d, d)


@wp.func
def fit_bone(
    body: Body,
    reference: wp.array2d(dtype=wp.vec3),
    moments: wp.array2d(dtype=vec16),
    e: int,
    b: int,
    thread: int,
    threads: int,
    # out
    bones: RigidFits,
):
    """Rigid motion of one bone: centre [m], its velocity [m/s], angular velocity [rad/s], inertia [kg m^2]."""
    s = vec16()
    for c in range(body.chunk_start[b] + thread, body.chunk_start[b + 1], threads):
        s += moments[e, c]
    s = sum_threads16(s, threads)
    if thread > 0:
        return
    m = wp.max(s[0], 1.0e-12)
    d = wp.vec3(s[1], s[2], s[3]) / m
    V = wp.vec3(s[4], s[5], s[6]) / m
    second = symmetric(wp.vec3(s[7], s[8], s[9]), wp.vec3(s[10], s[11], s[12])) - m * wp.outer(d, d)
    I = wp.diag(wp.vec3(wp.trace(second))) - second
    L = wp.vec3(s[13], s[14], s[15]) - m * wp.cross(d, V)
    bones.center[e, b] = reference[e, b] + d
    bones.velocity[e, b] = V
    bones.spin[e, b] = spin_of(I, L)
    bones.inertia[e, b] = I


@wp.func
def fit_whole(
    body: Body,
    bones: RigidFits,
    e: int,
    thread: int,
    threads: int,
    # out
    whole: RigidFit,
):
    """Rigid motion of the whole body from those of its bones: their momenta add up to the body's."""
    r = row(e, body.bone_mass.shape[0])
    pelvis = bones.center[e, 0]
    m = float(0.0)
    mx = wp.vec3()
    mv = wp.vec3()
    for b in range(thread, body.parent.shape[0], threads):
        m += body.bone_mass[r, b]
        mx += body.bone_mass[r, b] * (bones.center[e, b] - pelvis)
        mv += body.bone_mass[r, b] * bones.velocity[e, b]
    s = sum_threads12(vec12(m, mx[0], mx[1], mx[2], mv[0], mv[1], mv[2], 0.0, 0.0, 0.0, 0.0, 0.0), threads)
    c = pelvis + wp.vec3(s[1], s[2], s[3]) / s[0]
    I = wp.mat33()
    L = wp.vec3()
    for b in range(thread, body.parent.shape[0], threads):
        d = bones.center[e, b] - c
        I += bones.inertia[e, b] + point_inertia(body.bone_mass[r, b], d)
        L += bones.inertia[e, b] * bones.spin[e, b] + body.bone_mass[r, b] * wp.cross(d, bones.velocity[e, b])
    # fmt: off
    t = sum_threads12(
        vec12(L[0], L[1], L[2], I[0, 0], I[0, 1], I[0, 2], I[1, 0], I[1, 1], I[1, 2], I[2, 0], I[2, 1], I[2, 2]),
        threads,
    )
    # fmt: on
    if thread == 0:
        I = wp.mat33(t[3], t[4], t[5], t[6], t[7], t[8], t[9], t[10], t[11])
        whole.center[e] = c
        whole.velocity[e] = wp.vec3(s[4], s[5], s[6]) / s[0]
        whole.spin[e] = spin_of(I, wp.vec3(t[0], t[1], t[2]))
        whole.inertia[e] = I
