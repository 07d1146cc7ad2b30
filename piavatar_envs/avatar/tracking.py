"""Rigid motion of bones and of the whole body: fitted to velocities, and tracked from particle positions.

A fit to velocities is a mass- and skinning-weighted least-squares fit, so that the blended field
``sum_b w_b (V_b + Omega_b x (x - c_b))`` has exactly the linear and angular momentum of the fitted velocity, bone by
bone. The pose controller adds and removes velocity only through such fields, and therefore conserves momentum. The sums
over particles are those of :mod:`piavatar_envs.avatar.segment_sums`; ``threads`` threads share the chunks of a bone, or
the bones of a body.

Tracking uses Kabsch's closed form (Kabsch, "A solution for the best rotation to relate two sets of vectors", 1976): the
rotation that maximises ``tr(R^T H)`` for the correlation ``H = sum (x - mean x)(x0 - mean x0)^T`` is ``U V^T`` of its
singular value decomposition. ``wp.svd3`` returns proper rotations and puts the sign into the smallest singular value,
so ``U V^T`` is a proper rotation even for reflected point sets.
"""

from __future__ import annotations

import warp as wp

from piavatar_envs.avatar.rotation import quat_exp
from piavatar_envs.avatar.types import Body, RigidFit, RigidFits
from piavatar_envs.core.arrays import vec12, vec16
from piavatar_envs.core.cuda_intrinsics import sum_threads12, sum_threads16
from piavatar_envs.mpm.types import row

wp.set_module_options({"enable_backward": False})


@wp.func
def spin_of(inertia: wp.mat33, angular_momentum: wp.vec3):
    """Return the angular velocity ``I^-1 L``; zero where the inertia is singular."""
    det = wp.determinant(inertia)
    trace = inertia[0, 0] + inertia[1, 1] + inertia[2, 2]
    if det <= 1.0e-9 * trace * trace * trace:
        return wp.vec3(0.0)
    return wp.inverse(inertia) * angular_momentum


@wp.func
def symmetric(diag: wp.vec3, off: wp.vec3):
    """Return the symmetric matrix with the diagonal ``xx, yy, zz`` and the other entries ``yz, zx, xy``."""
    # fmt: off
    return wp.mat33(
        diag[0], off[2], off[1],
        off[2], diag[1], off[0],
        off[1], off[0], diag[2],
    )
    # fmt: on


@wp.func
def moments_of(w: float, d: wp.vec3, v: wp.vec3):
    """Return the moments of a mass ``w`` at ``d`` with velocity ``v``: m, m d, m v, m d d^T, m d x v."""
    p = w * v
    wd = w * d
    l = wp.cross(wd, v)
    # fmt: off
    return vec16(
        w, wd[0], wd[1], wd[2], p[0], p[1], p[2],
        wd[0] * d[0], wd[1] * d[1], wd[2] * d[2], wd[1] * d[2], wd[2] * d[0], wd[0] * d[1],
        l[0], l[1], l[2],
    )
    # fmt: on


@wp.func
def summed_second_moment(s: vec16):
    """Return the second moment [kg m^2] of sums of :func:`moments_of`, which have it from component 7 on."""
    return symmetric(wp.vec3(s[7], s[8], s[9]), wp.vec3(s[10], s[11], s[12]))


@wp.func
def inertia_of(second: wp.mat33):
    """Return the inertia ``tr(S) I - S`` of matter with the second moment ``S`` about the same point [kg m^2]."""
    return wp.diag(wp.vec3(wp.trace(second))) - second


@wp.func
def point_inertia(mass: float, d: wp.vec3):
    """Return the inertia of a point mass at ``d``."""
    return wp.diag(wp.vec3(mass * wp.dot(d, d))) - mass * wp.outer(d, d)


@wp.struct
class RigidMotion:
    """Rigid motion of matter that has its momentum and angular momentum."""

    mass: float  # [kg]
    center: wp.vec3  # of mass [m]
    velocity: wp.vec3  # there [m/s]
    spin: wp.vec3  # angular velocity [rad/s]
    inertia: wp.mat33  # about the centre of mass [kg m^2]


@wp.func
def fit_moments(s: vec16):
    """Return the :class:`RigidMotion` of matter whose moments, see :func:`moments_of`, add up to ``s``.

    Its centre is relative to the point, and its velocity to the velocity, that the moments are about.
    """
    motion = RigidMotion()
    motion.mass = wp.max(s[0], 1.0e-12)
    d = wp.vec3(s[1], s[2], s[3]) / motion.mass
    motion.center = d
    motion.velocity = wp.vec3(s[4], s[5], s[6]) / motion.mass
    motion.inertia = inertia_of(summed_second_moment(s) - motion.mass * wp.outer(d, d))
    L = wp.vec3(s[13], s[14], s[15]) - motion.mass * wp.cross(d, motion.velocity)
    motion.spin = spin_of(motion.inertia, L)
    return motion


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
    """Fit the rigid motion of a bone: centre [m], its velocity [m/s], angular velocity [rad/s], inertia [kg m^2]."""
    s = vec16()
    for c in range(body.chunk_start[b] + thread, body.chunk_start[b + 1], threads):
        s += moments[e, c]
    s = sum_threads16(s, threads)
    if thread > 0:
        return
    motion = fit_moments(s)
    bones.center[e, b] = reference[e, b] + motion.center
    bones.velocity[e, b] = motion.velocity
    bones.spin[e, b] = motion.spin
    bones.inertia[e, b] = motion.inertia


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
    """Compute the rigid motion of the whole body, whose momenta are the sums of those of its bones."""
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


@wp.func
def kabsch_rotation(H: wp.mat33):
    """Return the proper rotation that maximises ``tr(R^T H)``.

    ``H`` is normalised first, because ``wp.svd3`` is inaccurate for small entries. It is also inaccurate where singular
    values are close together, so two Newton steps on the optimum follow: the best ``R`` makes ``M = R^T H`` symmetric,
    and a turn by ``w`` changes its axial vector by ``(tr(M) I - M) w``.
    """
    U = wp.mat33()
    S = wp.vec3()
    V = wp.mat33()
    scale = wp.sqrt(wp.ddot(H, H))
    H = H * (1.0 / wp.max(scale, 1.0e-30))
    wp.svd3(H, U, S, V)
    R = U * wp.transpose(V)
    for _ in range(2):
        M = wp.transpose(R) * H
        slope = wp.diag(wp.vec3(wp.trace(M))) - 0.5 * (M + wp.transpose(M))
        if wp.determinant(slope) > 1.0e-3:  # otherwise two rotations are almost equally good
            w = wp.inverse(slope) * wp.vec3(M[2, 1] - M[1, 2], M[0, 2] - M[2, 0], M[1, 0] - M[0, 1])
            R = R * wp.quat_to_matrix(quat_exp(w))
    return R


@wp.kernel
def track_bones(
    body: Body,
    x: wp.array2d(dtype=wp.vec3),
    u: wp.array2d(dtype=wp.vec3),
    vk: wp.array2d(dtype=wp.vec3),
    failure: wp.array(dtype=int),
    # out
    rotation: wp.array2d(dtype=wp.quat),
    position: wp.array2d(dtype=wp.vec3),
    velocity: wp.array2d(dtype=wp.vec3),
):
    """Track world rotation, joint position [m] and velocity [m/s] of every bone, over ``(num_envs, bones)``.

    A failed environment keeps its last values.
    """
    e, b = wp.tid()
    if failure[e] != 0:
        return
    r = row(e, body.rest.shape[0])
    start = body.tracker_start[b]
    end = body.tracker_start[b + 1]
    share = 1.0 / float(end - start)
    mean = wp.vec3()
    mean0 = wp.vec3()
    v = wp.vec3()
    for t in range(start, end):
        p = body.tracker[t]
        mean += share * x[e, body.first + p]
        mean0 += share * body.rest[r, p]
        v += share * (u[e, body.first + p] + vk[e, body.first + p])
    H = wp.mat33()
    for t in range(start, end):
        p = body.tracker[t]
        H += wp.outer(x[e, body.first + p] - mean, body.rest[r, p] - mean0)
    R = kabsch_rotation(H)
    rotation[e, b] = wp.normalize(wp.quat_from_matrix(R))
    position[e, b] = mean + R * (body.rest_joint[row(e, body.rest_joint.shape[0]), b] - mean0)
    velocity[e, b] = v


@wp.kernel
def local_rotations(
    body: Body,
    rotation: wp.array2d(dtype=wp.quat),
    # out
    local: wp.array2d(dtype=wp.quat),
):
    """Compute the rotation of every bone relative to its parent; that of the root is its world rotation."""
    e, b = wp.tid()
    parent = body.parent[b]
    if parent < 0:
        local[e, b] = rotation[e, b]
    else:
        local[e, b] = wp.quat_inverse(rotation[e, parent]) * rotation[e, b]
