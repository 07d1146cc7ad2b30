"""Seeds as Gymnasium takes them, in the range that environments have."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium.utils import seeding

from piavatar_envs.core.rng import check_seeds


def checked_seed(seed: Any) -> int:
    """A seed as Gymnasium takes it, and below 2^32.

    Raises:
        ValueError: a seed outside [0, 2^32).
        gymnasium.error.Error: what is no seed.
    """
    seed = int(seed) if isinstance(seed, np.integer) else seed
    if isinstance(seed, int):
        check_seeds(seed)  # first: to Gymnasium a negative one is no seed
    seeding.np_random(seed)
    return seed
