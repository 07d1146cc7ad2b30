"""Where the nodes of a stencil have their records: as few look-ups as its blocks allow, and little arithmetic."""

from __future__ import annotations

import warp as wp

from piavatar_envs.mpm.stencil import BLOCK_NODES, block_index
from piavatar_envs.mpm.types import Blocks, Grid

wp.set_module_options({"enable_backward": False})

#: What a block has in an array of a vector a node, and in one of halves of records.
VECTORS, HALVES = wp.constant(int(BLOCK_NODES)), wp.constant(2 * int(BLOCK_NODES))


@wp.func_native("return (wp::uint64)&wp::index(blocks.slot, e, n);")
def address_of_slot(blocks: Blocks, e: int, n: int) -> wp.uint64:
    """Address of ``blocks.slot[e, n]``, for :func:`slot_from`."""
    ...


@wp.func_native("return reinterpret_cast<const int*>(address)[n];")
def slot_from(address: wp.uint64, n: int) -> int:
    """The ``n``-th slot from an address: neighbours are found without looking for the row again."""
    ...


@wp.func
def slab_records(grid: Grid, blocks: Blocks, e: int, f: int, base: wp.vec3i, i: int, of_block: int):
    """Where the blocks of the nodes ``base + (i, ...)`` of a stencil begin in an array, for :func:`line_of_records`.

    The slab lies in two blocks along y and two along z; where it does not, the second repeats the first. What is found
    holds for all slabs of a stencil in the same blocks. A block has ``of_block`` entries, ``VECTORS`` or ``HALVES``.
    """
    block = block_index(grid, base[0] + i, base[1], base[2])
    slots = address_of_slot(blocks, e, f * grid.num_blocks + block)
    lower = of_block * slot_from(slots, 0)
    lower_last = lower
    upper = lower
    upper_last = lower
    if (base[2] & 3) > 1:
        lower_last = of_block * slot_from(slots, 1) - 4
        upper_last = lower_last
    if (base[1] & 3) > 1:
        upper = of_block * slot_from(slots, grid.blocks[2])
        upper_last = upper
        if (base[2] & 3) > 1:
            upper_last = of_block * slot_from(slots, grid.blocks[2] + 1) - 4
    return wp.vec4i(lower, lower_last, upper, upper_last)


@wp.func
def ends_of_line(slab: wp.vec4i, base: wp.vec3i, i: int, j: int):
    """Places of the nodes ``base + (i, j, 0)`` and, less 2, ``base + (i, j, 2)``; see :func:`slab_records`."""
    y = (base[1] & 3) + j
    in_block = 16 * ((base[0] + i) & 3) + 4 * (y & 3) + (base[2] & 3)
    return wp.vec2i(wp.where(y > 3, slab[2], slab[0]) + in_block, wp.where(y > 3, slab[3], slab[1]) + in_block)


@wp.func
def line_of_records(slab: wp.vec4i, base: wp.vec3i, i: int, j: int):
    """Places of the nodes ``base + (i, j, 0..2)`` of a stencil, ``slab`` those of the blocks of ``i``."""
    ends = ends_of_line(slab, base, i, j)
    return wp.vec3i(ends[0], wp.where((base[2] & 3) == 3, ends[1], ends[0]) + 1, ends[1] + 2)
