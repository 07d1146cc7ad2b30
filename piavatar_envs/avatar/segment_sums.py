"""Sums over chunks of particles where quarters of a warp share them: one, two, or all four, by a chunk's length.

A warp that sums one chunk has as much to do with what its lanes have in the end as with the particles, and chunks of
bones are short. So all lanes have about as many particles, and what they have in the end is added up for up to four
chunks at once. On a CPU a thread has a chunk.

Sums over the particles of bones: moments that rigid motions are fitted to, momenta of what the drive changes.

They run over fixed lists of particles in chunks (no atomics): the result does not depend on the schedule. ``threads``
threads share a chunk, or the chunks of a bone.

Sums over bones in the pass over particles that finds what is to be summed.

A body's particles are in parts that follow each other in memory. On a GPU a CUDA block has a part: what its threads
find of the particles meets in shared memory, from where its warps sum the chunks of bones that are in the part. On a
CPU a body is one part, and its particles meet in an array that all bodies use after each other.
"""

from __future__ import annotations

import numpy as np
import warp as wp

from piavatar_envs.avatar.types import Body, PoseControl
from piavatar_envs.core.arrays import float_at, int_at, number_at, vec12, vec16, vector_at
from piavatar_envs.core.cuda_intrinsics import BLOCK, place_in_chunks, sum_threads12
from piavatar_envs.mpm.types import Particles, row

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})


#: Lanes of a quarter, quarters of a warp, and the most particles that a lane should have.
LANES, QUARTERS, MOST = 8, 4, 6


def share_chunks(chunk: np.ndarray, begin: np.ndarray, end: np.ndarray, bone: np.ndarray, device: str) -> np.ndarray:
    """Who shares chunks of these numbers, with entries from ``begin`` on before ``end``: records of four, int32.

    That is, of quarters that follow each other, in whole warps: the chunk whose sum a quarter stores, or -1; the
    ``bone`` of its chunk, and 256 times the lanes that share it; its first entry, and the end of all. On a CPU there is
    one for each chunk.
    """
    length = end - begin
    if not wp.get_device(device).is_cuda:
        return np.stack([chunk, bone + 256, begin, end], axis=1).astype(np.int32)
    count = np.select([length <= LANES * MOST, length <= 2 * LANES * MOST], [1, 2], QUARTERS)
    order = np.lexsort((-length, -count))  # those that share a warp begin with a whole one, a half one, or anywhere
    own = np.repeat(order, count[order])
    rank = np.concatenate([np.arange(n) for n in count[order]])
    stored = np.where(rank == 0, chunk[own], -1)
    records = [stored, bone[own] + 256 * LANES * count[own], begin[own] + LANES * rank, end[own]]
    nothing = np.tile([[-1, 256 * LANES, 0, 0]], (-len(own) % QUARTERS, 1))
    return np.concatenate([np.stack(records, axis=1), nothing]).astype(np.int32)


def warps_of(quarters: wp.array, threads: int) -> int:
    """Warps that share the chunks, of so many ``threads``; on a CPU there is one a chunk."""
    return quarters.shape[0] // max(1, threads // LANES)


@wp.func
def quarters_at_once(threads: int):
    """Quarters of a warp; 1 of a thread that is alone."""
    return wp.max(1, threads // LANES)


@wp.func_native("""
#if defined(__CUDA_ARCH__)
const int4 four = reinterpret_cast<const int4*>(quarters.data)[first + (lane >> 3)];
return wp::vec_t<4, wp::int32>(four.x, four.y, four.z + (lane & 7), four.w);
#else
return quarters.data[first];
#endif
""")
def share_of(quarters: wp.array(dtype=wp.vec4i), first: int, lane: int) -> wp.vec4i:
    """The share of a ``lane`` of the warp whose quarters are ``first`` and the next, with its own first entry."""
    ...


@wp.func
def own_share(quarters: wp.array(dtype=wp.vec4i), i: int, j: int, k: int, threads: int):
    """Environment and share of a thread in a launch over ``(num_envs, warps_of(quarters), threads)``."""
    together = quarters_at_once(threads)
    at = place_in_chunks(i, j, k, quarters.shape[0] // together)
    return at[0], share_of(quarters, together * at[1], at[2])


# Each step halves the numbers that a lane goes on with, as well as the lanes that go on with the same.
def _store(words: int, store: str) -> str:
    """A snippet that adds up the ``part`` of so many words of all lanes that share a chunk, and stores it."""
    size = 1 << (words - 1).bit_length()
    return f"""
#if defined(__CUDA_ARCH__)
constexpr unsigned ALL = 0xffffffffu;
constexpr int WORDS = {words}, SIZE = {size}, OWN = SIZE / 8;
const int lane = threadIdx.x & 7, lanes = share[1] >> 8, n = into.shape[1] * e + share[0];
float part[WORDS];
#pragma unroll
for (int k = 0; k < WORDS; ++k) part[k] = k < {min(words, 16)} ? value[k] : {"other[k - 16]" if words > 16 else "0.0f"};
const auto halve = [&](auto half_of) {{
    constexpr int HALF = decltype(half_of)::value;
    const bool upper = lane & HALF / OWN;
#pragma unroll
    for (int k = 0; k < HALF; ++k) {{
        const bool pair = k + HALF < WORDS;
        const float far = part[pair ? k + HALF : k], away = pair && !upper ? far : part[k];
        part[k] = (pair && upper ? far : part[k]) + __shfl_xor_sync(ALL, away, HALF / OWN);
    }}
}};
struct First {{ enum {{ value = SIZE / 2 }}; }};
struct Second {{ enum {{ value = SIZE / 4 }}; }};
struct Third {{ enum {{ value = SIZE / 8 }}; }};
halve(First{{}}), halve(Second{{}}), halve(Third{{}});
#pragma unroll
for (int distance = 8; distance < 32; distance *= 2)
#pragma unroll
    for (int k = 0; k < OWN; ++k) {{
        const float far = __shfl_xor_sync(ALL, part[k], distance);
        part[k] += lanes > distance ? far : 0.0f;
    }}
if (share[0] >= 0 && lane * OWN < WORDS) {{
    {store}
}}
#else
"""


@wp.func_native(
    _store(
        28,
        """float* const to = lane < 4 ? (float*)&into.data[n] : (float*)&other_into.data[n];
    reinterpret_cast<float4*>(to)[lane & 3] = make_float4(part[0], part[1], part[2], part[3]);""",
    )
    + "into.data[into.shape[1] * e + share[0]] = value;\n"
    + "other_into.data[other_into.shape[1] * e + share[0]] = other;\n#endif\n"
)
def store_both(
    into: wp.array2d(dtype=vec16),
    other_into: wp.array2d(dtype=vec12),
    e: int,
    share: wp.vec4i,
    value: vec16,
    other: vec12,
):
    """``into[e, c]`` = the sum of ``value`` over the lanes that share chunk ``c``, ``other_into[e, c]`` of ``other``.

    All threads of a warp come here.
    """
    ...


_TWO = "float* const to = (float*)(into.data + n) + 2 * lane;\n    to[0] = part[0], to[1] = part[1];"
_ALONE = "into.data[into.shape[1] * e + share[0]] = value;\n#endif\n"


@wp.func_native(_store(12, _TWO) + _ALONE)
def store_one(into: wp.array2d(dtype=vec12), e: int, share: wp.vec4i, value: vec12):
    """:func:`store_both` of twelve numbers."""
    ...


@wp.func_native(_store(16, _TWO) + _ALONE)
def store_moments(into: wp.array2d(dtype=vec16), e: int, share: wp.vec4i, value: vec16):
    """:func:`store_both` of sixteen numbers."""
    ...


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

    The ``share`` of a thread is as :mod:`piavatar_envs.avatar.segment_sums` has it.
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
    control: PoseControl,
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
    if failure[e] != 0 or (control.free_motion == 0 and let_go[e] == 0):
        return
    quarters = quarters_at_once(threads)
    for n in range(group, body.quarters.shape[0] // quarters, GROUPS):
        chunk_motion(body, particles, x, vk, center, e, share_of(body.quarters, quarters * n, thread), corrections)
