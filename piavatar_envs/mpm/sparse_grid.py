"""Sparse grid: active blocks of 4 x 4 x 4 nodes, activated where particles are.

A block of the grid has a bit for every velocity field with particles near it, and an active block, which stores node
records, for each of those. Memory and time depend on the bodies, not on the empty space around them. On a GPU the order
of activation is not deterministic; only addresses depend on it.

A block that is active for several fields is a contact block. Contact in a contact block acts at the nodes to which all
nearby particles of both fields have added their offsets. On the tiled path these *contact nodes* are known from the
previous substep: the grid update sets the bit of a field's node if another field had mass there, and particles near
such a node are contact candidates in the next substep. Contact thus begins a substep after the second field has come
to a node, where it has little weight unless it moves nearly a grid spacing a time step. After an activation the bits
of all nodes in contact blocks are set. The other paths treat every particle near a contact block as a candidate.
"""

from __future__ import annotations

import warp as wp

from piavatar_envs.core.cuda_intrinsics import lane_of_thread, lanes_with
from piavatar_envs.mpm.bspline import (
    BLOCK_NODES,
    base_node,
    block_index,
    blocks_touched,
    grid_position,
    node_in_block,
    stencil_inside,
)
from piavatar_envs.mpm.types import (
    CANDIDATE,
    FAILURE_BLOCKS,
    FAILURE_NONFINITE,
    FAILURE_OUT_OF_GRID,
    NEAR_FIELD,
    Blocks,
    Grid,
    Model,
    Particles,
)

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})

#: Threads of a CUDA block of the grid update and contact kernels.
THREADS = 128
#: Contact blocks for which a large GPU has threads at once.
CONTACT_BLOCKS_AT_ONCE = 132 * 6
#: Fewest contact blocks for which an environment gets threads.
MIN_CONTACT_BLOCKS = 2
_BLOCKS = wp.constant(FAILURE_BLOCKS)
_NONFINITE = wp.constant(FAILURE_NONFINITE)
_OUT_OF_GRID = wp.constant(FAILURE_OUT_OF_GRID)
#: ``Blocks.owner`` of an active block that is not in use.
UNASSIGNED = wp.constant(-1)
#: Entries of an active block in an array of one vector a node (``VECTORS``), and of halves of records (``HALVES``).
VECTORS, HALVES = wp.constant(int(BLOCK_NODES)), wp.constant(2 * int(BLOCK_NODES))


@wp.struct
class Sweep:
    """Distribution of an environment's nodes in contact blocks over threads; no threads if there is a single field.

    Thread ``t`` visits the nodes from ``t * nodes + visit * stride`` on, ``nodes`` of them.
    """

    threads: int  # of an environment
    visits: int  # most visits of a thread
    nodes: int  # nodes of a visit
    stride: int  # nodes from one visit to the next


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
wp::vec2i own(-1, -1);
#pragma unroll
for (int q = 0; q < 2; ++q) {
    const int i = begin[0] + 2 * q + (lane >> 4);
    if (__reduce_or_sync(ALL, (unsigned)(touched >> 32 * q)) >> lane & 1u)
        own[q] = (i * grid.blocks[1] + j) * grid.blocks[2] + k;
}
return own;
#else
return wp::vec2i(-2, -2);
#endif
""")
def share_of_blocks(grid: Grid, e: int, field: int, base: wp.vec3i, takes: bool) -> wp.vec2i:
    """Distribute the blocks that the stencils of a warp overlap over its threads, each block once; -1 for none.

    ``base`` is the lowest node of the thread's own stencil, ignored unless it ``takes`` part. Returns -2 if every
    thread must handle its own blocks: they are too many, or the threads differ in environment or field.
    """
    ...


@wp.func
def has_field(mask: int, f: int):
    """Return whether bit ``f`` of a block's mask is set."""
    return ((mask >> f) & 1) != 0


@wp.func_native("""
#if defined(__CUDA_ARCH__)
return mask != 0 ? __ffs(mask) - 1 : num_fields;
#else
return mask != 0 ? __builtin_ctz(mask) : num_fields;
#endif
""")
def lowest_field(mask: int, num_fields: int) -> int:
    """Return the first field of a mask, ``num_fields`` if it is empty."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
return 32 - __clz(mask);
#else
return mask != 0 ? 32 - __builtin_clz(mask) : 0;
#endif
""")
def end_of_fields(mask: int) -> int:
    """Return one more than the last field of a mask, 0 if it is empty."""
    ...


@wp.func
def lowest_other(mask: int, f: int, num_fields: int):
    """Return the first field of a mask that is not ``f``."""
    other = lowest_field(mask, num_fields)
    if other == f:
        other = f + 1
        while other < num_fields - 1 and not has_field(mask, other):
            other += 1
    return other


@wp.func
def fields_around(grid: Grid, blocks: Blocks, base: wp.vec3i, e: int):
    """Return the mask of fields that are active in any block of a stencil."""
    mask = int(0)
    for i in range(2):  # loads of repeated blocks, instead of branches, keep all eight loads in flight
        for j in range(2):
            for k in range(2):
                mask = mask | blocks.fields[e, block_index(grid, base[0] + 2 * i, base[1] + 2 * j, base[2] + 2 * k)]
    return mask


# Recomputing is as fast as a load on a GPU
@wp.func_native(f"""
#if !defined(__CUDA_ARCH__)
wp::index(blocks.candidate, e, p) = candidate ? {int(CANDIDATE)} | (near_field ? {int(NEAR_FIELD)} : 0) : 0;
#endif
""")
def store_candidate(blocks: Blocks, e: int, p: int, candidate: bool, near_field: bool):
    """Store whether particle ``p`` is a contact candidate, and whether because of another field; on a CPU only."""
    ...


@wp.func_native(f"""
#if !defined(__CUDA_ARCH__)
return wp::index(blocks.candidate, e, p);
#else
return {int(CANDIDATE) | int(NEAR_FIELD)};
#endif
""")
def candidate_bits(blocks: Blocks, e: int, p: int) -> int:
    """Return the bits ``CANDIDATE`` and ``NEAR_FIELD`` of particle ``p``; both on a GPU, where they are not stored."""
    ...


@wp.func
def fields_beyond(grid: Grid, blocks: Blocks, corner: wp.vec3i, e: int):
    """Return the mask of fields active in any block that a stencil based in the block at ``corner`` may overlap."""
    mask = int(0)
    for n in range(8):
        x = wp.min(corner[0] + 4 * (n >> 2), 4 * (grid.blocks[0] - 1))
        y = wp.min(corner[1] + 4 * ((n >> 1) & 1), 4 * (grid.blocks[1] - 1))
        z = wp.min(corner[2] + 4 * (n & 1), 4 * (grid.blocks[2] - 1))
        mask = mask | blocks.fields[e, block_index(grid, x, y, z)]
    return mask


@wp.func
def fields_next(grid: Grid, blocks: Blocks, block: int, e: int, n: int):
    """Return the mask of fields active in the ``n``-th of eight blocks that a stencil based in ``block`` may overlap.

    At the upper ends of the grid it is that of another block, which is harmless: no stencil is based there.
    """
    beyond = block + ((n >> 2) * grid.blocks[1] + ((n >> 1) & 1)) * grid.blocks[2] + (n & 1)
    return blocks.fields[e, wp.min(beyond, grid.num_blocks - 1)]


@wp.func
def first_record(grid: Grid, blocks: Blocks, e: int, f: int, block: int):
    """Return the record of the first node of a block, which must be active for field ``f``."""
    return BLOCK_NODES * blocks.active[e, f * grid.num_blocks + block]


@wp.func
def record_of(grid: Grid, blocks: Blocks, e: int, f: int, i: int, j: int, k: int):
    """Return the record of node ``(i, j, k)``, whose block must be active for field ``f``."""
    return first_record(grid, blocks, e, f, block_index(grid, i, j, k)) + node_in_block(i, j, k)


@wp.func
def num_active(blocks: Blocks, e: int):
    """Return the number of active blocks of environment ``e``."""
    return wp.min(blocks.num_active[e], blocks.owner.shape[1])


@wp.func
def field_and_block(grid: Grid, owner: int):
    """Return field and block of an active block from its ``owner``."""
    return wp.vec2i(owner // grid.num_blocks, owner % grid.num_blocks)


@wp.func
def list_contact_block(blocks: Blocks, e: int, block: int, before: int):
    """List a block as a contact block if its fields ``before`` this activation were exactly one."""
    if before != 0 and (before & (before - 1)) == 0:
        n = wp.atomic_add(blocks.num_contact_blocks, e, 1)
        if n < blocks.contact_blocks.shape[1]:
            blocks.contact_blocks[e, n] = block


@wp.func
def num_contact_nodes(blocks: Blocks, e: int):
    """Return the number of nodes in the contact blocks of environment ``e``."""
    return BLOCK_NODES * wp.min(blocks.num_contact_blocks[e], blocks.contact_blocks.shape[1])


@wp.func
def exceeds_active_blocks(failure: wp.array(dtype=int), e: int):
    """Return whether an environment lacks active blocks; neither P2G nor the grid update sets that flag."""
    return (failure[e] & _BLOCKS) != 0


@wp.func
def contact_block_of(blocks: Blocks, e: int, n: int):
    """Return the contact block of node ``n`` of :func:`num_contact_nodes`; safe, but meaningless, beyond them."""
    return blocks.contact_blocks[e, wp.min(n // BLOCK_NODES, blocks.contact_blocks.shape[1] - 1)]


@wp.func
def activate_block(grid: Grid, blocks: Blocks, block: int, field: int, e: int, failure: wp.array(dtype=int)):
    """Activate a block for a field; flags the environment if there are too few active blocks."""
    bit = 1 << field
    if (blocks.fields[e, block] & bit) != 0:
        return
    before = wp.atomic_or(blocks.fields, e, block, bit)
    if (before & bit) != 0:
        return
    list_contact_block(blocks, e, block, before)
    active = wp.atomic_add(blocks.num_active, e, 1)
    if active < blocks.owner.shape[1]:
        blocks.owner[e, active] = field * grid.num_blocks + block
        blocks.active[e, field * grid.num_blocks + block] = active
    else:
        wp.atomic_and(blocks.fields, e, block, ~bit)
        wp.atomic_or(failure, e, _BLOCKS)


@wp.func
def activate_stencil(grid: Grid, blocks: Blocks, base: wp.vec3i, field: int, e: int, failure: wp.array(dtype=int)):
    """Activate all blocks that a stencil overlaps."""
    touched = blocks_touched(base)
    for i in range(touched[0]):
        for j in range(touched[1]):
            for k in range(touched[2]):
                block = block_index(grid, base[0] + 2 * i, base[1] + 2 * j, base[2] + 2 * k)
                activate_block(grid, blocks, block, field, e, failure)


@wp.kernel
def deactivate_blocks(grid: Grid, blocks: Blocks):
    """Deactivate all blocks; :func:`reset_active_blocks` resets their number."""
    e, active = wp.tid()
    if active < num_active(blocks, e):
        blocks.fields[e, blocks.owner[e, active] % grid.num_blocks] = 0
        blocks.owner[e, active] = UNASSIGNED


@wp.kernel
def reset_active_blocks(failure: wp.array(dtype=int), blocks: Blocks):
    """Reset the numbers of active blocks and contact blocks."""
    e = wp.tid()
    blocks.num_active[e] = 0
    blocks.num_contact_blocks[e] = 0
    blocks.frozen[e] = failure[e]


@wp.kernel
def freeze(failure: wp.array(dtype=int), blocks: Blocks):
    """Freeze the environments that have failed.

    Threads must not stop at failures that others of the same launch have found, or the state that a failed environment
    keeps would depend on their order.
    """
    e = wp.tid()
    blocks.frozen[e] = failure[e]


@wp.kernel
def activate_particle_blocks(
    grid: Grid,
    particles: Particles,
    x: wp.array2d(dtype=wp.vec3),
    # in and out
    blocks: Blocks,
    failure: wp.array(dtype=int),
):
    """Activate the blocks of all particles; a particle outside the grid flags its environment.

    The threads of a warp activate each block once where possible: neighbouring particles share blocks.
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
    own = share_of_blocks(grid, e, field, base, takes)
    if own[0] == -2:
        if takes:
            activate_stencil(grid, blocks, base, field, e, failure)
        return
    for n in range(2):
        if own[n] >= 0:
            activate_block(grid, blocks, own[n], field, e, failure)


@wp.func_native("return (wp::uint64)&wp::index(blocks.active, e, n);")
def active_address(blocks: Blocks, e: int, n: int) -> wp.uint64:
    """Return the address of ``blocks.active[e, n]``, for :func:`active_from`."""
    ...


@wp.func_native("return reinterpret_cast<const int*>(address)[n];")
def active_from(address: wp.uint64, n: int) -> int:
    """Return the ``n``-th entry from an address, so that neighbours need no second row lookup."""
    ...


@wp.func
def slab_records(grid: Grid, blocks: Blocks, e: int, f: int, base: wp.vec3i, i: int, of_block: int):
    """Return where the blocks of the nodes ``base + (i, ...)`` begin in an array, for :func:`line_of_records`.

    The slab overlaps at most two blocks along y and two along z; if fewer, entries repeat. The result holds for all
    slabs of the stencil in the same blocks. A block has ``of_block`` entries, :data:`VECTORS` or :data:`HALVES`.
    """
    block = block_index(grid, base[0] + i, base[1], base[2])
    active_blocks = active_address(blocks, e, f * grid.num_blocks + block)
    lower = of_block * active_from(active_blocks, 0)
    lower_last = lower
    upper = lower
    upper_last = lower
    if (base[2] & 3) > 1:
        lower_last = of_block * active_from(active_blocks, 1) - 4
        upper_last = lower_last
    if (base[1] & 3) > 1:
        upper = of_block * active_from(active_blocks, grid.blocks[2])
        upper_last = upper
        if (base[2] & 3) > 1:
            upper_last = of_block * active_from(active_blocks, grid.blocks[2] + 1) - 4
    return wp.vec4i(lower, lower_last, upper, upper_last)


@wp.func
def ends_of_line(slab: wp.vec4i, base: wp.vec3i, i: int, j: int):
    """Return the indices of node ``base + (i, j, 0)`` and, less 2, ``base + (i, j, 2)``; see :func:`slab_records`."""
    y = (base[1] & 3) + j
    in_block = 16 * ((base[0] + i) & 3) + 4 * (y & 3) + (base[2] & 3)
    return wp.vec2i(wp.where(y > 3, slab[2], slab[0]) + in_block, wp.where(y > 3, slab[3], slab[1]) + in_block)


@wp.func
def line_of_records(slab: wp.vec4i, base: wp.vec3i, i: int, j: int):
    """Return the indices of the nodes ``base + (i, j, 0..2)`` of a stencil, from the ``slab`` of ``i``."""
    ends = ends_of_line(slab, base, i, j)
    return wp.vec3i(ends[0], wp.where((base[2] & 3) == 3, ends[1], ends[0]) + 1, ends[1] + 2)


def tracks_contact_nodes(model: Model) -> bool:
    """Return whether contact nodes are tracked from one substep to the next."""
    return model.path == "tiled" and model.contact.num_fields > 1


@wp.func
def initial_contact_nodes(blocks: Blocks, e: int, active: int):
    """Return the bits of the nodes of an active block after an activation: all in a contact block, else none."""
    candidates = int(0)
    if active < num_active(blocks, e):
        mask = blocks.fields[e, blocks.owner[e, active] % blocks.fields.shape[1]]
        if (mask & (mask - 1)) != 0:
            candidates = -1
    return candidates


@wp.kernel
def reset_contact_nodes(blocks: Blocks):
    """Reset the contact nodes after an activation of blocks."""
    e, active = wp.tid()
    candidates = initial_contact_nodes(blocks, e, active)
    blocks.contact_nodes[e, 2 * active] = candidates
    blocks.contact_nodes[e, 2 * active + 1] = candidates


@wp.func
def has_node_bit(words: wp.array2d(dtype=int), e: int, first: int, local: int):
    """Return the bit of node ``local`` in the two words from ``first`` on."""
    return ((words[e, first + local // 32] >> (local & 31)) & 1) != 0


@wp.func
def store_node_bits(words: wp.array2d(dtype=int), e: int, first: int, local: int, here: bool):
    """Store the bit of a node of a block; all threads of a warp, which has half a block, must call this."""
    bits = lanes_with(here)
    if lane_of_thread() == 0:
        words[e, first + local // 32] = bits


@wp.func
def had_contact(contact_nodes: wp.array2d(dtype=int), e: int, r: int):
    """Return whether another field had mass at the node of record ``r`` in the previous substep."""
    return has_node_bit(contact_nodes, e, 2 * (r // BLOCK_NODES), r % BLOCK_NODES)


@wp.func
def has_all_candidates(blocks: Blocks, e: int, r: int):
    """Return whether all particles near the node of record ``r`` of a contact block have added offsets to it."""
    if blocks.contact_nodes.shape[1] == 1:
        return True
    return had_contact(blocks.contact_nodes, e, r)


@wp.func
def store_contact_node(blocks: Blocks, e: int, r: int, here: bool):
    """Store whether another field is ``here`` at the node of record ``r``; all threads of a warp must call this."""
    if blocks.contact_nodes.shape[1] == 1:
        return
    store_node_bits(blocks.contact_nodes, e, 2 * (r // BLOCK_NODES), r % BLOCK_NODES, here)


def max_contact_blocks(model: Model) -> int:
    """Return the most contact blocks of an environment, at least 1."""
    return max(1, model.max_active_blocks // 2) if model.contact.num_fields > 1 else 1


def plan_sweep(model: Model) -> Sweep:
    """Return the distribution of contact blocks over threads."""
    nodes, blocks = int(BLOCK_NODES), 1
    sweep = Sweep()
    if model.contact.num_fields == 1:
        return sweep
    sweep.nodes = nodes
    if wp.get_device(model.device).is_cuda:
        blocks = min(max_contact_blocks(model), max(MIN_CONTACT_BLOCKS, -(-CONTACT_BLOCKS_AT_ONCE // model.num_envs)))
        sweep.nodes = 1
    sweep.visits, sweep.stride = -(-max_contact_blocks(model) // blocks), nodes * blocks
    sweep.threads = sweep.stride // sweep.nodes
    return sweep
