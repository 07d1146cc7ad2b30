"""What a warp of a GPU finds out together about the blocks around its particles: neighbours would ask for the same."""

from __future__ import annotations

import warp as wp

from piavatar_envs.mpm.types import Blocks, Grid

wp.set_module_options({"enable_backward": False})


@wp.func_native("""
#if defined(__CUDA_ARCH__) && __CUDA_ARCH__ >= 800
constexpr unsigned ALL = 0xffffffffu;
const int lane = threadIdx.x & 31;
if (__activemask() != ALL) return true;
const int e0 = __shfl_sync(ALL, e, 0);
if (!__all_sync(ALL, e == e0)) return true;
int begin[3], last[3];  // blocks of the box around all stencils
#pragma unroll
for (int c = 0; c < 3; ++c) {
    begin[c] = __reduce_min_sync(ALL, base[c]) >> 2;
    last[c] = (__reduce_max_sync(ALL, base[c]) + 2) >> 2;
}
if (wp::max(last[0] - begin[0], wp::max(last[1] - begin[1], last[2] - begin[2])) > 3) return true;
// of 4 x 4 x 4 blocks a thread asks for two; where the box has fewer, for its last
const int j = wp::min(begin[1] + (lane >> 2 & 3), last[1]), k = wp::min(begin[2] + (lane & 3), last[2]);
const int* const mine = &wp::index(blocks.fields, e, j * grid.blocks[2] + k);
const int plane = grid.blocks[1] * grid.blocks[2], i = begin[0] + (lane >> 4);
int fields = mine[wp::min(i, last[0]) * plane] | mine[wp::min(i + 2, last[0]) * plane];
fields = __reduce_or_sync(ALL, fields);
return (fields & (fields - 1)) != 0;
#else
return true;
#endif
""")
def fields_may_meet(grid: Grid, blocks: Blocks, e: int, base: wp.vec3i) -> bool:
    """Whether the particles of the warp, with stencils from ``base``, may have blocks of several fields around them."""
    ...
