"""Which worlds have several sets of sums, in use in turns, for substeps of one launch each."""

from __future__ import annotations

from dataclasses import dataclass

from piavatar_envs.mpm.counts import Counts, allocate_counts, is_sparse
from piavatar_envs.mpm.memory import MOST_SLOTS
from piavatar_envs.mpm.ranks import Ranks, allocate_ranks
from piavatar_envs.mpm.types import PAPER, Model, Scratch

#: Sets of sums that those worlds have at most.
TURNS = 3


def sets_of_sums(model: Model) -> int:
    """One is gathered, one is added to; and one is cleared, unless contact comes between and does that."""
    return TURNS if model.contact.num_fields == 1 else TURNS - 1


def has_turns(model: Model) -> bool:
    """Whether substeps between which nothing acts are one launch each, see :mod:`piavatar_envs.mpm.relay`.

    Few particles a cell, a field a subject, normals that are a pair's, boundaries that rest, no need of kinematic
    gradients, sums that strides of 32 bits can count, and nowhere so many particles that theirs cannot be counted.
    """
    if TURNS * model.max_slots >= MOST_SLOTS or not is_sparse(model):
        return False
    contact = model.contact
    plain = contact.num_fields == contact.num_subjects and contact.own_normals == 0 and not model.moving_boundaries
    return model.scatter == "singles" and plain and model.step.decoupling != int(PAPER)


@dataclass(frozen=True)
class Turns:
    """What relays add up, and in which order they carry particles on."""

    counts: Counts
    ranks: Ranks


def turns_of(model: Model, scratch: Scratch) -> Turns:
    """Those of a world, allocated when they are first asked for."""
    if scratch.turns is None:
        ranks = allocate_ranks(model.num_envs, model.num_particles, model.device)
        scratch.turns = Turns(allocate_counts(model, sets_of_sums(model)), ranks)
    return scratch.turns
