"""Stores of a warp: vectors and matrices that lie one after the other in memory, written in whole lines.

A thread that stores a matrix of 36 bytes writes nine words, and with each of them a warp touches 32 lines of memory: of
what then goes out, an eighth is news. Here a warp's values meet in shared memory and go out as they lie in memory.
Where the threads' places do not follow each other, or not all threads have come, each stores its own.
"""

from __future__ import annotations

import warp as wp

wp.set_module_options({"enable_backward": False})

_STORE = """
auto* const mine = reinterpret_cast<float*>(&wp::index(into, e, p));
#if defined(__CUDA_ARCH__)
constexpr unsigned ALL = 0xffffffffu;
constexpr int WORDS = %d;
__shared__ float stages[32 * 32 * WORDS / 4];  // of the 8 warps of 256 threads
const int lane = threadIdx.x & 31;
const unsigned here = __activemask();
if (here == ALL && blockDim.x <= 256) {
    float* const first = (float*)__shfl_sync(ALL, (unsigned long long)mine, 0);
    if (__all_sync(ALL, mine == first + WORDS * lane)) {
        float* const stage = stages + (threadIdx.x >> 5) * 32 * WORDS;
        const unsigned storing = __ballot_sync(ALL, store);
#pragma unroll
        for (int c = 0; c < WORDS; ++c) stage[WORDS * lane + c] = reinterpret_cast<const float*>(&value)[c];
        __syncwarp();
#pragma unroll
        for (int c = 0; c < WORDS; ++c) {
            const int word = 32 * c + lane;
            if (storing >> (word / WORDS) & 1u) first[word] = stage[word];
        }
        __syncwarp();
        return;
    }
}
#endif
if (store) wp::index(into, e, p) = value;
"""


@wp.func_native(_STORE % 3)
def store_vector(into: wp.array2d(dtype=wp.vec3), e: int, p: int, value: wp.vec3, store: bool):
    """``into[e, p] = value`` if ``store``; at best all threads of a warp come here."""
    ...


@wp.func_native(_STORE % 9)
def store_matrix(into: wp.array2d(dtype=wp.mat33), e: int, p: int, value: wp.mat33, store: bool):
    """:func:`store_vector` of a matrix."""
    ...
