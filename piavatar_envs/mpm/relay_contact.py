"""Contact between velocity fields where substeps are one launch each: see :mod:`piavatar_envs.mpm.relay`.

Between two such launches there is a short one, before anybody gathers. Some of its warps see to the nodes at which
fields may touch, which were listed in the substep before; others go over all nodes of blocks with several fields, note
who is where, and list the nodes of the next substep, see :mod:`piavatar_envs.mpm.relay_notes`. What a pair gives each
other is added to its sums: who gathers makes velocities out of these, and need not know which nodes have been in
contact. In integers, what one loses the other gains exactly.
"""

from __future__ import annotations

import warp as wp

from piavatar_envs.mpm.blocks import (
    end_of_fields,
    first_record,
    has_field,
    lowest_field,
    slots_used,
)
from piavatar_envs.mpm.contact import book_contact, book_pair, impulse_between
from piavatar_envs.mpm.counts import (
    Counts,
    counted,
    give_momentum,
    in_units,
    kinematic_numbers,
    mass_counted,
    numbers_at,
    physical_numbers,
    place_counted,
    vec4i,
)
from piavatar_envs.mpm.grid import total_velocity
from piavatar_envs.mpm.impulses import write_change
from piavatar_envs.mpm.measures import mass_unit_of, speed_of_counts, units_at
from piavatar_envs.mpm.meeting import (
    Encounter,
    Meeting,
    meetings_of,
    node_meeting,
    nodes_meeting,
    warps_of_meeting,
    warps_that_clear,
)
from piavatar_envs.mpm.normals import MASS_MIN, facing_from, neighbour_of_lane, normal_of_warp, volume_at
from piavatar_envs.mpm.others import had_others
from piavatar_envs.mpm.program import Program
from piavatar_envs.mpm.relay_notes import begin_contact, note_fields
from piavatar_envs.mpm.stencil import BLOCK_NODES, block_corner, node_of_block
from piavatar_envs.mpm.sums import physical_sum
from piavatar_envs.mpm.sweep import LANES, THREADS, Sweep, lane_of_thread, plan_sweep
from piavatar_envs.mpm.team_clear import clear_share
from piavatar_envs.mpm.threads import environment_of
from piavatar_envs.mpm.turns import turns_of
from piavatar_envs.mpm.types import (
    NO_STRESS,
    SPLIT,
    Blocks,
    Contact,
    Grid,
    Model,
    Scratch,
    Sensors,
    Step,
    group,
    vec8,
)

# divisions and roots to two units in the last place, in a few instructions instead of calls
wp.set_module_options({"enable_backward": False, "default_grid_stride": False, "fast_math": True})


@wp.func
def facing_at(
    grid: Grid,
    contact: Contact,
    counts: Counts,
    had: wp.array2d(dtype=int),
    now: Encounter,
    e: int,
    f: int,
    unit: float,
    r: int,
):
    """What a node says of field ``f`` by its sums at record ``r``, see :func:`piavatar_envs.mpm.normals.facing_from`.

    Nothing if not all particles have told it where they are; ``unit`` is of mass.
    """
    at = BLOCK_NODES * now.gathered + r
    n = mass_counted(counts, e, at)
    place = numbers_at(counts.offset, e, at)
    has_told = had_others(had, e, r)
    m = unit * float(n)
    V = volume_at(grid, contact, e, f, m)
    facing = wp.vec4()
    if has_told and V > 0.0:
        facing = facing_from(grid, V, m, place_counted(grid, unit, place))
    return facing


@wp.func
def sum_counted(units: wp.vec2, physical: vec4i, kinematic: vec4i):
    """Mass, physical and kinematic momentum, ``units`` being those of mass and of momentum."""
    k = units[1] * counted(kinematic)
    return physical_sum(units, counted(physical)) + vec8(0.0, 0.0, 0.0, 0.0, k[0], k[1], k[2], 0.0)


@wp.func
def meet_pair(
    grid: Grid,
    step: Step,
    contact: Contact,
    now: Encounter,
    blocks: Blocks,
    had: wp.array2d(dtype=int),
    counts: Counts,
    sensors: Sensors,
    e: int,
    block: int,
    local: int,
    a: int,
    b: int,
):
    """Contact of the fields ``a < b`` at a node, if both have told it where they are, added to their sums; by a warp.

    Its threads share the nodes around, which say what the normal is; the first does the rest.
    """
    split = step.decoupling == SPLIT or step.decoupling == NO_STRESS
    ra = first_record(grid, blocks, e, a, block) + local
    rb = first_record(grid, blocks, e, b, block) + local
    sa = BLOCK_NODES * now.gathered + ra
    sb = BLOCK_NODES * now.gathered + rb
    # all is asked for before the first has answered
    speed = speed_of_counts(counts, e, now.substep)
    unit_a = mass_unit_of(counts, e, a)
    unit_b = mass_unit_of(counts, e, b)
    physical_a = physical_numbers(counts, e, sa)
    physical_b = physical_numbers(counts, e, sb)
    driven_a = kinematic_numbers(counts, e, sa)
    driven_b = kinematic_numbers(counts, e, sb)
    place_a = numbers_at(counts.offset, e, sa)
    place_b = numbers_at(counts.offset, e, sb)
    told = had_others(had, e, ra) and had_others(had, e, rb)
    near = neighbour_of_lane(grid, blocks, e, node_of_block(block_corner(grid, block), local), a, b)
    of_a = facing_at(grid, contact, counts, had, now, e, a, unit_a, near.a)
    of_b = facing_at(grid, contact, counts, had, now, e, b, unit_b, near.b)
    n_ab = normal_of_warp(near.c, of_a, of_b)
    va = total_velocity(step, split, sum_counted(units_at(unit_a, speed), physical_a, driven_a))
    vb = total_velocity(step, split, sum_counted(units_at(unit_b, speed), physical_b, driven_b))
    if lane_of_thread() != 0 or not told or va[0] <= MASS_MIN or vb[0] <= MASS_MIN:
        return
    offset_a = place_counted(grid, unit_a, place_a)
    offset_b = place_counted(grid, unit_b, place_b)
    J = impulse_between(grid, contact, e, a, b, va, vb, offset_a, offset_b, n_ab)
    J = in_units(J, wp.max(unit_a, unit_b) * speed)
    if wp.length_sq(J) <= 0.0:
        return
    give_momentum(counts, e, unit_a * speed, sa, -J)
    give_momentum(counts, e, unit_b * speed, sb, J)
    book_contact(contact, e, ra, b, -J / va[0], now.substep + 1, sensors)
    book_contact(contact, e, rb, a, J / vb[0], now.substep + 1, sensors)
    book_pair(contact, e, a, b, J, sensors)


@wp.func
def meet_at_nodes(
    grid: Grid,
    step: Step,
    contact: Contact,
    now: Encounter,
    warp: int,
    e: int,
    blocks: Blocks,
    had: wp.array2d(dtype=int),
    meeting: Meeting,
    counts: Counts,
    sensors: Sensors,
):
    """Contact of all fields, in pairs, at every node that was listed for this substep, a ``warp`` each."""
    n = warp
    node = node_meeting(meeting, e, now.substep, n)
    end = nodes_meeting(meeting, e, now.substep)
    while n < end and now.stops[e] > now.substep:
        mask = blocks.fields[e, node[0]]
        first = lowest_field(mask, contact.num_fields)
        last = end_of_fields(mask)
        for f in range(first, last):
            if has_field(mask, f) and lane_of_thread() == 0:
                write_change(sensors.node, e, first_record(grid, blocks, e, f, node[0]) + node[1], wp.vec4())
        for a in range(first, last - 1):
            for b in range(a + 1, last):
                if has_field(mask, a) and has_field(mask, b):
                    meet_pair(grid, step, contact, now, blocks, had, counts, sensors, e, node[0], node[1], a, b)
        n += now.warps
        node = node_meeting(meeting, e, now.substep, n)


@wp.kernel(launch_bounds=(THREADS, 5))
def meet_fields(
    grid: Grid,
    step: Step,
    contact: Contact,
    sweep: Sweep,
    now: Encounter,
    blocks: Blocks,
    had: wp.array2d(dtype=int),
    # in and out
    counts: Counts,
    # out
    others: wp.array2d(dtype=int),
    meeting: Meeting,
    sensors: Sensors,
):
    """Contact of a substep, and who may be in contact in the next; what follows reads the sums.

    Of every environment, the first warps see to nodes where fields may touch, by what was noted in the last substep,
    others to who is where, and the last clear sums that have been gathered: none asks what the others change. Before
    the first substep there are only the second.
    """
    at = environment_of(wp.tid(), LANES * (now.warps + now.clearing) + sweep.threads)
    thread = at[1] - LANES * now.warps
    if thread >= sweep.threads:
        slot = (thread - sweep.threads) // LANES
        told = counts.told[at[0], now.swept + slot] != 0
        clear_share(counts, at[0], now.swept, slot, slots_used(blocks, at[0]), now.clearing, told)
    elif thread < 0:
        meet_at_nodes(
            grid, step, contact, now, at[1] // LANES, at[0], blocks, had, meeting, counts, sensors
        )  # fmt: skip
    else:
        note_fields(grid, contact, sweep, now, thread, at[0], blocks, had, counts, others, meeting, sensors)


def record_contact(program: Program, model: Model, scratch: Scratch) -> None:
    """Append what comes before the first contact, blocks having been marked."""
    its = meetings_of(model, scratch)
    outputs = [*its.others, scratch.sensors, its.lists]
    program.launch(begin_contact, (model.num_envs, model.max_slots), [], outputs)


def record_meeting(
    program: Program, model: Model, scratch: Scratch, stops: wp.array, substep: int, gathered: int, swept: int
) -> None:
    """Append the contact of a ``substep``, the set of sums whose first slot is ``gathered`` being complete.

    That which begins with the slot ``swept`` is cleared, unless it is the first substep.
    """
    m, sweep, its = model, plan_sweep(model), meetings_of(model, scratch)
    for at in (-1, 0) if substep == 0 else (substep,):  # who is where before the first
        warps = warps_of_meeting(m) if at >= 0 else 0
        clearing = warps_that_clear(m) if substep > 0 else 0
        now = group(Encounter, substep=at, gathered=gathered, warps=warps, swept=swept, clearing=clearing, stops=stops)
        program.launch(
            meet_fields,
            m.num_envs * (LANES * (warps + clearing) + sweep.threads),
            [m.grid, m.step, m.contact, sweep, now, scratch.blocks, its.others[(at - 1) & 1]],
            [turns_of(m, scratch).counts, its.others[at & 1], its.lists, scratch.sensors],
            block_dim=THREADS,
        )
