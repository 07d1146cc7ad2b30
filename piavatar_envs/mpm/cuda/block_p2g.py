"""P2G into the shared memory of a CUDA block, with integer sums.

The layout is in :mod:`piavatar_envs.mpm.cuda.block_grid`. The result depends neither on the order of the threads nor on
the number of subblocks that fit.
"""

from __future__ import annotations

import warp as wp

from piavatar_envs.core.arrays import vec8i
from piavatar_envs.core.cuda_intrinsics import sync_block, thread_of_block, threads_of_block
from piavatar_envs.core.shared_memory import (
    float_word,
    half_word,
    has_bit,
    list_bits,
    max_float_word,
    or_word,
    set_word,
    word,
)
from piavatar_envs.mpm.bspline import spline
from piavatar_envs.mpm.cuda.block_grid import (
    BLOCK_SUBBLOCKS,
    COUNT,
    FASTEST,
    FAULTS,
    LISTED,
    LOST,
    LOST_QUANTA,
    NUM_CANDIDATES,
    PLACES,
    SPEED,
    SUBBLOCK_WORDS,
    clear_subblocks,
    end_of_partition,
    in_flagged_plane,
    line_in_subblocks,
    mass_quantum_of,
    node_word,
    offset_quantum_of,
    quanta_suffice,
    record_of_place,
    rescale_quanta,
    speed_of,
    speeds_known,
    subblock_native,
    subblocks_around,
    subblocks_of_round,
    sums_at,
)
from piavatar_envs.mpm.p2g import (
    MOST_CELLS,
    Deposit,
    deposit_of,
    empty_deposit,
    fault_within,
    has_finite_velocity,
    momentum_bounds,
)
from piavatar_envs.mpm.types import (
    FAILURE_CFL,
    FAILURE_NONFINITE,
    Accumulators,
    Arena,
    Blocks,
    Grid,
    Moving,
    Particles,
    Step,
    row,
)

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})

_CFL = wp.constant(FAILURE_CFL)
_NONFINITE = wp.constant(FAILURE_NONFINITE)


# Additions to the same bank conflict. So each thread has its own order, from the bits of its particle's index: two bits
# for the four words of a node, and one for each axis, which selects the lower or the upper node of a subblock first
_ADD = """
constexpr int UNIT = %(scale)d;
const int px = s.base[0] & 1, py = s.base[1] & 1, pz = s.base[2] & 1;
const int order = p & 3, order_x = (p >> 2 ^ px) & 1, order_y = (p >> 3 ^ py) & 1, order_z = (p >> 4 ^ pz) & 1;
// a word at the lowest node, and its change along the axes; a mass does not change
float q[4] = {s.at_base[0] * per_mass}, along[4][3] = {};
for (int c = 0; c < 3; ++c) {
    q[1 + c] = s.at_base[1 + c] * per_momentum;
    for (int d = 0; d < 3; ++d) along[1 + c][d] = s.A.data[c][d] * per_momentum;
}
auto swap = [](bool yes, float& a, float& b) {
    const float first = yes ? b : a;
    b = yes ? a : b, a = first;
};
auto permute = [&](float& a, float& b, float& c, float& d) {  // word c ^ order comes to be c
    swap(order & 1, a, b), swap(order & 1, c, d), swap(order & 2, a, c), swap(order & 2, b, d);
};
permute(q[0], q[1], q[2], q[3]);
for (int d = 0; d < 3; ++d) permute(along[0][d], along[1][d], along[2][d], along[3][d]);
float weight_z[3], at_z[3];
int place_z[3];
bool upper_z[3];
for (int n = 0; n < 3; ++n) {
    const int l = n < 2 ? n ^ order_z : 2;
    weight_z[n] = l == 0 ? wz[0] : l == 1 ? wz[1] : wz[2];
    at_z[n] = (float)l, place_z[n] = UNIT * (((pz + l) & 1) * ALONG_Z + order), upper_z[n] = pz + l > 1;
}
%(before)s
#pragma unroll %(unrolled)d
for (int n = 0; n < 3; ++n) {
    const int i = n < 2 ? n ^ order_x : 2;
    const float wi = i == 0 ? wx[0] : i == 1 ? wx[1] : wx[2];
    const bool far = px + i > 1;
    %(plane)s
    const int plane = UNIT * ((px + i) & 1) * ALONG_X;
    const float at_x = i == 0 ? 0.0f : 1.0f;  // the last plane from the one before it
    for (int c = 0; c < 4; ++c) q[c] += i == 2 ? along[c][0] : 0.0f;
#pragma unroll %(unrolled)d
    for (int m = 0; m < 3; ++m) {
        const int j = m < 2 ? m ^ order_y : 2;
        const bool upper = py + j > 1;
        const int line = plane + UNIT * ((py + j) & 1) * ALONG_Y;
        %(line)s
        const float w = wi * (j == 0 ? wy[0] : j == 1 ? wy[1] : wy[2]);
        float at[4];
        for (int c = 0; c < 4; ++c) at[c] = q[c] + at_x * along[c][0] + (float)j * along[c][1];
#pragma unroll
        for (int l = 0; l < 3; ++l) {
            const int node = %(node)s;  // a multiple of four words, and the order
            const float wl = w * weight_z[l];
            for (int c = 0; c < 4; ++c) {
                int* const word = reinterpret_cast<int*>(reinterpret_cast<char*>(arena) + 4 / UNIT * (node ^ UNIT * c));
                atomicAdd(word, __float2int_rn(wl * (at[c] + at_z[l] * along[c][2])));
            }
        }
    }
}
"""


def adding(scale: int, before: str, plane: str, line: str, node: str, unrolled: int) -> str:
    """Return the snippet that adds a particle to nodes in subblocks, from its pieces.

    Args:
        scale: unit of addresses: 1 for words, 4 for bytes.
        before: statement before all planes of the stencil.
        plane: statement for a plane, which lies ``far``, in the upper subblocks along x, or not.
        line: statement for one of its lines, in the ``upper`` subblocks along y or not.
        node: address of the first word of node ``l`` of the line.
        unrolled: planes, and lines of a plane, that the compiler unrolls.
    """
    pieces = {"scale": scale, "before": before, "plane": plane, "line": line, "node": node, "unrolled": unrolled}
    return subblock_native(_ADD % pieces)


@wp.func_native(
    adding(
        scale=1,
        before="",
        plane="""const int b00 = far ? subblocks[4] : subblocks[0], b01 = far ? subblocks[5] : subblocks[1];
    const int b10 = far ? subblocks[6] : subblocks[2], b11 = far ? subblocks[7] : subblocks[3];""",
        line="const int first = upper ? b10 : b00, last = upper ? b11 : b01;",
        node="line + (upper_z[l] ? last : first) + place_z[l]",
        unrolled=1,
    )
)
def add_to_subblocks(
    subblocks: vec8i,
    p: int,
    s: Deposit,
    wx: wp.vec3,
    wy: wp.vec3,
    wz: wp.vec3,
    per_mass: float,
    per_momentum: float,
):
    """Add mass and physical momentum of particle ``p`` to its 27 nodes, in subblocks that begin at those words."""
    ...


@wp.func_native(
    subblock_native("""
const int px = s.base[0] & 1, py = s.base[1] & 1, pz = s.base[2] & 1;
const float k[3] = {s.at_base[4] * per_momentum, s.at_base[5] * per_momentum, s.at_base[6] * per_momentum};
#pragma unroll 1
for (int n = 0; n < 9; ++n) {
    const int i = n / 3, j = n % 3;
    const bool far = px + i > 1, upper = py + j > 1;
    const int first = far ? (upper ? subblocks[6] : subblocks[4]) : (upper ? subblocks[2] : subblocks[0]);
    const int last = far ? (upper ? subblocks[7] : subblocks[5]) : (upper ? subblocks[3] : subblocks[1]);
    const int line = ((px + i) & 1) * ALONG_X + ((py + j) & 1) * ALONG_Y;
    const float w = (i == 0 ? wx[0] : i == 1 ? wx[1] : wx[2]) * (j == 0 ? wy[0] : j == 1 ? wy[1] : wy[2]);
    for (int l = 0; l < 3; ++l) {
        const int node = line + (pz + l > 1 ? last : first) + ((pz + l) & 1) * ALONG_Z;
        for (int c = 0; c < 3; ++c)
            atomicAdd(arena + kinematic_of(layout, node) + c, __float2int_rn(w * wz[l] * k[c]));
    }
}
""")
)
def add_kinematic(
    layout: Arena, subblocks: vec8i, s: Deposit, wx: wp.vec3, wy: wp.vec3, wz: wp.vec3, per_momentum: float
):
    """Add the kinematic momentum of a particle; compact code, because few particles have one."""
    ...


@wp.func
def share_of_round(arena: Arena, subblocks: vec8i, base: wp.vec3i, wx: wp.vec3, wy: wp.vec3, wz: wp.vec3):
    """Return the share of a particle that its nodes in subblocks of this round get."""
    share = float(0.0)
    lines = int(9)
    for n in range(lines):
        at = line_in_subblocks(subblocks, base, n // 3, n % 3)
        for l in range(3):
            if at[l] < arena.subblocks + SUBBLOCK_WORDS * arena.capacity:
                share += wx[n // 3] * wy[n % 3] * wz[l]
    return share


@wp.func_native(
    subblock_native("""
const int px = base[0] & 1, py = base[1] & 1, pz = base[2] & 1;
const float g[3] = {wx[1] + 2.0f * wx[2], wy[1] + 2.0f * wy[2], wz[1] + 2.0f * wz[2]};  // where it is, from the lowest
const float wi = i == 0 ? wx[0] : i == 1 ? wx[1] : wx[2];
for (int j = 0; j < 3; ++j)
    for (int l = 0; l < 3; ++l) {
        const int b = (px + i > 1 ? 4 : 0) + (py + j > 1 ? 2 : 0) + (pz + l > 1 ? 1 : 0);
        const int in_plane = ((py + j) & 1) * ALONG_Y + ((pz + l) & 1) * ALONG_Z;
        int* const node = arena + subblocks[b] + ((px + i) & 1) * ALONG_X + in_plane;
        const float m = wi * wy[j] * wz[l] * mass;
        atomicAdd(node, __float2int_rn(m * ((float)i - g[0])));
        atomicAdd(node + 1, __float2int_rn(m * ((float)j - g[1])));
        atomicAdd(node + 2, __float2int_rn(m * ((float)l - g[2])));
        atomicAdd(node + 3, __float2int_rn(m * seam));
    }
""")
)
def add_place(
    subblocks: vec8i, base: wp.vec3i, wx: wp.vec3, wy: wp.vec3, wz: wp.vec3, i: int, mass: float, seam: float
):
    """Add offsets ``w m (x_i - x_p) / dx`` and a seam's ``w m`` to plane ``i`` of a contact candidate's stencil."""
    ...


@wp.func
def add_particle_offset(
    grid: Grid,
    particles: Particles,
    blocks: Blocks,
    arena: Arena,
    e: int,
    p: int,
    plane: int,
    first: int,
    x: wp.array2d(dtype=wp.vec3),
):
    """Add the offsets of particle ``p`` to the subblocks of a plane of its stencil."""
    field = particles.field[p]
    s = empty_deposit(grid, x[e, p])
    m = particles.mass[row(e, particles.mass.shape[0]), p] / offset_quantum_of(field)
    n = subblocks_around(grid, blocks, arena, e, field, s.base, first)
    add_place(n, s.base, spline(s.f[0]), spline(s.f[1]), spline(s.f[2]), plane, m, particles.seam[p])


@wp.func
def add_offsets(
    grid: Grid,
    particles: Particles,
    blocks: Blocks,
    arena: Arena,
    e: int,
    partition: wp.vec3i,
    first: int,
    x: wp.array2d(dtype=wp.vec3),
    # out
    accumulators: Accumulators,
):
    """Add the offsets of all contact candidates to the nodes' accumulators; clears the subblocks before and after.

    With a single field only nodes near colliders receive them; the grid update clears them.
    """
    t = thread_of_block()
    several = arena.speed.shape[1] > 1
    clear_subblocks(arena, first)
    sync_block()
    # candidates are few and would leave most threads of many warps idle: they are listed behind the subblocks where
    # memory is left, which is in the last round only
    listed = arena.subblocks + SUBBLOCK_WORDS * subblocks_of_round(arena, first)
    if word(NUM_CANDIDATES) <= 2 * (arena.subblocks + SUBBLOCK_WORDS * arena.capacity - listed):
        list_bits(arena.candidates, arena.near - arena.candidates, listed, LISTED)
        sync_block()
        for n in range(t, 3 * word(NUM_CANDIDATES), threads_of_block()):
            add_particle_offset(grid, particles, blocks, arena, e, half_word(listed, n // 3), n % 3, first, x)
    else:
        for n in range(3 * partition[0] + t, 3 * partition[1], threads_of_block()):
            if has_bit(arena.candidates, n // 3):
                add_particle_offset(grid, particles, blocks, arena, e, n // 3, n % 3, first, x)
    sync_block()
    for n in range(t, 8 * subblocks_of_round(arena, first), threads_of_block()):
        at = node_word(arena, n)
        candidates = sums_at(at)
        if candidates[0] != 0 or candidates[1] != 0 or candidates[2] != 0 or candidates[3] != 0:
            flagged = half_word(arena.places, first + n // 8)
            place = flagged % PLACES
            if several or in_flagged_plane(flagged, n):
                f = int(0)
                if several:
                    f = blocks.owner[e, place // BLOCK_SUBBLOCKS] // grid.num_blocks
                quantum = offset_quantum_of(f)
                o = (grid.dx * quantum) * wp.vec3(float(candidates[0]), float(candidates[1]), float(candidates[2]))
                accumulators.offset[e, record_of_place(place, n % 8)] = wp.vec4(
                    o[0], o[1], o[2], quantum * float(candidates[3])
                )
            for c in range(4):
                set_word(at + c, 0)
    sync_block()


@wp.func
def add_momenta(
    grid: Grid,
    step: Step,
    particles: Particles,
    moving: Moving,
    blocks: Blocks,
    arena: Arena,
    accumulators: Accumulators,
    failure: wp.array(dtype=int),
    e: int,
    partition: wp.vec3i,
    first: int,
    adds: bool,
    clears: bool,
):
    """Find the fastest particle of every field and, if it ``adds``, add masses and momenta of all to the subblocks.

    Returns the mass that the particles of a thread give [LOST_QUANTA].
    """
    t = thread_of_block()
    given = int(0)
    if t == 0:
        set_word(LOST, 0)
    if t < arena.speed.shape[1]:
        set_word(FASTEST + t, 0)
    if clears:
        clear_subblocks(arena, first)
    sync_block()
    for p in range(partition[0] + t, end_of_partition(blocks, failure, e, partition), threads_of_block()):
        field = particles.field[p]
        s = deposit_of(grid, step, particles, moving, e, p, has_bit(arena.candidates, p))  # all loads at once
        if has_finite_velocity(moving, e, p):
            bounds = momentum_bounds(s)
            quantum = accumulators.momentum_quantum[row(e, accumulators.momentum_quantum.shape[0]), field]
            fault = fault_within(s, bounds, quantum)
            speed = speed_of(s, wp.max(bounds))
            if fault != 0:
                wp.atomic_or(failure, e, fault)
                or_word(FAULTS, fault)
            elif speed * step.dt > MOST_CELLS * grid.dx:  # its quanta would be too coarse for the others
                wp.atomic_or(failure, e, _CFL)
            else:
                max_float_word(FASTEST + field, speed)
                if adds:
                    n = subblocks_around(grid, blocks, arena, e, field, s.base, first)
                    per_mass = 1.0 / mass_quantum_of(field)
                    per_momentum = per_mass / float_word(SPEED + field)
                    wx = spline(s.f[0])
                    wy = spline(s.f[1])
                    wz = spline(s.f[2])
                    if s.at_base[4] != 0.0 or s.at_base[5] != 0.0 or s.at_base[6] != 0.0:
                        add_kinematic(arena, n, s, wx, wy, wz, per_momentum)
                    units = s.at_base[0] * per_mass
                    if word(COUNT) > arena.capacity:
                        units *= share_of_round(arena, n, s.base, wx, wy, wz)
                    given += int(units) // LOST_QUANTA
                    add_to_subblocks(n, p, s, wx, wy, wz, per_mass, per_momentum)
        else:
            wp.atomic_or(failure, e, _NONFINITE)
            or_word(FAULTS, _NONFINITE)
    sync_block()
    return given


@wp.func
def p2g_round(
    grid: Grid,
    step: Step,
    particles: Particles,
    moving: Moving,
    blocks: Blocks,
    arena: Arena,
    accumulators: Accumulators,
    failure: wp.array(dtype=int),
    e: int,
    partition: wp.vec3i,
    first: int,
    clear: bool,
):
    """Sum the subblocks from ``first`` on, with quanta that suffice. The subblocks may be ``clear``."""
    hold = bool(False)
    unused = bool(clear)
    while not hold:
        adds = speeds_known(arena, partition)
        clears = adds and not unused
        given = add_momenta(
            grid, step, particles, moving, blocks, arena, accumulators, failure, e, partition, first, adds, clears
        )
        unused = unused and not adds
        hold = quanta_suffice(arena, partition, first, given)
        if not hold:
            rescale_quanta(arena, partition)
