"""Tasks: one file each. A new file with a ``TASK`` is registered and tested without being listed anywhere."""

from __future__ import annotations

import difflib
import importlib
import pkgutil
import re
from collections.abc import Iterable, Sequence
from importlib.util import find_spec
from typing import TYPE_CHECKING, TypeGuard

if TYPE_CHECKING:
    from piavatar_envs.envs.task import Task

NAMESPACE = "PIAvatar"
#: Prefix of the modules of games.
_MULTI = "piavatar_envs.multi."
_VERSION = re.compile(r"[-_]v\d+$")


def task_modules() -> dict[str, str]:
    """Return registered ids -> module names: ``PIAvatar/TrackMotion-v0`` for ``track_motion``. Imports nothing."""
    names = sorted(m.name for m in pkgutil.iter_modules(__path__) if not m.ispkg)
    return {id_of(name): name for name in names}


def id_of(module: str) -> str:
    """Return the id of a file's task: ``PIAvatar/TrackMotion-v0`` for ``track_motion``."""
    return f"{NAMESPACE}/{''.join(part.capitalize() for part in module.split('_'))}-v0"


#: Tasks from elsewhere by id, see :func:`add_task`.
_added: dict[str, type[Task] | str] = {}


def add_task(env_id: str, task: type[Task] | str) -> None:
    """Let :func:`load_task` find a task that is not of this package.

    Args:
        env_id: a namespace of your own, a name and a version: ``"Mine/Hop-v0"``. A task that has it is replaced.
        task: its class, or ``"module:Class"``, imported when it is first needed.

    Raises:
        TypeError: the task is neither.
        ValueError: an id without namespace or version, or one of this package.
    """
    if not re.fullmatch(r"[\w-]+/[\w.-]+-v\d+", env_id):
        raise ValueError(f"{env_id!r} must be a namespace, a name and a version, such as 'Mine/Hop-v0'")
    if env_id.startswith(f"{NAMESPACE}/"):
        raise ValueError(f"{env_id!r} is in the namespace of this package; use one of your own: 'Mine/Hop-v0'")
    check_task_class(env_id, task)
    _added[env_id] = task


def check_task_class(name: str, task: type[Task] | str) -> None:
    """Refuse what cannot be registered as the task ``name``.

    Raises:
        TypeError: the task is neither a class of a task nor ``"module:Class"``.
    """
    if not (_is_task(task) or (isinstance(task, str) and ":" in task)):
        raise TypeError(f"{name}: {task!r} is neither a subclass of Task nor 'module:Class'")


def place_of(env_id: str, task: type[Task] | str) -> str:
    """Return the name by which another process loads a task: ``"module:Class"``, or the id if no import gives it."""
    if isinstance(task, str):
        return task
    importable = task.__module__ != "__main__" and task.__qualname__.isidentifier()
    return f"{task.__module__}:{task.__name__}" if importable else env_id


def listed_name(name: str) -> str:
    """Return an environment's name as ``piavatar_envs list`` shows it.

    ``Reach-v0`` gets its namespace, the module of a game loses its package, and any other name stays as it is.
    """
    full = f"{NAMESPACE}/{name}"
    return full if full in task_modules() else name.removeprefix(_MULTI)


def load_task(task: str | type[Task]) -> type[Task]:
    """Return the class of a task.

    Args:
        task: its id, for the tasks of this package with or without the namespace; ``"module:id"`` imports the module
            first, which registers it; ``"module:Class"``; or the class itself.

    Raises:
        ImportError: the module cannot be imported.
        ValueError: there is no such task.
    """
    if _is_task(task):
        return task
    module, _, name = str(task).rpartition(":")
    found = importlib.import_module(module) if module else None
    if module and "/" not in name:
        task_class = getattr(found, name, None)
        if not _is_task(task_class):
            raise ValueError(f"{module} has no task {name!r}: it must be a subclass of piavatar_envs.envs.task.Task")
        return task_class
    modules = task_modules()
    full = name if "/" in name else f"{NAMESPACE}/{name}"
    if full in modules:
        return importlib.import_module(f"{__name__}.{modules[full]}").TASK
    if full not in _added:
        games = find_spec(f"{__name__}.games.{_VERSION.sub('', name)}") if name.isidentifier() else None
        if not module and games:
            raise ValueError(
                f"task={task!r} has several agents: use piavatar_envs.multi.{name}.parallel_env(), or its TASK"
            )
        raise ValueError(f"unknown task {task!r}; {instead_of(str(task), [*modules, *_added])}")
    return load_task(_added[full])


def load_registered(task: str | type[Task], registered: Sequence[str] | None) -> type[Task]:
    """Return the class of the task of an environment that may be made by its id.

    Args:
        task: as for :func:`load_task`.
        registered: the id and the task that it was registered for; None for an environment made without one.

    Raises:
        ImportError: the module cannot be imported.
        ValueError: there is no such task, or it is not that of the id.
    """
    found = load_task(task)
    if registered is None:
        return found
    env_id, own = registered
    if found is not load_task(own):
        known = [*task_modules(), *_added]
        others = [other for other in known if task in (other, other.removeprefix(f"{NAMESPACE}/"))]
        remedy = f"make {others[0]!r}" if others else "make the id that piavatar_envs.register_task gives it"
        name = task if isinstance(task, str) else found.__name__
        raise ValueError(f"task={name!r} is not that of {env_id}; {remedy}")
    return found


def how_to_name(env_id: str) -> str:
    """Return advice on naming a task from elsewhere, such as ``env_id``, that is not registered."""
    return f"a task of your own is named with the module that registers it, such as my_tasks:{env_id}"


def instead_of(name: str, known: Iterable[str]) -> str:
    """Return advice on an unknown name: the known one that is close to it, or all of them.

    Args:
        name: the unknown name; with a namespace that is not this package's, it may be a task from elsewhere.
        known: the known names.
    """
    own = "/" in name and ":" not in name and not name.startswith(f"{NAMESPACE}/")
    how = [how_to_name(name)] if own else []
    by_stem = {_stem(one): one for one in known}
    close = difflib.get_close_matches(_stem(name), by_stem, n=1, cutoff=0.65)
    if close:
        return "; ".join([*how, f"did you mean {by_stem[close[0]]}?"])
    return "; ".join([f"there are {', '.join(by_stem.values()) or 'none'}", *how])


def _stem(name: str) -> str:
    """Return a name without namespace and version: ``PIAvatar/PushBox-v0`` and ``push_box_v0`` are ``pushbox``."""
    return _VERSION.sub("", re.split(r"[/:.]", name)[-1]).replace("_", "").lower()


def _is_task(task: object) -> TypeGuard[type[Task]]:
    if not isinstance(task, type):
        return False
    from piavatar_envs.envs.task import Task  # a subclass exists, so this is imported already

    return issubclass(task, Task)
