"""The nodes of a group of particles in the shared memory of its CUDA block, in CUDA: where they lie.

They lie in bricks of 2 x 2 x 2 nodes, numbered as they come. A brick's key says where it is on the grid and of which
velocity field; a sparse table, where hardly any two keys meet, leads from keys to numbers. So it does not matter how a
group lies. Particles of a warp that lie in the same brick list it once, and all threads look the neighbors of what is
listed up. Numbers depend on who comes first, sums do not: integers are added, and whether there is room depends on how
many bricks there are.

Nothing here runs on a CPU. In words of 4 bytes, the room has: a header; the table of keys, and of numbers in half
words; of every brick its key, later its field, its record, and which nodes have got mass; four sums of every node, one
after the other; where in the table the bricks are that were looked up, in half words; what is handed to other threads,
first the list of bricks.
"""

from __future__ import annotations

import warp as wp

from piavatar_envs.mpm.runs import KINEMATIC, PLACE
from piavatar_envs.mpm.shared_memory import APPEND, native
from piavatar_envs.mpm.transfer import Scattered
from piavatar_envs.mpm.types import Blocks, Grid

wp.set_module_options({"enable_backward": False})

#: Bricks that there is room for: a multiprocessor of 228 KB holds six groups.
CAPACITY = wp.constant(184)
#: Places of the table, a power of two: with so many more than bricks, a key is mostly found at the first.
TABLE_BITS = wp.constant(9)
TABLE = wp.constant(1 << int(TABLE_BITS))
#: Particles of a group, at most; so many threads it has, whatever their number.
THREADS = wp.constant(128)
#: Particles of a group of which a thread takes a plane of nodes instead, at most.
MOST_SPLIT = wp.constant(int(THREADS) // 2)
#: Words of the header: how many bricks there are, or more than there is room for; bits of what else is added up; how
#: many bricks are listed whose neighbors are sought; and of each of up to 32 fields, the most that a particle has of
#: mass [kg], momentum, kinematic momentum [kg m/s], and the sums' own units.
COUNT, MORE, LISTED = (wp.constant(n) for n in range(3))
HEAVIEST, FASTEST, DRIVEN = (wp.constant(n) for n in (4, 36, 68))
MASS_UNIT, MOMENTUM_UNIT = (wp.constant(n) for n in (100, 132))
KEYS = wp.constant(164)
NUMBERS = wp.constant(int(KEYS) + int(TABLE))
BRICKS = wp.constant(int(NUMBERS) + int(TABLE) // 2)
RECORDS = wp.constant(int(BRICKS) + int(CAPACITY))
MASSIVE = wp.constant(int(RECORDS) + int(CAPACITY))
NODES = wp.constant(int(MASSIVE) + int(CAPACITY))
#: From a sum of a node to its next; the four of eight nodes lie in 32 banks.
ALONG = wp.constant(8 * int(CAPACITY) + 8)
FOUND = wp.constant(int(NODES) + 4 * int(ALONG))
HANDED = wp.constant(int(FOUND) + 4 * int(THREADS))
#: Words of a room.
WORDS = wp.constant(int(HANDED) + 21 * int(MOST_SPLIT))
#: Units of the most that a particle has.
UNITS = wp.constant(float(2**25))
#: What a brick's record has besides it, if there is matter of another field in its block.
SHARED = wp.constant(1 << 30)

#: The least power of two that is not below the positive number in a word.
POWER = "auto power_of_two = [](int word) { return __int_as_float((word + 0x7fffff) & 0x7f800000); };"


def in_group(cuda: str, otherwise: str = "") -> str:
    """A snippet that knows what lies where."""
    names = "CAPACITY TABLE_BITS TABLE COUNT LISTED HEAVIEST FASTEST DRIVEN MASS_UNIT MOMENTUM_UNIT KEYS NUMBERS BRICKS"
    names += " RECORDS MASSIVE NODES ALONG FOUND HANDED MOST_SPLIT SHARED"
    values = {name: globals()[name] for name in names.split()} | {"KINEMATIC": KINEMATIC, "PLACE": PLACE}
    known = ", ".join(f"{name} = {int(value)}" for name, value in values.items())
    return native(f"constexpr int {known};\nconstexpr unsigned ALL = 0xffffffffu;\n{cuda}", otherwise)


@wp.func_native(
    in_group("""
const int lane = threadIdx.x & 31;
const int some = __ffs(__ballot_sync(ALL, takes) | 1u << 31) - 1, of_some = __shfl_sync(ALL, field, some);
const bool one = __all_sync(ALL, !takes || field == of_some);
int mass = takes ? __float_as_int(s.at_base[0]) : 0, most = takes ? __float_as_int(momentum) : 0;
#if __CUDA_ARCH__ >= 800
if (one) {
    mass = __reduce_max_sync(ALL, mass), most = __reduce_max_sync(ALL, most);
    takes = lane == 0;
    field = of_some;
}
#endif
int* const of_mass = room + HEAVIEST + field;
int* const of_vector = room + (kind == 0 ? FASTEST : DRIVEN) + field;
if (takes && mass > *of_mass) atomicMax(of_mass, mass);  // it is 0 where it is not asked for
if (takes && most > *of_vector) atomicMax(of_vector, most);
""")
)
def raise_most(takes: bool, field: int, kind: int, s: Scattered, momentum: float):
    """See that the group's units are large enough for a particle's momenta; all threads of a warp come here."""
    ...


@wp.func_native(
    in_group(
        APPEND
        + """
const int lane = threadIdx.x & 31, i = base[0], j = base[1], k = base[2];
const unsigned block = field * grid.num_blocks + ((i >> 2) * grid.blocks[1] + (j >> 2)) * grid.blocks[2] + (k >> 2);
const unsigned own = takes ? 8u * block + ((i & 2) << 1) + (j & 2) + ((k & 2) >> 1) + 1 : 0u;  // 0 is for nobody's
if (!__any_sync(ALL, takes)) return 0;
const int first = __ffs(__match_any_sync(ALL, own)) - 1;
const bool is_first = takes && first == lane;
const int place = append(room + LISTED, __ballot_sync(ALL, is_first), first);
if (is_first) room[HANDED + place] = (int)own;
return place;
""",
        "return 0;",
    )
)
def list_brick(grid: Grid, takes: bool, field: int, base: wp.vec3i) -> int:
    """List the brick that a stencil begins in, once a warp, for :func:`seek_bricks`; all threads of a warp come here.

    Returns its place in the list, for :func:`bricks_found`.
    """
    ...


@wp.func_native(
    in_group("""
const int ny = grid.blocks[1], nz = grid.blocks[2], items = 8 * room[LISTED];
volatile unsigned* const keys = reinterpret_cast<unsigned*>(room + KEYS);
unsigned short* const numbers = reinterpret_cast<unsigned short*>(room + NUMBERS);
unsigned short* const found_at = reinterpret_cast<unsigned short*>(room + FOUND);
for (int item = threadIdx.x; item < items; item += blockDim.x) {
    // when there are too many, it does not matter who they are; and the table is never full
    if (*(volatile int*)(room + COUNT) > CAPACITY) break;
    const int b = item & 7;
    unsigned key = (unsigned)room[HANDED + (item >> 3)];
    const unsigned lowest = key - 1u;
    if (b & 4) key += lowest & 4u ? 8 * ny * nz - 4 : 4;
    if (b & 2) key += lowest & 2u ? 8 * nz - 2 : 2;
    if (b & 1) key += lowest & 1u ? 7 : 1;
    unsigned at = key * 0x9e3779b1u >> (32 - TABLE_BITS), got;
    while ((got = keys[at]) != key) {
        if (got == 0u) {
            got = atomicCAS((unsigned*)keys + at, 0u, key);
            if (got == key) break;
            if (got == 0u) {
                const int number = atomicAdd(room + COUNT, 1);
                if (number < CAPACITY) room[BRICKS + number] = (int)key;
                numbers[at] = (unsigned short)number;
                break;
            }
        }
        at = at + 1 & TABLE - 1;
    }
    found_at[item] = (unsigned short)at;
}
""")
)
def seek_bricks(grid: Grid):
    """See that the listed bricks and their upper neighbors have numbers, if there is room, a thread each of them.

    All threads of the group come here, and have met before; when they meet again, :func:`bricks_found` finds them.
    """
    ...


@wp.func_native(
    in_group(
        """
const int4 at = *reinterpret_cast<const int4*>(room + FOUND + 4 * place);
const unsigned short* const numbers = reinterpret_cast<const unsigned short*>(room + NUMBERS);
auto both = [=](int two) { return 8 * (numbers[two & 0xffff] | numbers[(unsigned)two >> 16] << 16); };
return wp::vec_t<4, wp::int32>(both(at.x), both(at.y), both(at.z), both(at.w));
""",
        "return wp::vec_t<4, wp::int32>();",
    )
)
def bricks_found(place: int) -> wp.vec4i:
    """First nodes of the bricks of a stencil: for the lower and the upper along x and y, of the two along z in 16 bits.

    Its own is at a ``place`` of the list; and there has been room for them, see :func:`seek_bricks`.
    """
    ...


@wp.func_native(
    in_group("""
for (int n = threadIdx.x; n < room[COUNT]; n += blockDim.x) {
    const int held = (int)((unsigned)(room[BRICKS + n] - 1) >> 3);  // field and block
    const int* const slot = &wp::index(blocks.slot, e, held);
#if __CUDA_ARCH__ >= 800
    const unsigned to = (unsigned)__cvta_generic_to_shared(room + RECORDS + n);
    asm volatile("cp.async.ca.shared.global [%0], [%1], 4;" :: "r"(to), "l"(slot) : "memory");
#else
    room[RECORDS + n] = *slot;
#endif
}
""")
)
def fetch_slots(blocks: Blocks, e: int):
    """Ask for the slots of the bricks' blocks, which nobody waits for before :func:`note_records`."""
    ...


@wp.func_native(
    in_group("""
for (int n = threadIdx.x; n < room[COUNT]; n += blockDim.x) {
    const int brick = room[BRICKS + n] - 1;
    int record = ((brick & 4) << 3) + ((brick & 2) << 2) + ((brick & 1) << 1);
    if (num_fields > 1) {
        const int held = (int)((unsigned)brick >> 3), field = held / grid.num_blocks;
        if (wp::index(blocks.fields, e, held - field * grid.num_blocks) != 1 << field) record |= SHARED;
        room[BRICKS + n] = field;
    }
#if __CUDA_ARCH__ >= 800
    asm volatile("cp.async.wait_all;" ::: "memory");
#endif
    room[RECORDS + n] = record + 64 * room[RECORDS + n];
}
""")
)
def note_records(grid: Grid, blocks: Blocks, num_fields: int, e: int):
    """Find the record of every brick's first node, and whether its block is shared; its field takes its key's place.

    The slots are those that the same threads have fetched.
    """
    ...


@wp.func_native(
    in_group(
        """
int all = 0;
for (int n = 0; n < 4; ++n) all |= room[RECORDS + (bricks[n] & 0xffff) / 8] | room[RECORDS + (bricks[n] >> 16) / 8];
return (all & SHARED) != 0;
""",
        "return false;",
    )
)
def is_shared(bricks: wp.vec4i) -> bool:
    """Whether a block of a particle's stencil has matter of another field."""
    ...


@wp.func_native(
    in_group(
        POWER + "return __int_as_float(0x7f000000 - __float_as_int(power_of_two(room[at]))) * 0x1p25f;",
        "return 0.0f;",
    )
)
def per_unit_of(at: int) -> float:
    """One over the unit for what has the most in word ``at``; exact, however the module divides."""
    ...
