"""The scatter of a GPU for large bodies of few particles a cell, skins for example: each goes to the nodes by itself.

Groups of particles, see :mod:`piavatar_envs.mpm.groups`, take time to find out which nodes they have in common. Where
these are few, memory is faster asked for all additions. A particle has eight threads, all of which know what it
scatters. Each looks one of the eight blocks up that its stencil may lie in, and to every node all add together, a high
or a low part of four numbers each: 32 bytes, which memory takes at a time. What is added are integers: runs repeat bit
for bit.
"""

from __future__ import annotations

from typing import Any

import warp as wp

from piavatar_envs.mpm.program import Program
from piavatar_envs.mpm.runs import KINEMATIC, MOMENTUM, PLACE, bounded, scattered
from piavatar_envs.mpm.shared_memory import native
from piavatar_envs.mpm.stencil import BLOCK_NODES, base_node, block_index, grid_position, spline
from piavatar_envs.mpm.sweep import any_lane, lane_of_thread
from piavatar_envs.mpm.threads import environment_of
from piavatar_envs.mpm.transfer import Scattered, admitted, moves_finitely, near_boundary, takes_part
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

#: Threads of a particle.
TEAM = wp.constant(8)
#: Threads of a CUDA block.
THREADS = 128


@wp.func
def block_of_thread(grid: Grid, base: wp.vec3i):
    """The one that a thread looks up, of the eight blocks that the stencil at ``base`` may lie in.

    Bits of the thread's place in its team say whether it is the upper along x, y and z; where the stencil lies in one
    block along an axis, that is the lower. It exists also where a particle is outside the grid, and takes no part.
    """
    upper = lane_of_thread()
    i = base[0] + 2 * ((upper >> 2) & 1)
    j = base[1] + 2 * ((upper >> 1) & 1)
    return wp.clamp(block_index(grid, i, j, base[2] + 2 * (upper & 1)), 0, grid.num_blocks - 1)


@wp.func_native(
    native(
        "return (__ballot_sync(0xffffffffu, here) >> (threadIdx.x & 24) & 255u) != 0u;",
        "return here;",
    )
)
def any_of_team(here: bool) -> bool:
    """Whether it is so ``here`` in any thread of a particle's; all of the warp come here."""
    ...


@wp.func_native(
    native(f"""
constexpr unsigned ALL = 0xffffffffu;
if (!__any_sync(ALL, takes)) return;
const int lane = threadIdx.x & 31, c = lane & 3, part = lane >> 2 & 1;  // of the four numbers, and of their two parts
const bool is_place = kind == {int(PLACE)}, is_fixed = sums.is_fixed != 0;
// units are powers of two: one over them is exact, however the module divides
auto per = [](float unit) {{ return __int_as_float(0x7f000000 - __float_as_int(unit)); }};
float scale = is_place && c > 0 ? grid.dx : 1.0f, massive = 0.0f;
if (is_fixed) scale = per(c == 0 || is_place ? units[0] : units[1]), massive = per(units[0]) * mass;
float value = s[0], along_x = 0.0f, along_y = 0.0f, along_z = 0.0f;
#pragma unroll
for (int n = 1; n < 4; ++n)
    if (c == n) value = s[n], along_x = A.data[n - 1][0], along_y = A.data[n - 1][1], along_z = A.data[n - 1][2];
value *= scale, along_x *= scale, along_y *= scale, along_z *= scale;
const int word = kind == {int(MOMENTUM)} ? c : c + 3 & 3;  // a vector begins where the mass was, if there is none
char* to;
if (is_fixed) to = is_place ? (char*)&wp::index(sums.offset_fixed, e, 0) : (char*)&wp::index(sums.fixed, e, 0);
else to = is_place ? (char*)&wp::index(sums.offset, e, 0) : (char*)&wp::index(sums.value, e, 0);
to += 4 * word + (is_fixed ? 16 * part : 0) + (kind == {int(KINEMATIC)} ? (is_fixed ? 32 : 16) : 0);
takes = takes && (is_fixed || part == 0);
struct Fixed {{ enum {{ value = 1 }}; }};
struct Floating {{ enum {{ value = 0 }}; }};
auto add = [&](auto sum) {{
    constexpr bool FIXED = decltype(sum)::value;
    const size_t size = FIXED ? (is_place ? 32 : 64) : (is_place ? 16 : 32);  // of a node's record [bytes]
#pragma unroll
    for (int n = 0; n < 27; ++n) {{
        const int i = n / 9, j = n / 3 % 3, l = n % 3;
        const int x = (base[0] & 3) + i, y = (base[1] & 3) + j, z = (base[2] & 3) + l;
        // from the thread that has looked the node's block up
        const int first = __shfl_sync(ALL, record, (lane & 24) | (x & 4) | (y & 4) >> 1 | z >> 2);
        char* const node = to + (size_t)(first + 16 * (x & 3) + 4 * (y & 3) + (z & 3)) * size;
        const float w = wx[i] * wy[j] * wz[l], number = w * (value + i * along_x + j * along_y + l * along_z);
        if (FIXED) {{
            const int high = __float2int_rn(0x1p-20f * number);
            const int added = part == 0 ? high : __float2int_rn(number - 0x1p20f * (float)high);
            // who adds no mass adds nothing: a zero, since branches would keep the next one waiting
            atomicAdd((int*)node, takes && w * massive > 0.5f ? added : 0);
        }} else if (takes)
            atomicAdd((float*)node, number);
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

    ``record`` is of the first node of :func:`block_of_thread`; ``units`` are of mass and of momentum. All threads of a
    warp come here.
    """
    ...


@wp.func
def add_kind(
    grid: Grid, sums: Sums, e: int, takes: bool, kind: int, s: Scattered, mass: float, record: int, units: wp.vec2
):
    """Add what a particle has of a ``kind`` to the nodes. All threads of a warp come here."""
    wx = spline(s.f[0])
    wy = spline(s.f[1])
    wz = spline(s.f[2])
    at_base = wp.vec4(s.at_base[0], s.at_base[1], s.at_base[2], s.at_base[3])
    add_to_nodes(grid, sums, e, takes, kind, s.base, wx, wy, wz, at_base, s.A, mass, record, units)


@wp.kernel(launch_bounds=(THREADS, 5))
def singles_to_grid(
    grid: Grid,
    step: Step,
    particles: Particles,
    boundaries: Boundaries,
    contact: Contact,
    moving: Moving,
    blocks: Blocks,
    # in and out
    failure: wp.array(dtype=int),
    sums: Sums,
):
    """The same sums as :func:`piavatar_envs.mpm.transfer.particles_to_grid`, eight threads a particle."""
    at = environment_of(wp.tid() // TEAM, moving.x.shape[1])
    e = at[0]
    p = at[1]
    takes = bool(False)
    tells = bool(False)
    record = int(0)
    units = wp.vec2()
    s = Scattered()
    if e < moving.x.shape[0]:  # the last warp may have more threads than there are
        # all is asked for at once, before it is known who takes part: a warp with four particles has little else to do
        x = moving.x[e, p]
        field = particles.field[p]
        moves = moves_finitely(moving, e, p)
        here = takes_part(blocks, e, failure)
        block = block_of_thread(grid, base_node(grid_position(grid, x)))
        record = BLOCK_NODES * blocks.slot[e, field * grid.num_blocks + block]
        units[0] = sums.mass_unit[row(e, sums.mass_unit.shape[0]), field]
        units[1] = sums.momentum_unit[row(e, sums.momentum_unit.shape[0]), field]
        if contact.num_fields > 1:
            tells = blocks.fields[e, block] != (1 << field)
        s = scattered(grid, step, particles, moving, e, p, MOMENTUM)
        tells = tells or near_boundary(grid, boundaries, e, x)
        takes = admitted(here, moves, e, failure)
        if takes:
            takes = bounded(s, units[1], failure, e) >= 0.0
    mass = s.at_base[0]
    if contact.num_fields > 1:
        tells = any_of_team(tells)
    add_kind(grid, sums, e, takes, MOMENTUM, s, mass, record, units)
    driven = step.decoupling == PAPER  # that variant needs the gradient of kinematic momentum everywhere
    kind = int(KINEMATIC)
    while kind <= PLACE and any_lane(takes and (tells or driven)):
        adds = takes and (tells or (driven and kind == KINEMATIC))
        if adds:
            s = scattered(grid, step, particles, moving, e, p, kind)
            if kind == KINEMATIC:
                adds = bounded(s, units[1], failure, e) >= 0.0
        add_kind(grid, sums, e, adds, kind, s, mass, record, units)
        kind += 1


def record_singles(program: Program, inputs: list[Any], shape: tuple[int, int], failure: Any, sums: Sums) -> None:
    """Append :func:`singles_to_grid` for particles of ``shape``; its threads exchange numbers, by whole warps."""
    threads = -(-shape[0] * shape[1] * int(TEAM) // 32) * 32
    program.launch(singles_to_grid, threads, inputs, [failure, sums], block_dim=THREADS)
