"""Which episodes a training plays: none that an evaluation does, and none that a training of another seed does.

Environment ``i`` of a training plays the episodes of its first seed plus ``i``, whichever library learns and however
the environments run.
"""

from __future__ import annotations

#: Training episodes begin here; those of evaluations, which no agent was trained on, end before it.
FIRST_TRAINED = 2**30
#: Environments that one training can have: so many seeds are its own.
MOST_ENVS = 2**16
#: Seeds that trainings can have: the episodes' seeds stay below 2^31.
MOST_RUNS = 1000


def first_seed(run: int) -> int:
    """Seed of the first environment's episodes in the training of seed ``run``."""
    return FIRST_TRAINED + MOST_ENVS * run
