"""Who is where in blocks with several fields, noted for the next substep: see :mod:`piavatar_envs.mpm.relay_contact`.

Bits of nodes say where a field has others, see :mod:`piavatar_envs.mpm.others`, and nodes where fields may touch are
listed, see :mod:`piavatar_envs.mpm.meeting`.
"""

from __future__ import annotations

import warp as wp

from piavatar_envs.mpm.blocks import end_of_fields, first_record, has_field, lowest_field, nodes_shared, shared_block
from piavatar_envs.mpm.counts import Counts, mass_counted
from piavatar_envs.mpm.impulses import write_change
from piavatar_envs.mpm.meeting import LENGTHS, Encounter, Meeting, begin_meeting, note_meeting
from piavatar_envs.mpm.others import had_others, note_bits
from piavatar_envs.mpm.stencil import BLOCK_NODES
from piavatar_envs.mpm.sweep import Sweep
from piavatar_envs.mpm.types import Blocks, Contact, Grid, Sensors

wp.set_module_options({"enable_backward": False})


@wp.kernel
def begin_contact(even: wp.array2d(dtype=int), odd: wp.array2d(dtype=int), sensors: Sensors, meeting: Meeting):
    """Nobody is anywhere, no node is listed, and nothing has been touched."""
    e, slot = wp.tid()
    if slot == 0:
        for n in range(LENGTHS):
            meeting.count[e, n] = 0
    for half in range(2):
        even[e, 2 * slot + half] = 0
        odd[e, 2 * slot + half] = 0
    sensors.touched[e, slot] = 0


@wp.func
def note_fields(
    grid: Grid,
    contact: Contact,
    sweep: Sweep,
    now: Encounter,
    thread: int,
    e: int,
    blocks: Blocks,
    had: wp.array2d(dtype=int),
    counts: Counts,
    others: wp.array2d(dtype=int),
    meeting: Meeting,
    sensors: Sensors,
):
    """Note who is at the nodes of blocks with several fields, a ``thread`` each, and where they may touch next.

    Fields may where all particles of two or more will have told the node where they are: those that others are with,
    also fields that are not at the node, but in its block, and may come.
    """
    if thread == 0:
        begin_meeting(meeting, e, now.substep)
    end = nodes_shared(blocks, e)
    for turn in range(sweep.turns):
        n = thread + turn * sweep.stride
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
                m = mass_counted(counts, e, BLOCK_NODES * now.gathered + r)
                told += wp.where(had_others(had, e, r), 1, 0)
                present = present | wp.where(m > 0, 1 << f, 0)
        tell = int(0)
        for f in range(first, last):
            if has_field(mask, f):
                r = first_record(grid, blocks, e, f, block) + local
                here = (present & ~(1 << f)) != 0
                tell += wp.where(here, 1, 0)
                note_bits(others, e, 2 * (r // BLOCK_NODES), local, here)
                if told < 2:  # else the node was listed, and who sees to it writes that
                    write_change(sensors.node, e, r, wp.vec4())
        note_meeting(meeting, e, now.substep, BLOCK_NODES * block + local, tell > 1)
