"""The sums of a group of particles in shared memory, put down on the nodes.

What particles add has a scalar and a vector that is linear over the stencil. It is counted in units of the group: 2^-25
of the most that any of its particles has, a power of two, and not less than what the sums outside count. So integers
are added in any order, and put down exactly. A weight is 27/64 at most: 128 summands stay below 2^31. (Units four times
as large would do with a fused addition to make an integer of a summand, but a body that drifts through the grid makes
the same errors again and again: it lost 1e-5 of its momentum in 300 substeps.)
"""

from __future__ import annotations

import warp as wp

from piavatar_envs.mpm.group_bricks import MOMENTUM_UNIT, POWER, SIZE, in_group, raise_most
from piavatar_envs.mpm.runs import bounded
from piavatar_envs.mpm.shared_memory import number
from piavatar_envs.mpm.transfer import Scattered
from piavatar_envs.mpm.types import FAILURE_CFL, Grid, Sums

wp.set_module_options({"enable_backward": False})


@wp.func
def raised(s: Scattered, takes: bool, kind: int, failure: wp.array(dtype=int), e: int):
    """Whether a particle can be added up; if so, the group's units are raised to its momenta. All threads come here."""
    momentum = float(0.0)
    if takes:
        momentum = bounded(s, number(MOMENTUM_UNIT), failure, e)
        takes = momentum >= 0.0
    raise_most(takes, kind, s.at_base[0], momentum)
    return takes


@wp.func_native(
    in_group(f"""
{POWER}{SIZE}
const int lane = threadIdx.x & 31, warp = threadIdx.x >> 5, c = lane & 3;  // of four sums
int warps = blockDim.x >> 5;
asm volatile("" : "+r"(warps));  // or a compiler finds it anew for each brick
const int bricks = size[0] * size[1] * size[2];
const bool is_place = kind == PLACE, of_mass = c == 0 || is_place;
const int word = kind == 0 ? c : c + 3 & 3;  // a vector begins where the mass was, if there is none
const int within = (lane & 16) + (lane >> 1 & 4) + (lane >> 2 & 1) + (kind == KINEMATIC ? 64 : 0);
const unsigned mass_of_node = 1u << (lane & 28);
// the group's units are not smaller than those of the sums: shifted, they are exact
float unit = power_of_two(room[of_mass ? HEAVIEST : kind == KINEMATIC ? DRIVEN : FASTEST]);
unit *= is_place && c > 0 ? 0x1p-24f : 0x1p-25f;
const int shift = __float_as_int(unit) - room[of_mass ? MASS_UNIT : MOMENTUM_UNIT] >> 23;
// a loop for what comes first and one for the rest: threads that branch in it would wait for each other
struct First {{ enum {{ IS = 1 }}; }};
struct Later {{ enum {{ IS = 0 }}; }};
auto put_bricks = [&](auto which, auto add) {{
    int* from = room + NODES + start + BRICK_WORDS * warp + lane;
#pragma unroll 1
    for (int n = RECORDS + warp; n < RECORDS + bricks; n += warps, from += BRICK_WORDS * warps) {{
        const int sum = *from, record = room[n] + within;
        int& massive = room[n - RECORDS + MASSIVE];
        if (decltype(which)::IS) massive = __ballot_sync(ALL, sum != 0);  // written by all threads, the same
        if (sum != 0 && (massive & mass_of_node)) add(record, sum);  // who adds no mass adds nothing
    }}
}};
auto put = [&](auto add) {{
    if (kind == 0) put_bricks(First(), add);
    else put_bricks(Later(), add);
}};
// memory takes the four numbers of a node at a time
auto red = [](size_t to, int record, long long added) {{
    size_t node;
    asm("mad.wide.s32 %0, %1, %2, %3;" : "=l"(node) : "r"(record), "r"(32), "l"(to));
    asm volatile("red.global.add.u64 [%0], %1;" :: "l"(node), "l"(added) : "memory");
}};
// what places have of records has no halves
auto own = [&](int record) {{ return is_place ? (record >> 1 & ~63) + (record & 63) : record; }};
if (is_place)
    for (int n = threadIdx.x; n < bricks; n += blockDim.x)
        if (room[MASSIVE + n]) wp::index(sums.told, e, room[RECORDS + n] >> 7) = 1;
bool too_much = false;
// sums have 31 bits, so most of them cannot be too large
if (!is_place && __all_sync(ALL, shift < 18)) {{
    const size_t to = __cvta_generic_to_global(&wp::index(sums.fixed, e, 0)) + 8 * word;
    const int factor = 1 << shift;
    put([&](int record, int sum) {{
        long long added;
        asm("mul.wide.s32 %0, %1, %2;" : "=l"(added) : "r"(sum), "r"(factor));
        red(to, record, added);
    }});
}} else {{
    void* const records = is_place ? (void*)&wp::index(sums.offset_fixed, e, 0) : &wp::index(sums.fixed, e, 0);
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
def put_down(grid: Grid, sums: Sums, failure: wp.array(dtype=int), e: int, kind: int, start: int):
    """Add what the nodes have got of a ``kind`` to the sums outside; sums that are too large are not.

    It begins ``start`` words after the nodes' first. Four threads a node. Masses come first; slots whose nodes are told
    places are noted.
    """
    ...
