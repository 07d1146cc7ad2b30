"""What a warp of a GPU finds out together about the blocks around its particles: neighbours would ask for the same."""

from __future__ import annotations

import warp as wp

from piavatar_envs.mpm.types import Grid

wp.set_module_options({"enable_backward": False})


@wp.func_native("""
#if defined(__CUDA_ARCH__) && __CUDA_ARCH__ >= 800
constexpr unsigned ALL = 0xffffffffu;
const wp::vec2i apart(-2, -2);
const int lane = threadIdx.x & 31;
if (__activemask() != ALL) return apart;
const int e0 = __shfl_sync(ALL, e, 0), field0 = __shfl_sync(ALL, field, 0);
if (!__all_sync(ALL, e == e0 && field == field0)) return apart;
const unsigned takers = __ballot_sync(ALL, takes);
if (takers == 0u) return wp::vec2i(-1, -1);
int begin[3], lower[3], upper[3];  // blocks of all stencils, and of the thread's own from the first of those
bool many = false;
#pragma unroll
for (int c = 0; c < 3; ++c) {
    const int of_first = __shfl_sync(ALL, base[c], __ffs(takers) - 1);
    const int own = takes ? base[c] : of_first;
    begin[c] = __reduce_min_sync(ALL, own) >> 2;
    lower[c] = (own >> 2) - begin[c];
    upper[c] = ((own + 2) >> 2) - begin[c];
    many |= upper[c] > 3;
}
if (__any_sync(ALL, many)) return apart;
// a bit for each of 4 x 4 x 4 blocks, 16 a plane
const unsigned line = 1u << lower[2] | 1u << upper[2];
const unsigned long long plane = line << 4 * lower[1] | line << 4 * upper[1];
const unsigned long long touched = plane << 16 * lower[0] | plane << 16 * upper[0];
const int j = begin[1] + (lane >> 2 & 3), k = begin[2] + (lane & 3);
wp::vec2i mine(-1, -1);
#pragma unroll
for (int q = 0; q < 2; ++q) {
    const int i = begin[0] + 2 * q + (lane >> 4);
    if (__reduce_or_sync(ALL, (unsigned)(touched >> 32 * q)) >> lane & 1u)
        mine[q] = (i * grid.blocks[1] + j) * grid.blocks[2] + k;
}
return mine;
#else
return wp::vec2i(-2, -2);
#endif
""")
def share_of_blocks(grid: Grid, e: int, field: int, base: wp.vec3i, takes: bool) -> wp.vec2i:
    """Blocks that a thread sees to of those that the stencils of the warp touch, each block once; -1 for none.

    ``base`` is the lowest node of the thread's own stencil, if it ``takes`` part. -2 if every thread has to see to its
    own: their blocks are too many, or not all threads of a warp have come with the same environment and field.
    """
    ...
