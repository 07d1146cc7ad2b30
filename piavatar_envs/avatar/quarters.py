"""Sums over chunks of particles where quarters of a warp share them: one, two, or all four, by a chunk's length.

A warp that sums one chunk has as much to do with what its lanes have in the end as with the particles, and chunks of
bones are short. So all lanes have about as many particles, and what they have in the end is added up for up to four
chunks at once. On a CPU a thread has a chunk.
"""

from __future__ import annotations

import numpy as np
import warp as wp

from piavatar_envs.avatar.lanes import place_in_chunks
from piavatar_envs.avatar.types import vec12, vec16

wp.set_module_options({"enable_backward": False})

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
