"""The nodes of a group of particles in the shared memory of its CUDA block, in CUDA: where they lie.

They lie in bricks of 2 x 2 x 2 nodes. A brick's key says where it is on the grid and of which velocity field; its place
follows from that, or is the next that is free. So it does not matter how a group lies: three quarters of the places are
enough for 256 particles inside a body or 64 on its skin.

Nothing here runs on a CPU. In words of 4 bytes, the room has: a header; the keys; four sums of every node, one after
the other; of every brick its record, and which nodes have got mass; what is handed to other threads.
"""

from __future__ import annotations

import warp as wp

from piavatar_envs.mpm.shared_memory import native
from piavatar_envs.mpm.transfer import Scattered
from piavatar_envs.mpm.types import Blocks, Grid

wp.set_module_options({"enable_backward": False})

#: Bricks that there is room for.
CAPACITY = wp.constant(216)
#: Bricks that have places of their own whatever the others are: a cube of them, wherever it lies.
EDGE = wp.constant(6)
#: Bricks that a particle touches.
BRICKS_TOUCHED = wp.constant(8)
#: Particles of a group, at most; so many threads it has, whatever their number.
THREADS = wp.constant(256)
#: Words of the header: not 0 if a particle has found no room; bits of what else is added up; and of each of up to 32
#: fields, the most that a particle has of mass [kg], momentum, kinematic momentum [kg m/s], and the sums' own units.
CROWDED, MORE = (wp.constant(n) for n in range(2))
HEAVIEST, FASTEST, DRIVEN = (wp.constant(n) for n in (4, 36, 68))
MASS_UNIT, MOMENTUM_UNIT = (wp.constant(n) for n in (100, 132))
KEYS = wp.constant(164)
NODES = wp.constant(int(KEYS) + int(CAPACITY))
RECORDS = wp.constant(int(NODES) + 4 * 8 * int(CAPACITY))
MASSIVE = wp.constant(int(RECORDS) + int(CAPACITY))
HANDED = wp.constant(int(MASSIVE) + int(CAPACITY))
#: Words of a room; a third of the threads' particles may be handed on.
WORDS = wp.constant(int(HANDED) + 21 * (int(THREADS) // 3))
#: Units of the most that a particle has.
UNITS = wp.constant(float(2**23))
#: What a brick's record has besides it, if there is matter of another field in its block.
SHARED = wp.constant(1 << 30)
#: What is added up: mass and momentum; kinematic momentum; places and seams.
MOMENTUM, KINEMATIC, PLACE = (wp.constant(n) for n in range(3))


#: The least power of two that is not below the positive number in a word.
POWER = "auto power_of_two = [](int word) { return __int_as_float((word + 0x7fffff) & 0x7f800000); };"


def in_group(cuda: str, otherwise: str = "") -> str:
    """A snippet that knows what lies where."""
    names = "CAPACITY EDGE HEAVIEST FASTEST DRIVEN MASS_UNIT MOMENTUM_UNIT KEYS NODES RECORDS MASSIVE HANDED SHARED"
    names += " KINEMATIC PLACE"
    known = ", ".join(f"{name} = {int(globals()[name])}" for name in names.split())
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
        """
if (!takes) return wp::vec_t<4, wp::int32>(-1, 0, 0, 0);
unsigned* const keys = reinterpret_cast<unsigned*>(room + KEYS);
const int ny = grid.blocks[1], nz = grid.blocks[2];
unsigned x[2], y[2], z[2], key[8], got[8];
int at[8];
for (int n = 0; n < 2; ++n) {
    const int i = base[0] + 2 * n, j = base[1] + 2 * n, k = base[2] + 2 * n;
    x[n] = 8u * (field * grid.num_blocks + (i >> 2) * ny * nz) + ((i & 2) << 1) + 1;  // 0 is for nobody's
    y[n] = 8u * ((j >> 2) * nz) + (j & 2);
    z[n] = 8u * (k >> 2) + ((k & 2) >> 1);
}
// bricks next to each other have places of their own; other fields' begin elsewhere
const int bx = (unsigned)((base[0] >> 1) + 3 * (field & 1)) % EDGE, by = (unsigned)(base[1] >> 1) % EDGE;
const int bz = (unsigned)((base[2] >> 1) + 3 * (field >> 1 & 1)) % EDGE;
const int of_x[2] = {bx * EDGE * EDGE, bx == EDGE - 1 ? 0 : (bx + 1) * EDGE * EDGE};
const int of_y[2] = {by * EDGE, by == EDGE - 1 ? 0 : (by + 1) * EDGE}, of_z[2] = {bz, bz == EDGE - 1 ? 0 : bz + 1};
#pragma unroll
for (int b = 0; b < 8; ++b) {
    key[b] = x[b >> 2] + y[b >> 1 & 1] + z[b & 1];
    at[b] = of_x[b >> 2] + of_y[b >> 1 & 1] + of_z[b & 1];
}
#pragma unroll
for (int b = 0; b < 8; ++b) got[b] = atomicCAS(keys + at[b], 0u, key[b]);  // one does not wait for the other
bool fits = true;
#pragma unroll
for (int b = 0; b < 8; ++b)
    for (int n = 1; got[b] != 0u && got[b] != key[b]; ++n) {
        if (n == CAPACITY) {
            fits = false;
            break;
        }
        at[b] = at[b] + 1 == CAPACITY ? 0 : at[b] + 1;
        got[b] = atomicCAS(keys + at[b], 0u, key[b]);
    }
if (!fits) return wp::vec_t<4, wp::int32>(-1, 0, 0, 0);
return wp::vec_t<4, wp::int32>(
    8 * (at[0] | at[1] << 16), 8 * (at[2] | at[3] << 16), 8 * (at[4] | at[5] << 16), 8 * (at[6] | at[7] << 16));
""",
        "return wp::vec_t<4, wp::int32>();",
    )
)
def find_bricks(grid: Grid, takes: bool, field: int, base: wp.vec3i) -> wp.vec4i:
    """First nodes of the bricks of a stencil: for the lower and the upper along x and y, of the two along z in 16 bits.

    -1 is the first word of a particle that does not ``take`` part, or for whose bricks there is no room.
    """
    ...


@wp.func_native(
    in_group("""
const int key = threadIdx.x < CAPACITY ? room[KEYS + threadIdx.x] : 0;
if (key == 0) return;
const int brick = key - 1, held = (int)((unsigned)brick >> 3);  // field and block
int record = 64 * wp::index(blocks.slot, e, held) + ((brick & 4) << 3) + ((brick & 2) << 2) + ((brick & 1) << 1);
if (num_fields > 1) {
    const int field = held / grid.num_blocks;
    if (wp::index(blocks.fields, e, held - field * grid.num_blocks) != 1 << field) record |= SHARED;
}
room[RECORDS + threadIdx.x] = record;
""")
)
def note_record(grid: Grid, blocks: Blocks, num_fields: int, e: int):
    """Find the record of the first node of the thread's brick, and whether its block is shared with another field."""
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
        POWER + "return __int_as_float(0x7f000000 - __float_as_int(power_of_two(room[at]))) * 0x1p23f;",
        "return 0.0f;",
    )
)
def per_unit_of(at: int) -> float:
    """One over the unit for what has the most in word ``at``; exact, however the module divides."""
    ...
