"""Soft human avatars for reinforcement learning: importing this package registers its Gymnasium ids.

Nothing heavy is imported and no GPU is touched until an environment is made.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from piavatar_envs.core.command_start import report_interrupts

report_interrupts()  # before the imports, which take longest

from gymnasium.envs.registration import register, registry  # noqa: E402

from piavatar_envs.tasks import add_task, id_of, place_of, task_modules  # noqa: E402
from piavatar_envs.tasks.games import game_modules  # noqa: E402

if TYPE_CHECKING:
    from piavatar_envs.api.conformance import check_task
    from piavatar_envs.avatar.body.sources import register_source
    from piavatar_envs.avatar.motion import register_motion
    from piavatar_envs.cloth.fabric import register_fabric
    from piavatar_envs.cloth.garments import register_garment
    from piavatar_envs.envs.observations import ObservationTerm
    from piavatar_envs.envs.task import Metric, Task, TaskArray, Term
    from piavatar_envs.mpm.materials import register_material
    from piavatar_envs.mpm.types import failure_name
    from piavatar_envs.tasks.games import register_game

#: Public names with heavy imports, and the modules that define them.
_LAZY = {
    "Metric": "piavatar_envs.envs.task",
    "ObservationTerm": "piavatar_envs.envs.observations",
    "Task": "piavatar_envs.envs.task",
    "TaskArray": "piavatar_envs.envs.task",
    "Term": "piavatar_envs.envs.task",
    "check_task": "piavatar_envs.api.conformance",
    "failure_name": "piavatar_envs.mpm.types",
    "register_fabric": "piavatar_envs.cloth.fabric",
    "register_game": "piavatar_envs.tasks.games",
    "register_garment": "piavatar_envs.cloth.garments",
    "register_material": "piavatar_envs.mpm.materials",
    "register_motion": "piavatar_envs.avatar.motion",
    "register_source": "piavatar_envs.avatar.body.sources",
}

__all__ = [
    "Metric",
    "ObservationTerm",
    "Task",
    "TaskArray",
    "Term",
    "check_task",
    "failure_name",
    "register_fabric",
    "register_game",
    "register_garment",
    "register_material",
    "register_motion",
    "register_source",
    "register_task",
]
__version__ = "0.1.0"

#: Called by Gymnasium for every id.
ENTRY_POINT = "piavatar_envs.api.gym_env:AvatarEnv"
#: Called by Gymnasium for the id of a game, and raises an error that says where it is.
GAME_ENTRY_POINT = "piavatar_envs.tasks.games:refuse_single"


def _register(env_id: str, task: str) -> None:
    register(
        id=env_id,
        entry_point=ENTRY_POINT,
        vector_entry_point="piavatar_envs.api.vector_env:AvatarVectorEnv",
        # the time limit is part of the environment, so that a saved state holds it
        max_episode_steps=None,
        # the task a second time, because a caller of gym.make can replace the first
        kwargs={"task": task, "registered": [env_id, task]},
    )


def register_task(env_id: str, task: type[Task] | str) -> None:
    """Make a task of your own an environment for ``gym.make``, ``gym.make_vec`` and all views; see docs/tasks.md.

    Args:
        env_id: a namespace of your own, a name and a version: ``"Mine/Hop-v0"``. Registering it again replaces it.
        task: a subclass of :class:`piavatar_envs.Task`, or ``"module:Class"``, imported when it is made.

    Raises:
        TypeError: the task is neither.
        ValueError: an id without namespace or version, or one of this package.
    """
    add_task(env_id, task)
    registry.pop(env_id, None)  # without Gymnasium's warning, because notebook cells are run repeatedly
    # by a name that a process without this registration can import
    _register(env_id, place_of(env_id, task))


def __getattr__(name: str) -> Any:
    """Import a public name of :data:`_LAZY` when it is first used."""
    if name not in _LAZY:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    found = getattr(importlib.import_module(_LAZY[name]), name)
    globals()[name] = found
    return found


def __dir__() -> list[str]:
    return sorted({*globals(), *_LAZY})


for _env_id in task_modules():
    _register(_env_id, _env_id)
for _game, _file in game_modules().items():
    # gym.make of a game says where it is, instead of that there is no such id
    register(id=id_of(_file), entry_point=GAME_ENTRY_POINT, kwargs={"game": _game})
