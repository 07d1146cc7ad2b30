"""One launch a substep: G2P and the next substep's P2G together, and no grid pass.

For bodies of few particles a cell on a GPU, see :mod:`piavatar_envs.mpm.singles`, and for substeps between which
nothing else acts. Where there are several fields, their contact takes a short launch more, see
:mod:`piavatar_envs.mpm.relay_contact`. A launch is mostly waiting there: for what it reads, and for the last of its
threads. What it does for a particle is in :mod:`piavatar_envs.mpm.carry`.

There are three sets of sums, in turns: a launch gathers what the last one has added up, adds to the next set, and
clears the one that the last launch has gathered. With contact between there are two, one of which the contact clears.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
import warp as wp

from piavatar_envs.mpm.blocks import slots_used
from piavatar_envs.mpm.carry import TEAM_OF_FIELDS, Turn, carry_fields_on, carry_on
from piavatar_envs.mpm.counts import Counts
from piavatar_envs.mpm.measures import forget_measures
from piavatar_envs.mpm.meeting import meetings_of
from piavatar_envs.mpm.program import Program
from piavatar_envs.mpm.ranks import PART, Ranks, forget_ranks
from piavatar_envs.mpm.relay_contact import record_contact, record_meeting
from piavatar_envs.mpm.singles import TEAM, THREADS, record_first
from piavatar_envs.mpm.sweep import LANES, lanes_of_warp
from piavatar_envs.mpm.team_clear import clear_slot
from piavatar_envs.mpm.threads import environment_of
from piavatar_envs.mpm.turns import sets_of_sums, turns_of
from piavatar_envs.mpm.types import Blocks, Model, Moving, Scratch, State

# divisions and roots to two units in the last place, and logarithms to 4e-7, in a few instructions instead of calls
wp.set_module_options({"enable_backward": False, "default_grid_stride": False, "fast_math": True})

#: At most so many substeps between two marks of all blocks, which cost nine launches or more. Blocks that a body leaves
#: behind keep their slots until then, so that a fast one needs more of them than where they are marked every eight.
PORTION = 50


@wp.kernel
def begin_turns(failure: wp.array(dtype=int), stops: wp.array(dtype=int)):
    """Environments that have failed take no part."""
    e = wp.tid()
    stops[e] = wp.where(failure[e] != 0, 0, PORTION + 1)


@wp.kernel
def sweep_sums(blocks: Blocks, swept: int, slots: int, counts: Counts, ranks: Ranks):
    """:func:`clear_slot` of all ``slots`` that an environment may have, a warp each; the first forgets the rest."""
    at = environment_of(wp.tid() // lanes_of_warp(), slots)
    told = counts.told[at[0], swept + at[1]] != 0
    if at[1] < slots_used(blocks, at[0]):
        clear_slot(counts, at[0], swept + at[1], told)
    if at[1] == 0:
        forget_measures(counts, at[0])
        forget_ranks(ranks, at[0])


def record_relay(
    program: Program, model: Model, state: State, scratch: Scratch, moving: Moving, inputs: list[Any], count: int
) -> None:
    """Append ``count`` substeps whose blocks have just been marked; ``inputs`` are those of :func:`record_first`."""
    m, s, turns = model, state, turns_of(model, scratch)
    counts, ranks = turns.counts, turns.ranks
    stops = wp.zeros(m.num_envs, dtype=int, device=m.device)
    record_first(program, inputs, s.x.shape, s.failure, counts, ranks)
    program.launch(begin_turns, m.num_envs, [s.failure], [stops])
    several, sets = m.contact.num_fields > 1, sets_of_sums(m)
    team = int(TEAM_OF_FIELDS if several else TEAM)
    if several:
        record_contact(program, m, scratch)
    for index in range(count):
        turn = Turn()
        turn.substep, turn.stops, turn.order = index, stops, ranks.order
        turn.gathered, turn.scattered, turn.swept = (m.max_slots * ((index + n) % sets) for n in (0, 1, sets - 1))
        if index == count - 1:
            turn.scattered = -1
        if index == 0:
            turn.swept = -1
        if several:
            record_meeting(program, m, scratch, stops, index, turn.gathered, turn.swept)
            turn.swept = -1
        others = [meetings_of(m, scratch).others[index & 1]] if several else []
        program.launch(
            carry_fields_on if several else carry_on,
            m.num_envs * ranks.order.shape[1] * int(PART) * team,
            [m.grid, m.step, m.particles, m.boundaries, m.contact, turn, *others],
            [scratch.blocks, moving, s.failure, counts, scratch.sensors],
            block_dim=THREADS,
        )
    program.launch(
        sweep_sums,
        m.num_envs * m.max_slots * LANES,
        [scratch.blocks, turn.gathered, m.max_slots],
        [counts, ranks],
        block_dim=THREADS,
    )


def portions(count: int) -> list[int]:
    """``count`` substeps in as few equal parts as may be, none longer than ``PORTION``."""
    ends = np.linspace(0, count, -(-count // PORTION) + 1).round().astype(int)
    return [int(end - begin) for begin, end in pairwise(ends)]
