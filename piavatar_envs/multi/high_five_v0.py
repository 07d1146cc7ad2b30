"""HighFive: two avatars face each other and slap one hand each.

In the form of PettingZoo's own games: ``high_five_v0.parallel_env()``. For the rules see
:mod:`piavatar_envs.tasks.games.high_five`.
"""

from piavatar_envs.multi import Game
from piavatar_envs.tasks.games.high_five import HighFiveTask

__all__ = ["TASK", "env", "parallel_env"]

TASK = HighFiveTask
_game = Game("high_five_v0", TASK)
parallel_env, env = _game.parallel_env, _game.env
