"""The additions of a particle's threads to the nodes of its stencil in relays, see :mod:`piavatar_envs.mpm.counts`.

A node has two words, a sector of memory two nodes. So four threads add to the pair of a row together, see
:mod:`piavatar_envs.mpm.team_nodes`, and to the third nodes of two rows: 18 sectors are asked for, of 27 nodes. A team
of eight does that for twice as many rows at a time. Warps wait for their program where they are many, so a team of
four has one piece of it for all planes of the stencil, and all teams have one for all that is added.
"""

from __future__ import annotations

import warp as wp

from piavatar_envs.mpm.counts import Counts
from piavatar_envs.mpm.runs import KINEMATIC, MOMENTUM, PLACE, told_by
from piavatar_envs.mpm.shared_memory import native
from piavatar_envs.mpm.stencil import BLOCK_NODES, spline
from piavatar_envs.mpm.sweep import any_lane
from piavatar_envs.mpm.team_nodes import FIND_ROW
from piavatar_envs.mpm.transfer import Scattered, momentum_bounds
from piavatar_envs.mpm.types import Grid, Particles

# roots to two units in the last place, in a few instructions instead of calls
wp.set_module_options({"enable_backward": False, "default_grid_stride": False, "fast_math": True})


@wp.func_native(
    native(f"""
constexpr unsigned ALL = 0xffffffffu;
if (!__any_sync(ALL, takes)) return;
const int lane = threadIdx.x & 31, word = lane & 1, one = lane >> 1 & 1;  // of a node's words, of two nodes
const bool is_second = lane & team - 1 & 4;  // of two who add up the same words, on other rows
const bool is_place = kind == {int(PLACE)};
// units are powers of two: one over them is exact, however the module divides
auto per = [](float unit) {{ return __int_as_float(0x7f000000 - __float_as_int(unit)); }};
const float per_mass = takes ? per(units[0]) : 0.0f;
const float least = takes ? 0.5f * units[0] / mass : 1.0f;  // who adds no mass to a node adds nothing
const float per_vector = is_place ? per_mass : takes ? per(units[1]) : 0.0f;
// the lower number of a word and the higher one: a scalar and a vector, which comes first where it is not of momentum
struct Number {{ float at, x, y, z; }};
auto scalar = [&] {{ return Number{{per_mass * s[0], 0.0f, 0.0f, 0.0f}}; }};
auto vector = [&](int c) {{
    const float* const along = A.data[c];
    return Number{{per_vector * s[1 + c], per_vector * along[0], per_vector * along[1], per_vector * along[2]}};
}};
Number low = vector(1), high = vector(2);
if (kind == {int(MOMENTUM)}) {{
    if (word == 0) low = scalar(), high = vector(0);
}} else {{
    if (word == 0) high = low, low = vector(0);
    else low = high, high = scalar();
}}
const void* records_at = &wp::index(counts.sum, e, 0);
if (is_place) records_at = &wp::index(counts.offset, e, 0);
const size_t to = __cvta_generic_to_global(records_at) + 8 * word + (kind == {int(KINEMATIC)} ? 64 * 16 : 0);
const int blocks_apart = is_place ? 1 : 2;  // the halves of records lie apart
const int bx = base[0] & 3, by = base[1] & 3;
{FIND_ROW}
// a thread's node in every row of pairs, and in those of third ones: its weight and numbers, and where the row is
struct Node {{ float w, low, high; Row row; }};
auto node_at = [&](int l, float w) {{
    return Node{{w, low.at + (float)l * low.z, high.at + (float)l * high.z, find_row(l, blocks_apart)}};
}};
const bool is_odd = base[2] & 1;
const Node pair = node_at((is_odd ? 1 : 0) + one, is_odd ? (one ? wz[2] : wz[1]) : one ? wz[1] : wz[0]);
const Node third = node_at(is_odd ? 0 : 2, is_odd ? wz[0] : wz[2]);
// the middle node comes last, and gets what the others have left of all that a particle has: tiny shares are rounded to
// nothing more often than to one, by which a body would lose momentum
const bool is_middle = !is_second && one == (is_odd ? 0 : 1);
auto of_all = [&](const Number& n) {{
    const float x = wx[1] + 2.0f * wx[2], y = wy[1] + 2.0f * wy[2], z = wz[1] + 2.0f * wz[2];
    return is_middle ? __float2int_rn(n.at + x * n.x + y * n.y + z * n.z) : 0;
}};
int left_low = of_all(low), left_high = of_all(high);
auto put = [&](size_t plane, int at, float w, float lower, float higher, bool here, bool is_last) {{
    here = here && w > least;
    int first = __float2int_rn(w * lower), second = __float2int_rn(w * higher);
    if (here && !(is_last && is_middle)) left_low -= first, left_high -= second;
    if (is_last) {{  // so for all
#pragma unroll
        for (int distance = 2; distance < team; distance *= 2) {{
            left_low += __shfl_xor_sync(ALL, left_low, distance);
            left_high += __shfl_xor_sync(ALL, left_high, distance);
        }}
        if (is_middle) first = left_low, second = left_high;
    }}
    second += first >> 31;
    size_t words;
    asm("mad.wide.s32 %0, %1, %2, %3;" : "=l"(words) : "r"(at), "r"(16), "l"(plane));
    const unsigned long long both = (unsigned long long)(unsigned)second << 32 | (unsigned)first;
    if (here) asm volatile("red.global.add.u64 [%0], %1;" :: "l"(words), "l"(both) : "memory");
}};
if (team == 4) {{
    // a thread's nodes of every plane, in three rows, and in two: their weights and numbers, and where they are in the
    // lower and in the upper of two blocks
    struct Line {{ float w, low, high; int lower, upper; }};
    auto line_at = [&](const Node& node, int j, float w) {{
        const bool is_far = by + j > 3;
        const int in = 4 * (by + j & 3);
        return Line{{w * node.w, node.low + (float)j * low.y, node.high + (float)j * high.y,
                    in + (is_far ? node.row.in[1] : node.row.in[0]), in + (is_far ? node.row.in[3] : node.row.in[2])}};
    }};
    const Line lines[5] = {{line_at(pair, 0, wy[0]), line_at(pair, 2, wy[2]), line_at(third, one, one ? wy[1] : wy[0]),
                           line_at(third, 2, wy[2]), line_at(pair, 1, wy[1])}};
#pragma unroll 1  // warps wait for their program
    for (int n = 0; n < 3; ++n) {{
        const int i = n == 0 ? 0 : 3 - n;
        const float wi = n == 0 ? wx[0] : n == 1 ? wx[2] : wx[1], x = (float)i * low.x, x_high = (float)i * high.x;
        const size_t plane = to + 16 * 16 * (bx + i & 3);
#pragma unroll
        for (int m = 0; m < 5; ++m) {{
            const Line& line = lines[m];
            put(plane, bx + i > 3 ? line.upper : line.lower, wi * line.w, line.low + x, line.high + x_high,
                m != 3 || one == 0, n == 2 && m == 4);
        }}
    }}
    return;
}}
auto put_one = [&](const Node& node, int i, int j, float w, bool here, bool is_last) {{
    put(to, in_row(node.row, bx, by, i, j), w * node.w, node.low + (float)i * low.x + (float)j * low.y,
        node.high + (float)i * high.x + (float)j * high.y, here, is_last);
}};
auto put_pairs = [&](int n, bool is_last) {{  // the second of two has the row after it
    const int m = n < 8 ? n + 1 : n;
    put_one(pair, is_second ? m / 3 : n / 3, is_second ? m % 3 : n % 3,
            is_second ? wx[m / 3] * wy[m % 3] : wx[n / 3] * wy[n % 3], n < 8 || !is_second, is_last);
}};
put_pairs(0, false), put_pairs(2, false), put_pairs(6, false), put_pairs(8, false);
#pragma unroll
for (int n = 0; n < 9; n += 4) {{  // four rows at a time
    const int own = min(n + 2 * (is_second ? 1 : 0) + one, 8), i = own * 11 >> 5, j = own - 3 * i;
    const float wi = i == 0 ? wx[0] : i == 1 ? wx[1] : wx[2], wj = j == 0 ? wy[0] : j == 1 ? wy[1] : wy[2];
    put_one(third, i, j, wi * wj, n < 8 || !is_second && one == 0, false);
}}
put_pairs(4, true);
""")
)
def add_to_nodes(
    team: int,
    counts: Counts,
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

    ``record`` are the first of :func:`piavatar_envs.mpm.singles.slots_of_thread`, ``units`` are of mass and of
    momentum. All threads of a warp come here.
    """
    ...


@wp.func
def most_of(momentum: Scattered, mass: float, vk: wp.vec3):
    """The greatest momentum of any kind that a particle adds [kg m/s]; not finite if any of it is not."""
    bounds = momentum_bounds(momentum)
    k = mass * wp.abs(vk)
    total = bounds[0] + bounds[1] + bounds[2] + k[0] + k[1] + k[2]  # of what is no number, max would be another
    return wp.where(wp.isfinite(total), wp.max(wp.max(bounds), wp.max(k)), total)


@wp.func
def count_single(
    team: int,
    grid: Grid,
    particles: Particles,
    counts: Counts,
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
    told = takes and tells
    if told:
        counts.told[e, record[0] // BLOCK_NODES] = 1
        if team == 4:
            counts.told[e, record[1] // BLOCK_NODES] = 1
    # momentum comes last: what a thread reads after its additions waits for them
    kind = wp.where(any_lane(told), int(KINEMATIC), int(MOMENTUM))
    goes_on = bool(True)
    while goes_on:  # one piece of program for all kinds
        s = momentum
        adds = takes
        if kind != MOMENTUM:
            s = told_by(grid, particles, e, p, x, vk, kind)
            adds = told
        at_base = wp.vec4(s.at_base[0], s.at_base[1], s.at_base[2], s.at_base[3])
        add_to_nodes(
            team, counts, e, adds, kind, s.base, spline(s.f[0]), spline(s.f[1]), spline(s.f[2]), at_base, s.A,
            momentum.at_base[0], record, units,
        )  # fmt: skip
        goes_on = kind != MOMENTUM
        kind = wp.where(kind == KINEMATIC, int(PLACE), int(MOMENTUM))
