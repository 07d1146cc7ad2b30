"""Stores of a warp: vectors and matrices that lie one after the other in memory, written in whole lines.

A thread that stores a matrix of 36 bytes writes nine words, and with each of them a warp touches 32 lines of memory: of
what then goes out, an eighth is news. Here a warp's values meet in shared memory and go out as they lie in memory.
Where the threads' places do not follow each other, or not all threads have come, each stores its own.
"""

from __future__ import annotations

import warp as wp

from piavatar_envs.mpm.gather import Gathered
from piavatar_envs.mpm.types import Moving

wp.set_module_options({"enable_backward": False})

_STORE = """
#if defined(__CUDA_ARCH__)
constexpr unsigned ALL = 0xffffffffu;
constexpr int STAGE = 144;  // words of a warp: 16 matrices
__shared__ float stages[WP_TILE_BLOCK_DIM / 32 * STAGE];  // as many threads as the module is compiled for
const int lane = threadIdx.x & 31;
float* const stage = stages + (threadIdx.x >> 5) * STAGE;
const bool here = __activemask() == ALL && blockDim.x <= WP_TILE_BLOCK_DIM;
bool together = false;
unsigned storing = 0;
if (here) {  // all threads of the warp go on to every exchange, or they would wait for each other for ever
    const int first = __shfl_sync(ALL, p, 0), row = __shfl_sync(ALL, e, 0);
    together = __all_sync(ALL, p == first + lane && e == row);
    storing = __ballot_sync(ALL, store);
}
auto put = [&](auto& into, const auto& value) {
    if (!together) {
        if (store) wp::index(into, e, p) = value;
        return;
    }
    constexpr int WORDS = sizeof(value) / 4, AT_ONCE = WORDS > 4 ? 16 : 32, TURNS = (WORDS * AT_ONCE + 31) / 32;
    float* const first = reinterpret_cast<float*>(&wp::index(into, e, p - lane));
#pragma unroll
    for (int begin = 0; begin < 32; begin += AT_ONCE) {
        if (lane >= begin && lane < begin + AT_ONCE)
            for (int c = 0; c < WORDS; ++c)
                stage[WORDS * (lane - begin) + c] = reinterpret_cast<const float*>(&value)[c];
        __syncwarp();
#pragma unroll
        for (int c = 0; c < TURNS; ++c) {
            const int word = 32 * c + lane;
            if (word < WORDS * AT_ONCE && (storing == ALL || (storing >> (begin + word / WORDS) & 1u)))
                first[WORDS * begin + word] = stage[word];
        }
        __syncwarp();
    }
};
%s
#else
auto put = [&](auto& into, const auto& value) {
    if (store) wp::index(into, e, p) = value;
};
%s
#endif
"""


@wp.func_native(_STORE % (("put(into, value);",) * 2))
def store_vector(into: wp.array2d(dtype=wp.vec3), e: int, p: int, value: wp.vec3, store: bool):
    """``into[e, p] = value`` if ``store``; at best all threads of a warp come here."""
    ...


@wp.func_native(_STORE % (("put(moved.x, s.x); put(moved.u, s.u); put(moved.C, s.C); put(moved.F, s.F);",) * 2))
def store_particle(moved: Moving, e: int, p: int, s: Gathered, store: bool):
    """:func:`store_vector` of all that a particle ``p`` has become."""
    ...
