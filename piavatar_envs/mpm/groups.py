"""The scatter of a GPU for large, dense bodies: particles are added up by the group before the nodes are touched.

A group is of neighbours in memory, which should be neighbours in the body: the fewer bricks of nodes they touch, the
less there is to put down. It has a CUDA block of its own, see :mod:`piavatar_envs.mpm.group_bricks` and
:mod:`piavatar_envs.mpm.group_sums`. What it adds up depends on its own particles only, and integers are added: runs
repeat bit for bit, and an environment does the same in any batch.
"""

from __future__ import annotations

from typing import Any

import warp as wp

from piavatar_envs.mpm.group_bricks import (
    CAPACITY,
    COUNT,
    DRIVEN,
    FASTEST,
    FOUND,
    HEAVIEST,
    KEYS,
    LISTED,
    MASS_UNIT,
    MOMENTUM_UNIT,
    MORE,
    NODES,
    NUMBERS,
    THREADS,
    UNITS,
    WORDS,
    bricks_found,
    fetch_slots,
    is_shared,
    list_brick,
    note_records,
    per_unit_of,
    raise_most,
    seek_bricks,
)
from piavatar_envs.mpm.group_sums import add_to_nodes, put_down
from piavatar_envs.mpm.program import Program
from piavatar_envs.mpm.runs import KINEMATIC, MOMENTUM, PLACE, bounded, scattered
from piavatar_envs.mpm.shared_memory import (
    clear_words,
    meet,
    number,
    or_word,
    set_number,
    set_word,
    thread_of_block,
    word,
)
from piavatar_envs.mpm.threads import environment_of
from piavatar_envs.mpm.transfer import Scattered, near_boundary, scatters
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

# divisions and roots to two units in the last place, and logarithms to 4e-7, in a few instructions instead of calls: a
# warp with a few particles waits for its instructions as much as for its numbers
wp.set_module_options({"enable_backward": False, "default_grid_stride": False, "fast_math": True})

#: Up to how many particles of an environment a group has so many: smaller worlds fill a GPU with small groups only. The
#: numbers must not depend on the batch: units do on the group.
SHARES = ((16384, 21), (65536, 64), (2**31, int(THREADS)))


@wp.func
def begin_group(sums: Sums, num_fields: int, e: int, driven: bool):
    """Nothing has been added yet; units are not smaller than those of the sums. All threads meet later."""
    f = thread_of_block() - (THREADS - 32)  # the last warp's threads: it has few particles to wait for, or none
    if f >= 0 and f < num_fields:
        mass = sums.mass_unit[row(e, sums.mass_unit.shape[0]), f]
        momentum = sums.momentum_unit[row(e, sums.momentum_unit.shape[0]), f]
        set_number(MASS_UNIT + f, mass)
        set_number(MOMENTUM_UNIT + f, momentum)
        set_number(HEAVIEST + f, UNITS * mass)
        set_number(FASTEST + f, UNITS * momentum)
        set_number(DRIVEN + f, UNITS * momentum)
    if thread_of_block() == 0:
        set_word(MORE, wp.where(driven, 1 << KINEMATIC, 0))
    clear_words(NODES, FOUND - NODES)


@wp.func
def begin_round():
    """Forget the bricks of the round before, whose nodes have been put down. All threads come here."""
    meet()  # all have seen how many there were
    clear_words(KEYS, NUMBERS - KEYS)
    if thread_of_block() == 0:
        set_word(COUNT, 0)
        set_word(LISTED, 0)
    meet()


@wp.func
def sum_up(
    grid: Grid,
    blocks: Blocks,
    sums: Sums,
    num_fields: int,
    failure: wp.array(dtype=int),
    e: int,
    share: int,
    adds: bool,
    field: int,
    kind: int,
    bricks: wp.vec4i,
    s: Scattered,
):
    """Add what a particle has of a ``kind`` up with the group's, and put the sums down. All threads come here."""
    per_scalar = per_unit_of(HEAVIEST + field)
    per_vector = 0.5 * per_scalar  # of places, up to 1.5 masses
    if kind != PLACE:
        per_vector = per_unit_of(wp.where(kind == MOMENTUM, FASTEST, DRIVEN) + field)
    at_base = wp.vec4(s.at_base[0], s.at_base[1], s.at_base[2], s.at_base[3])
    add_to_nodes(share, adds, bricks, s.base, s.f, at_base, s.A, per_scalar, per_vector)
    if kind == MOMENTUM and num_fields == 1:  # nobody needs them before
        note_records(grid, blocks, num_fields, e)
    meet()
    put_down(grid, sums, num_fields, failure, e, kind)
    meet()


@wp.func
def scatter_kind(
    grid: Grid,
    step: Step,
    particles: Particles,
    moving: Moving,
    blocks: Blocks,
    failure: wp.array(dtype=int),
    sums: Sums,
    num_fields: int,
    e: int,
    p: int,
    field: int,
    share: int,
    adds: bool,
    near: bool,
    kind: int,
    known: wp.vec4i,
):
    """Scatter what a particle has of a ``kind``, unless there is no room for the group's bricks. All threads come here.

    Returns whether it takes part and tells its place, and its bricks, which are ``known`` but for the first kind.
    """
    active = adds
    tells = near
    momentum = float(0.0)
    bricks = known
    s = Scattered()
    if adds:
        s = scattered(grid, step, particles, moving, e, p, kind)
        if kind != PLACE:  # whose numbers are no momenta, and as sound as the masses were
            momentum = bounded(s, number(MOMENTUM_UNIT + field), failure, e)
            active = momentum >= 0.0
    if kind != PLACE:
        raise_most(active, field, kind, s, momentum)
    place = int(0)
    if kind == MOMENTUM:
        place = list_brick(grid, active, field, s.base)
        meet()
        seek_bricks(grid)
    meet()
    if word(COUNT) <= CAPACITY:
        if kind == MOMENTUM:
            if active:
                bricks = bricks_found(place)
            fetch_slots(blocks, e)
            if num_fields > 1:
                note_records(grid, blocks, num_fields, e)
                meet()
                tells = tells or (active and is_shared(bricks))
            if active and tells:
                or_word(MORE, (1 << KINEMATIC) + (1 << PLACE))
        sum_up(grid, blocks, sums, num_fields, failure, e, share, active, field, kind, bricks, s)
    return active, tells, bricks


@wp.func
def scatter_round(
    grid: Grid,
    step: Step,
    particles: Particles,
    moving: Moving,
    blocks: Blocks,
    failure: wp.array(dtype=int),
    sums: Sums,
    num_fields: int,
    e: int,
    p: int,
    field: int,
    share: int,
    ours: bool,
    near: bool,
):
    """Scatter the particles that are ``ours``, unless there is no room for all their bricks. All threads come here."""
    driven = step.decoupling == PAPER  # that variant needs the gradient of kinematic momentum everywhere
    has_bricks = bool(ours)
    tells = bool(near)
    bricks = wp.vec4i()
    kind = int(0)
    while kind <= PLACE:
        adds = has_bricks and (kind == MOMENTUM or tells or (driven and kind == KINEMATIC))
        active, tells_now, found = scatter_kind(
            grid, step, particles, moving, blocks, failure, sums, num_fields, e, p, field, share, adds, tells, kind,
            bricks,
        )  # fmt: skip
        if kind == MOMENTUM:
            has_bricks = active
            tells = tells_now
            bricks = found
        kind += 1
        if word(COUNT) > CAPACITY or word(MORE) == 0:
            kind = PLACE + 1


@wp.kernel(launch_bounds=(int(THREADS), 6))
def runs_to_grid(
    grid: Grid,
    step: Step,
    particles: Particles,
    boundaries: Boundaries,
    contact: Contact,
    moving: Moving,
    blocks: Blocks,
    share: int,
    groups: int,
    # in and out
    failure: wp.array(dtype=int),
    sums: Sums,
):
    """The same sums as :func:`piavatar_envs.mpm.transfer.particles_to_grid`.

    A CUDA block takes a ``share`` of particles, a thread each, one of the ``groups`` of an environment; all of its
    threads come to what they do together.
    """
    group = environment_of(wp.tid() // THREADS, groups)
    e = group[0]
    reserved = wp.tile_empty(shape=(WORDS,), dtype=int, storage="shared")  # noqa: F841
    t = thread_of_block()
    p = group[1] * share + t
    begin_group(sums, contact.num_fields, e, step.decoupling == PAPER)
    takes = bool(False)
    near = bool(False)
    field = int(0)
    if t < share and p < moving.x.shape[1]:
        x = moving.x[e, p]  # with the field asked for before it is known who takes part
        field = particles.field[p]
        takes = scatters(blocks, moving, e, p, failure)
        near = near_boundary(grid, boundaries, e, x)
    first = int(0)
    size = int(share)  # of a round: all at once, or half as many where there was no room for their bricks
    while first < share:
        begin_round()
        ours = takes and t >= first and t < first + size
        scatter_round(
            grid, step, particles, moving, blocks, failure, sums, contact.num_fields, e, p, field, share, ours, near
        )
        if word(COUNT) > CAPACITY:
            size = (size + 1) // 2
        else:
            first += size


def record_runs(program: Program, inputs: list[Any], shape: tuple[int, int], failure: wp.array, sums: Sums) -> None:
    """Append :func:`runs_to_grid` for particles of ``shape``: no CUDA block has two environments."""
    num_envs, per_env = shape
    share = next(rest for most, rest in SHARES if per_env <= most)
    groups = -(-per_env // share)
    inputs = [*inputs, share, groups]
    program.launch(runs_to_grid, num_envs * groups * int(THREADS), inputs, [failure, sums], block_dim=int(THREADS))
