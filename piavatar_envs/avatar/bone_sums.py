"""Sums over the particles of bones: moments that rigid motions are fitted to, momenta of what the drive changes.

They run over fixed lists of particles in chunks (no atomics): the result does not depend on the schedule. ``threads``
threads share a chunk, or the chunks of a bone.
"""

from __future__ import annotations

import warp as wp

from piavatar_envs.avatar.lanes import BLOCK, sum_threads12
from piavatar_envs.avatar.loads import float_at, int_at, number_at, vector_at
from piavatar_envs.avatar.quarters import own_share, quarters_at_once, share_of, store_moments, store_one
from piavatar_envs.avatar.types import Body, Drive, vec12, vec16
from piavatar_envs.mpm.types import Particles, row

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})

#: Groups of threads that share the chunks of a body, where it seldom has any.
GROUPS = wp.constant(8)


#: Entries of a chunk that a thread asks for at once, in sums that wait for memory.
AT_ONCE = wp.constant(2)


@wp.func
def entry_of(body: Body, n: int, last: int):
    """Particle of entry ``n`` and the bone's weight in it, 0 beyond the ``last`` entry of the chunk."""
    at = wp.min(n, last)
    weight = float_at(body.entry_weight, at)
    return int_at(body.entry, at), wp.where(n > last, 0.0, weight)


@wp.func
def moments_of(w: float, d: wp.vec3, v: wp.vec3):
    """What a share of mass ``w`` at ``d`` with velocity ``v`` has of the sums in :data:`vec16`."""
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
def chunk_moments(
    body: Body,
    particles: Particles,
    x: wp.array2d(dtype=wp.vec3),
    u: wp.array2d(dtype=wp.vec3),
    reference: wp.array2d(dtype=wp.vec3),
    e: int,
    share: wp.vec4i,
    # out
    moments: wp.array2d(dtype=vec16),
):
    """Moments of one chunk of a bone's particles about the bone's reference point (small numbers, small round-off).

    The ``share`` of a thread is as :mod:`piavatar_envs.avatar.quarters` has it.
    """
    origin = reference[e, share[1] & 255]
    r = row(e, particles.mass.shape[0])
    total = vec16()
    last = share[3] - 1
    n = share[2]
    while n <= last:
        for _ in range(AT_ONCE):
            entry, weight = entry_of(body, n, last)
            p = body.first + entry
            w = weight * number_at(particles.mass, r, p)
            total += moments_of(w, vector_at(x, e, p) - origin, vector_at(u, e, p))
            n += share[1] >> 8
    store_moments(moments, e, share, total)


@wp.kernel(launch_bounds=(BLOCK, 9))
def sum_moments(
    body: Body,
    particles: Particles,
    x: wp.array2d(dtype=wp.vec3),
    u: wp.array2d(dtype=wp.vec3),
    reference: wp.array2d(dtype=wp.vec3),
    failure: wp.array(dtype=int),
    threads: int,
    # out
    moments: wp.array2d(dtype=vec16),
):
    """:func:`chunk_moments` of every chunk, over ``(num_envs, warps of the quarters, threads)``."""
    i, j, k = wp.tid()
    e, share = own_share(body.quarters, i, j, k, threads)
    if failure[e] == 0:
        chunk_moments(body, particles, x, u, reference, e, share, moments)


@wp.func
def chunk_corrections(
    body: Body,
    particles: Particles,
    x: wp.array2d(dtype=wp.vec3),
    center: wp.array2d(dtype=wp.vec3),
    pull: wp.array2d(dtype=wp.vec3),
    lean: wp.array2d(dtype=wp.vec3),
    e: int,
    share: wp.vec4i,
    # out
    corrections: wp.array2d(dtype=vec12),
):
    """Momentum and angular momentum, about the bone's centre, of the pulls and of the lean in one chunk."""
    origin = center[e, share[1] & 255]
    r = row(e, particles.mass.shape[0])
    p1 = wp.vec3()
    l1 = wp.vec3()
    p2 = wp.vec3()
    l2 = wp.vec3()
    last = share[3] - 1
    n = share[2]
    while n <= last:
        for _ in range(AT_ONCE):
            p, weight = entry_of(body, n, last)
            w = weight * number_at(particles.mass, r, body.first + p)
            d = vector_at(x, e, body.first + p) - origin
            a = w * vector_at(pull, e, p)
            p1 += a
            l1 += wp.cross(d, a)
            a = w * vector_at(lean, e, p)
            p2 += a
            l2 += wp.cross(d, a)
            n += share[1] >> 8
    total = vec12(p1[0], p1[1], p1[2], l1[0], l1[1], l1[2], p2[0], p2[1], p2[2], l2[0], l2[1], l2[2])
    store_one(corrections, e, share, total)


@wp.kernel(launch_bounds=(BLOCK, 9))
def sum_corrections(
    body: Body,
    particles: Particles,
    x: wp.array2d(dtype=wp.vec3),
    center: wp.array2d(dtype=wp.vec3),
    pull: wp.array2d(dtype=wp.vec3),
    lean: wp.array2d(dtype=wp.vec3),
    failure: wp.array(dtype=int),
    threads: int,
    # out
    corrections: wp.array2d(dtype=vec12),
):
    """:func:`chunk_corrections` of every chunk, over ``(num_envs, warps of the quarters, threads)``."""
    i, j, k = wp.tid()
    e, share = own_share(body.quarters, i, j, k, threads)
    if failure[e] == 0:
        chunk_corrections(body, particles, x, center, pull, lean, e, share, corrections)


@wp.func
def add_chunks(
    body: Body,
    corrections: wp.array2d(dtype=vec12),
    e: int,
    b: int,
    thread: int,
    threads: int,
    # out
    bone_corrections: wp.array2d(dtype=vec12),
):
    """Sum of the chunks of bone ``b``."""
    s = vec12()
    for c in range(body.chunk_start[b] + thread, body.chunk_start[b + 1], threads):
        s += corrections[e, c]
    s = sum_threads12(s, threads)
    if thread == 0:
        bone_corrections[e, b] = s


@wp.func
def chunk_motion(
    body: Body,
    particles: Particles,
    x: wp.array2d(dtype=wp.vec3),
    vk: wp.array2d(dtype=wp.vec3),
    center: wp.array2d(dtype=wp.vec3),
    e: int,
    share: wp.vec4i,
    # out
    corrections: wp.array2d(dtype=vec12),
):
    """Momentum of the kinematic velocity and its moment ``sum m d vk^T`` about the bone's centre in one chunk."""
    origin = center[e, share[1] & 255]
    r = row(e, particles.mass.shape[0])
    P = wp.vec3()
    K = wp.mat33()
    for n in range(share[2], share[3], share[1] >> 8):
        p = body.first + int_at(body.entry, n)
        a = (float_at(body.entry_weight, n) * number_at(particles.mass, r, p)) * vector_at(vk, e, p)
        P += a
        K += wp.outer(vector_at(x, e, p) - origin, a)
    total = vec12(P[0], P[1], P[2], K[0, 0], K[0, 1], K[0, 2], K[1, 0], K[1, 1], K[1, 2], K[2, 0], K[2, 1], K[2, 2])
    store_one(corrections, e, share, total)


@wp.kernel(launch_bounds=(BLOCK, 10))
def sum_motion(
    body: Body,
    drive: Drive,
    particles: Particles,
    x: wp.array2d(dtype=wp.vec3),
    vk: wp.array2d(dtype=wp.vec3),
    center: wp.array2d(dtype=wp.vec3),
    let_go: wp.array(dtype=int),
    failure: wp.array(dtype=int),
    threads: int,
    # out
    corrections: wp.array2d(dtype=vec12),
):
    """:func:`chunk_motion` of bodies that nothing supports.

    Launched over ``(num_envs, GROUPS, threads)``: most bodies have nothing to do here, and end few threads.
    """
    e, group, thread = wp.tid()
    if failure[e] != 0 or (drive.free_motion == 0 and let_go[e] == 0):
        return
    quarters = quarters_at_once(threads)
    for n in range(group, body.quarters.shape[0] // quarters, GROUPS):
        chunk_motion(body, particles, x, vk, center, e, share_of(body.quarters, quarters * n, thread), corrections)
