"""Contact between velocity fields where substeps are one launch each: see :mod:`piavatar_envs.mpm.relay`.

Between two such launches there are two short ones, before anybody gathers. The first goes over all nodes of blocks with
several fields and lists those where fields may touch, the second over these, see :mod:`piavatar_envs.mpm.meeting`. What
a pair gives each other there is added to its sums: who gathers makes velocities out of these, and need not know which
nodes have been in contact. In integers, what one loses the other gains exactly.

Contact asks where the particles of a node are, so all of them must tell it. Whoever scatters goes by where fields were
*before* the launch, which does not depend on the order in which others of it come to their nodes: a field has told a
node if another was there in the substep before, and only nodes that both have told are in contact. That is a substep
after the second has come to it, with little weight unless it moves nearly a grid spacing in a time step.
"""

from __future__ import annotations

import warp as wp

from piavatar_envs.mpm.blocks import (
    end_of_fields,
    first_record,
    has_field,
    lowest_field,
    nodes_shared,
    shared_block,
)
from piavatar_envs.mpm.contact import book_contact, book_pair, impulse_between
from piavatar_envs.mpm.grid import total_velocity
from piavatar_envs.mpm.impulses import read_change, write_change
from piavatar_envs.mpm.meeting import (
    Meeting,
    begin_list,
    begin_meeting,
    node_meeting,
    nodes_meeting,
    note_meeting,
    warps_of_meeting,
)
from piavatar_envs.mpm.normals import facing_from, normal_of_warp, volume_at
from piavatar_envs.mpm.others import has_bit, note_bits, told_at_first
from piavatar_envs.mpm.program import Program
from piavatar_envs.mpm.singles import place_of_block
from piavatar_envs.mpm.stencil import BLOCK_NODES, block_corner, node_of_block
from piavatar_envs.mpm.sums import (
    begin_sum,
    counted,
    give_momentum,
    kinematic_numbers,
    numbers_at,
    offset_from,
    physical_sum,
    sum_from,
    units_of,
)
from piavatar_envs.mpm.sweep import LANES, THREADS, Sweep, lane_of_thread, plan_sweep
from piavatar_envs.mpm.threads import environment_of
from piavatar_envs.mpm.types import NO_STRESS, SPLIT, Blocks, Contact, Grid, Model, Scratch, Sensors, Step, Sums

# divisions and roots to two units in the last place, in a few instructions instead of calls
wp.set_module_options({"enable_backward": False, "default_grid_stride": False, "fast_math": True})


@wp.func
def place_of_bits(slots: int, substep: int, slot: int):
    """The first of two words with the bits of a slot's nodes, those that the launches of a ``substep`` write."""
    return 2 * ((substep & 1) * slots + slot)


@wp.func
def had_others(others: wp.array2d(dtype=int), slots: int, e: int, substep: int, r: int):
    """Whether the node of a field's record ``r`` had another field in ``substep``; in the next, its own has told it."""
    return has_bit(others, e, place_of_bits(slots, substep, r // BLOCK_NODES), r % BLOCK_NODES)


@wp.func
def nodes_along(base: int, upper: bool):
    """Bits of the nodes ``base`` to ``base + 2`` in a block of 4 along an axis, the lower or upper that they lie in."""
    block = base >> 2
    if upper:
        block = (base + 2) >> 2
    return (7 << (base - 4 * block + 2) >> 2) & 15


@wp.func
def meets_others(
    team: int, others: wp.array2d(dtype=int), slots: int, e: int, substep: int, slot: wp.vec2i, base: wp.vec3i
):
    """Whether there was another field at those nodes of the stencil at ``base`` that are in a thread's blocks.

    Those of :func:`piavatar_envs.mpm.singles.slots_of_thread`, which these are.
    """
    meets = has_others(others, slots, e, substep, slot[0], place_of_block(team, 0), base)
    if team == 4:
        meets = has_others(others, slots, e, substep, slot[1], place_of_block(team, 1), base) or meets
    return meets


@wp.func
def has_others(others: wp.array2d(dtype=int), slots: int, e: int, substep: int, slot: int, place: int, base: wp.vec3i):
    """:func:`meets_others` in one ``slot``, by its :func:`piavatar_envs.mpm.singles.place_of_block`."""
    at = place_of_bits(slots, substep, slot)
    lower = others[e, at]
    upper = others[e, at + 1]
    x = nodes_along(base[0], (place & 4) != 0)
    y = nodes_along(base[1], (place & 2) != 0)
    z = nodes_along(base[2], (place & 1) != 0)
    plane = z * ((y & 1) | ((y & 2) << 3) | ((y & 4) << 6) | ((y & 8) << 9))
    first = plane * (x & 1) | (plane << 16) * ((x >> 1) & 1)
    second = plane * ((x >> 2) & 1) | (plane << 16) * (x >> 3)
    return ((lower & first) | (upper & second)) != 0


@wp.kernel
def begin_contact(blocks: Blocks, others: wp.array2d(dtype=int), sensors: Sensors, meeting: Meeting):
    """All have told where blocks have several fields, and nothing has been touched."""
    e, slot = wp.tid()
    if slot == 0:
        meeting.count[e, 0] = 0
        meeting.count[e, 1] = 0
    slots = blocks.held.shape[1]
    told = told_at_first(blocks, e, slot)
    for half in range(2):
        others[e, place_of_bits(slots, 0, slot) + half] = 0
        others[e, place_of_bits(slots, 1, slot) + half] = told
    sensors.touched[e, slot] = 0


@wp.kernel(launch_bounds=(THREADS, 6))
def face_fields(
    grid: Grid,
    contact: Contact,
    sweep: Sweep,
    substep: int,
    gathered: int,
    blocks: Blocks,
    sums: Sums,
    # in and out
    others: wp.array2d(dtype=int),
    # out
    node_facing: wp.array2d(dtype=wp.vec4),
    meeting: Meeting,
    sensors: Sensors,
):
    """What every node of a block with several fields says about the normals around it, who is there, and who may touch.

    Fields may where all particles of two or more have told the node where they are.
    """
    at = environment_of(wp.tid(), sweep.threads)
    e = at[0]
    if at[1] == 0:
        begin_meeting(meeting, e, substep)
    slots = blocks.held.shape[1]
    end = nodes_shared(blocks, e)
    for turn in range(sweep.turns):
        n = at[1] + turn * sweep.stride
        block = shared_block(blocks, e, n)
        if n >= end:  # so for all threads of a warp, which have half of a block
            break
        local = n % BLOCK_NODES
        mask = blocks.fields[e, block]
        first = lowest_field(mask, contact.num_fields)
        last = end_of_fields(mask)
        present = int(0)
        told = int(0)
        for f in range(first, last):
            if has_field(mask, f):
                r = first_record(grid, blocks, e, f, block) + local
                at_node = BLOCK_NODES * gathered + r
                begun = begin_sum(sums, e, at_node)  # all is asked for before it is known what for
                off = numbers_at(sums.offset_fixed, e, at_node)
                has_told = had_others(others, slots, e, substep + 1, r)
                m = physical_sum(units_of(sums, e, f), counted(begun))[0]
                V = volume_at(grid, contact, e, f, m)
                facing = wp.vec4()
                if m > 0.0:
                    present = present | (1 << f)
                if has_told and V > 0.0:
                    facing = facing_from(grid, V, m, offset_from(grid, sums, e, f, off))
                told += wp.where(facing[3] > 0.0, 1, 0)
                write_change(node_facing, e, r, facing)
                write_change(sensors.node, e, r, wp.vec4())
        note_meeting(meeting, e, substep, BLOCK_NODES * block + local, told > 1)
        for f in range(first, last):
            if has_field(mask, f):
                r = first_record(grid, blocks, e, f, block) + local
                first_word = place_of_bits(slots, substep, r // BLOCK_NODES)
                note_bits(others, e, first_word, local, (present & ~(1 << f)) != 0)


@wp.func
def meet_pair(
    grid: Grid,
    step: Step,
    contact: Contact,
    blocks: Blocks,
    sums: Sums,
    sensors: Sensors,
    node_facing: wp.array2d(dtype=wp.vec4),
    substep: int,
    gathered: int,
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
    sa = BLOCK_NODES * gathered + ra
    sb = BLOCK_NODES * gathered + rb
    node = node_of_block(block_corner(grid, block), local)
    # all is asked for before the first has answered
    units_a = units_of(sums, e, a)
    units_b = units_of(sums, e, b)
    begun_a = begin_sum(sums, e, sa)
    begun_b = begin_sum(sums, e, sb)
    driven_a = kinematic_numbers(sums, e, sa)
    driven_b = kinematic_numbers(sums, e, sb)
    off_a = numbers_at(sums.offset_fixed, e, sa)
    off_b = numbers_at(sums.offset_fixed, e, sb)
    facing_a = read_change(node_facing, e, ra)
    facing_b = read_change(node_facing, e, rb)
    n_ab = normal_of_warp(grid, blocks, e, node, a, b, node_facing)
    if lane_of_thread() != 0 or facing_a[3] <= 0.0 or facing_b[3] <= 0.0:
        return
    va = total_velocity(step, split, sum_from(units_a, begun_a, driven_a))
    vb = total_velocity(step, split, sum_from(units_b, begun_b, driven_b))
    offset_a = offset_from(grid, sums, e, a, off_a)
    offset_b = offset_from(grid, sums, e, b, off_b)
    J = impulse_between(grid, contact, e, a, b, va, vb, offset_a, offset_b, n_ab)
    if wp.length_sq(J) <= 0.0:
        return
    give_momentum(sums, e, a, sa, -J)
    give_momentum(sums, e, b, sb, J)
    book_contact(contact, e, ra, b, -J / va[0], substep + 1, sensors)
    book_contact(contact, e, rb, a, J / vb[0], substep + 1, sensors)
    book_pair(contact, e, a, b, J, sensors)


@wp.kernel(launch_bounds=(THREADS, 4))
def meet_fields(
    grid: Grid,
    step: Step,
    contact: Contact,
    warps: int,
    substep: int,
    gathered: int,
    stops: wp.array(dtype=int),
    meeting: Meeting,
    blocks: Blocks,
    node_facing: wp.array2d(dtype=wp.vec4),
    # in and out
    sums: Sums,
    sensors: Sensors,
):
    """Contact of all fields, in pairs, at every node where they may touch, by a warp; what follows reads the sums."""
    at = environment_of(wp.tid() // LANES, warps)
    e = at[0]
    n = at[1]
    node = node_meeting(meeting, e, n)
    end = nodes_meeting(meeting, e, substep)
    while n < end and stops[e] > substep:
        mask = blocks.fields[e, node[0]]
        first = lowest_field(mask, contact.num_fields)
        last = end_of_fields(mask)
        for a in range(first, last - 1):
            for b in range(a + 1, last):
                if has_field(mask, a) and has_field(mask, b):
                    meet_pair(
                        grid, step, contact, blocks, sums, sensors, node_facing, substep, gathered, e, node[0], node[1],
                        a, b,
                    )  # fmt: skip
        n += warps
        node = node_meeting(meeting, e, n)


def record_contact(program: Program, model: Model, scratch: Scratch) -> tuple[wp.array, Meeting]:
    """Append what comes before the first contact, blocks having been marked.

    Returns:
        where other fields are, bits of a field's slots, in turns: see :func:`had_others`; and who may touch where.
    """
    others = wp.zeros((model.num_envs, 4 * model.max_slots), dtype=int, device=model.device)
    meeting = begin_list(model)
    outputs = [others, scratch.sensors, meeting]
    program.launch(begin_contact, (model.num_envs, model.max_slots), [scratch.blocks], outputs)
    return others, meeting


def record_meeting(
    program: Program,
    model: Model,
    scratch: Scratch,
    others: wp.array,
    meeting: Meeting,
    stops: wp.array,
    substep: int,
    gathered: int,
) -> None:
    """Append the contact of a substep, the set of sums whose first slot is ``gathered`` being complete."""
    m, sweep, turn, warps = model, plan_sweep(model), [substep, gathered], warps_of_meeting(model)
    program.launch(
        face_fields,
        m.num_envs * sweep.threads,
        [m.grid, m.contact, sweep, *turn, scratch.blocks, scratch.turns],
        [others, scratch.facing, meeting, scratch.sensors],
        block_dim=THREADS,
    )
    program.launch(
        meet_fields,
        m.num_envs * warps * LANES,
        [m.grid, m.step, m.contact, warps, *turn, stops, meeting, scratch.blocks, scratch.facing],
        [scratch.turns, scratch.sensors],
        block_dim=THREADS,
    )
