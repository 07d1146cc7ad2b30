"""Worlds of several agents: one PettingZoo module each, such as ``piavatar_envs.tasks.games.sumo`` (extra ``multi``).

A new file ``<name>_v<N>.py`` with a ``TASK``, a ``parallel_env`` and an ``env`` is found and tested without being
listed anywhere. Importing this package imports none of them.
"""

from __future__ import annotations

import importlib
import pkgutil
import re
from collections.abc import Iterable
from types import ModuleType

from piavatar_envs.tasks import instead_of

_MODULE = re.compile(r"[a-z0-9_]+_v\d+")


def multi_modules() -> tuple[str, ...]:
    """Dotted names of all modules, such as ``piavatar_envs.tasks.games.sumo``. Imports nothing."""
    names = sorted(module.name for module in pkgutil.iter_modules(__path__))
    return tuple(f"{__name__}.{name}" for name in names if _MODULE.fullmatch(name))


def listed_worlds() -> dict[str, str]:
    """Listed name -> dotted name of the module: ``sumo_v0`` for ``piavatar_envs.tasks.games.sumo``. Imports nothing."""
    return {path.rpartition(".")[2]: path for path in multi_modules()}


def load_world(name: str, others: Iterable[str] = ()) -> ModuleType:
    """The module of a world by its listed name, such as ``sumo_v0``.

    Args:
        name: of the world.
        others: what else may be asked for where the name was given.

    Raises:
        ImportError: PettingZoo is not installed.
        ValueError: there is no such world.
    """
    known = listed_worlds()
    if name not in known:
        raise ValueError(f"unknown world {name!r}; {instead_of(name, [*known, *others])}")
    return importlib.import_module(known[name])
