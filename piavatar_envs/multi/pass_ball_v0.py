"""PassBall: a circle of avatars keeps a ball going round.

In the form of PettingZoo's own games: ``pass_ball_v0.parallel_env()``. For the rules see
:mod:`piavatar_envs.tasks.games.pass_ball`.
"""

from piavatar_envs.multi import Game
from piavatar_envs.tasks.games.pass_ball import PassBallTask

__all__ = ["TASK", "env", "parallel_env"]

TASK = PassBallTask
_game = Game("pass_ball_v0", TASK)
parallel_env, env = _game.parallel_env, _game.env
