"""The scatter of a GPU for large, dense bodies: particles are added up by the group before the nodes are touched.

A group is of neighbours in memory, which should be neighbours in the body: the fewer bricks of nodes there are in the
box around them, the less there is to put down. It has a CUDA block of its own, see
:mod:`piavatar_envs.mpm.group_bricks` and :mod:`piavatar_envs.mpm.group_sums`. What it adds up depends on its own
particles only, and integers are added: runs repeat bit for bit, and an environment does the same in any batch. What few
particles have besides is in :mod:`piavatar_envs.mpm.group_tellers`.
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
    widen_box,
)
from piavatar_envs.mpm.group_plan import THREADS, share_of
from piavatar_envs.mpm.group_sums import put_down, raised
from piavatar_envs.mpm.group_tellers import note_teller, tell_nodes
from piavatar_envs.mpm.program import Program
from piavatar_envs.mpm.runs import MOMENTUM
from piavatar_envs.mpm.shared_add import add_to_box
from piavatar_envs.mpm.shared_memory import (
    block_of_launch,
    meet,
    native,
    set_number,
    thread_of_block,
    word,
)
from piavatar_envs.mpm.stencil import spline
from piavatar_envs.mpm.threads import environment_of
from piavatar_envs.mpm.transfer import Scattered, near_boundary, prepare, scatters
from piavatar_envs.mpm.types import (
    PAPER,
    Blocks,
    Boundaries,
    Contact,
    Grid,
    Model,
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
def begin_group(particles: Particles, sums: Sums):
    """The group of a CUDA block: environment, particle of the thread, field, particle after the last.

    Nothing has been added yet; units are not smaller than those of the sums. All threads meet later.
    """
    at_group = environment_of(block_of_launch(), particles.groups.shape[0] - 1)
    e = at_group[0]
    begins = particles.groups[at_group[1]]
    field = begins[1]
    if thread_of_block() == 0:
        mass = sums.mass_unit[row(e, sums.mass_unit.shape[0]), field]
        momentum = sums.momentum_unit[row(e, sums.momentum_unit.shape[0]), field]
        set_number(MASS_UNIT, mass)
        set_number(MOMENTUM_UNIT, momentum)
        set_number(HEAVIEST, UNITS * mass)
        set_number(FASTEST, UNITS * momentum)
        set_number(DRIVEN, UNITS * momentum)
    begin_turn()
    clear_nodes()
    return wp.vec4i(e, particle_of_thread(begins[0]), field, particles.groups[at_group[1] + 1][0])


@wp.func
def begins_again():
    """Whether particles are left for another turn, which begins then; all threads come here."""
    goes_on = word(LEFT) != 0
    if goes_on:
        meet()
        begin_turn()
        clear_nodes()
    return goes_on


@wp.func
def add_momentum(box: wp.vec3i, s: Scattered):
    """Add mass and momentum of a particle to the group's nodes."""
    add_to_box(
        box, thread_of_block(), s, spline(s.f[0]), spline(s.f[1]), spline(s.f[2]), per_unit_of(HEAVIEST),
        per_unit_of(FASTEST),
    )  # fmt: skip


@wp.struct
class Turn:
    """A particle while its group scatters."""

    takes: bool  # whether it takes part
    ours: bool  # whether it has its turn
    base: wp.vec3i  # lowest node of its stencil
    box: wp.vec3i  # where the bricks around that are, see :func:`bricks_around`


@wp.func
def add_turn(
    grid: Grid,
    blocks: Blocks,
    failure: wp.array(dtype=int),
    num_fields: int,
    at: wp.vec4i,
    left: bool,
    s: Scattered,
):
    """Add up those of the particles that are ``left`` whose turn it is; ``s`` is what one scatters that is left.

    All threads come here, and to :func:`put_turn` then.
    """
    e = at[0]
    meet()  # not before memory has been asked for what particles have; a turn has begun then
    takes = raised(s, left, MOMENTUM, failure, e)
    widen_box(takes, s.base)
    meet()
    ours = has_turn(grid, takes, s.base)
    box = bricks_around(s.base)
    fetch_slots(grid, blocks, num_fields, e, at[2])
    if ours:
        add_momentum(box, s)
    note_records(blocks, e)  # nobody needs them before
    return Turn(takes, ours, s.base, box)


@wp.func
def put_turn(
    grid: Grid,
    step: Step,
    particles: Particles,
    moving: Moving,
    failure: wp.array(dtype=int),
    sums: Sums,
    num_fields: int,
    at: wp.vec4i,
    turn: Turn,
    near: bool,
):
    """Put down what has been added up; returns whether this particle is left then.

    A boundary may be ``near`` it. All threads have met since they added.
    """
    tells = near or step.decoupling == PAPER  # which needs the gradient of kinematic momentum everywhere
    # others are asked for only of who has a box
    note_teller(turn.ours and (tells or (num_fields > 1 and has_others(turn.box, turn.base))))
    put_down(grid, sums, failure, at[0], MOMENTUM, 0)
    meet()
    if word(MORE) != 0:
        tell_nodes(grid, particles, moving, failure, sums, at)
    return turn.takes and not turn.ours


@wp.func
def scatter_left(
    grid: Grid,
    step: Step,
    particles: Particles,
    moving: Moving,
    boundaries: Boundaries,
    blocks: Blocks,
    failure: wp.array(dtype=int),
    sums: Sums,
    num_fields: int,
    at: wp.vec4i,
    left: bool,
):
    """Scatter those of the particles that are ``left`` whose turn it is; returns whether this one is left then.

    Written into a kernel's loop, ``s`` would be kept from turn to turn, and four times as many registers be spilled.
    """
    e = at[0]
    s = Scattered()
    if left:
        s = prepare(grid, step, particles, moving, e, at[1], False)
    turn = add_turn(grid, blocks, failure, num_fields, at, left, s)
    meet()
    # not before: the less a thread keeps while it waits for what particles have, the earlier it asks for it
    near = near_boundary(grid, boundaries, e, moving.x[e, wp.min(at[1], moving.x.shape[1] - 1)])
    return put_turn(grid, step, particles, moving, failure, sums, num_fields, at, turn, near)


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

    A CUDA block takes one group of an environment, a thread a particle; all of its threads come to what they do
    together.
    """
    reserved = wp.tile_empty(shape=(WORDS,), dtype=int, storage="shared")  # noqa: F841
    at = begin_group(particles, sums)
    left = bool(False)
    if at[1] < at[3]:
        left = scatters(blocks, moving, at[0], at[1], failure)
    goes_on = bool(True)
    while goes_on:
        left = scatter_left(
            grid, step, particles, moving, boundaries, blocks, failure, sums, contact.num_fields, at, left
        )  # fmt: skip
        goes_on = begins_again()


def record_groups(program: Program, model: Model, inputs: list[Any], outputs: list[Any]) -> None:
    """Append the P2G of all groups of all environments; no CUDA block has two."""
    share = share_of(model.num_particles)
    threads = model.num_envs * (model.particles.groups.shape[0] - 1) * share
    program.launch(runs_to_grid, threads, inputs, outputs, block_dim=share)
