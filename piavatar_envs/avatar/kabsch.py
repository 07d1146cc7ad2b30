"""Tracking: the rigid motion of every bone from its particles.

Kabsch's closed form (Kabsch, "A solution for the best rotation to relate two sets of vectors", 1976): the rotation
that maximises ``tr(R^T H)`` for the correlation ``H = sum (x - mean x)(x0 - mean x0)^T`` is ``U V^T`` of its singular
value decomposition. ``wp.svd3`` returns proper rotations and puts the sign into the smallest singular value, so
``U V^T`` is the proper rotation also for reflected point sets.
"""

from __future__ import annotations

import warp as wp

from piavatar_envs.avatar.rotation import quat_exp
from piavatar_envs.avatar.types import Body
from piavatar_envs.mpm.types import row

wp.set_module_options({"enable_backward": False})


@wp.func
def kabsch_rotation(H: wp.mat33):
    """Proper rotation that maximises ``tr(R^T H)``.

    ``H`` is normalised first: ``wp.svd3`` errs by tens of degrees when the entries are near 1e-5. It also errs by up
    to 0.3 degrees where singular values are close together, so two Newton steps on the optimum follow: the best ``R``
    makes ``M = R^T H`` symmetric, and a turn by ``w`` changes its axial vector by ``(tr(M) I - M) w``.
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
        if wp.determinant(slope) > 1.0e-3:  # else two rotations are almost equally good
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
    """World rotation, joint position [m] and velocity [m/s] of every bone. A failed environment keeps its last."""
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
    """Rotation of every bone relative to its parent; the root's is its world rotation."""
    e, b = wp.tid()
    parent = body.parent[b]
    if parent < 0:
        local[e, b] = rotation[e, b]
    else:
        local[e, b] = wp.quat_inverse(rotation[e, parent]) * rotation[e, b]
