"""Which worlds have several sets of sums, in use in turns, for substeps of one launch each."""

from __future__ import annotations

from piavatar_envs.mpm.types import PAPER, Model

#: Sets of sums that those worlds have.
TURNS = 3


def has_turns(model: Model) -> bool:
    """Whether substeps between which nothing acts are one launch each, see :mod:`piavatar_envs.mpm.relay`.

    Few particles a cell, one field, boundaries that rest, and no need of kinematic gradients.
    """
    alone = model.contact.num_fields == 1 and not model.moving_boundaries
    return model.scatter == "singles" and alone and model.step.decoupling != int(PAPER)


def sets_of_sums(model: Model) -> int:
    """How many sets of sums a world has."""
    return TURNS if has_turns(model) else 1
