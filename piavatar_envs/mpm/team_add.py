"""The additions of a particle's threads, its team, to the nodes of its stencil; see :mod:`piavatar_envs.mpm.singles`.

To every node four threads add together, one of four numbers each: 32 bytes, which memory takes at a time. Eight do that
for two nodes at a time. Relays, whose sums are others, have :mod:`piavatar_envs.mpm.team_count`.
"""

from __future__ import annotations

import warp as wp

from piavatar_envs.mpm.runs import KINEMATIC, MOMENTUM, PLACE, told_by
from piavatar_envs.mpm.shared_memory import native
from piavatar_envs.mpm.stencil import BLOCK_NODES, spline
from piavatar_envs.mpm.sweep import any_lane
from piavatar_envs.mpm.transfer import Scattered
from piavatar_envs.mpm.types import PAPER, Grid, Particles, Step, Sums

# roots to two units in the last place, in a few instructions instead of calls
wp.set_module_options({"enable_backward": False, "default_grid_stride": False, "fast_math": True})


@wp.func_native(
    native(f"""
constexpr unsigned ALL = 0xffffffffu;
if (!__any_sync(ALL, takes)) return;
const int lane = threadIdx.x & 31, c = lane & 3;  // of the four numbers
const bool is_second = lane & 4;  // of two who add up one number, on every other line of nodes
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
const int bx = base[0] & 3, by = base[1] & 3, bz = base[2] & 3;
int lower[4], upper[4];  // of the threads that have looked them up
#pragma unroll
for (int n = 0; n < 4; ++n) {{
    lower[n] = blocks_apart * __shfl_sync(ALL, record, lane & 24 | n);
    upper[n] = blocks_apart * __shfl_sync(ALL, record, lane & 24 | 4 | n);
}}
auto add = [&](auto sum) {{
    constexpr bool FIXED = decltype(sum)::FIXED;
    auto add_line = [&](int i, int j, float w_line) {{
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
    }};
#pragma unroll
    for (int first = 0; first < 9; first += 2) {{  // the second of two threads has the lines between
        if (first == 8 && is_second) break;
        const int second = first < 8 ? first + 1 : first;
        const int i = is_second ? second / 3 : first / 3, j = is_second ? second % 3 : first % 3;
        add_line(i, j, is_second ? wx[second / 3] * wy[second % 3] : wx[first / 3] * wy[first % 3]);
    }}
}};
if (is_fixed) add(Fixed());
else add(Floating());
""")
)
def add_to_nodes(
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
    record: int,
    units: wp.vec2,
):
    """Add a scalar and a vector to the 27 nodes of a stencil, ``s`` at the lowest node, the latter changing by ``A``.

    ``record`` is the first of :func:`piavatar_envs.mpm.singles.slots_of_thread`, ``units`` are of mass and of
    momentum. All threads of a warp come here.
    """
    ...


@wp.func
def add_single(
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
    record: int,
    units: wp.vec2,
    momentum: Scattered,
):
    """Add to the nodes what particle ``p`` scatters, if it ``takes`` part: its mass and ``momentum``, what it tells.

    All threads of a warp come here, ``record`` and ``units`` as for :func:`add_to_nodes`: all threads of a particle
    take part or none, and their records exist even where they do not.
    """
    mass = momentum.at_base[0]
    told = takes and tells
    if told:
        sums.told[e, record // BLOCK_NODES] = 1
    # momentum comes last: what a thread reads after its additions waits for them
    kind = int(KINEMATIC)
    adds = takes and (tells or step.decoupling == PAPER)  # which needs that gradient everywhere
    while any_lane(adds):
        add_one(grid, sums, e, adds, kind, told_by(grid, particles, e, p, x, vk, kind), mass, record, units)
        kind += 1
        adds = told and kind <= PLACE
    add_one(grid, sums, e, takes, MOMENTUM, momentum, mass, record, units)


@wp.func
def add_one(
    grid: Grid,
    sums: Sums,
    e: int,
    takes: bool,
    kind: int,
    s: Scattered,
    mass: float,
    record: int,
    units: wp.vec2,
):
    """:func:`add_to_nodes` of what a particle scatters of a ``kind``."""
    at_base = wp.vec4(s.at_base[0], s.at_base[1], s.at_base[2], s.at_base[3])
    add_to_nodes(
        grid, sums, e, takes, kind, s.base, spline(s.f[0]), spline(s.f[1]), spline(s.f[2]), at_base, s.A, mass, record,
        units,
    )  # fmt: skip
