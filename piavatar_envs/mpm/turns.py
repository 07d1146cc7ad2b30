"""Which worlds have several sets of sums, in use in turns, for substeps of one launch each."""

from __future__ import annotations

from piavatar_envs.mpm.counts import is_sparse
from piavatar_envs.mpm.memory import MOST_SLOTS
from piavatar_envs.mpm.types import PAPER, Model

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
