"""Sumo: push the others out of the ring, or over, and stay in it.

In the form of PettingZoo's own games: ``sumo_v0.parallel_env()``. For the rules see
:mod:`piavatar_envs.tasks.games.sumo`.
"""

from piavatar_envs.multi import Game
from piavatar_envs.tasks.games.sumo import SumoTask

__all__ = ["TASK", "env", "parallel_env"]

TASK = SumoTask
_game = Game("sumo_v0", TASK)
parallel_env, env = _game.parallel_env, _game.env
