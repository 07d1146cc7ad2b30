"""Tasks: one file each. A new file with a ``TASK`` is registered and tested without being listed anywhere."""

from __future__ import annotations

import importlib
import pkgutil
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from piavatar_envs.tasks.base import Task

_NOT_TASKS = {
    "base",
    "clip",
    "disturb",
    "ease",
    "fall",
    "gait",
    "gate",
    "goal",
    "ground",
    "hands",
    "hits",
    "leash",
    "lying",
    "place",
    "pushes",
    "pushing",
    "ranges",
    "rewards",
    "rising",
    "spawn",
    "throws",
    "turns",
    "upright",
}
NAMESPACE = "PIAvatar"


def task_modules() -> dict[str, str]:
    """Registered id -> module name: ``PIAvatar/TrackMotion-v0`` for ``track_motion``. Imports nothing."""
    names = sorted(m.name for m in pkgutil.iter_modules(__path__) if m.name not in _NOT_TASKS)
    return {f"{NAMESPACE}/{''.join(part.capitalize() for part in name.split('_'))}-v0": name for name in names}


def load_task(env_id: str) -> type[Task]:
    """The task class of an id, with or without the namespace.

    Raises:
        ValueError: there is no such task.
    """
    modules = task_modules()
    full = env_id if "/" in env_id else f"{NAMESPACE}/{env_id}"
    if full not in modules:
        raise ValueError(f"unknown task {env_id!r}; there are {', '.join(modules)}")
    return importlib.import_module(f"{__name__}.{modules[full]}").TASK
