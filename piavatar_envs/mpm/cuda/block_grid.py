"""Block per environment: which worlds it suits, its partitions, and the layout of the grid in shared memory.

In this package *CUDA block* always means a group of threads; *block* alone, as in "active block" and "subblock", means
4 x 4 x 4 nodes of the grid. This path runs on GPUs only.

Bodies that share no velocity field are independent until contact. The particles of an environment are split into such
partitions, and each has its own CUDA block.

A small body touches about 2,000 nodes. They fit into the shared memory of a CUDA block, where integer additions are
much faster than in global memory. There they are stored in subblocks of 2 x 2 x 2 nodes, numbered anew in every substep
as particles touch them; more subblocks than fit are processed in several rounds.

The accumulators have 32 bits. Masses count quanta of 2^-27 of a field's heaviest particle, so a node may hold 16 of
them; if one overflows, the environment repeats the sums with quanta eight times as large. Momenta count the mass
quantum times a speed that no particle of the field exceeds, a power of two chosen in every substep. So the integers are
used to the full, and contributions are rounded much as floating-point numbers would be.

The arena in shared memory, in this order; words have 4 bytes:

==============  =============  ======================================================================================
field           element        count
==============  =============  ======================================================================================
header          word           ``HEADER``
``numbers``     half word      8 for each active block: the number of each of its subblocks
``candidates``  bit            1 for each particle: whether it is a contact candidate
``near``        byte           1 for each active block: which slabs are near a collider
``places``      half word      8 for each active block: index and flag of each numbered subblock
``subblocks``   4 words        8 (nodes) for each of ``capacity`` + 1 subblocks: mass and physical momentum
``kinematic``   3 words        8 (nodes) for each subblock, in the same order: kinematic momentum
==============  =============  ======================================================================================

A subblock has a word in each of the 32 banks, and the position within the subblock selects the bank: threads that add
to different nodes of the eight, or to different words of the four, do not conflict.
"""

from __future__ import annotations

import numpy as np
import warp as wp

from piavatar_envs.core.arrays import vec8, vec8i
from piavatar_envs.core.cuda_intrinsics import sync_block, thread_of_block, threads_of_block
from piavatar_envs.core.shared_memory import (
    APPEND,
    add_word,
    byte,
    clear_words,
    fill_words,
    float_word,
    max_float_word,
    native,
    or_word,
    set_byte,
    set_float_word,
    set_half_word,
    word,
)
from piavatar_envs.mpm.bspline import BLOCK_NODES, base_node, block_corner, grid_position
from piavatar_envs.mpm.colliders import GATED_SLAB
from piavatar_envs.mpm.grid_update import SLAB_NODES, block_is_near, slab_is_near
from piavatar_envs.mpm.p2g import Deposit, is_contact_candidate, takes_part
from piavatar_envs.mpm.sparse_grid import fields_beyond, has_field, num_active
from piavatar_envs.mpm.types import Arena, Blocks, Boundaries, Contact, Grid, Model, Particles, row

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})

#: Words of an arena of which two fit into a multiprocessor, and of one that fills it, with the staging memory of
#: stores.
SMALL_ARENA, LARGE_ARENA = 27_008, 54_272
#: Threads of the CUDA blocks of either arena.
SMALL_THREADS, LARGE_THREADS = 320, 640
#: Active blocks of a partition up to which the small arena suffices: more than it will use, and half of their nodes.
SMALL_ACTIVE_BLOCKS = 210
#: Most particles of a partition: its CUDA block must not take longer than those of other bodies.
MOST_PARTICLES = 8192
#: Most particles of an environment, whose indices are half words.
MOST_LISTED = 2**16
#: Words of a node: mass and physical momentum, later physical velocity and padding, for loads of 16 bytes.
NODE_WORDS = wp.constant(4)
#: Further words of a node: kinematic momentum, later kinematic velocity.
KINEMATIC_WORDS = wp.constant(3)
#: Words of a subblock of 2 x 2 x 2 nodes, as many as there are banks, and its further words.
SUBBLOCK_WORDS, KINEMATIC_SUBBLOCK_WORDS = wp.constant(8 * NODE_WORDS), wp.constant(8 * KINEMATIC_WORDS)
#: Subblocks of a block.
BLOCK_SUBBLOCKS = wp.constant(8)
#: Words of the header: subblocks in use; bits FAILURE_*; contact candidates; mass lost [LOST_QUANTA]; quanta in a
#: field's heaviest particle; listed candidates; and for each of at most 32 fields the mass of its heaviest particle
#: [kg], the speed of its fastest, and the speed that scales its momentum quantum [m/s].
HEADER = wp.constant(104)
COUNT, FAULTS, NUM_CANDIDATES, LOST, QUANTA, LISTED = (wp.constant(n) for n in range(6))
HEAVIEST, FASTEST, SPEED = (wp.constant(n) for n in (8, 40, 72))
#: Mass quanta of a field's heaviest particle, unless a node overflows.
MAX_MASS_QUANTA = wp.constant(float(2**27))
#: Number of an untouched subblock, and of one that is touched but not numbered yet.
NO_SUBBLOCK, TOUCHED = wp.constant(0xFFFF), wp.constant(0xFFFE)
#: Flag of a subblock's place: above the index, a bit for each of its planes across x that is near a collider.
PLACES = wp.constant(0x4000)
#: Flag of an active block that may hold contact candidates, above the bits of its four slabs.
MAY_CONTACT = wp.constant(16)
#: Least speed that scales a momentum quantum [m/s].
SLOWEST = wp.constant(2.0**-20)
#: Mass quanta of a field's heaviest particle in the sums of offsets.
OFFSET_QUANTA = wp.constant(2.0**20)
#: Mass quanta in which the mass that particles gave and nodes lack is counted. An overflowed word misses at least 2^20
#: of these; rounding stays far below half of that.
LOST_QUANTA, MAX_LOST = wp.constant(2**12), wp.constant(2**19)


def partitions_of(field: np.ndarray) -> list[tuple[int, int, int]]:
    """Return the shortest runs of particles that share no velocity field, each for a CUDA block of its own.

    Args:
        field: velocity fields of the particles, shape ``(num_particles,)``.

    Returns:
        First particle, one after the last, and bits of the fields, of every partition.
    """
    last = {int(f): int(np.flatnonzero(field == f)[-1]) for f in np.unique(field)}
    partitions, first, end = [], 0, 0
    for p, f in enumerate(field.tolist()):
        end = max(end, last[f])
        if p == end:
            partitions.append((first, p + 1, int(np.bitwise_or.reduce(1 << np.unique(field[first : p + 1])))))
            first = p + 1
    return partitions


def largest_partition(field: np.ndarray) -> int:
    """Return the number of particles of the largest partition."""
    return max(end - first for first, end, _ in partitions_of(field))


def suits_block_path(device: str, field: np.ndarray, max_active_blocks: int) -> bool:
    """Return whether the device has enough shared memory for a block per environment with these particles."""
    target = wp.get_device(device)
    few = largest_partition(field) <= MOST_PARTICLES and len(field) <= MOST_LISTED
    if not (target.is_cuda and target.arch >= 80 and few):
        return False
    tables = int(BLOCK_SUBBLOCKS) * max_active_blocks + len(field) // 32 + max_active_blocks // 4
    fits = 4 * tables < LARGE_ARENA and int(BLOCK_SUBBLOCKS) * max_active_blocks < int(PLACES)
    return target.max_shared_memory_per_block >= 227 * 1024 and fits


def needs_large_arena(model: Model, partitions: list[tuple[int, int, int]]) -> bool:
    """Return whether arenas should fill a multiprocessor each: the nodes need it, or there are enough multiprocessors.

    A large arena has more threads; the integer sums, and thus the results, are the same.
    """
    share = max(end - first for first, end, _ in partitions) / model.num_particles
    if share * model.max_active_blocks > SMALL_ACTIVE_BLOCKS:
        return True
    return model.num_envs * len(partitions) <= wp.get_device(model.device).sm_count


def plan_arena(model: Model) -> tuple[Arena, bool]:
    """Return the layout of the arena, and whether it is a large one."""
    arena = Arena()
    if model.path != "block":
        return arena, False
    partitions = partitions_of(model.particles.field.numpy())
    large = needs_large_arena(model, partitions)
    arena.numbers = int(HEADER)
    arena.candidates = arena.numbers + int(BLOCK_SUBBLOCKS) * model.max_active_blocks // 2
    arena.near = arena.candidates + -(-model.num_particles // 32)
    arena.places = _multiple_of_4(arena.near + -(-model.max_active_blocks // 4))
    arena.subblocks = _multiple_of_4(arena.places + int(BLOCK_SUBBLOCKS) * model.max_active_blocks // 2)
    words = int(SUBBLOCK_WORDS) + int(KINEMATIC_SUBBLOCK_WORDS)
    arena.capacity = ((LARGE_ARENA if large else SMALL_ARENA) - arena.subblocks) // words - 1
    arena.kinematic = arena.subblocks + int(SUBBLOCK_WORDS) * (arena.capacity + 1)
    arena.partition = wp.array(np.array(partitions, np.int32), dtype=wp.vec3i, device=model.device)
    arena.speed = wp.zeros((model.num_envs, model.contact.num_fields), dtype=float, device=model.device)
    return arena, large


def _multiple_of_4(words: int) -> int:
    return -(-words // 4) * 4


def subblock_native(cuda: str, otherwise: str = "") -> str:
    """Return a snippet with the header's words, the strides of a subblock's nodes, and ``kinematic_of`` in scope."""
    z, rest = int(NODE_WORDS), int(KINEMATIC_WORDS)
    strides = f"constexpr int ALONG_Z = {z}, ALONG_Y = {2 * z}, ALONG_X = {4 * z}, SUBBLOCK = {8 * z};\n"
    words = f"COUNT = {int(COUNT)}, TOUCHED = {int(TOUCHED)}, PLACES = {int(PLACES)}"
    of = f"[](const auto& in, int at) {{ return in.kinematic + (at - in.subblocks) / {z} * {rest}; }}"
    return native(f"constexpr int {words};\n{strides}auto kinematic_of = {of};\n{cuda}", otherwise)


@wp.func_native(native("return __uint_as_float((__float_as_uint(x) + 0x7fffffu) & 0xff800000u);", "return x;"))
def power_of_two(x: float) -> float:
    """Return the least power of two that is not below ``x``, which must not be negative."""
    ...


@wp.func_native(
    subblock_native(
        APPEND
        + """
unsigned short* const number = reinterpret_cast<unsigned short*>(arena + numbers);
unsigned short* const place = reinterpret_cast<unsigned short*>(arena + places);
const unsigned char* const slabs = reinterpret_cast<const unsigned char*>(arena + near);
const int lane = threadIdx.x & 31;
for (int n = threadIdx.x; n - lane < most; n += blockDim.x) {
    const bool touched = n < most && number[n] == TOUCHED;
    // a subblock covers the first or the last two of the four slabs of a block
    const int planes = touched ? slabs[n >> 3] >> ((n & 4) >> 1) & 3 : 0;
    const bool own = touched && (planes != 0) == by_boundaries;
    const int next = append(arena + COUNT, __ballot_sync(0xffffffffu, own), lane);
    if (own) number[n] = next, place[next] = n + planes * PLACES;
}
"""
    )
)
def number_subblocks(numbers: int, places: int, near: int, most: int, by_boundaries: bool):
    """Number the touched subblocks of ``most`` that are near colliders, or those that are not, and store their places.

    All threads must call this; the order of the numbers varies, and no result depends on it.
    """
    ...


@wp.func
def subblocks_of_round(arena: Arena, first: int):
    """Return the number of subblocks in the round that begins at subblock ``first``."""
    return wp.min(word(COUNT) - first, arena.capacity)


@wp.func
def node_word(arena: Arena, n: int):
    """Return the word at which node ``n`` of a round begins, eight nodes a subblock."""
    return arena.subblocks + NODE_WORDS * n


@wp.func
def kinematic_word(arena: Arena, n: int):
    """Return the word at which the kinematic momentum of node ``n`` of a round begins."""
    return arena.kinematic + KINEMATIC_WORDS * n


@wp.func
def kinematic_of(arena: Arena, at: int):
    """Return the word of the kinematic momentum of the node that begins at word ``at``."""
    return kinematic_word(arena, (at - arena.subblocks) >> 2)


@wp.func
def clear_subblocks(arena: Arena, first: int):
    """Zero the nodes of a round."""
    clear_words(arena.subblocks, SUBBLOCK_WORDS * subblocks_of_round(arena, first))
    clear_words(arena.kinematic, KINEMATIC_SUBBLOCK_WORDS * subblocks_of_round(arena, first))


@wp.func
def in_flagged_plane(flagged: int, n: int):
    """Return whether the plane of node ``n`` of a round is near a collider, from the flagged place of its subblock."""
    return (flagged & (PLACES << ((n >> 2) & 1))) != 0


# of two subblocks along an axis the upper one lies in the next block if the lower one is the second of its block; no
# active block is loaded twice, because scattered loads of a warp are the bottleneck
_AROUND = """
const int ny = grid.blocks[1], nz = grid.blocks[2];
const int block = ((base[0] >> 2) * ny + (base[1] >> 2)) * nz + (base[2] >> 2);
const int* const active_blocks = &wp::index(blocks.active, e, field * grid.num_blocks + block);
const bool next_x = base[0] & 2, next_y = base[1] & 2, next_z = base[2] & 2;
int needed[8] = {};
#pragma unroll
for (int b = 0; b < 8; ++b)
    if ((!(b & 4) || next_x) && (!(b & 2) || next_y) && (!(b & 1) || next_z))
        needed[b] = active_blocks[(b & 4 ? ny * nz : 0) + (b & 2 ? nz : 0) + (b & 1)];
const int in_x = (base[0] & 2) << 1, in_y = base[1] & 2, in_z = (base[2] & 2) >> 1;
wp::vec_t<8, wp::int32> n;
#pragma unroll
for (int b = 0; b < 8; ++b) {
    if ((b & 4) && !next_x) needed[b] = needed[b ^ 4];
    else if ((b & 2) && !next_y) needed[b] = needed[b ^ 2];
    else if ((b & 1) && !next_z) needed[b] = needed[b ^ 1];
    n[b] = 8 * needed[b] + (b & 4 ? 4 - in_x : in_x) + (b & 2 ? 2 - in_y : in_y) + (b & 1 ? 1 - in_z : in_z);
}
"""


@wp.func_native(subblock_native(_AROUND + "return n;", "return wp::vec_t<8, wp::int32>();"))
def places_around(grid: Grid, blocks: Blocks, e: int, field: int, base: wp.vec3i) -> vec8i:
    """Return the places of a stencil's subblocks, 8 active block + subblock in block: x, y and z lower and upper."""
    ...


@wp.func_native(
    subblock_native(
        _AROUND
        + """
const unsigned short* const number = reinterpret_cast<const unsigned short*>(arena + layout.numbers);
for (int b = 0; b < 8; ++b)  // the last subblock collects what belongs to other rounds
    n[b] = layout.subblocks + SUBBLOCK * (int)min((unsigned)(number[n[b]] - first), (unsigned)layout.capacity);
return n;
""",
        "return wp::vec_t<8, wp::int32>();",
    )
)
def subblocks_around(
    grid: Grid, blocks: Blocks, layout: Arena, e: int, field: int, base: wp.vec3i, first: int
) -> vec8i:
    """Return the words at which the subblocks of a stencil begin, in the round from subblock ``first`` on."""
    ...


@wp.func_native(
    subblock_native(
        """
const int px = base[0] & 1, py = base[1] & 1, pz = base[2] & 1;
const bool far = px + i > 1, upper = py + j > 1;
const int lower_z = far ? (upper ? subblocks[6] : subblocks[4]) : (upper ? subblocks[2] : subblocks[0]);
const int upper_z = far ? (upper ? subblocks[7] : subblocks[5]) : (upper ? subblocks[3] : subblocks[1]);
const int line = ((px + i) & 1) * ALONG_X + ((py + j) & 1) * ALONG_Y;
const int second = pz ? upper_z : lower_z + ALONG_Z;
return wp::vec3i(line + lower_z + pz * ALONG_Z, line + second, line + upper_z + pz * ALONG_Z);
""",
        "return wp::vec3i();",
    )
)
def line_in_subblocks(subblocks: vec8i, base: wp.vec3i, i: int, j: int) -> wp.vec3i:
    """Return the words at which the nodes ``base + (i, j, 0..2)`` begin."""
    ...


@wp.func_native(
    subblock_native(
        """
const float4 v = *reinterpret_cast<const float4*>(arena + at);
return wp::vec_t<4, wp::float32>(0.0f, v.x, v.y, v.z);
""",
        "return wp::vec_t<4, wp::float32>();",
    )
)
def physical_at(at: int) -> wp.vec4:
    """Return zero and the physical velocity of the node that begins at a word."""
    ...


@wp.func_native(
    subblock_native(
        """
const float* const v = reinterpret_cast<const float*>(arena + at);
return wp::vec_t<4, wp::float32>(0.0f, v[0], v[1], v[2]);
""",
        "return wp::vec_t<4, wp::float32>();",
    )
)
def kinematic_at(at: int) -> wp.vec4:
    """Return zero and the kinematic velocity stored at a word."""
    ...


@wp.func_native(
    subblock_native(
        """
const int4 v = *reinterpret_cast<const int4*>(arena + at);
return wp::vec_t<4, wp::int32>(v.x, v.y, v.z, v.w);
""",
        "return wp::vec_t<4, wp::int32>();",
    )
)
def sums_at(at: int) -> wp.vec4i:
    """Return mass and physical momentum of the node that begins at a word."""
    ...


@wp.func_native(
    subblock_native("""
*reinterpret_cast<float4*>(arena + at) = make_float4(value[1], value[2], value[3], 0.0f);
float* const k = reinterpret_cast<float*>(arena + kinematic);
for (int c = 0; c < 3; ++c) k[c] = value[4 + c];
""")
)
def set_velocities(at: int, kinematic: int, value: vec8):
    """Write the velocities of a node over its sums, as :func:`physical_at` and :func:`kinematic_at` read them."""
    ...


@wp.func
def block_of(grid: Grid, contact: Contact, owner: int):
    """Return the block of an active block from its ``owner``; a division only if there are several fields."""
    block = owner
    if contact.num_fields > 1:
        block = owner % grid.num_blocks
    return block


@wp.func
def record_of_place(place: int, node: int):
    """Return the record of node ``node`` of the 2 x 2 x 2 nodes of the subblock at a place."""
    subblock = place % BLOCK_SUBBLOCKS
    i = ((subblock >> 2) << 1) + (node >> 2)
    j = (((subblock >> 1) & 1) << 1) + ((node >> 1) & 1)
    k = ((subblock & 1) << 1) + (node & 1)
    return BLOCK_NODES * (place // BLOCK_SUBBLOCKS) + 16 * i + 4 * j + k


@wp.func
def place_of_record(r: int):
    """Return the place of the subblock that holds a record's node; see :func:`record_of_place`."""
    return BLOCK_SUBBLOCKS * (r // BLOCK_NODES) + ((r >> 5) & 1) * 4 + ((r >> 3) & 1) * 2 + ((r >> 1) & 1)


@wp.func
def end_of_partition(blocks: Blocks, failure: wp.array(dtype=int), e: int, partition: wp.vec3i):
    """Return the end of a partition's particles, its begin if the environment takes no part."""
    end = partition[1]
    if not takes_part(blocks, e, failure):
        end = partition[0]
    return end


@wp.func
def note_boundaries(grid: Grid, boundaries: Boundaries, contact: Contact, blocks: Blocks, arena: Arena, e: int):
    """Store for every active block which slabs are near colliders, and whether it may hold contact candidates."""
    for active in range(thread_of_block(), num_active(blocks, e), threads_of_block()):
        owner = blocks.owner[e, active]
        corner = block_corner(grid, block_of(grid, contact, owner))
        bits = int(0)
        for slab in range(4):
            if slab_is_near(grid, boundaries, e, corner, SLAB_NODES * slab, GATED_SLAB):
                bits = bits | (1 << slab)
        near = block_is_near(grid, boundaries, e, corner)
        if contact.num_fields > 1:
            near = near or fields_beyond(grid, blocks, corner, e) != (1 << (owner // grid.num_blocks))
        set_byte(arena.near, active, wp.where(near, bits | MAY_CONTACT, bits))


@wp.func
def touch_subblocks(
    grid: Grid,
    particles: Particles,
    boundaries: Boundaries,
    contact: Contact,
    blocks: Blocks,
    arena: Arena,
    e: int,
    p: int,
    at: wp.vec3,
    mass: float,
    field: int,
    places: vec8i,
):
    """Mark the subblocks of a particle's stencil, at ``places``, and store whether it is a contact candidate."""
    max_float_word(HEAVIEST + field, mass)
    for b in range(8):
        set_half_word(arena.numbers, places[b], TOUCHED)
    if (byte(arena.near, places[0] // BLOCK_SUBBLOCKS) & MAY_CONTACT) != 0:  # noqa: SIM102 - `and` would evaluate both
        if is_contact_candidate(
            grid, particles, boundaries, contact, blocks, e, p, at, base_node(grid_position(grid, at))
        ):
            or_word(arena.candidates + p // 32, 1 << (p % 32))
            add_word(NUM_CANDIDATES, 1)


@wp.func
def touch_with_all(
    grid: Grid,
    particles: Particles,
    boundaries: Boundaries,
    contact: Contact,
    blocks: Blocks,
    arena: Arena,
    e: int,
    begin: int,
    end: int,
    x: wp.array2d(dtype=wp.vec3),
):
    """Call :func:`touch_subblocks` for the particles from ``begin`` to ``end``, three of a thread at a time."""
    r = row(e, particles.mass.shape[0])
    step = threads_of_block()
    for p in range(begin + thread_of_block(), end, 3 * step):
        second = wp.min(p + step, end - 1)
        third = wp.min(p + 2 * step, end - 1)
        at = x[e, p]
        at_second = x[e, second]
        at_third = x[e, third]
        f = wp.vec3i(particles.field[p], particles.field[second], particles.field[third])
        m = wp.vec3(particles.mass[r, p], particles.mass[r, second], particles.mass[r, third])
        n = places_around(grid, blocks, e, f[0], base_node(grid_position(grid, at)))
        n_second = places_around(grid, blocks, e, f[1], base_node(grid_position(grid, at_second)))
        n_third = places_around(grid, blocks, e, f[2], base_node(grid_position(grid, at_third)))
        touch_subblocks(grid, particles, boundaries, contact, blocks, arena, e, p, at, m[0], f[0], n)
        if p + step < end:
            touch_subblocks(
                grid, particles, boundaries, contact, blocks, arena, e, second, at_second, m[1], f[1], n_second
            )
        if p + 2 * step < end:
            touch_subblocks(
                grid, particles, boundaries, contact, blocks, arena, e, third, at_third, m[2], f[2], n_third
            )


@wp.func
def lay_out_arena(
    grid: Grid,
    particles: Particles,
    boundaries: Boundaries,
    contact: Contact,
    blocks: Blocks,
    arena: Arena,
    failure: wp.array(dtype=int),
    e: int,
    partition: wp.vec3i,
    x: wp.array2d(dtype=wp.vec3),
):
    """Number the subblocks that particles touch, and find the contact candidates.

    Subblocks away from colliders come first, so that few warps handle nodes near colliders.
    """
    clear_words(0, arena.numbers)
    fill_words(arena.numbers, arena.candidates - arena.numbers, -1)  # NO_SUBBLOCK twice
    clear_words(arena.candidates, arena.places - arena.candidates)
    sync_block()
    note_boundaries(grid, boundaries, contact, blocks, arena, e)
    sync_block()
    end = end_of_partition(blocks, failure, e, partition)
    touch_with_all(grid, particles, boundaries, contact, blocks, arena, e, partition[0], end, x)
    sync_block()
    most = BLOCK_SUBBLOCKS * num_active(blocks, e)
    number_subblocks(arena.numbers, arena.places, arena.near, most, False)
    sync_block()
    number_subblocks(arena.numbers, arena.places, arena.near, most, True)
    sync_block()


@wp.func
def mass_quantum_of(field: int):
    """Return the mass quantum of a field [kg], a power of two."""
    return power_of_two(float_word(HEAVIEST + field)) / float_word(QUANTA)


@wp.func
def offset_quantum_of(field: int):
    """Return the mass quantum of a field in sums of offsets [kg], coarser than that of masses."""
    return power_of_two(float_word(HEAVIEST + field)) / OFFSET_QUANTA


@wp.func
def speed_of(s: Deposit, physical: float):
    """Return a bound of a particle's momenta by its mass [m/s]; ``physical`` bounds the physical one [kg m/s]."""
    most = physical
    for c in range(3):
        most = wp.max(most, wp.abs(s.at_base[4 + c]))
    return most / s.at_base[0]


@wp.func
def speed_for(fastest: float):
    """Return a power of two that the fastest particle will not exceed unless it gains a quarter at once [m/s]."""
    return wp.max(SLOWEST, power_of_two(1.25 * fastest))


@wp.func
def speeds_known(arena: Arena, partition: wp.vec3i):
    """Return whether every field of a partition has a speed that scales its momentum quantum."""
    known = bool(True)
    for f in range(arena.speed.shape[1]):
        known = known and (float_word(SPEED + f) > 0.0 or not has_field(partition[2], f))
    return known


@wp.func
def quanta_suffice(arena: Arena, partition: wp.vec3i, first: int, given: int):
    """Return whether no particle exceeded its field's speed and no accumulator overflowed.

    All threads must call this; their particles have ``given`` that much mass [LOST_QUANTA].
    """
    known = speeds_known(arena, partition)
    if known:
        lost = int(given)
        for n in range(thread_of_block(), 8 * subblocks_of_round(arena, first), threads_of_block()):
            lost -= word(node_word(arena, n)) // LOST_QUANTA
        add_word(LOST, lost)
    sync_block()
    hold = known and word(LOST) < MAX_LOST
    for f in range(arena.speed.shape[1]):
        hold = hold and (float_word(FASTEST + f) <= float_word(SPEED + f) or not has_field(partition[2], f))
    return hold


@wp.func
def rescale_quanta(arena: Arena, partition: wp.vec3i):
    """Raise the momentum quanta of fields that were too fast, and the mass quanta if accumulators overflowed.

    All threads must call this.
    """
    f = thread_of_block()
    sync_block()
    if f == 0 and word(LOST) >= MAX_LOST:
        set_float_word(QUANTA, float_word(QUANTA) / 8.0)
    if f < arena.speed.shape[1]:
        slow = float_word(SPEED + f) == 0.0 or float_word(FASTEST + f) > float_word(SPEED + f)
        if slow and has_field(partition[2], f):
            set_float_word(SPEED + f, speed_for(float_word(FASTEST + f)))
    sync_block()
