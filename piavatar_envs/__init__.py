"""Soft human avatars for reinforcement learning: importing this package registers its Gymnasium ids.

Nothing heavy is imported and no GPU is touched until an environment is made.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from gymnasium.envs.registration import register, registry

from piavatar_envs.tasks import add_task, place_of, task_modules

if TYPE_CHECKING:
    from piavatar_envs.api.conformance import check_task
    from piavatar_envs.avatar.body.sources import register_source
    from piavatar_envs.avatar.motion import register_motion
    from piavatar_envs.envs.task import Task
    from piavatar_envs.mpm.materials import register_material

__all__ = [
    "check_task",
    "register_game",
    "register_material",
    "register_motion",
    "register_source",
    "register_task",
]
__version__ = "0.1.0"

#: Modules of the public functions that are imported on first use.
_LAZY = {
    "check_task": "api.conformance",
    "register_material": "mpm.materials",
    "register_motion": "avatar.motion",
    "register_source": "avatar.body.sources",
}
#: What Gymnasium calls for every id.
ENTRY_POINT = "piavatar_envs.api.gym_env:AvatarEnv"


def _register(env_id: str, task: str) -> None:
    register(
        id=env_id,
        entry_point=ENTRY_POINT,
        vector_entry_point="piavatar_envs.api.vector_env:AvatarVectorEnv",
        # the time limit lives inside, so that a saved state holds it
        max_episode_steps=None,
        # the task a second time, where nobody who makes the id can replace it
        kwargs={"task": task, "registered": [env_id, task]},
    )


def register_task(env_id: str, task: type[Task] | str) -> None:
    """Make a task of your own an environment for ``gym.make``, ``gym.make_vec`` and all views; see docs/tasks.md.

    Args:
        env_id: a namespace of your own, a name and a version: ``"Mine/Hop-v0"``. Registering it again replaces it.
        task: a subclass of :class:`piavatar_envs.envs.task.Task`, or ``"module:Class"``, imported when it is made.

    Raises:
        TypeError: the task is neither.
        ValueError: an id without namespace or version, or one of this package.
    """
    add_task(env_id, task)
    registry.pop(env_id, None)  # without Gymnasium's warning: a notebook's cell is often run twice
    # by what a process that has not run this can import
    _register(env_id, place_of(env_id, task))


def register_game(name: str, task: type[Task] | str) -> None:
    """Make a task of several agents a game for :mod:`piavatar_envs.multi` and the command line; see docs/tasks.md.

    Args:
        name: a name and a version: ``"tag_v0"``. Registering it again replaces it.
        task: a subclass of :class:`piavatar_envs.envs.task.Task`, or ``"module:Class"``, imported when it is made.

    Raises:
        TypeError: the task is neither.
        ValueError: a name without a version, or that of a game of this package.
    """
    from piavatar_envs.tasks.games import add_game

    add_game(name, task)


def __getattr__(name: str) -> Any:
    """Import a public function on first use, because its module imports much."""
    if name not in _LAZY:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_LAZY[name]}"), name)


for _env_id in task_modules():
    _register(_env_id, _env_id)
