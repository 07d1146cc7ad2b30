"""Sumo: push the others out of the ring, or over, and stay in it.

The rules are in :mod:`piavatar_envs.tasks.games.sumo`, which is enough for
``piavatar_envs.multi.parallel_env("sumo_v0")``. This module adds only the form that PettingZoo's own games have,
``sumo_v0.parallel_env()``.

"""

from __future__ import annotations

from typing import Any

from piavatar_envs.api.pettingzoo import AECEnv, AvatarParallelEnv, parallel_to_aec
from piavatar_envs.tasks.games.sumo import SumoTask

TASK = SumoTask


def parallel_env(**settings: Any) -> AvatarParallelEnv:
    """Build the game; for the settings see :class:`~piavatar_envs.api.pettingzoo.AvatarParallelEnv`."""
    return AvatarParallelEnv(TASK, name="sumo_v0", **settings)


def env(**settings: Any) -> AECEnv:
    """Build the same game for PettingZoo's turn-based API."""
    return parallel_to_aec(parallel_env(**settings))
