"""Which fields have mass in a block of nodes: bit ``f`` of its mask for field ``f``."""

from __future__ import annotations

import warp as wp

from piavatar_envs.mpm.stencil import block_index, blocks_touched
from piavatar_envs.mpm.types import Grid

wp.set_module_options({"enable_backward": False})


@wp.func
def has_field(mask: int, f: int):
    """Whether bit ``f`` of a block's mask is set."""
    return ((mask >> f) & 1) != 0


@wp.func
def lowest_field(mask: int, num_fields: int):
    """First field of a mask; ``num_fields`` if it is empty."""
    f = int(0)
    while f < num_fields and not has_field(mask, f):
        f += 1
    return f


@wp.func
def end_of_fields(mask: int, num_fields: int):
    """One more than the last field of a mask; 0 if it is empty."""
    f = num_fields
    while f > 0 and not has_field(mask, f - 1):
        f -= 1
    return f


@wp.func
def lowest_other(mask: int, f: int, num_fields: int):
    """First field of a mask that is not ``f``."""
    other = lowest_field(mask, num_fields)
    if other == f:
        other = f + 1
        while other < num_fields - 1 and not has_field(mask, other):
            other += 1
    return other


@wp.func
def fields_around(grid: Grid, base: wp.vec3i, e: int, active: wp.array2d(dtype=int)):
    """Fields that have mass in any block of a stencil."""
    mask = int(0)
    blocks = blocks_touched(base)
    for i in range(blocks[0]):
        for j in range(blocks[1]):
            for k in range(blocks[2]):
                mask = mask | active[e, block_index(grid, base[0] + 2 * i, base[1] + 2 * j, base[2] + 2 * k)]
    return mask
