"""PettingZoo environments of the games in :mod:`piavatar_envs.tasks.games` (extra ``multi``).

Every game is built by its name, ``parallel_env("sumo_v0")``. Those of this package also have modules here, in the style
of PettingZoo: ``from piavatar_envs.multi import sumo_v0``. Importing this package imports none of them, and registers
them with PettingZoo from 1.27 on: ``pettingzoo.make("parallel", "piavatar/sumo_v0")``.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

from piavatar_envs.tasks.games import game_modules, listed_games, load_game_task

if TYPE_CHECKING:
    from piavatar_envs.api.pettingzoo import AECEnv, AvatarParallelEnv
    from piavatar_envs.envs.task import Task

__all__ = ["Game", "env", "listed_games", "load_game", "parallel_env"]


@dataclass(frozen=True)
class Game:
    """A game with the members of a PettingZoo module.

    Attributes:
        name: such as ``sumo_v0``.
        TASK: its task.
    """

    name: str
    TASK: type[Task]

    def parallel_env(self, **settings: Any) -> AvatarParallelEnv:
        """Build the game; for the settings see :class:`~piavatar_envs.api.pettingzoo.AvatarParallelEnv`.

        Raises:
            ImportError: PettingZoo is not installed.
        """
        from piavatar_envs.api.pettingzoo import AvatarParallelEnv

        return AvatarParallelEnv(self.TASK, name=self.name, **settings)

    def env(self, **settings: Any) -> AECEnv:
        """Build the same game for PettingZoo's turn-based API.

        Raises:
            ImportError: PettingZoo is not installed.
        """
        from piavatar_envs.api.pettingzoo import parallel_to_aec

        return parallel_to_aec(self.parallel_env(**settings))


def load_game(name: str, others: Iterable[str] = ()) -> Game:
    """Return a game by its name.

    Args:
        name: such as ``sumo_v0``; ``"module:name"`` imports the module first, which registers it.
        others: other names that were possible, for the message.

    Raises:
        ImportError: a module cannot be imported.
        ValueError: there is no such game.
    """
    return Game(name.rpartition(":")[2], load_game_task(name, others))


def parallel_env(name: str, **settings: Any) -> AvatarParallelEnv:
    """Build the game ``name``; see :func:`load_game` and :meth:`Game.parallel_env`."""
    return load_game(name).parallel_env(**settings)


def env(name: str, **settings: Any) -> AECEnv:
    """Build the game ``name`` for PettingZoo's turn-based API; see :func:`load_game` and :meth:`Game.env`."""
    return load_game(name).env(**settings)


def _register() -> None:
    """Add the games of this package to PettingZoo's registries; does nothing where it has none or is not installed."""
    try:
        from pettingzoo import register
    except ImportError:
        return
    for name in game_modules():
        register("parallel", f"piavatar/{name}", partial(parallel_env, name))
        register("aec", f"piavatar/{name}", partial(env, name))


_register()
