"""What a policy is made for, and lessons: settings of an environment that make it easier while an agent learns."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Any

from piavatar_envs.config import ConfigError, EnvConfig, load_config
from piavatar_envs.envs.task import Task


def interface(task: Task, observe: Collection[str] | None = None) -> dict[str, Any]:
    """What a policy is made for: what its actions do, and what it sees.

    Args:
        task: of the environment.
        observe: terms of the observation that the policy sees; None for all of it.
    """
    config = task.config
    control = config.control.mode
    actions = task.action_spec().under(control)
    seen = [term for term in task.terms() if observe is None or term.name in observe]
    return {
        "control.mode": control,
        "its actions": actions if control == "pose" else actions.joints,  # under torques nothing has a speed of its own
        "observe_parameters": config.observe_parameters,
        "its observations": (seen, task.observed_props() if observe is None else ()),
    }


def changed(task: Task, other: Task, observe: Collection[str] | None = None) -> list[str]:
    """What of :func:`interface` is not the same in another environment, by name: a policy would take it for another."""
    then = interface(other, observe)
    return [name for name, now in interface(task, observe).items() if now != then[name]]


def with_lessons(task: Task, lessons: Mapping[str, Any]) -> EnvConfig:
    """Settings of the environments to learn in: those of ``task``, but for the lessons.

    Raises:
        ConfigError: a lesson is no setting, or changes what the policy is made for.
    """
    settings = load_config(type(task.config), task.config, dict(lessons))
    if unlike := changed(task, type(task)(settings)):
        raise ConfigError(
            f"lessons={dict(lessons)} change {', '.join(unlike)}: what is learned would not fit the "
            "environment that it is for; give such settings as env"
        )
    return settings
