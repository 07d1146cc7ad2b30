"""The sparse grid: blocks of 4 x 4 x 4 nodes get room for their nodes' records when matter comes to them.

A block has a bit for every velocity field with matter in it, and a slot for each of those. Slots are given out as
particles arrive and taken back when blocks are marked anew, so memory and time depend on the bodies, not on the empty
space around them. In which order they are given out is not determined on a GPU; nothing but addresses depends on it.
"""

from __future__ import annotations

import warp as wp

from piavatar_envs.mpm.stencil import (
    BLOCK_NODES,
    base_node,
    block_index,
    blocks_touched,
    grid_position,
    node_in_block,
    stencil_inside,
)
from piavatar_envs.mpm.types import (
    BESIDE,
    FAILURE_BLOCKS,
    FAILURE_NONFINITE,
    FAILURE_OUT_OF_GRID,
    TELLS,
    Blocks,
    Grid,
    Particles,
)
from piavatar_envs.mpm.warp_blocks import share_of_blocks

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})

_BLOCKS = wp.constant(FAILURE_BLOCKS)
_NONFINITE = wp.constant(FAILURE_NONFINITE)
_OUT_OF_GRID = wp.constant(FAILURE_OUT_OF_GRID)


#: What ``held`` says of a slot that nobody has got yet.
NOBODY = wp.constant(-1)


@wp.func
def has_field(mask: int, f: int):
    """Whether bit ``f`` of a block's mask is set."""
    return ((mask >> f) & 1) != 0


@wp.func_native("""
#if defined(__CUDA_ARCH__)
return mask != 0 ? __ffs(mask) - 1 : num_fields;
#else
return mask != 0 ? __builtin_ctz(mask) : num_fields;
#endif
""")
def lowest_field(mask: int, num_fields: int) -> int:
    """First field of a mask; ``num_fields`` if it is empty."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
return 32 - __clz(mask);
#else
return mask != 0 ? 32 - __builtin_clz(mask) : 0;
#endif
""")
def end_of_fields(mask: int) -> int:
    """One more than the last field of a mask; 0 if it is empty."""
    ...


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
def fields_around(grid: Grid, blocks: Blocks, base: wp.vec3i, e: int):
    """Fields that have matter in any block of a stencil."""
    mask = int(0)
    for i in range(2):  # a block may come twice: so all are asked for before the first has answered
        for j in range(2):
            for k in range(2):
                mask = mask | blocks.fields[e, block_index(grid, base[0] + 2 * i, base[1] + 2 * j, base[2] + 2 * k)]
    return mask


@wp.func_native(f"""
const volatile int* const slot_of = &wp::index(blocks.slot, e, held);
const volatile int* const failing = &wp::index(failure, e);
do {{
    const int slot = *slot_of;
    if (slot >= 0 && slot < blocks.held.shape[1] && *(const volatile int*)&wp::index(blocks.held, e, slot) == held)
        return slot;
}} while (!(*failing & {FAILURE_BLOCKS}));
return {int(NOBODY)};
""")
def awaited_slot(blocks: Blocks, e: int, held: int, failure: wp.array(dtype=int)) -> int:
    """Slot of a field's block that is marked in this launch, maybe by another thread; ``NOBODY`` if there is none."""
    ...


# A GPU finds out anew: to write it down and read it takes as long
@wp.func_native(f"""
#if !defined(__CUDA_ARCH__)
wp::index(blocks.around, e, p) = tells ? {int(TELLS)} | (beside ? {int(BESIDE)} : 0) : 0;
#endif
""")
def note_around(blocks: Blocks, e: int, p: int, tells: bool, beside: bool):
    """Note whether particle ``p`` tells its nodes where it is, and whether that is because another field is beside."""
    ...


@wp.func_native(f"""
#if !defined(__CUDA_ARCH__)
return wp::index(blocks.around, e, p);
#else
return {int(TELLS) | int(BESIDE)};
#endif
""")
def noted_around(blocks: Blocks, e: int, p: int) -> int:
    """Bits ``TELLS`` and ``BESIDE`` of particle ``p``; what may be, where nobody notes what is."""
    ...


@wp.func
def fields_beyond(grid: Grid, blocks: Blocks, corner: wp.vec3i, e: int):
    """Fields with matter in any block that a stencil may lie in whose lowest node is in the block at ``corner``."""
    mask = int(0)
    for n in range(8):
        x = wp.min(corner[0] + 4 * (n >> 2), 4 * (grid.blocks[0] - 1))
        y = wp.min(corner[1] + 4 * ((n >> 1) & 1), 4 * (grid.blocks[1] - 1))
        z = wp.min(corner[2] + 4 * (n & 1), 4 * (grid.blocks[2] - 1))
        mask = mask | blocks.fields[e, block_index(grid, x, y, z)]
    return mask


@wp.func
def fields_next(grid: Grid, blocks: Blocks, block: int, e: int, n: int):
    """Fields with matter in the ``n``-th of the eight blocks that a stencil may lie in which begins in a ``block``.

    Where the grid ends, in another block instead: no stencil begins there, and to look for neither row nor column takes
    no division.
    """
    beyond = block + ((n >> 2) * grid.blocks[1] + ((n >> 1) & 1)) * grid.blocks[2] + (n & 1)
    return blocks.fields[e, wp.min(beyond, grid.num_blocks - 1)]


@wp.func
def first_record(grid: Grid, blocks: Blocks, e: int, f: int, block: int):
    """Record of the first node of a block that holds matter of field ``f``."""
    return BLOCK_NODES * blocks.slot[e, f * grid.num_blocks + block]


@wp.func
def record_of(grid: Grid, blocks: Blocks, e: int, f: int, i: int, j: int, k: int):
    """Record of node ``(i, j, k)``, whose block must hold matter of field ``f``."""
    return first_record(grid, blocks, e, f, block_index(grid, i, j, k)) + node_in_block(i, j, k)


@wp.func
def slots_used(blocks: Blocks, e: int):
    """Slots of environment ``e`` that mean something, though more may have been asked for."""
    return wp.min(blocks.count[e], blocks.held.shape[1])


@wp.func
def held_by(grid: Grid, held: int):
    """Field and block that a slot belongs to, from what ``held`` says of it."""
    return wp.vec2i(held // grid.num_blocks, held % grid.num_blocks)


@wp.func
def list_shared(blocks: Blocks, e: int, block: int, before: int):
    """Note that a block which had the fields ``before`` gets another one, if that is its second."""
    if before != 0 and (before & (before - 1)) == 0:
        n = wp.atomic_add(blocks.num_shared, e, 1)
        if n < blocks.shared.shape[1]:
            blocks.shared[e, n] = block


@wp.func
def nodes_shared(blocks: Blocks, e: int):
    """Nodes of the blocks of environment ``e`` that have several fields."""
    return BLOCK_NODES * wp.min(blocks.num_shared[e], blocks.shared.shape[1])


@wp.func
def lacks_slots(failure: wp.array(dtype=int), e: int):
    """Whether slots have run out: some particles have none. No scatter and no grid pass sets that flag."""
    return (failure[e] & _BLOCKS) != 0


@wp.func
def shared_block(blocks: Blocks, e: int, n: int):
    """Block with the ``n``-th of :func:`nodes_shared`, nonsense beyond: who asks need not know their number yet."""
    return blocks.shared[e, wp.min(n // BLOCK_NODES, blocks.shared.shape[1] - 1)]


@wp.func
def mark_block(grid: Grid, blocks: Blocks, block: int, field: int, e: int, failure: wp.array(dtype=int)):
    """See that a field has a slot in a block; too few slots flag the environment."""
    bit = 1 << field
    if (blocks.fields[e, block] & bit) != 0:
        return
    before = wp.atomic_or(blocks.fields, e, block, bit)
    if (before & bit) != 0:
        return
    list_shared(blocks, e, block, before)
    slot = wp.atomic_add(blocks.count, e, 1)
    if slot < blocks.held.shape[1]:
        blocks.held[e, slot] = field * grid.num_blocks + block
        blocks.slot[e, field * grid.num_blocks + block] = slot
    else:
        wp.atomic_and(blocks.fields, e, block, ~bit)
        wp.atomic_or(failure, e, _BLOCKS)


@wp.func
def mark_blocks(grid: Grid, blocks: Blocks, base: wp.vec3i, field: int, e: int, failure: wp.array(dtype=int)):
    """:func:`mark_block` of all blocks that a stencil touches."""
    touched = blocks_touched(base)
    for i in range(touched[0]):
        for j in range(touched[1]):
            for k in range(touched[2]):
                block = block_index(grid, base[0] + 2 * i, base[1] + 2 * j, base[2] + 2 * k)
                mark_block(grid, blocks, block, field, e, failure)


@wp.kernel
def forget_blocks(grid: Grid, blocks: Blocks):
    """No block holds matter; the slots are taken back by :func:`free_slots`."""
    e, slot = wp.tid()
    if slot < slots_used(blocks, e):
        blocks.fields[e, blocks.held[e, slot] % grid.num_blocks] = 0
        blocks.held[e, slot] = NOBODY


@wp.kernel
def free_slots(failure: wp.array(dtype=int), blocks: Blocks):
    """No slot is in use."""
    e = wp.tid()
    blocks.count[e] = 0
    blocks.num_shared[e] = 0
    blocks.frozen[e] = failure[e]


@wp.kernel
def freeze(failure: wp.array(dtype=int), blocks: Blocks):
    """From now on environments that have failed take no part.

    Threads of one launch must not stop at what others of it have found, or what a failed environment is left with would
    depend on their order.
    """
    e = wp.tid()
    blocks.frozen[e] = failure[e]


@wp.kernel
def mark_particles(
    grid: Grid,
    particles: Particles,
    x: wp.array2d(dtype=wp.vec3),
    # in and out
    blocks: Blocks,
    failure: wp.array(dtype=int),
):
    """Mark the blocks of all particles, wherever they have been put; one outside the grid flags its environment.

    A warp marks each block once, where it can: the first to come all find it without a mark.
    """
    e, p = wp.tid()
    field = particles.field[p]
    base = wp.vec3i()
    takes = bool(False)
    if blocks.frozen[e] == 0:
        if wp.isfinite(wp.length_sq(x[e, p])):
            base = base_node(grid_position(grid, x[e, p]))
            takes = stencil_inside(grid, base)
            if not takes:
                wp.atomic_or(failure, e, _OUT_OF_GRID)
        else:
            wp.atomic_or(failure, e, _NONFINITE)
    mine = share_of_blocks(grid, e, field, base, takes)
    if mine[0] == -2:
        if takes:
            mark_blocks(grid, blocks, base, field, e, failure)
        return
    for n in range(2):
        if mine[n] >= 0:
            mark_block(grid, blocks, mine[n], field, e, failure)
