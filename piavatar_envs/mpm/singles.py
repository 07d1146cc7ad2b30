"""The scatter of a GPU for large bodies of few particles a cell, skins for example: each goes to the nodes by itself.

Groups of particles, see :mod:`piavatar_envs.mpm.groups`, take time to find out which nodes they have in common. Where
these are few, memory is faster asked for all additions. A particle has eight threads here, four in some relays (see
:mod:`piavatar_envs.mpm.carry`), all of which know what it scatters. Each looks one or two of the eight blocks up that
its stencil may lie in, and to every node four add together, one of four numbers each: 32 bytes, which memory takes at a
time. What is added are integers: runs repeat bit for bit.
"""

from __future__ import annotations

from typing import Any

import warp as wp

from piavatar_envs.mpm.program import Program
from piavatar_envs.mpm.runs import KINEMATIC, MOMENTUM, PLACE, bounded, told_by
from piavatar_envs.mpm.shared_memory import native
from piavatar_envs.mpm.stencil import BLOCK_NODES, base_node, block_index, grid_position, spline
from piavatar_envs.mpm.sweep import any_lane, lane_of_thread
from piavatar_envs.mpm.threads import environment_of
from piavatar_envs.mpm.transfer import Scattered, admitted, moves_finitely, near_boundary, prepare, takes_part
from piavatar_envs.mpm.types import (
    PAPER,
    Blocks,
    Boundaries,
    Contact,
    Grid,
    Moving,
    Particles,
    Step,
    Sums,
    row,
)

# divisions and roots to two units in the last place, and logarithms to 4e-7, in a few instructions instead of calls
wp.set_module_options({"enable_backward": False, "default_grid_stride": False, "fast_math": True})

#: Threads of a particle in the scatter alone. Teams of eight and of four are known, see :mod:`piavatar_envs.mpm.team`;
#: here four, eight of which add the particles of both in turn, need fewer instructions and more time.
TEAM = wp.constant(8)
#: Particles of a warp.
SHARE = wp.constant(32 // int(TEAM))
#: Threads of a CUDA block.
THREADS = 128


@wp.func
def place_of_block(team: int, n: int):
    """Which one of eight blocks is the ``n``-th that a thread looks up: bits for the upper along x, y and z."""
    return (lane_of_thread() & (team - 1)) + team * n


@wp.func
def block_of_thread(team: int, grid: Grid, base: wp.vec3i, n: int):
    """The ``n``-th that a thread looks up, of the eight blocks that the stencil at ``base`` may lie in.

    :func:`place_of_block` says which, by the thread's place in its ``team``; where the stencil lies in one block along
    an axis, that is the lower. It exists also where a particle is outside the grid, and takes no part.
    """
    upper = place_of_block(team, n)
    i = base[0] + 2 * ((upper >> 2) & 1)
    j = base[1] + (upper & 2)
    return wp.clamp(block_index(grid, i, j, base[2] + 2 * (upper & 1)), 0, grid.num_blocks - 1)


@wp.func
def slots_of_thread(team: int, grid: Grid, blocks: Blocks, e: int, f: int, base: wp.vec3i):
    """Slots of field ``f`` in the blocks that a thread looks up: one, or two in a ``team`` of four."""
    slots = wp.vec2i(blocks.slot[e, f * grid.num_blocks + block_of_thread(team, grid, base, 0)], 0)
    if team == 4:
        slots = wp.vec2i(slots[0], blocks.slot[e, f * grid.num_blocks + block_of_thread(team, grid, base, 1)])
    return slots


@wp.func_native(
    native(
        "return (__ballot_sync(0xffffffffu, here) >> (threadIdx.x & 32 - team) & (1u << team) - 1u) != 0u;",
        "return here;",
    )
)
def any_of_team(team: int, here: bool) -> bool:
    """Whether it is so ``here`` in any thread of a particle's; all of the warp come here."""
    ...


@wp.func_native(
    native(f"""
constexpr unsigned ALL = 0xffffffffu;
if (!__any_sync(ALL, takes)) return;
const int lane = threadIdx.x & 31, c = lane & 3;  // of the four numbers
const bool is_second = lane & team - 1 & 4;  // of two who add up one number, on every other line of nodes
const bool is_place = kind == {int(PLACE)}, is_fixed = sums.is_fixed != 0;
// units are powers of two: one over them is exact, however the module divides
auto per = [](float unit) {{ return __int_as_float(0x7f000000 - __float_as_int(unit)); }};
float scale = is_place && c > 0 ? grid.dx : 1.0f, massive = 1.0f;
if (is_fixed) scale = per(c == 0 || is_place ? units[0] : units[1]), massive = per(units[0]) * mass;
float value = s[0], along_x = 0.0f, along_y = 0.0f, along_z = 0.0f;
#pragma unroll
for (int n = 1; n < 4; ++n)
    if (c == n) value = s[n], along_x = A.data[n - 1][0], along_y = A.data[n - 1][1], along_z = A.data[n - 1][2];
if (!takes) value = along_x = along_y = along_z = massive = 0.0f;
value *= scale, along_x *= scale, along_y *= scale, along_z *= scale;
const int word = kind == {int(MOMENTUM)} ? c : c + 3 & 3;  // a vector begins where the mass was, if there is none
const void* records_at = &wp::index(sums.value, is_fixed ? 0 : e, 0);
if (is_fixed) records_at = &wp::index(sums.fixed, e, 0);
if (is_place) records_at = &wp::index(sums.offset, is_fixed ? 0 : e, 0);
if (is_place && is_fixed) records_at = &wp::index(sums.offset_fixed, e, 0);
const size_t to = __cvta_generic_to_global(records_at) + (is_fixed ? 8 : 4) * word
    + (kind == {int(KINEMATIC)} ? 64 * (is_fixed ? 32 : 16) : 0);
const int size = is_fixed ? 32 : 16;  // from a node to the next of a block [bytes]
const int blocks_apart = is_place ? 1 : 2;  // the halves of records lie apart
struct Fixed {{ enum {{ FIXED = 1 }}; }};
struct Floating {{ enum {{ FIXED = 0 }}; }};
int bx = base[0] & 3;
const int by = base[1] & 3, bz = base[2] & 3;
wp::vec_t<3, wp::float32> x = wx;
if (team == 4) {{  // or a compiler keeps the nodes and weights of all kinds, for which there are too few registers
    asm volatile("" : "+r"(bx));
    asm volatile("" : "+f"(x[0]));
    asm volatile("" : "+f"(x[1]));
    asm volatile("" : "+f"(x[2]));
}}
int lower[4], upper[4];  // of the threads that have looked them up
#pragma unroll
for (int n = 0; n < 4; ++n) {{
    lower[n] = blocks_apart * __shfl_sync(ALL, record[0], lane & 32 - team | n);
    upper[n] = blocks_apart * __shfl_sync(ALL, team == 4 ? record[1] : record[0], lane & 32 - team | team - 1 & 4 | n);
}}
auto add = [&](auto sum) {{
    constexpr bool FIXED = decltype(sum)::FIXED;
#pragma unroll
    for (int first = 0; first < 9; ++first) {{
        if (team == 8 && first % 2 != 0) continue;  // the second of the two has it
        if (first == 8 && is_second) break;
        const int second = first < 8 ? first + 1 : first;
        const int i = is_second ? second / 3 : first / 3, j = is_second ? second % 3 : first % 3;
        const float w_line = is_second ? x[second / 3] * wy[second % 3] : x[first / 3] * wy[first % 3];
        const float line = value + (float)i * along_x + (float)j * along_y;
        const bool is_upper = bx + i > 3, is_far = by + j > 3;
        const int in_block = 16 * (bx + i & 3) + 4 * (by + j & 3);
        const int near = (is_far ? (is_upper ? upper[2] : lower[2]) : (is_upper ? upper[0] : lower[0])) + in_block;
        const int next = (is_far ? (is_upper ? upper[3] : lower[3]) : (is_upper ? upper[1] : lower[1])) + in_block;
#pragma unroll
        for (int l = 0; l < 3; ++l) {{
            const float w = w_line * wz[l], number = w * (l == 0 ? line : line + l * along_z);
            size_t node;
            asm("mad.wide.s32 %0, %1, %2, %3;"
                : "=l"(node) : "r"((bz + l > 3 ? next : near) + (bz + l & 3)), "r"(size), "l"(to));
            if (FIXED) {{
                // who adds no mass adds nothing
                const long long added = w * massive > 0.5f ? __float2ll_rn(number) : 0ll;
                asm volatile("red.global.add.u64 [%0], %1;" :: "l"(node), "l"(added) : "memory");
            }} else if (massive > 0.0f)
                asm volatile("red.global.add.f32 [%0], %1;" :: "l"(node), "f"(number) : "memory");
        }}
    }}
}};
if (is_fixed) add(Fixed());
else add(Floating());
""")
)
def add_to_nodes(
    team: int,
    grid: Grid,
    sums: Sums,
    e: int,
    takes: bool,
    kind: int,
    base: wp.vec3i,
    wx: wp.vec3,
    wy: wp.vec3,
    wz: wp.vec3,
    s: wp.vec4,
    A: wp.mat33,
    mass: float,
    record: wp.vec2i,
    units: wp.vec2,
):
    """Add a scalar and a vector to the 27 nodes of a stencil, ``s`` at the lowest node, the latter changing by ``A``.

    ``record`` are the first of :func:`slots_of_thread`, ``units`` are of mass and of momentum. All threads of a warp
    come here.
    """
    ...


@wp.func
def add_single(
    team: int,
    grid: Grid,
    step: Step,
    particles: Particles,
    sums: Sums,
    e: int,
    p: int,
    x: wp.vec3,
    vk: wp.vec3,
    takes: bool,
    tells: bool,
    record: wp.vec2i,
    units: wp.vec2,
    momentum: Scattered,
):
    """Add to the nodes what particle ``p`` scatters, if it ``takes`` part: its mass and ``momentum``, what it tells.

    All threads of a warp come here, ``record`` and ``units`` as for :func:`add_to_nodes`: all threads of a particle
    take part or none, and their records exist even where they do not.
    """
    mass = momentum.at_base[0]
    kind = int(KINEMATIC)
    adds = takes and (tells or step.decoupling == PAPER)  # which needs that gradient everywhere
    while any_lane(adds):
        add_one(team, grid, sums, e, adds, kind, told_by(grid, particles, e, p, x, vk, kind), mass, record, units)
        kind += 1
        adds = takes and tells and kind <= PLACE
        if adds:
            sums.told[e, record[0] // BLOCK_NODES] = 1
            if team == 4:
                sums.told[e, record[1] // BLOCK_NODES] = 1
    # comes last: what a thread reads after its additions waits for them
    add_one(team, grid, sums, e, takes, MOMENTUM, momentum, mass, record, units)


@wp.func
def add_one(
    team: int,
    grid: Grid,
    sums: Sums,
    e: int,
    takes: bool,
    kind: int,
    s: Scattered,
    mass: float,
    record: wp.vec2i,
    units: wp.vec2,
):
    """:func:`add_to_nodes` of what a particle scatters of a ``kind``."""
    at_base = wp.vec4(s.at_base[0], s.at_base[1], s.at_base[2], s.at_base[3])
    add_to_nodes(
        team, grid, sums, e, takes, kind, s.base, spline(s.f[0]), spline(s.f[1]), spline(s.f[2]), at_base, s.A, mass,
        record, units,
    )  # fmt: skip


@wp.func
def fits(
    grid: Grid,
    particles: Particles,
    e: int,
    p: int,
    x: wp.vec3,
    vk: wp.vec3,
    adds: bool,
    tells: bool,
    momentum: Scattered,
    unit: float,
    failure: wp.array(dtype=int),
):
    """Whether what a particle ``adds`` to its nodes, and ``tells`` them, can be counted."""
    if adds:
        adds = bounded(momentum, unit, failure, e) >= 0.0
    if adds and tells:
        adds = bounded(told_by(grid, particles, e, p, x, vk, KINEMATIC), unit, failure, e) >= 0.0
    return adds


@wp.kernel(launch_bounds=(THREADS, 5))
def singles_to_grid(
    grid: Grid,
    step: Step,
    particles: Particles,
    boundaries: Boundaries,
    contact: Contact,
    moving: Moving,
    blocks: Blocks,
    per_env: int,
    # in and out
    failure: wp.array(dtype=int),
    sums: Sums,
):
    """The same sums as :func:`piavatar_envs.mpm.transfer.particles_to_grid`; ``per_env`` particles fill whole warps."""
    at = environment_of(wp.tid() // TEAM, per_env)
    e = at[0]
    p = at[1]
    takes = bool(False)
    tells = bool(False)
    record = wp.vec2i()
    units = wp.vec2()
    s = Scattered()
    x = wp.vec3()
    vk = wp.vec3()
    if p < moving.x.shape[1]:
        # all is asked for at once, before it is known who takes part: a warp with few particles has little else to do
        x = moving.x[e, p]
        vk = moving.vk[e, p]
        field = particles.field[p]
        moves = moves_finitely(moving, e, p)
        here = takes_part(blocks, e, failure)
        block = block_of_thread(TEAM, grid, base_node(grid_position(grid, x)), 0)
        record[0] = BLOCK_NODES * blocks.slot[e, field * grid.num_blocks + block]
        units[0] = sums.mass_unit[row(e, sums.mass_unit.shape[0]), field]
        units[1] = sums.momentum_unit[row(e, sums.momentum_unit.shape[0]), field]
        if contact.num_fields > 1:
            tells = blocks.fields[e, block] != (1 << field)
        s = prepare(grid, step, particles, moving, e, p, False)
        tells = tells or near_boundary(grid, boundaries, e, x)
        takes = admitted(here, moves, e, failure)
    tells = any_of_team(TEAM, tells)
    driven = tells or step.decoupling == PAPER
    takes = fits(grid, particles, e, p, x, vk, takes, driven, s, units[1], failure)
    add_single(
        TEAM, grid, step, particles, sums, e, wp.min(p, moving.x.shape[1] - 1), x, vk, takes, tells, record, units, s
    )  # fmt: skip


def record_singles(program: Program, inputs: list[Any], shape: tuple[int, int], failure: Any, sums: Sums) -> None:
    """Append :func:`singles_to_grid` for particles of ``shape``; no warp has two environments."""
    per_env = -(-shape[1] // int(SHARE)) * int(SHARE)
    threads = shape[0] * per_env * int(TEAM)
    program.launch(singles_to_grid, threads, [*inputs, per_env], [failure, sums], block_dim=THREADS)
