"""Games of several agents: one file each. A new file with a ``TASK`` is the game ``<file>_v0`` without being listed.

:mod:`piavatar_envs.multi` makes PettingZoo environments of them.
"""

from __future__ import annotations

import importlib
import pkgutil
import re
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any, NoReturn

from piavatar_envs.tasks import check_task_class, instead_of, load_task

if TYPE_CHECKING:
    from piavatar_envs.envs.task import Task

#: Games from elsewhere by name, see :func:`register_game`.
_added: dict[str, type[Task] | str] = {}


def game_modules() -> dict[str, str]:
    """Return the games of this package, name -> module: ``sumo_v0`` for ``sumo``. Imports nothing."""
    return {f"{name}_v0": name for name in sorted(m.name for m in pkgutil.iter_modules(__path__))}


def listed_games() -> tuple[str, ...]:
    """Return the names of all games, those of this package first. Imports nothing."""
    return (*game_modules(), *_added)


def refuse_single(game: str, **settings: Any) -> NoReturn:
    """Refuse to make a game with Gymnasium, which has one agent.

    Raises:
        ValueError: always, with the way to make it.
    """
    raise ValueError(
        f"{game} is a game of several agents, which gym.make cannot make; use PettingZoo's interface: "
        f"from piavatar_envs.multi import {game}; {game}.parallel_env()"
    )


def register_game(name: str, task: type[Task] | str) -> None:
    """Make a task of several agents a game for :mod:`piavatar_envs.multi` and the command line; see docs/tasks.md.

    Args:
        name: a name and a version: ``"tag_v0"``. A game from elsewhere that has it already is replaced.
        task: a subclass of :class:`piavatar_envs.Task`, or ``"module:Class"``, imported when it is first used.

    Raises:
        TypeError: the task is neither.
        ValueError: a name without a version, or that of a game of this package.
    """
    if not re.fullmatch(r"[a-z0-9_]+_v\d+", name):
        raise ValueError(f"{name!r} must be a name in small letters and a version, such as 'tag_v0'")
    if name in game_modules():
        raise ValueError(f"{name!r} is a game of this package; choose another name")
    check_task_class(name, task)
    _added[name] = task


def load_game_task(name: str, others: Iterable[str] = ()) -> type[Task]:
    """Return the task of a game.

    Args:
        name: of the game, such as ``sumo_v0``; ``"module:name"`` imports the module first, which registers it.
        others: other names that were possible, for the message.

    Raises:
        ImportError: a module cannot be imported.
        ValueError: there is no such game.
    """
    module, _, own = name.rpartition(":")
    if module:
        importlib.import_module(module)
    if own in _added:
        return load_task(_added[own])
    modules = game_modules()
    if own not in modules:
        raise ValueError(f"unknown game {name!r}; {instead_of(own, [*listed_games(), *others])}")
    return importlib.import_module(f"{__name__}.{modules[own]}").TASK
