"""Sums over the particles of bones: moments that rigid motions are fitted to, and momenta that controllers return.

The sums run over fixed lists of particles in chunks, without atomics, so that the result does not depend on the
schedule. On a GPU up to four chunks share a warp, because a warp that summed a single chunk would spend as long on the
reduction over its lanes as on the particles: by its length a chunk has one, two or all four quarters of a warp. On a
CPU a thread has a chunk.

The torque controller sums in the same pass over particles that computes the summands. For this the particles of a body
are partitioned in memory order: on a GPU a CUDA block stores the particles of a partition in shared memory, and its
warps sum the chunks of that partition. On a CPU a body is one partition, and the particles are stored in an array that
all bodies use one after the other.
"""

from __future__ import annotations

import numpy as np
import warp as wp

from piavatar_envs.avatar.tracking import moments_of
from piavatar_envs.avatar.types import Body, PoseControl
from piavatar_envs.core.arrays import float_at, int_at, number_at, vec8, vec12, vec16, vector_at
from piavatar_envs.core.cuda_intrinsics import BLOCK, place_in_chunks, sum_threads12
from piavatar_envs.mpm.types import Particles, row

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})


#: Lanes of a quarter, quarters of a warp, and the greatest number of particles that a lane should sum.
LANES, QUARTERS, MOST = 8, 4, 6


def share_chunks(chunk: np.ndarray, begin: np.ndarray, end: np.ndarray, bone: np.ndarray, device: str) -> np.ndarray:
    """Distribute chunks, with entries from ``begin`` on before ``end``, over quarters of warps.

    Returns:
        Records ``(quarters, 4)`` int32, in whole warps: the chunk whose sum a quarter stores, or -1; the ``bone`` of
        its chunk plus 256 times the lanes that share it; its first entry; the end of all. On a CPU one for each chunk.
    """
    length = end - begin
    if not wp.get_device(device).is_cuda:
        return np.stack([chunk, bone + 256, begin, end], axis=1).astype(np.int32)
    count = np.select([length <= LANES * MOST, length <= 2 * LANES * MOST], [1, 2], QUARTERS)
    order = np.lexsort((-length, -count))  # longest shares first, so that none straddles two warps
    own = np.repeat(order, count[order])
    rank = np.concatenate([np.arange(n) for n in count[order]])
    stored = np.where(rank == 0, chunk[own], -1)
    records = [stored, bone[own] + 256 * LANES * count[own], begin[own] + LANES * rank, end[own]]
    nothing = np.tile([[-1, 256 * LANES, 0, 0]], (-len(own) % QUARTERS, 1))
    return np.concatenate([np.stack(records, axis=1), nothing]).astype(np.int32)


def warps_of(quarters: wp.array, threads: int) -> int:
    """Return the number of warps of ``threads`` that share the chunks; on a CPU one a chunk."""
    return quarters.shape[0] // max(1, threads // LANES)


@wp.func
def quarters_at_once(threads: int):
    """Return the quarters of a warp; 1 for a single thread."""
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
    """Return the share of a ``lane`` of the warp whose quarters begin at ``first``, with its own first entry."""
    ...


@wp.func
def own_share(quarters: wp.array(dtype=wp.vec4i), i: int, j: int, k: int, threads: int):
    """Return environment and share of a thread in a launch over ``(num_envs, warps_of(quarters), threads)``."""
    together = quarters_at_once(threads)
    at = place_in_chunks(i, j, k, quarters.shape[0] // together)
    return at[0], share_of(quarters, together * at[1], at[2])


# Each step halves the numbers that a lane continues with, and the lanes that hold the same numbers.
def _store(words: int, store: str) -> str:
    """Return a snippet that sums ``words`` words over the lanes that share a chunk, and stores them."""
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
    """Store the sums of ``value`` and ``other`` over the lanes that share chunk ``c`` in ``[e, c]`` of both arrays.

    All threads of a warp must call this.
    """
    ...


_TWO = "float* const to = (float*)(into.data + n) + 2 * lane;\n    to[0] = part[0], to[1] = part[1];"
_ALONE = "into.data[into.shape[1] * e + share[0]] = value;\n#endif\n"


@wp.func_native(_store(12, _TWO) + _ALONE)
def store_one(into: wp.array2d(dtype=vec12), e: int, share: wp.vec4i, value: vec12):
    """Store the sum of twelve numbers like :func:`store_both`."""
    ...


@wp.func_native(_store(6, "((float*)(into.data + n))[lane] = part[0];") + _ALONE)
def store_wrench(into: wp.array2d(dtype=vec8), e: int, share: wp.vec4i, value: vec8):
    """Store the sum of the first six numbers like :func:`store_both`."""
    ...


@wp.func_native(_store(16, _TWO) + _ALONE)
def store_moments(into: wp.array2d(dtype=vec16), e: int, share: wp.vec4i, value: vec16):
    """Store the sum of sixteen numbers like :func:`store_both`."""
    ...


#: Groups of threads that share the chunks of a body in :func:`sum_motion`, which few bodies need.
GROUPS = wp.constant(8)


#: Entries of a chunk that a thread loads at once, to hide the latency of memory.
AT_ONCE = wp.constant(2)


@wp.func
def entry_of(body: Body, n: int, last: int):
    """Return the particle of entry ``n`` and the bone's weight in it, 0 beyond the ``last`` entry of the chunk."""
    at = wp.min(n, last)
    weight = float_at(body.entry_weight, at)
    return int_at(body.entry, at), wp.where(n > last, 0.0, weight)


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
    """Sum the moments of one chunk of a bone's particles about the bone's reference point, for small round-off.

    ``share`` is a record of :func:`share_chunks`, with the thread's own first entry.
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
    """Run :func:`chunk_moments` for every chunk, over ``(num_envs, warps of the quarters, threads)``."""
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
    jump: wp.array2d(dtype=wp.vec3),
    e: int,
    share: wp.vec4i,
    # out
    corrections: wp.array2d(dtype=vec12),
    jumps: wp.array2d(dtype=vec8),
):
    """Sum the momenta of pulls and lean in one chunk, linear and angular about the bone's centre.

    If ``jumps`` has columns, sum those of commanded changes of velocity too.
    """
    origin = center[e, share[1] & 255]
    r = row(e, particles.mass.shape[0])
    held = jumps.shape[1] > 0
    p1 = wp.vec3()
    l1 = wp.vec3()
    p2 = wp.vec3()
    l2 = wp.vec3()
    p3 = wp.vec3()
    l3 = wp.vec3()
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
            if held:
                a = w * vector_at(jump, e, p)
                p3 += a
                l3 += wp.cross(d, a)
            n += share[1] >> 8
    total = vec12(p1[0], p1[1], p1[2], l1[0], l1[1], l1[2], p2[0], p2[1], p2[2], l2[0], l2[1], l2[2])
    store_one(corrections, e, share, total)
    if held:
        store_wrench(jumps, e, share, vec8(p3[0], p3[1], p3[2], l3[0], l3[1], l3[2], 0.0, 0.0))


@wp.kernel(launch_bounds=(BLOCK, 9))
def sum_corrections(
    body: Body,
    particles: Particles,
    x: wp.array2d(dtype=wp.vec3),
    center: wp.array2d(dtype=wp.vec3),
    pull: wp.array2d(dtype=wp.vec3),
    lean: wp.array2d(dtype=wp.vec3),
    jump: wp.array2d(dtype=wp.vec3),
    failure: wp.array(dtype=int),
    threads: int,
    # out
    corrections: wp.array2d(dtype=vec12),
    jumps: wp.array2d(dtype=vec8),
):
    """Run :func:`chunk_corrections` for every chunk, over ``(num_envs, warps of the quarters, threads)``."""
    i, j, k = wp.tid()
    e, share = own_share(body.quarters, i, j, k, threads)
    if failure[e] == 0:
        chunk_corrections(body, particles, x, center, pull, lean, jump, e, share, corrections, jumps)


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
    """Add up the chunks of bone ``b``."""
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
    """Sum momentum of the kinematic velocity and its moment ``sum m d vk^T`` about the bone's centre in one chunk."""
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
    released: wp.array(dtype=int),
    failure: wp.array(dtype=int),
    threads: int,
    # out
    corrections: wp.array2d(dtype=vec12),
):
    """Run :func:`chunk_motion` for bodies that nothing supports, over ``(num_envs, GROUPS, threads)``."""
    e, group, thread = wp.tid()
    if failure[e] != 0 or (control.free_motion == 0 and released[e] == 0):
        return
    quarters = quarters_at_once(threads)
    for n in range(group, body.quarters.shape[0] // quarters, GROUPS):
        chunk_motion(body, particles, x, vk, center, e, share_of(body.quarters, quarters * n, thread), corrections)


#: Threads of the CUDA block of a partition.
PARTITION_THREADS = 256
#: Particles of a partition on a GPU: larger partitions need fewer chunks, but more shared memory. The size must not
#: depend on the number of environments, because sums depend on it.
PARTITION_SIZE = 3 * PARTITION_THREADS
#: Words of a particle's record: three times four, so that lanes whose particles follow each other read from different
#: banks. Masses follow all records.
WORDS = wp.constant(12)
#: All words of a particle, with its mass.
ALL_WORDS = int(WORDS) + 1


@wp.struct
class Partitions:
    """Partitions of a body's particles: partition ``i`` begins at particle ``i * size``."""

    size: int
    start: wp.array(dtype=int)  # (partitions + 1,) chunks of partition i are those of quarters[start[i] : start[i + 1]]
    quarters: wp.array(dtype=wp.vec4i)  # of warps, see piavatar_envs.avatar.segment_sums
    entry: wp.array(dtype=wp.vec2i)  # like the body's: index in the partition, bits of the weight


@wp.func_native("""
#if defined(__CUDA_ARCH__)
const unsigned partitions = gridDim.x / (unsigned)num_envs, row = blockIdx.x / partitions;
return wp::vec_t<3, wp::int32>((int)row, (int)(blockIdx.x - row * partitions), (int)threadIdx.x);
#else
return wp::vec_t<3, wp::int32>(e, part, thread);
#endif
""")
def place_in_partitions(e: int, part: int, thread: int, num_envs: int) -> wp.vec3i:
    """Return environment, partition and thread in a launch over ``(num_envs, partitions, PARTITION_THREADS)``.

    The partitions of a body are consecutive, because they read the same bones.
    """
    ...


@wp.func_native(f"""
#if defined(__CUDA_ARCH__)
__shared__ float __align__(16) particles[{ALL_WORDS * PARTITION_SIZE}];
return reinterpret_cast<wp::uint64>(particles);
#else
return reinterpret_cast<wp::uint64>(scratch.data);
#endif
""")
def particle_arena(scratch: wp.array(dtype=float)) -> wp.uint64:
    """Return the arena of a partition's particles: a CUDA block's shared memory, on a CPU ``scratch``."""
    ...


@wp.func_native(f"""
float* const to = reinterpret_cast<float*>(arena) + {int(WORDS)} * n;
reinterpret_cast<float*>(arena)[{int(WORDS)} * size + n] = m;
#if defined(__CUDA_ARCH__)
reinterpret_cast<float4*>(to)[0] = make_float4(x[0], x[1], x[2], way[0]);
reinterpret_cast<float4*>(to)[1] = make_float4(first[0], first[1], first[2], way[1]);
reinterpret_cast<float4*>(to)[2] = make_float4(second[0], second[1], second[2], way[2]);
#else
for (int c = 0; c < 3; ++c) to[c] = x[c], to[4 + c] = first[c], to[8 + c] = second[c], to[3 + 4 * c] = way[c];
#endif
""")
def store_point(
    arena: wp.uint64, size: int, n: int, m: float, x: wp.vec3, first: wp.vec3, second: wp.vec3, way: wp.vec3
):
    """Store mass, position and three vectors of particle ``n`` of a partition of ``size`` particles."""
    ...


@wp.func_native(f"""
const float* const from = reinterpret_cast<const float*>(arena) + {int(WORDS)} * n;
wp::vec_t<12, wp::float32> value;
#if defined(__CUDA_ARCH__)
#pragma unroll
for (int c = 0; c < 3; ++c) {{
    const float4 four = reinterpret_cast<const float4*>(from)[c];
    value[4 * c] = four.x, value[4 * c + 1] = four.y, value[4 * c + 2] = four.z, value[4 * c + 3] = four.w;
}}
#else
for (int c = 0; c < 12; ++c) value[c] = from[c];
#endif
return value;
""")
def load_point(arena: wp.uint64, n: int) -> vec12:
    """Return position, first and second vector of particle ``n``, each followed by a component of the displacement."""
    ...


@wp.func_native(f"return reinterpret_cast<const float*>(arena)[{int(WORDS)} * size + n];")
def load_mass(arena: wp.uint64, size: int, n: int) -> float:
    """Return the mass of particle ``n``."""
    ...


@wp.func_native(f"""
const float* const from = reinterpret_cast<const float*>(arena) + 8;
float* const to = reinterpret_cast<float*>(&wp::index(into, e, first));
for (int n = thread; n < 3 * count; n += threads) to[n] = from[{int(WORDS)} * (n / 3) + n % 3];
""")
def store_second_vectors(
    arena: wp.uint64, count: int, thread: int, threads: int, e: int, first: int, into: wp.array2d(dtype=wp.vec3)
):
    """Write the second vectors of ``count`` particles to ``into[e, first:]``, in memory order."""
    ...


@wp.func_native("return entries.data[n];")
def entry_at(entries: wp.array(dtype=wp.vec2i), n: int) -> wp.vec2i:
    """Return ``entries[n]``."""
    ...


@wp.func_native("float weight;\nmemcpy(&weight, &entry[1], sizeof(weight));\nreturn weight;")
def weight_of(entry: wp.vec2i) -> float:
    """Return the weight of an entry of a partition."""
    ...


@wp.func
def sum_chunk(
    partitions: Partitions,
    arena: wp.uint64,
    share: wp.vec4i,
    origin: wp.vec3,
    e: int,
    # out
    moments: wp.array2d(dtype=vec16),
    other_moments: wp.array2d(dtype=vec12),
):
    """Sum the moments about ``origin`` of the chunk of a ``share``, with the first vector as velocity.

    For the second vector and the displacement (``way``), sum momentum and angular momentum.
    """
    total = vec16()
    P = wp.vec3()
    L = wp.vec3()
    way_P = wp.vec3()
    way_L = wp.vec3()
    n = share[2]
    while n < share[3]:
        entry = entry_at(partitions.entry, n)
        s = load_point(arena, entry[0])
        w = weight_of(entry) * load_mass(arena, partitions.size, entry[0])
        d = wp.vec3(s[0], s[1], s[2]) - origin
        total += moments_of(w, d, wp.vec3(s[4], s[5], s[6]))
        momentum = w * wp.vec3(s[8], s[9], s[10])
        P += momentum
        L += wp.cross(d, momentum)
        momentum = w * wp.vec3(s[3], s[7], s[11])
        way_P += momentum
        way_L += wp.cross(d, momentum)
        n += share[1] >> 8
    # fmt: off
    other = vec12(
        P[0], P[1], P[2], L[0], L[1], L[2],
        way_P[0], way_P[1], way_P[2], way_L[0], way_L[1], way_L[2],
    )
    # fmt: on
    store_both(moments, other_moments, e, share, total, other)
