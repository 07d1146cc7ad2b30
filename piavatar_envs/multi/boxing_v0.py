"""Boxing: hit the other's head and trunk with the arms, and keep your own out of the way.

In the form of PettingZoo's own games: ``boxing_v0.parallel_env()``. For the rules see
:mod:`piavatar_envs.tasks.games.boxing`.
"""

from piavatar_envs.multi import Game
from piavatar_envs.tasks.games.boxing import BoxingTask

__all__ = ["TASK", "env", "parallel_env"]

TASK = BoxingTask
_game = Game("boxing_v0", TASK)
parallel_env, env = _game.parallel_env, _game.env
