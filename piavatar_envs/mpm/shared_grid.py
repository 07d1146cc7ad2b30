"""The grid of a small body in the shared memory of one CUDA block: where its nodes lie there, and how to get at them.

A small body touches two thousand nodes. They fit into the memory that a multiprocessor shares among the threads of a
CUDA block, where an integer is added a hundred times as fast as in the GPU's own. There they lie in bricks of 2 x 2 x 2
nodes, numbered anew in every substep as the particles touch them; what touches more than fit goes in several rounds.

An integer has 32 bits. Of mass they count units of 2^-27 of a field's heaviest particle, so a node may hold 16 of them;
where one gets more, the environment counts anew, eight units as one. Of momentum they count such units at a speed that
none of the field's particles exceeds, a power of two, in every substep another: so the integers are used to the full,
and what a particle adds is rounded as a floating-point number would be.

Nothing here runs on a CPU. In words of 4 bytes, the room has: a header; for every brick of every slot a half word, its
number; a bit for every particle; a byte for every slot; the bricks' own places; bricks of seven words a node.
"""

from __future__ import annotations

import warp as wp

from piavatar_envs.mpm.shared_memory import APPEND, native, word
from piavatar_envs.mpm.transfer import Scattered
from piavatar_envs.mpm.types import Blocks, Grid, Room, vec8, vec8i

wp.set_module_options({"enable_backward": False})

#: Words of a node: mass, physical and kinematic momentum; odd, for the banks.
NODE_WORDS = wp.constant(7)
#: Words of a brick of 2 x 2 x 2 nodes.
BRICK_WORDS = wp.constant(8 * NODE_WORDS)
#: Later a brick has the physical velocities of its eight nodes, in so many words each, for loads of 16 bytes; and from
#: a word on, the kinematic ones.
PHYSICAL_WORDS, KINEMATIC, KINEMATIC_WORDS = wp.constant(4), wp.constant(32), wp.constant(3)
#: Bricks of a block of 4 x 4 x 4 nodes.
BLOCK_BRICKS = wp.constant(8)
#: Words of the header: bricks in use; bits FAILURE_*; particles that tell their places; not 0 if a node holds too much;
#: units in a field's heaviest particle; how many particles are listed; and of every field, of which there are 32 at
#: most, for they are bits of a block's mask: the mass of its heaviest particle [kg], the speed of its fastest, and the
#: speed that its momenta are counted at [m/s].
HEADER = wp.constant(104)
COUNT, FAULTS, TOLD, CROWDED, UNITS, LISTED = (wp.constant(n) for n in range(6))
HEAVIEST, FASTEST, SPEED = (wp.constant(n) for n in (8, 40, 72))
#: Units of mass in a field's heaviest particle, if no node holds too much.
MOST_UNITS = wp.constant(float(2**27))
#: No brick has this number; nor this one, which those have that are to be numbered.
NO_BRICK, TOUCHED = wp.constant(0xFFFF), wp.constant(0xFFFE)
#: What a brick's place has besides its slot and its number there: a bit for each of its planes of nodes across x.
PLACES = wp.constant(0x4000)


def _native(cuda: str, otherwise: str = "") -> str:
    """A snippet that knows the header's words and the strides of the nodes of a brick."""
    z = int(NODE_WORDS)
    strides = f"constexpr int ALONG_Z = {z}, ALONG_Y = {2 * z}, ALONG_X = {4 * z}, BRICK = {8 * z};\n"
    words = f"COUNT = {int(COUNT)}, CROWDED = {int(CROWDED)}, TOUCHED = {int(TOUCHED)}, PLACES = {int(PLACES)}"
    return native(f"constexpr int {words};\n{strides}{cuda}", otherwise)


@wp.func_native(
    _native(
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
    return room.bricks + BRICK_WORDS * (n // 8) + NODE_WORDS * (n % 8)


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


@wp.func_native(_native(_AROUND + "return n;", "return wp::vec_t<8, wp::int32>();"))
def places_around(grid: Grid, blocks: Blocks, e: int, field: int, base: wp.vec3i) -> vec8i:
    """Where the bricks of a stencil have their half words: 8 slot + brick in block, for x, y and z lower and upper."""
    ...


@wp.func_native(
    _native(
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
    _native("""
const int px = s.base[0] & 1, py = s.base[1] & 1, pz = s.base[2] & 1;
const float m = s.at_base[0] * per_mass;
float q[3], k[3], along[3][3];
for (int c = 0; c < 3; ++c) {
    q[c] = s.at_base[1 + c] * per_momentum;
    k[c] = s.at_base[4 + c] * per_momentum;
    for (int d = 0; d < 3; ++d) along[c][d] = s.A.data[c][d] * per_momentum;
}
const bool driven = k[0] != 0.0f || k[1] != 0.0f || k[2] != 0.0f;
// threads that add to the same word wait for each other: neighbours, which are often in the same cell, take the nodes
// of a plane in another order
float weight_y[3], weight_z[3], at_y[3], at_z[3];
int word_y[3], word_z[3];
bool upper_y[3], upper_z[3];
int j = threadIdx.x / 3 % 3, l = threadIdx.x % 3;
for (int n = 0; n < 3; ++n) {
    weight_y[n] = j == 0 ? wy[0] : j == 1 ? wy[1] : wy[2];
    weight_z[n] = l == 0 ? wz[0] : l == 1 ? wz[1] : wz[2];
    at_y[n] = (float)j, at_z[n] = (float)l;
    word_y[n] = ((py + j) & 1) * ALONG_Y, word_z[n] = ((pz + l) & 1) * ALONG_Z;
    upper_y[n] = py + j > 1, upper_z[n] = pz + l > 1;
    j = j == 2 ? 0 : j + 1, l = l == 2 ? 0 : l + 1;
}
#pragma unroll 1
for (int i = 0; i < 3; ++i) {
    const float wi = i == 0 ? wx[0] : i == 1 ? wx[1] : wx[2];
    const bool far = px + i > 1;
    const int b00 = far ? bricks[4] : bricks[0], b01 = far ? bricks[5] : bricks[1];
    const int b10 = far ? bricks[6] : bricks[2], b11 = far ? bricks[7] : bricks[3];
    int* const plane = room + ((px + i) & 1) * ALONG_X;
    int over = 0;
#pragma unroll
    for (int j = 0; j < 3; ++j) {
        int* const line = plane + word_y[j];
        const int first = upper_y[j] ? b10 : b00, last = upper_y[j] ? b11 : b01;
        const int of_first = first == trash ? 0 : -1, of_last = last == trash ? 0 : -1;
        const float w = wi * weight_y[j];
        float at[3];
        for (int c = 0; c < 3; ++c) at[c] = q[c] + at_y[j] * along[c][1];
#pragma unroll
        for (int l = 0; l < 3; ++l) {
            int* const node = line + (upper_z[l] ? last : first) + word_z[l];
            const float wl = w * weight_z[l];
            // a sum of masses that runs over is negative for 2^31, which nobody adds at once: somebody sees it
            over |= atomicAdd(node, __float2int_rn(wl * m)) & (upper_z[l] ? of_last : of_first);
            for (int c = 0; c < 3; ++c)
                atomicAdd(node + 1 + c, __float2int_rn(wl * (at[c] + at_z[l] * along[c][2])));
            if (driven)
                for (int c = 0; c < 3; ++c) atomicAdd(node + 4 + c, __float2int_rn(wl * k[c]));
        }
    }
    if (over < 0) room[CROWDED] = 1;
    for (int c = 0; c < 3; ++c) q[c] += along[c][0];
}
""")
)
def add_to_bricks(
    bricks: vec8i,
    trash: int,
    s: Scattered,
    wx: wp.vec3,
    wy: wp.vec3,
    wz: wp.vec3,
    per_mass: float,
    per_momentum: float,
):
    """Add a particle to the 27 nodes of its stencil, in bricks that begin at those words; one may be ``trash``."""
    ...


@wp.func_native(
    _native("""
const int px = base[0] & 1, py = base[1] & 1, pz = base[2] & 1;
const float g[3] = {wx[1] + 2.0f * wx[2], wy[1] + 2.0f * wy[2], wz[1] + 2.0f * wz[2]};  // where it is, from the lowest
const float wi = i == 0 ? wx[0] : i == 1 ? wx[1] : wx[2];
for (int j = 0; j < 3; ++j)
    for (int l = 0; l < 3; ++l) {
        const int b = (px + i > 1 ? 4 : 0) + (py + j > 1 ? 2 : 0) + (pz + l > 1 ? 1 : 0);
        const int in_plane = ((py + j) & 1) * ALONG_Y + ((pz + l) & 1) * ALONG_Z;
        int* const node = room + bricks[b] + ((px + i) & 1) * ALONG_X + in_plane;
        const float m = wi * wy[j] * wz[l] * mass;
        atomicAdd(node, __float2int_rn(m * ((float)i - g[0])));
        atomicAdd(node + 1, __float2int_rn(m * ((float)j - g[1])));
        atomicAdd(node + 2, __float2int_rn(m * ((float)l - g[2])));
        atomicAdd(node + 3, __float2int_rn(m * seam));
    }
""")
)
def add_place(bricks: vec8i, base: wp.vec3i, wx: wp.vec3, wy: wp.vec3, wz: wp.vec3, i: int, mass: float, seam: float):
    """Tell plane ``i`` of a stencil where a particle is: ``w m (x_i - x_p) / dx``, and ``w m`` of a seam; in units."""
    ...


@wp.func_native(
    _native(
        """
const int px = base[0] & 1, py = base[1] & 1, pz = base[2] & 1;
const bool far = px + i > 1, upper = py + j > 1;
const int lower_z = far ? (upper ? bricks[6] : bricks[4]) : (upper ? bricks[2] : bricks[0]);
const int upper_z = far ? (upper ? bricks[7] : bricks[5]) : (upper ? bricks[3] : bricks[1]);
const int line = first + along * (4 * ((px + i) & 1) + 2 * ((py + j) & 1));
const int second = pz ? upper_z : lower_z + along;
return wp::vec3i(line + lower_z + pz * along, line + second, line + upper_z + pz * along);
""",
        "return wp::vec3i();",
    )
)
def line_in_bricks(bricks: vec8i, base: wp.vec3i, i: int, j: int, first: int, along: int) -> wp.vec3i:
    """Words of the nodes ``base + (i, j, 0..2)``, which a brick has from its word ``first``, ``along`` words each."""
    ...


@wp.func_native(
    _native(
        """
const float4 v = *reinterpret_cast<const float4*>(room + at);
return wp::vec_t<4, wp::float32>(0.0f, v.x, v.y, v.z);
""",
        "return wp::vec_t<4, wp::float32>();",
    )
)
def physical_at(at: int) -> wp.vec4:
    """Nothing, and the physical velocity of the node that has it at a word."""
    ...


@wp.func_native(
    _native(
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
    _native(f"""
float4* const v = reinterpret_cast<float4*>(room + brick + {int(PHYSICAL_WORDS)} * node);
*v = make_float4(value[1], value[2], value[3], 0.0f);
float* const k = reinterpret_cast<float*>(room + brick + {int(KINEMATIC)} + {int(KINEMATIC_WORDS)} * node);
for (int c = 0; c < 3; ++c) k[c] = value[4 + c];
""")
)
def set_velocities(brick: int, node: int, value: vec8):
    """Write what :func:`physical_at` and :func:`kinematic_at` read, of one of the eight nodes of a brick."""
    ...
