"""Tiles: the nodes around a tile of particles in shared memory, and their sums.

The nodes are those of a box around the particles' stencils, in subblocks of 2 x 2 x 2 nodes, so the address of a node
follows from its position on the grid. A tile whose box has too many subblocks is processed in passes: each takes the
particles near the first remaining one, with a box around that. The order of passes depends on positions only.

Arena, in words of 4 bytes: header; for every subblock its record, a mask of its nodes with mass, and its position in
its block; the list of contact candidates; four sums a node, subblock after subblock. A subblock has a word in each of
the 32 banks, as in :mod:`piavatar_envs.mpm.cuda.block_grid`. Nothing here runs on a CPU.

A particle contributes a scalar and a vector that is linear over the stencil. Both are counted in quanta of the tile:
2^-25 of the most that any of its particles has, a power of two, and not less than the quanta of the accumulators. So
integers are added in any order and flushed exactly. A weight is at most 27/64: 128 summands stay below 2^31. (Quanta
four times as large would allow a fused addition to round, but a body that drifts through the grid repeats the same
errors and lost 1e-5 of its momentum in 300 substeps.)
"""

from __future__ import annotations

import warp as wp

from piavatar_envs.core.shared_memory import float_word, native
from piavatar_envs.mpm.cuda.block_grid import SUBBLOCK_WORDS
from piavatar_envs.mpm.p2g import Deposit, fault_within, momentum_bounds
from piavatar_envs.mpm.types import FAILURE_CFL, Accumulators, Blocks, Grid

wp.set_module_options({"enable_backward": False})

#: Kinds of sums: mass and momentum; kinematic momentum; offsets and seams.
MOMENTUM, KINEMATIC, PLACE = (wp.constant(n) for n in range(3))
#: Most particles of a tile, a thread each.
THREADS = 128
#: Subblocks that fit, enough for a box of ``REACH`` grid spacings to each side of a particle.
CAPACITY = wp.constant(128)
REACH = wp.constant(3)
#: Words of the header: number of contact candidates; whether particles remain for another pass; the first of them; the
#: most that a particle has of mass [kg], momentum and kinematic momentum [kg m/s]; quanta of the accumulators; least
#: and greatest lowest node of a stencil along three axes, and between them whether any node is a contact node.
NUM_CANDIDATES, REMAINING, FIRST = (wp.constant(n) for n in range(3))
HEAVIEST, FASTEST, FASTEST_KINEMATIC = (wp.constant(n) for n in range(3, 6))
MASS_QUANTUM, MOMENTUM_QUANTUM = (wp.constant(n) for n in (6, 7))
LOWEST, HAS_CONTACT_NODES, HIGHEST = (wp.constant(n) for n in (8, 11, 12))
RECORDS = wp.constant(16)
MASSIVE = wp.constant(int(RECORDS) + int(CAPACITY))
WITHIN = wp.constant(int(MASSIVE) + int(CAPACITY))
CANDIDATES = wp.constant(int(WITHIN) + int(CAPACITY))
NODES = wp.constant(-(-(int(CANDIDATES) + THREADS) // 32) * 32)
#: Words of an arena.
WORDS = wp.constant(int(NODES) + int(SUBBLOCK_WORDS) * int(CAPACITY))
#: Quanta of the most that a particle has.
MAX_PARTICLE_QUANTA = wp.constant(float(2**25))
#: Flags of a subblock above its position in its block: it is in a contact block; then bits of its contact nodes.
SEVERAL_FIELDS, CONTACT_NODES = wp.constant(1 << 30), wp.constant(256)
#: The least power of two that is not below the positive number in a word.
POWER = "auto power_of_two = [](int word) { return __int_as_float((word + 0x7fffff) & 0x7f800000); };"


#: Subblocks of the box along each axis, none if the box is empty.
SIZE = """
int lowest[3], size[3];
for (int c = 0; c < 3; ++c) {
    lowest[c] = arena[LOWEST + c] >> 1;
    size[c] = max((arena[HIGHEST + c] + 2 >> 1) - lowest[c] + 1, 0);
}
"""


def tile_native(cuda: str, otherwise: str = "") -> str:
    """Return a snippet with the words of the arena in scope."""
    names = "CAPACITY REACH NUM_CANDIDATES REMAINING FIRST HEAVIEST FASTEST FASTEST_KINEMATIC MASS_QUANTUM"
    names += " MOMENTUM_QUANTUM LOWEST HIGHEST RECORDS"
    names += " HAS_CONTACT_NODES MASSIVE WITHIN CANDIDATES NODES SUBBLOCK_WORDS SEVERAL_FIELDS CONTACT_NODES"
    values = {name: globals()[name] for name in names.split()} | {"KINEMATIC": KINEMATIC, "PLACE": PLACE}
    known = ", ".join(f"{name} = {int(value)}" for name, value in values.items())
    return native(f"constexpr int {known};\nconstexpr unsigned ALL = 0xffffffffu;\n{cuda}", otherwise)


@wp.func_native(
    tile_native("""
int4* const nodes = reinterpret_cast<int4*>(arena + NODES);
if (blockDim.x == 128) {  // the usual case without a loop
#pragma unroll
    for (int n = 0; n < SUBBLOCK_WORDS * CAPACITY / 512; ++n) nodes[threadIdx.x + 128 * n] = make_int4(0, 0, 0, 0);
} else
    for (int n = threadIdx.x; n < SUBBLOCK_WORDS * CAPACITY / 4; n += blockDim.x) nodes[n] = make_int4(0, 0, 0, 0);
""")
)
def clear_nodes():
    """Zero the sums of all nodes."""
    ...


@wp.func_native(
    tile_native("""
if (threadIdx.x != 0) return;
arena[NUM_CANDIDATES] = 0, arena[REMAINING] = 0, arena[HAS_CONTACT_NODES] = 0, arena[FIRST] = 0x7fffffff;
for (int c = 0; c < 3; ++c) arena[LOWEST + c] = 0x7fffffff, arena[HIGHEST + c] = -1;
""")
)
def begin_pass():
    """Reset the box and the list of contact candidates."""
    ...


@wp.func_native(
    tile_native("""
int mass = takes ? __float_as_int(scalar) : 0, most = takes ? __float_as_int(momentum) : 0;
#if __CUDA_ARCH__ >= 800
mass = __reduce_max_sync(ALL, mass), most = __reduce_max_sync(ALL, most);
takes = (threadIdx.x & 31) == 0;
#endif
int* const of_vector = arena + (kind == 0 ? FASTEST : FASTEST_KINEMATIC);
if (takes && mass > arena[HEAVIEST]) atomicMax(arena + HEAVIEST, mass);  // it is 0 where it is not needed for
if (takes && most > *of_vector) atomicMax(of_vector, most);
""")
)
def raise_maxima(takes: bool, kind: int, scalar: float, momentum: float):
    """Raise the tile's maxima to a particle's mass and momentum; all threads of a warp must call this."""
    ...


@wp.func_native(
    tile_native("""
int low[3], high[3];
for (int c = 0; c < 3; ++c) {
    low[c] = takes ? base[c] : 0x7fffffff, high[c] = takes ? base[c] : -1;
#if __CUDA_ARCH__ >= 800
    low[c] = __reduce_min_sync(ALL, low[c]), high[c] = __reduce_max_sync(ALL, high[c]);
#endif
}
#if __CUDA_ARCH__ >= 800
takes = (threadIdx.x & 31) == 0;
#endif
if (!takes) return;
for (int c = 0; c < 3; ++c) atomicMin(arena + LOWEST + c, low[c]), atomicMax(arena + HIGHEST + c, high[c]);
""")
)
def widen_box(takes: bool, base: wp.vec3i):
    """Widen the box to a stencil; all threads of a warp must call this."""
    ...


@wp.func_native(
    tile_native(
        SIZE
        + """
const bool fits = (float)size[0] * (float)size[1] * (float)size[2] <= (float)CAPACITY;
if (threadIdx.x == 0) arena[REMAINING] = !fits;
if (fits) return takes;
__syncthreads();  // all have seen it
if (takes) atomicMin(arena + FIRST, (int)threadIdx.x);
__syncthreads();
if (threadIdx.x == arena[FIRST])
    for (int c = 0; c < 3; ++c) {
        arena[LOWEST + c] = max(base[c] - REACH, 0);
        arena[HIGHEST + c] = min(base[c] + REACH, grid.nodes[c] - 3);
    }
__syncthreads();
for (int c = 0; c < 3; ++c) takes = takes && base[c] >= arena[LOWEST + c] && base[c] <= arena[HIGHEST + c];
return takes;
""",
        "return takes;",
    )
)
def in_pass(grid: Grid, takes: bool, base: wp.vec3i) -> bool:
    """Return whether a particle is in this pass: any that takes part, or is in a smaller box if the box is too large.

    All threads must call this after a barrier that follows :func:`widen_box`. Word ``REMAINING`` says whether some
    remain.
    """
    ...


@wp.func_native(
    tile_native(
        SIZE
        + """
const int along_y = SUBBLOCK_WORDS * size[2], along_x = along_y * size[1];
const int first = NODES + ((base[0] >> 1) - lowest[0]) * along_x + ((base[1] >> 1) - lowest[1]) * along_y
    + ((base[2] >> 1) - lowest[2]) * SUBBLOCK_WORDS;
return wp::vec_t<3, wp::int32>(first, along_x, along_y);
""",
        "return wp::vec_t<3, wp::int32>();",
    )
)
def subblocks_around(base: wp.vec3i) -> wp.vec3i:
    """Return the word at which the subblock of a stencil's lowest node begins, and the strides along x and y."""
    ...


@wp.func_native(
    tile_native(
        SIZE
        + """
const int subblocks = size[0] * size[1] * size[2];
for (int n = threadIdx.x; n < subblocks; n += blockDim.x) {
    // division of floats is faster, and exact enough for halves
    const int line = (int)(((float)n + 0.5f) / (float)size[2]), plane = (int)(((float)line + 0.5f) / (float)size[1]);
    const int i = lowest[0] + plane, j = lowest[1] + line - plane * size[1], l = lowest[2] + n - line * size[2];
    const int block = ((i >> 1) * grid.blocks[1] + (j >> 1)) * grid.blocks[2] + (l >> 1);
    int within = ((i & 1) << 5) + ((j & 1) << 3) + ((l & 1) << 1);
    const int* const active = &wp::index(blocks.active, e, field * grid.num_blocks + block);
#if __CUDA_ARCH__ >= 800
    const unsigned to = (unsigned)__cvta_generic_to_shared(arena + RECORDS + n);
    asm volatile("cp.async.ca.shared.global [%0], [%1], 4;" :: "r"(to), "l"(active) : "memory");
#else
    arena[RECORDS + n] = *active;
#endif
    if (num_fields > 1 && wp::index(blocks.fields, e, block) != 1 << field) within |= SEVERAL_FIELDS;
    arena[WITHIN + n] = within;
}
"""
    )
)
def fetch_active(grid: Grid, blocks: Blocks, num_fields: int, e: int, field: int):
    """Start the loads of the subblocks' active blocks, which :func:`store_records` waits for."""
    ...


@wp.func_native(
    tile_native(
        SIZE
        + """
#if __CUDA_ARCH__ >= 800
asm volatile("cp.async.wait_all;" ::: "memory");
#endif
const int subblocks = size[0] * size[1] * size[2];
for (int n = threadIdx.x; n < subblocks; n += blockDim.x) {
    const int active = arena[RECORDS + n], within = arena[WITHIN + n];
    arena[RECORDS + n] = 128 * active + (within & ~SEVERAL_FIELDS);
    if (within & SEVERAL_FIELDS) {
        // from half a block, two planes of 16 nodes, the subblock's: two nodes along each axis
        const unsigned half = wp::index(blocks.contact_nodes, e, 2 * active + (within >> 5 & 1));
        const unsigned two = half >> (within & 10) & 0x330033u, four = (two | two >> 2) & 0xf000fu;
        const int contact_nodes = (four | four >> 12) & 0xff;
        arena[WITHIN + n] = CONTACT_NODES * contact_nodes;
        if (contact_nodes != 0) arena[HAS_CONTACT_NODES] = 1;
    }
}
"""
    )
)
def store_records(blocks: Blocks, e: int):
    """Store the first record of every subblock, and its contact nodes, from what the same thread has fetched."""
    ...


@wp.func_native(
    tile_native(
        """
if (arena[HAS_CONTACT_NODES] == 0) return false;
// of a subblock's two nodes along an axis, those that are in the stencil: of the lower subblock, and of the upper one
int lower[3], upper[3];
for (int c = 0; c < 3; ++c) lower[c] = base[c] & 1 ? 2 : 3, upper[c] = base[c] & 1 ? 3 : 1;
int all = 0;
#pragma unroll 1
for (int n = 0; n < 8; ++n) {
    const int at = box[0] + (n & 4 ? box[1] : 0) + (n & 2 ? box[2] : 0) + (n & 1 ? SUBBLOCK_WORDS : 0);
    const int x = n & 4 ? upper[0] : lower[0], y = n & 2 ? upper[1] : lower[1], z = n & 1 ? upper[2] : lower[2];
    const int plane = z * ((y & 1) + 2 * (y & 2));
    all |= arena[WITHIN + (at - NODES) / SUBBLOCK_WORDS] & CONTACT_NODES * plane * ((x & 1) + 8 * (x & 2));
}
return all != 0;
""",
        "return false;",
    )
)
def has_contact_nodes(box: wp.vec3i, base: wp.vec3i) -> bool:
    """Return whether any node of the stencil at ``base`` is a contact node; see :func:`subblocks_around`."""
    ...


@wp.func_native(
    tile_native(
        POWER + "return __int_as_float(0x7f000000 - __float_as_int(power_of_two(arena[at]))) * 0x1p25f;",
        "return 0.0f;",
    )
)
def inverse_quantum(at: int) -> float:
    """Return one over the quantum for the maximum in word ``at``; exact, with any division mode."""
    ...


@wp.func
def bounded(s: Deposit, quantum: float, failure: wp.array(dtype=int), e: int):
    """Return the most momentum of a particle in its stencil [kg m/s]; -1 and a failure if it cannot be added."""
    bounds = momentum_bounds(s)
    fault = fault_within(s, bounds, quantum)
    if fault != 0:
        wp.atomic_or(failure, e, fault)
        return -1.0
    return wp.max(bounds)


@wp.func
def raise_quanta(s: Deposit, takes: bool, kind: int, failure: wp.array(dtype=int), e: int):
    """Return whether a particle can be added; if so, raise the tile's maxima to it. All threads must call this."""
    momentum = float(0.0)
    if takes:
        momentum = bounded(s, float_word(MOMENTUM_QUANTUM), failure, e)
        takes = momentum >= 0.0
    raise_maxima(takes, kind, s.at_base[0], momentum)
    return takes


@wp.func_native(
    tile_native(f"""
{POWER}{SIZE}
const int lane = threadIdx.x & 31, warp = threadIdx.x >> 5, c = lane & 3;  // of four accumulators
int warps = blockDim.x >> 5;
asm volatile("" : "+r"(warps));  // keeps the compiler from recomputing it for each subblock
const int subblocks = size[0] * size[1] * size[2];
const bool is_place = kind == PLACE, of_mass = c == 0 || is_place;
const int word = kind == 0 ? c : c + 3 & 3;  // a vector begins where the mass was, if there is none
const int within = (lane & 16) + (lane >> 1 & 4) + (lane >> 2 & 1) + (kind == KINEMATIC ? 64 : 0);
const unsigned mass_of_node = 1u << (lane & 28);
// the tile's quanta are at least those of the accumulators: shifted, they are exact
float quantum = power_of_two(arena[of_mass ? HEAVIEST : kind == KINEMATIC ? FASTEST_KINEMATIC : FASTEST]);
quantum *= is_place && c > 0 ? 0x1p-24f : 0x1p-25f;
const int shift = __float_as_int(quantum) - arena[of_mass ? MASS_QUANTUM : MOMENTUM_QUANTUM] >> 23;
// a loop of its own for masses, which come first: no divergent branches within
struct First {{ enum {{ IS = 1 }}; }};
struct Later {{ enum {{ IS = 0 }}; }};
auto put_subblocks = [&](auto which, auto add) {{
    int* from = arena + NODES + start + SUBBLOCK_WORDS * warp + lane;
#pragma unroll 1
    for (int n = RECORDS + warp; n < RECORDS + subblocks; n += warps, from += SUBBLOCK_WORDS * warps) {{
        const int sum = *from, record = arena[n] + within;
        int& massive = arena[n - RECORDS + MASSIVE];
        if (decltype(which)::IS) massive = __ballot_sync(ALL, sum != 0);  // written by all threads, the same
        if (sum != 0 && (massive & mass_of_node)) add(record, sum);  // without mass, the rest is rounding
    }}
}};
auto put = [&](auto add) {{
    if (kind == 0) put_subblocks(First(), add);
    else put_subblocks(Later(), add);
}};
// the four numbers of a node are one memory sector
auto red = [](size_t to, int record, long long added) {{
    size_t node;
    asm("mad.wide.s32 %0, %1, %2, %3;" : "=l"(node) : "r"(record), "r"(32), "l"(to));
    asm volatile("red.global.add.u64 [%0], %1;" :: "l"(node), "l"(added) : "memory");
}};
// records of offsets have no halves
auto own = [&](int record) {{ return is_place ? (record >> 1 & ~63) + (record & 63) : record; }};
if (is_place)
    for (int n = threadIdx.x; n < subblocks; n += blockDim.x)
        if (arena[MASSIVE + n]) wp::index(accumulators.candidates, e, arena[RECORDS + n] >> 7) = 1;
bool too_much = false;
// accumulators have 31 bits, so most of them cannot be too large
if (!is_place && __all_sync(ALL, shift < 18)) {{
    const size_t to = __cvta_generic_to_global(&wp::index(accumulators.fixed, e, 0)) + 8 * word;
    const int factor = 1 << shift;
    put([&](int record, int sum) {{
        long long added;
        asm("mul.wide.s32 %0, %1, %2;" : "=l"(added) : "r"(sum), "r"(factor));
        red(to, record, added);
    }});
}} else {{
    void* const records
        = is_place ? (void*)&wp::index(accumulators.offset_fixed, e, 0) : &wp::index(accumulators.fixed, e, 0);
    const size_t to = __cvta_generic_to_global(records) + 8 * word;
    const int most_counted = shift > 48 ? 0 : shift < 18 ? 0x7fffffff : 1 << (48 - shift);
    put([&](int record, int sum) {{
        if (abs(sum) <= most_counted) red(to, own(record), (long long)sum << shift);
        else too_much = true;
    }});
}}
if (too_much) atomicOr(&wp::index(failure, e), {FAILURE_CFL});
""")
)
def flush_nodes(grid: Grid, accumulators: Accumulators, failure: wp.array(dtype=int), e: int, kind: int, start: int):
    """Add the nodes' sums of a ``kind`` to the accumulators, four threads a node; sums that are too large fail.

    They begin ``start`` words after the first. Masses must be flushed first; offsets flag their active blocks.
    """
    ...
