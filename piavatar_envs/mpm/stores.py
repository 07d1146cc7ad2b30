"""Stores of a warp: vectors that lie one after the other in memory, written in whole lines.

A thread that stores a vector writes three words, and each of them goes out with all lines that the warp's vectors are
in. Here a warp's values meet in shared memory and go out as they lie in memory.
Where the threads' places do not follow each other, or not all threads store, each that does stores its own.
"""

from __future__ import annotations

import warp as wp

from piavatar_envs.mpm.g2p import Gathered
from piavatar_envs.mpm.types import Kinematic, Moving, store_matrix

wp.set_module_options({"enable_backward": False})

_STORE = """
#if defined(__CUDA_ARCH__)
constexpr unsigned ALL = 0xffffffffu;
constexpr int STAGE = 96;  // words of a warp: 32 vectors
__shared__ float stages[WP_TILE_BLOCK_DIM / 32 * STAGE];  // as many threads as the module is compiled for
const int lane = threadIdx.x & 31;
float* const stage = stages + (threadIdx.x >> 5) * STAGE;
const bool here = __activemask() == ALL && blockDim.x <= WP_TILE_BLOCK_DIM;
bool together = false;
if (here) {  // all threads of the warp go on to every exchange, or they would wait for each other for ever
    const int first = __shfl_sync(ALL, p, 0), row = __shfl_sync(ALL, e, 0);
    together = __all_sync(ALL, store && p == first + lane && e == row);
}
auto put = [&](auto& into, const auto& value) {
    if (!together) {
        if (store) wp::index(into, e, p) = value;
        return;
    }
    float* const first = reinterpret_cast<float*>(&wp::index(into, e, p - lane));
#pragma unroll
    for (int c = 0; c < 3; ++c) stage[3 * lane + c] = value[c];
    __syncwarp();
#pragma unroll
    for (int c = 0; c < 3; ++c) first[32 * c + lane] = stage[32 * c + lane];
    __syncwarp();
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


@wp.func_native(_STORE % (("put(moved.x, s.x); put(moved.u, s.u);",) * 2))
def store_vectors(moved: Moving, e: int, p: int, s: Gathered, store: bool):
    """:func:`store_vector` of where particle ``p`` has come to, and of its velocity."""
    ...


@wp.func_native(_STORE % (("put(u, velocity); put(driven.vk, vk); put(driven.spin, spin);",) * 2))
def store_velocities(
    u: wp.array2d(dtype=wp.vec3),
    driven: Kinematic,
    e: int,
    p: int,
    velocity: wp.vec3,
    vk: wp.vec3,
    spin: wp.vec3,
    store: bool,
):
    """:func:`store_vector` of a particle's physical velocity, and of its prescribed motion."""
    ...


@wp.func_native(_STORE % (("put(first, one); if (second_too) put(second, other);",) * 2))
def store_pair(
    first: wp.array2d(dtype=wp.vec3),
    second: wp.array2d(dtype=wp.vec3),
    e: int,
    p: int,
    one: wp.vec3,
    other: wp.vec3,
    second_too: bool,
    store: bool,
):
    """:func:`store_vector` of one, and of another if that is wanted, as all threads know."""
    ...


@wp.func
def store_particle(moved: Moving, e: int, p: int, s: Gathered, store: bool):
    """All that a particle ``p`` has become, if ``store``; at best all threads of a warp come here."""
    store_vectors(moved, e, p, s, store)
    if store:
        store_matrix(moved.C, e, p, s.C)
        store_matrix(moved.F, e, p, s.F)
