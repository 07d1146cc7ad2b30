"""What a particle adds to the nodes around it in the shared memory of a CUDA block.

The scatter of a body into the shared memory of its CUDA block: integers are added up.

Where they lie is in :mod:`piavatar_envs.mpm.cuda.block_grid`. The result does not depend on the order of the threads,
and not on how many bricks there is room for.
"""

from __future__ import annotations

import warp as wp

from piavatar_envs.core.arrays import vec8i
from piavatar_envs.core.cuda_intrinsics import meet, thread_of_block, threads_of_block
from piavatar_envs.core.shared_memory import half_word, has_bit, list_bits, number, or_word, raise_to, set_word, word
from piavatar_envs.mpm.bspline import spline
from piavatar_envs.mpm.cuda.block_grid import (
    BLOCK_BRICKS,
    BRICK_WORDS,
    COUNT,
    FASTEST,
    FAULTS,
    LISTED,
    LOST,
    LOST_UNITS,
    PLACES,
    SPEED,
    TOLD,
    brick_native,
    bricks_around,
    bricks_of_round,
    clear_bricks,
    correct_units,
    end_of_part,
    in_marked_plane,
    line_in_bricks,
    node_word,
    record_of_place,
    speed_of,
    speeds_known,
    sums_at,
    sums_hold,
    unit_of_mass,
    unit_of_place,
)
from piavatar_envs.mpm.p2g import Scattered, fault_within, momentum_bounds, moves_finitely, placed, prepare
from piavatar_envs.mpm.types import (
    FAILURE_CFL,
    FAILURE_NONFINITE,
    Blocks,
    Grid,
    Moving,
    Particles,
    Room,
    Step,
    Sums,
    row,
)

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})


# Threads that add to the same bank wait for each other. So each has an order of its own, as the bits of its particle's
# number say: two of them that of the four words of a node; one that of the nodes along each axis, first the lower or
# the upper one of a brick, then the other, and last what is left
_ADD = """
constexpr int UNIT = %(unit)d;
const int px = s.base[0] & 1, py = s.base[1] & 1, pz = s.base[2] & 1;
const int turn = p & 3, turn_x = (p >> 2 ^ px) & 1, turn_y = (p >> 3 ^ py) & 1, turn_z = (p >> 4 ^ pz) & 1;
// a word at the lowest node, and how it changes along the axes; a mass does not
float q[4] = {s.at_base[0] * per_mass}, along[4][3] = {};
for (int c = 0; c < 3; ++c) {
    q[1 + c] = s.at_base[1 + c] * per_momentum;
    for (int d = 0; d < 3; ++d) along[1 + c][d] = s.A.data[c][d] * per_momentum;
}
auto swap = [](bool yes, float& a, float& b) {
    const float first = yes ? b : a;
    b = yes ? a : b, a = first;
};
auto take_turn = [&](float& a, float& b, float& c, float& d) {  // word c ^ turn comes to be c
    swap(turn & 1, a, b), swap(turn & 1, c, d), swap(turn & 2, a, c), swap(turn & 2, b, d);
};
take_turn(q[0], q[1], q[2], q[3]);
for (int d = 0; d < 3; ++d) take_turn(along[0][d], along[1][d], along[2][d], along[3][d]);
float weight_z[3], at_z[3];
int place_z[3];
bool upper_z[3];
for (int n = 0; n < 3; ++n) {
    const int l = n < 2 ? n ^ turn_z : 2;
    weight_z[n] = l == 0 ? wz[0] : l == 1 ? wz[1] : wz[2];
    at_z[n] = (float)l, place_z[n] = UNIT * (((pz + l) & 1) * ALONG_Z + turn), upper_z[n] = pz + l > 1;
}
%(before)s
#pragma unroll %(unrolled)d
for (int n = 0; n < 3; ++n) {
    const int i = n < 2 ? n ^ turn_x : 2;
    const float wi = i == 0 ? wx[0] : i == 1 ? wx[1] : wx[2];
    const bool far = px + i > 1;
    %(plane)s
    const int plane = UNIT * ((px + i) & 1) * ALONG_X;
    const float at_x = i == 0 ? 0.0f : 1.0f;  // the last plane from the one before it
    for (int c = 0; c < 4; ++c) q[c] += i == 2 ? along[c][0] : 0.0f;
#pragma unroll %(unrolled)d
    for (int m = 0; m < 3; ++m) {
        const int j = m < 2 ? m ^ turn_y : 2;
        const bool upper = py + j > 1;
        const int line = plane + UNIT * ((py + j) & 1) * ALONG_Y;
        %(line)s
        const float w = wi * (j == 0 ? wy[0] : j == 1 ? wy[1] : wy[2]);
        float at[4];
        for (int c = 0; c < 4; ++c) at[c] = q[c] + at_x * along[c][0] + (float)j * along[c][1];
#pragma unroll
        for (int l = 0; l < 3; ++l) {
            const int node = %(node)s;  // a multiple of four words, and the turn
            const float wl = w * weight_z[l];
            for (int c = 0; c < 4; ++c) {
                int* const word = reinterpret_cast<int*>(reinterpret_cast<char*>(room) + 4 / UNIT * (node ^ UNIT * c));
                atomicAdd(word, __float2int_rn(wl * (at[c] + at_z[l] * along[c][2])));
            }
        }
    }
}
"""


def adding(unit: int, before: str, plane: str, line: str, node: str, unrolled: int) -> str:
    """The snippet that adds a particle to nodes in bricks, from its pieces.

    Args:
        unit: what places are counted in, 1 for words, 4 for bytes.
        before: what is to be known before all planes of the stencil.
        plane: what is to be known of one that lies ``far``, in the upper bricks along x, or not.
        line: what is to be known of one of its lines, in the ``upper`` bricks along y or not.
        node: the place of the first word of node ``l`` of the line.
        unrolled: planes, and lines of a plane, that the compiler writes down.
    """
    pieces = {"unit": unit, "before": before, "plane": plane, "line": line, "node": node, "unrolled": unrolled}
    return brick_native(_ADD % pieces)


@wp.func_native(
    adding(
        unit=1,
        before="",
        plane="""const int b00 = far ? bricks[4] : bricks[0], b01 = far ? bricks[5] : bricks[1];
    const int b10 = far ? bricks[6] : bricks[2], b11 = far ? bricks[7] : bricks[3];""",
        line="const int first = upper ? b10 : b00, last = upper ? b11 : b01;",
        node="line + (upper_z[l] ? last : first) + place_z[l]",
        unrolled=1,
    )
)
def add_to_bricks(
    bricks: vec8i,
    p: int,
    s: Scattered,
    wx: wp.vec3,
    wy: wp.vec3,
    wz: wp.vec3,
    per_mass: float,
    per_momentum: float,
):
    """Add mass and physical momentum of particle ``p`` to its 27 nodes, in bricks that begin at those words."""
    ...


@wp.func_native(
    brick_native("""
const int px = s.base[0] & 1, py = s.base[1] & 1, pz = s.base[2] & 1;
const float k[3] = {s.at_base[4] * per_momentum, s.at_base[5] * per_momentum, s.at_base[6] * per_momentum};
#pragma unroll 1
for (int n = 0; n < 9; ++n) {
    const int i = n / 3, j = n % 3;
    const bool far = px + i > 1, upper = py + j > 1;
    const int first = far ? (upper ? bricks[6] : bricks[4]) : (upper ? bricks[2] : bricks[0]);
    const int last = far ? (upper ? bricks[7] : bricks[5]) : (upper ? bricks[3] : bricks[1]);
    const int line = ((px + i) & 1) * ALONG_X + ((py + j) & 1) * ALONG_Y;
    const float w = (i == 0 ? wx[0] : i == 1 ? wx[1] : wx[2]) * (j == 0 ? wy[0] : j == 1 ? wy[1] : wy[2]);
    for (int l = 0; l < 3; ++l) {
        const int node = line + (pz + l > 1 ? last : first) + ((pz + l) & 1) * ALONG_Z;
        for (int c = 0; c < 3; ++c)
            atomicAdd(room + kinematic_of(layout, node) + c, __float2int_rn(w * wz[l] * k[c]));
    }
}
""")
)
def add_kinematic(
    layout: Room, bricks: vec8i, s: Scattered, wx: wp.vec3, wy: wp.vec3, wz: wp.vec3, per_momentum: float
):
    """Add the kinematic momentum of a particle; few have one, so this is as short as can be."""
    ...


@wp.func
def share_of_round(room: Room, bricks: vec8i, base: wp.vec3i, wx: wp.vec3, wy: wp.vec3, wz: wp.vec3):
    """Share of a particle that its nodes in bricks of this round get."""
    share = float(0.0)
    lines = int(9)
    for n in range(lines):
        at = line_in_bricks(bricks, base, n // 3, n % 3)
        for l in range(3):
            if at[l] < room.bricks + BRICK_WORDS * room.capacity:
                share += wx[n // 3] * wy[n % 3] * wz[l]
    return share


@wp.func_native(
    brick_native("""
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


_CFL = wp.constant(FAILURE_CFL)
_NONFINITE = wp.constant(FAILURE_NONFINITE)
#: A particle that goes or is driven further than this in a substep [grid spacings] has failed, and is not added up.
MOST_CELLS = wp.constant(8.0)


@wp.func
def scatter_place(
    grid: Grid,
    particles: Particles,
    blocks: Blocks,
    room: Room,
    e: int,
    p: int,
    plane: int,
    first: int,
    x: wp.array2d(dtype=wp.vec3),
):
    """Where a particle is, to the bricks that a plane of its stencil is in."""
    field = particles.field[p]
    s = placed(grid, x[e, p])
    m = particles.mass[row(e, particles.mass.shape[0]), p] / unit_of_place(field)
    n = bricks_around(grid, blocks, room, e, field, s.base, first)
    add_place(n, s.base, spline(s.f[0]), spline(s.f[1]), spline(s.f[2]), plane, m, particles.seam[p])


@wp.func
def scatter_places(
    grid: Grid,
    particles: Particles,
    blocks: Blocks,
    room: Room,
    e: int,
    part: wp.vec3i,
    first: int,
    x: wp.array2d(dtype=wp.vec3),
    # out
    sums: Sums,
):
    """Where particles are, to the nodes' offsets, from those that tell it; the bricks are left clear.

    Where there is one field, only nodes near a boundary are told; the grid pass forgets what they have been told.
    """
    t = thread_of_block()
    several = room.speed.shape[1] > 1
    clear_bricks(room, first)
    meet()
    # they are few, and would leave most threads of many warps idle: where there is room behind the bricks, they are
    # listed, which is in one round only, for all but the last are full
    listed = room.bricks + BRICK_WORDS * bricks_of_round(room, first)
    if word(TOLD) <= 2 * (room.bricks + BRICK_WORDS * room.capacity - listed):
        list_bits(room.told, room.near - room.told, listed, LISTED)
        meet()
        for n in range(t, 3 * word(TOLD), threads_of_block()):
            scatter_place(grid, particles, blocks, room, e, half_word(listed, n // 3), n % 3, first, x)
    else:
        for n in range(3 * part[0] + t, 3 * part[1], threads_of_block()):
            if has_bit(room.told, n // 3):
                scatter_place(grid, particles, blocks, room, e, n // 3, n % 3, first, x)
    meet()
    for n in range(t, 8 * bricks_of_round(room, first), threads_of_block()):
        at = node_word(room, n)
        told = sums_at(at)
        if told[0] != 0 or told[1] != 0 or told[2] != 0 or told[3] != 0:
            marked = half_word(room.places, first + n // 8)
            place = marked % PLACES
            if several or in_marked_plane(marked, n):
                f = int(0)
                if several:
                    f = blocks.held[e, place // BLOCK_BRICKS] // grid.num_blocks
                unit = unit_of_place(f)
                o = (grid.dx * unit) * wp.vec3(float(told[0]), float(told[1]), float(told[2]))
                sums.offset[e, record_of_place(place, n % 8)] = wp.vec4(o[0], o[1], o[2], unit * float(told[3]))
            for c in range(4):
                set_word(at + c, 0)
    meet()


@wp.func
def scatter_momenta(
    grid: Grid,
    step: Step,
    particles: Particles,
    moving: Moving,
    blocks: Blocks,
    room: Room,
    sums: Sums,
    failure: wp.array(dtype=int),
    e: int,
    part: wp.vec3i,
    first: int,
    adds: bool,
    clears: bool,
):
    """Find the fastest particle of every field, and where it ``adds``, add masses and momenta of all to the bricks.

    Returns the mass that the particles of a thread give [LOST_UNITS].
    """
    t = thread_of_block()
    given = int(0)
    if t == 0:
        set_word(LOST, 0)
    if t < room.speed.shape[1]:
        set_word(FASTEST + t, 0)
    if clears:
        clear_bricks(room, first)
    meet()
    for p in range(part[0] + t, end_of_part(blocks, failure, e, part), threads_of_block()):
        field = particles.field[p]
        s = prepare(grid, step, particles, moving, e, p, has_bit(room.told, p))  # asks for all that it needs at once
        if moves_finitely(moving, e, p):
            bounds = momentum_bounds(s)
            unit = sums.momentum_unit[row(e, sums.momentum_unit.shape[0]), field]
            fault = fault_within(s, bounds, unit)
            speed = speed_of(s, wp.max(bounds))
            if fault != 0:
                wp.atomic_or(failure, e, fault)
                or_word(FAULTS, fault)
            elif speed * step.dt > MOST_CELLS * grid.dx:  # it would blur the sums of the others
                wp.atomic_or(failure, e, _CFL)
            else:
                raise_to(FASTEST + field, speed)
                if adds:
                    n = bricks_around(grid, blocks, room, e, field, s.base, first)
                    per_mass = 1.0 / unit_of_mass(field)
                    per_momentum = per_mass / number(SPEED + field)
                    wx = spline(s.f[0])
                    wy = spline(s.f[1])
                    wz = spline(s.f[2])
                    if s.at_base[4] != 0.0 or s.at_base[5] != 0.0 or s.at_base[6] != 0.0:
                        add_kinematic(room, n, s, wx, wy, wz, per_momentum)
                    units = s.at_base[0] * per_mass
                    if word(COUNT) > room.capacity:
                        units *= share_of_round(room, n, s.base, wx, wy, wz)
                    given += int(units) // LOST_UNITS
                    add_to_bricks(n, p, s, wx, wy, wz, per_mass, per_momentum)
        else:
            wp.atomic_or(failure, e, _NONFINITE)
            or_word(FAULTS, _NONFINITE)
    meet()
    return given


@wp.func
def scatter_round(
    grid: Grid,
    step: Step,
    particles: Particles,
    moving: Moving,
    blocks: Blocks,
    room: Room,
    sums: Sums,
    failure: wp.array(dtype=int),
    e: int,
    part: wp.vec3i,
    first: int,
    clear: bool,
):
    """Sums of the bricks from the ``first`` on, in units that hold. The bricks may be ``clear``."""
    hold = bool(False)
    unused = bool(clear)
    while not hold:
        adds = speeds_known(room, part)
        clears = adds and not unused
        given = scatter_momenta(
            grid, step, particles, moving, blocks, room, sums, failure, e, part, first, adds, clears
        )
        unused = unused and not adds
        hold = sums_hold(room, part, first, given)
        if not hold:
            correct_units(room, part)
