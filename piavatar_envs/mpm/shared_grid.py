"""The grid of a small body in the shared memory of one CUDA block: where its nodes lie there, and how to get at them.

A small body touches two thousand nodes. They fit into the memory that a multiprocessor shares among the threads of a
CUDA block, where an integer is added a hundred times as fast as in the GPU's own. There they lie in bricks of 2 x 2 x 2
nodes, numbered anew in every substep as the particles touch them; what touches more than fit goes in several rounds.

An integer has 32 bits. Of mass they count units of 2^-27 of a field's heaviest particle, so a node may hold 16 of them;
where one gets more, the environment counts anew, eight units as one. Of momentum they count such units at a speed that
none of the field's particles exceeds, a power of two, in every substep another: so the integers are used to the full,
and what a particle adds is rounded as a floating-point number would be.

Nothing here runs on a CPU. In words of 4 bytes, the room has: a header; for every brick of every slot a half word, its
number; a bit for every particle; a byte for every slot; the bricks' own places; bricks of four words a node; three more
of every node, in the same order. A brick has a word in each of the 32 banks, and its place in the brick says in which:
threads that add to different nodes of the eight, or to different words of the four, do not wait for each other.
"""

from __future__ import annotations

import warp as wp

from piavatar_envs.mpm.shared_memory import APPEND, clear_words, native, word
from piavatar_envs.mpm.types import Blocks, Grid, Room, vec8, vec8i

wp.set_module_options({"enable_backward": False})

#: Words of a node: mass and physical momentum, later physical velocity and nothing, for loads of 16 bytes.
NODE_WORDS = wp.constant(4)
#: Words that it has elsewhere: kinematic momentum, later kinematic velocity.
KINEMATIC_WORDS = wp.constant(3)
#: Words of a brick of 2 x 2 x 2 nodes, as many as there are banks, and those that it has elsewhere.
BRICK_WORDS, KINEMATIC_BRICK_WORDS = wp.constant(8 * NODE_WORDS), wp.constant(8 * KINEMATIC_WORDS)
#: Bricks of a block of 4 x 4 x 4 nodes.
BLOCK_BRICKS = wp.constant(8)
#: Words of the header: bricks in use; bits FAILURE_*; particles that tell their places; mass that has been lost
#: [LOST_UNITS]; units in a field's heaviest particle; how many particles are listed; and of every field, of which there
#: are 32 at most, for they are bits of a block's mask: the mass of its heaviest particle [kg], the speed of its
#: fastest, and the speed that its momenta are counted at [m/s].
HEADER = wp.constant(104)
COUNT, FAULTS, TOLD, LOST, UNITS, LISTED = (wp.constant(n) for n in range(6))
HEAVIEST, FASTEST, SPEED = (wp.constant(n) for n in (8, 40, 72))
#: Units of mass in a field's heaviest particle, if no node holds too much.
MOST_UNITS = wp.constant(float(2**27))
#: No brick has this number; nor this one, which those have that are to be numbered.
NO_BRICK, TOUCHED = wp.constant(0xFFFF), wp.constant(0xFFFE)
#: What a brick's place has besides its slot and its number there: a bit for each of its planes of nodes across x.
PLACES = wp.constant(0x4000)


def brick_native(cuda: str, otherwise: str = "") -> str:
    """A snippet that knows the header's words, the strides of the nodes of a brick, and :func:`kinematic_of`."""
    z, rest = int(NODE_WORDS), int(KINEMATIC_WORDS)
    strides = f"constexpr int ALONG_Z = {z}, ALONG_Y = {2 * z}, ALONG_X = {4 * z}, BRICK = {8 * z};\n"
    words = f"COUNT = {int(COUNT)}, TOUCHED = {int(TOUCHED)}, PLACES = {int(PLACES)}"
    of = f"[](const auto& in, int at) {{ return in.kinematic + (at - in.bricks) / {z} * {rest}; }}"
    return native(f"constexpr int {words};\n{strides}auto kinematic_of = {of};\n{cuda}", otherwise)


@wp.func_native(
    brick_native(
        APPEND
        + """
unsigned short* const number = reinterpret_cast<unsigned short*>(room + numbers);
unsigned short* const place = reinterpret_cast<unsigned short*>(room + places);
const unsigned char* const slabs = reinterpret_cast<const unsigned char*>(room + near);
const int lane = threadIdx.x & 31;
for (int n = threadIdx.x; n - lane < most; n += blockDim.x) {
    const bool touched = n < most && number[n] == TOUCHED;
    // of the four slabs of a block a brick has the first or the last two
    const int planes = touched ? slabs[n >> 3] >> ((n & 4) >> 1) & 3 : 0;
    const bool own = touched && (planes != 0) == by_boundaries;
    const int next = append(room + COUNT, __ballot_sync(0xffffffffu, own), lane);
    if (own) number[n] = next, place[next] = n + planes * PLACES;
}
"""
    )
)
def number_bricks(numbers: int, places: int, near: int, most: int, by_boundaries: bool):
    """Number the touched bricks of ``most`` that boundaries are near, or those that none is, and note their places.

    All threads come here; which number a brick gets depends on who comes first, and nothing depends on that.
    """
    ...


@wp.func
def bricks_of_round(room: Room, first: int):
    """How many bricks there are in a round of those from the ``first`` on."""
    return wp.min(word(COUNT) - first, room.capacity)


@wp.func
def node_word(room: Room, n: int):
    """Word at which node ``n`` of a round begins, eight a brick."""
    return room.bricks + NODE_WORDS * n


@wp.func
def kinematic_word(room: Room, n: int):
    """Word at which the kinematic momentum of node ``n`` of a round begins."""
    return room.kinematic + KINEMATIC_WORDS * n


@wp.func
def kinematic_of(room: Room, at: int):
    """The same of the node that begins at word ``at``."""
    return kinematic_word(room, (at - room.bricks) >> 2)


@wp.func
def clear_bricks(room: Room, first: int):
    """Zero the nodes of a round."""
    clear_words(room.bricks, BRICK_WORDS * bricks_of_round(room, first))
    clear_words(room.kinematic, KINEMATIC_BRICK_WORDS * bricks_of_round(room, first))


@wp.func
def in_marked_plane(marked: int, n: int):
    """Whether the plane of node ``n`` of a round has its bit in the ``marked`` place of the brick."""
    return (marked & (PLACES << ((n >> 2) & 1))) != 0


# of two bricks along an axis the upper one lies in the next block if the lower one is a block's second; a thread asks
# for no slot twice: reads of a warp in many places are what keeps a multiprocessor busy
_AROUND = """
const int ny = grid.blocks[1], nz = grid.blocks[2];
const int* const slots =
    &wp::index(blocks.slot, e, field * grid.num_blocks + ((base[0] >> 2) * ny + (base[1] >> 2)) * nz + (base[2] >> 2));
const bool next_x = base[0] & 2, next_y = base[1] & 2, next_z = base[2] & 2;
int asked[8] = {};
#pragma unroll
for (int b = 0; b < 8; ++b)
    if ((!(b & 4) || next_x) && (!(b & 2) || next_y) && (!(b & 1) || next_z))
        asked[b] = slots[(b & 4 ? ny * nz : 0) + (b & 2 ? nz : 0) + (b & 1)];
const int in_x = (base[0] & 2) << 1, in_y = base[1] & 2, in_z = (base[2] & 2) >> 1;
wp::vec_t<8, wp::int32> n;
#pragma unroll
for (int b = 0; b < 8; ++b) {
    if ((b & 4) && !next_x) asked[b] = asked[b ^ 4];
    else if ((b & 2) && !next_y) asked[b] = asked[b ^ 2];
    else if ((b & 1) && !next_z) asked[b] = asked[b ^ 1];
    n[b] = 8 * asked[b] + (b & 4 ? 4 - in_x : in_x) + (b & 2 ? 2 - in_y : in_y) + (b & 1 ? 1 - in_z : in_z);
}
"""


@wp.func_native(brick_native(_AROUND + "return n;", "return wp::vec_t<8, wp::int32>();"))
def places_around(grid: Grid, blocks: Blocks, e: int, field: int, base: wp.vec3i) -> vec8i:
    """Where the bricks of a stencil have their half words: 8 slot + brick in block, for x, y and z lower and upper."""
    ...


@wp.func_native(
    brick_native(
        _AROUND
        + """
const unsigned short* const number = reinterpret_cast<const unsigned short*>(room + layout.numbers);
for (int b = 0; b < 8; ++b)  // the last brick takes what is not of this round
    n[b] = layout.bricks + BRICK * (int)min((unsigned)(number[n[b]] - first), (unsigned)layout.capacity);
return n;
""",
        "return wp::vec_t<8, wp::int32>();",
    )
)
def bricks_around(grid: Grid, blocks: Blocks, layout: Room, e: int, field: int, base: wp.vec3i, first: int) -> vec8i:
    """Words at which the bricks of a stencil begin, in a round of bricks from the ``first`` on."""
    ...


@wp.func_native(
    brick_native(
        """
const int px = base[0] & 1, py = base[1] & 1, pz = base[2] & 1;
const bool far = px + i > 1, upper = py + j > 1;
const int lower_z = far ? (upper ? bricks[6] : bricks[4]) : (upper ? bricks[2] : bricks[0]);
const int upper_z = far ? (upper ? bricks[7] : bricks[5]) : (upper ? bricks[3] : bricks[1]);
const int line = ((px + i) & 1) * ALONG_X + ((py + j) & 1) * ALONG_Y;
const int second = pz ? upper_z : lower_z + ALONG_Z;
return wp::vec3i(line + lower_z + pz * ALONG_Z, line + second, line + upper_z + pz * ALONG_Z);
""",
        "return wp::vec3i();",
    )
)
def line_in_bricks(bricks: vec8i, base: wp.vec3i, i: int, j: int) -> wp.vec3i:
    """Words at which the nodes ``base + (i, j, 0..2)`` begin."""
    ...


@wp.func_native(
    brick_native(
        """
const float4 v = *reinterpret_cast<const float4*>(room + at);
return wp::vec_t<4, wp::float32>(0.0f, v.x, v.y, v.z);
""",
        "return wp::vec_t<4, wp::float32>();",
    )
)
def physical_at(at: int) -> wp.vec4:
    """Nothing, and the physical velocity of the node that begins at a word."""
    ...


@wp.func_native(
    brick_native(
        """
const float* const v = reinterpret_cast<const float*>(room + at);
return wp::vec_t<4, wp::float32>(0.0f, v[0], v[1], v[2]);
""",
        "return wp::vec_t<4, wp::float32>();",
    )
)
def kinematic_at(at: int) -> wp.vec4:
    """Nothing, and the kinematic velocity of the node that has it at a word."""
    ...


@wp.func_native(
    brick_native(
        """
const int4 v = *reinterpret_cast<const int4*>(room + at);
return wp::vec_t<4, wp::int32>(v.x, v.y, v.z, v.w);
""",
        "return wp::vec_t<4, wp::int32>();",
    )
)
def sums_at(at: int) -> wp.vec4i:
    """Mass and physical momentum of the node that begins at a word."""
    ...


@wp.func_native(
    brick_native("""
*reinterpret_cast<float4*>(room + at) = make_float4(value[1], value[2], value[3], 0.0f);
float* const k = reinterpret_cast<float*>(room + kinematic);
for (int c = 0; c < 3; ++c) k[c] = value[4 + c];
""")
)
def set_velocities(at: int, kinematic: int, value: vec8):
    """Write what :func:`physical_at` and :func:`kinematic_at` read, of one node, where its sums were."""
    ...
