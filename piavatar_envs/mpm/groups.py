"""The scatter of a GPU for large, dense bodies: particles are added up by the group before the nodes are touched.

A group is of neighbours in memory, which should be neighbours in the body: the fewer bricks of nodes there are in the
box around them, the less there is to put down. It has a CUDA block of its own, see
:mod:`piavatar_envs.mpm.group_bricks` and :mod:`piavatar_envs.mpm.group_sums`. What it adds up depends on its own
particles only, and integers are added: runs repeat bit for bit, and an environment does the same in any batch.
"""

from __future__ import annotations

from typing import Any

import warp as wp

from piavatar_envs.mpm.group_bricks import (
    DRIVEN,
    FASTEST,
    HEAVIEST,
    LEFT,
    MASS_UNIT,
    MOMENTUM_UNIT,
    MORE,
    UNITS,
    WORDS,
    begin_turn,
    bricks_around,
    clear_nodes,
    fetch_slots,
    has_others,
    has_turn,
    note_records,
    per_unit_of,
    raise_most,
    widen_box,
)
from piavatar_envs.mpm.group_plan import THREADS, share_of
from piavatar_envs.mpm.group_sums import put_down
from piavatar_envs.mpm.program import Program
from piavatar_envs.mpm.runs import KINEMATIC, MOMENTUM, PLACE, bounded, scattered
from piavatar_envs.mpm.shared_add import add_to_box
from piavatar_envs.mpm.shared_memory import (
    block_of_launch,
    meet,
    native,
    number,
    or_word,
    set_number,
    thread_of_block,
    word,
)
from piavatar_envs.mpm.stencil import spline
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


@wp.func_native(native("return (first + (int)threadIdx.x) & 0x7fffffff;", "return first;"))
def particle_of_thread(first: int) -> int:
    """The particle of a thread, of a group's ``first``; the mask tells the compiler that it is not negative."""
    ...


@wp.func
def begin_group(sums: Sums, e: int, field: int, driven: bool):
    """Nothing has been added yet; units are not smaller than those of the sums. All threads meet later."""
    if thread_of_block() == 0:
        mass = sums.mass_unit[row(e, sums.mass_unit.shape[0]), field]
        momentum = sums.momentum_unit[row(e, sums.momentum_unit.shape[0]), field]
        set_number(MASS_UNIT, mass)
        set_number(MOMENTUM_UNIT, momentum)
        set_number(HEAVIEST, UNITS * mass)
        set_number(FASTEST, UNITS * momentum)
        set_number(DRIVEN, UNITS * momentum)
    begin_turn(driven)
    clear_nodes()


@wp.func
def prepare_kind(
    grid: Grid,
    step: Step,
    particles: Particles,
    moving: Moving,
    failure: wp.array(dtype=int),
    e: int,
    p: int,
    kind: int,
    adds: bool,
):
    """What a particle has of a ``kind``, and whether it ``adds`` that; the group's units are raised to it.

    All threads come here, and meet after they have found what they have of momentum, before which a turn has begun.
    """
    active = adds
    momentum = float(0.0)
    s = Scattered()
    if adds:
        s = scattered(grid, step, particles, moving, e, p, kind)
    if kind == MOMENTUM:
        meet()  # not before memory has been asked for what particles have
    if kind != PLACE:  # whose numbers are no momenta, and as sound as the masses were
        if adds:
            momentum = bounded(s, number(MOMENTUM_UNIT), failure, e)
            active = momentum >= 0.0
        raise_most(active, kind, s.at_base[0], momentum)
    return s, active


@wp.func
def add_up(kind: int, box: wp.vec3i, s: Scattered):
    """Add what a particle has of a ``kind`` to the group's nodes."""
    per_scalar = per_unit_of(HEAVIEST)
    per_vector = 0.5 * per_scalar  # of places, up to 1.5 masses
    if kind != PLACE:
        per_vector = per_unit_of(wp.where(kind == MOMENTUM, FASTEST, DRIVEN))
    wx = spline(s.f[0])
    wy = spline(s.f[1])
    wz = spline(s.f[2])
    add_to_box(box, thread_of_block(), s, wx, wy, wz, per_scalar, per_vector)


@wp.func
def scatter_turn(
    grid: Grid,
    step: Step,
    particles: Particles,
    moving: Moving,
    boundaries: Boundaries,
    blocks: Blocks,
    failure: wp.array(dtype=int),
    sums: Sums,
    num_fields: int,
    at: wp.vec3i,
    left: bool,
):
    """Scatter those of the particles that are ``left`` whose turn it is; returns whether this one is left then.

    All threads come here.
    """
    e = at[0]
    driven = step.decoupling == PAPER  # that variant needs the gradient of kinematic momentum everywhere
    ours = bool(left)
    stays = bool(False)
    tells = bool(False)
    box = wp.vec3i()
    kind = int(MOMENTUM)
    while kind <= PLACE:
        wanted = ours and (kind == MOMENTUM or tells or (driven and kind == KINEMATIC))
        s, adds = prepare_kind(grid, step, particles, moving, failure, e, at[1], kind, wanted)
        if kind == MOMENTUM:
            widen_box(adds, s.base)
        meet()
        if kind == MOMENTUM:
            ours = has_turn(grid, adds, s.base)
            stays = adds and not ours
            adds = ours
            box = bricks_around(s.base)
            fetch_slots(grid, blocks, num_fields, e, at[2])
        if adds:
            add_up(kind, box, s)
        if kind == MOMENTUM:
            note_records(blocks, e)  # nobody needs them before
        meet()
        if kind == MOMENTUM:
            # not before: the less a thread keeps while it waits for what particles have, the earlier it asks for it
            near = near_boundary(grid, boundaries, e, moving.x[e, wp.min(at[1], moving.x.shape[1] - 1)])
            tells = (ours and near) or (num_fields > 1 and ours and has_others(box, s.base))
            if ours and tells:
                or_word(MORE, (1 << KINEMATIC) + (1 << PLACE))
        put_down(grid, sums, failure, e, kind)
        kind += 1
        meet()
        if word(MORE) == 0:
            kind = PLACE + 1
    return stays


# that leaves a thread 80 registers, all but a few of those that it asks for
@wp.kernel(launch_bounds=(THREADS, 6))
def runs_to_grid(
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
    """The same sums as :func:`piavatar_envs.mpm.transfer.particles_to_grid`.

    A CUDA block takes one of the groups of an environment, a thread a particle; all of its threads come to what they do
    together.
    """
    group = environment_of(block_of_launch(), particles.groups.shape[0] - 1)
    e = group[0]
    reserved = wp.tile_empty(shape=(WORDS,), dtype=int, storage="shared")  # noqa: F841
    begins = particles.groups[group[1]]
    p = particle_of_thread(begins[0])
    driven = step.decoupling == PAPER
    begin_group(sums, e, begins[1], driven)
    left = bool(False)
    if p < particles.groups[group[1] + 1][0]:
        left = scatters(blocks, moving, e, p, failure)
    at = wp.vec3i(e, p, begins[1])
    goes_on = bool(True)
    while goes_on:
        left = scatter_turn(
            grid, step, particles, moving, boundaries, blocks, failure, sums, contact.num_fields, at, left
        )  # fmt: skip
        goes_on = word(LEFT) != 0
        if goes_on:
            meet()
            begin_turn(driven)


def record_runs(program: Program, inputs: list[Any], particles: Particles, failure: wp.array, sums: Sums) -> None:
    """Append :func:`runs_to_grid` for all environments: no CUDA block has two of them."""
    share, groups = share_of(particles.field.shape[0]), particles.groups.shape[0] - 1
    threads = failure.shape[0] * groups * share
    program.launch(runs_to_grid, threads, inputs, [failure, sums], block_dim=share)
