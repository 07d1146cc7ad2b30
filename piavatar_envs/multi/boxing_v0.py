"""Boxing: hit the other's head and trunk with the arms, and keep your own out of the way.

The rules are in :mod:`piavatar_envs.tasks.games.boxing`, which is enough for
``piavatar_envs.multi.parallel_env("boxing_v0")``. This module adds only the form that PettingZoo's own games have,
``boxing_v0.parallel_env()``.

"""

from __future__ import annotations

from typing import Any

from piavatar_envs.api.pettingzoo import AECEnv, AvatarParallelEnv, parallel_to_aec
from piavatar_envs.tasks.games.boxing import BoxingTask

TASK = BoxingTask


def parallel_env(**settings: Any) -> AvatarParallelEnv:
    """Build the game; for the settings see :class:`~piavatar_envs.api.pettingzoo.AvatarParallelEnv`."""
    return AvatarParallelEnv(TASK, name="boxing_v0", **settings)


def env(**settings: Any) -> AECEnv:
    """Build the same game for PettingZoo's turn-based API."""
    return parallel_to_aec(parallel_env(**settings))
