"""The scatter of a GPU for large bodies of few particles a cell, skins for example: each goes to the nodes by itself.

Groups of particles, see :mod:`piavatar_envs.mpm.groups`, take time to find out which nodes they have in common. Where
these are few, memory is faster asked for all additions. A particle has eight threads here, four in some relays (see
:mod:`piavatar_envs.mpm.carry`), all of which know what it scatters. Each looks one or two of the eight blocks up that
its stencil may lie in, and all of them add, see :mod:`piavatar_envs.mpm.team_add`, or where a relay begins
:mod:`piavatar_envs.mpm.team_count`. What is added are integers: runs repeat bit for bit.
"""

from __future__ import annotations

from typing import Any

import warp as wp

from piavatar_envs.mpm.counts import Counts
from piavatar_envs.mpm.measures import (
    countable,
    known_speed,
    mass_unit_of,
    measure_mass,
    measure_speed,
    prepare_speeds,
    speed_counted,
    speed_of_counts,
    units_at,
)
from piavatar_envs.mpm.program import Program
from piavatar_envs.mpm.ranks import NEAR_BOUNDARY, TELLING, Ranks, raise_rank, record_order
from piavatar_envs.mpm.runs import KINEMATIC, bounded, told_by
from piavatar_envs.mpm.shared_memory import native
from piavatar_envs.mpm.stencil import BLOCK_NODES, base_node, block_index, grid_position
from piavatar_envs.mpm.sums import units_of
from piavatar_envs.mpm.sweep import LANES, lane_of_thread
from piavatar_envs.mpm.team_add import add_single
from piavatar_envs.mpm.team_count import count_single, most_of
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
)

# divisions and roots to two units in the last place, and logarithms to 4e-7, in a few instructions instead of calls
wp.set_module_options({"enable_backward": False, "default_grid_stride": False, "fast_math": True})

#: Threads of a particle in the scatter alone. Teams of four are for some relays only; four here, as tried before, need
#: fewer instructions and more time.
TEAM = wp.constant(8)
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


@wp.struct
class Single:
    """A particle that is scattered; its threads know the same of it, but for their own ``record``."""

    p: int  # one that exists, also where there are no more
    x: wp.vec3
    vk: wp.vec3
    field: int
    record: int  # the first of the block that the thread has looked up
    takes: bool
    near: bool  # a boundary
    tells: bool
    scattered: Scattered


@wp.func
def single_of(
    grid: Grid,
    step: Step,
    particles: Particles,
    boundaries: Boundaries,
    contact: Contact,
    moving: Moving,
    blocks: Blocks,
    at: wp.vec2i,
    failure: wp.array(dtype=int),
):
    """Environment and place ``at`` which a team is say who it scatters; all threads of a warp come here."""
    s = Single()
    e = at[0]
    s.p = wp.min(at[1], moving.x.shape[1] - 1)
    if at[1] < moving.x.shape[1]:
        # all is asked for at once, before it is known who takes part: a warp with few particles has little else to do
        s.x = moving.x[e, s.p]
        s.vk = moving.vk[e, s.p]
        s.field = particles.field[s.p]
        moves = moves_finitely(moving, e, s.p)
        here = takes_part(blocks, e, failure)
        block = block_of_thread(TEAM, grid, base_node(grid_position(grid, s.x)), 0)
        s.record = BLOCK_NODES * blocks.slot[e, s.field * grid.num_blocks + block]
        if contact.num_fields > 1:
            s.tells = blocks.fields[e, block] != (1 << s.field)
        s.scattered = prepare(grid, step, particles, moving, e, s.p, False)
        s.near = near_boundary(grid, boundaries, e, s.x)
        s.tells = s.tells or s.near
        s.takes = admitted(here, moves, e, failure)
    s.tells = any_of_team(TEAM, s.tells)
    return s


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
    s = single_of(grid, step, particles, boundaries, contact, moving, blocks, at, failure)
    units = units_of(sums, e, s.field)
    driven = s.tells or step.decoupling == PAPER
    takes = fits(grid, particles, e, s.p, s.x, s.vk, s.takes, driven, s.scattered, units[1], failure)
    add_single(
        grid, step, particles, sums, e, s.p, s.x, s.vk, takes, s.tells, s.record, units, s.scattered
    )  # fmt: skip


@wp.kernel
def measure_singles(
    grid: Grid,
    step: Step,
    particles: Particles,
    moving: Moving,
    per_env: int,
    # in and out
    counts: Counts,
):
    """Find the units of a relay's sums, those of momentum for the first two; ``per_env`` particles fill whole warps."""
    at = environment_of(wp.tid(), per_env)
    e = at[0]
    p = wp.min(at[1], moving.x.shape[1] - 1)
    s = prepare(grid, step, particles, moving, e, p, False)
    mass = s.at_base[0]
    speed = most_of(s, mass, moving.vk[e, p]) / mass
    # who does not move finitely is seen to by who adds up
    measure_speed(counts, e, 0, known_speed(counts, e, 0), wp.where(wp.isfinite(speed), speed, 0.0))
    measure_mass(counts, e, particles.field[p], mass)


@wp.kernel(launch_bounds=(THREADS, 5))
def singles_to_counts(
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
    counts: Counts,
    ranks: Ranks,
):
    """As :func:`singles_to_grid`, the first sums of a relay, which have been measured; also, find ranks."""
    at = environment_of(wp.tid() // TEAM, per_env)
    e = at[0]
    s = single_of(grid, step, particles, boundaries, contact, moving, blocks, at, failure)
    unit = mass_unit_of(counts, e, s.field)
    counted = speed_of_counts(counts, e, 0)
    most = most_of(s.scattered, s.scattered.at_base[0], s.vk)
    takes = countable(s.takes, speed_counted(most, unit), counted, e, failure)
    if at[1] == 0:
        prepare_speeds(counts, e, 0)
    if s.tells:
        raise_rank(ranks, e, s.p, wp.where(s.near, NEAR_BOUNDARY, TELLING))
    record, units = wp.vec2i(s.record), units_at(unit, counted)
    count_single(
        TEAM, grid, particles, counts, e, s.p, s.x, s.vk, takes, s.tells, record, units, s.scattered
    )  # fmt: skip


def in_whole_warps(count: int, team: int) -> int:
    """``count`` particles of ``team`` threads each, and as many more as fill the last warp."""
    share = LANES // team
    return -(-count // share) * share


def record_singles(program: Program, inputs: list[Any], shape: tuple[int, int], failure: Any, sums: Sums) -> None:
    """Append :func:`singles_to_grid` for particles of ``shape``; no warp has two environments."""
    per_env = in_whole_warps(shape[1], int(TEAM))
    threads = shape[0] * per_env * int(TEAM)
    program.launch(singles_to_grid, threads, [*inputs, per_env], [failure, sums], block_dim=THREADS)


def record_first(
    program: Program, inputs: list[Any], shape: tuple[int, int], failure: Any, counts: Counts, ranks: Ranks
) -> None:
    """Append :func:`singles_to_counts`, as :func:`record_singles`, where nobody has been measured or has a rank yet."""
    grid, step, particles, _, _, moving, _ = inputs
    per_env = in_whole_warps(shape[1], int(TEAM))
    particles_of_warps = in_whole_warps(shape[1], 1)
    measured = [grid, step, particles, moving, particles_of_warps]
    program.launch(measure_singles, shape[0] * particles_of_warps, measured, [counts], block_dim=THREADS)
    threads = shape[0] * per_env * int(TEAM)
    program.launch(singles_to_counts, threads, [*inputs, per_env], [failure, counts, ranks], block_dim=THREADS)
    record_order(program, ranks)
