"""Lessons: settings of an environment that make it easier while an agent learns."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from piavatar_envs.envs.config import ConfigError, EnvConfig, load_config
from piavatar_envs.tasks.base import Task


def interface(task: Task) -> dict[str, Any]:
    """What a policy is made for: what its actions do, and what it sees."""
    config = task.config
    return {
        "drive.control": config.drive.control,
        "its actions": task.action_spec(),
        "observe_parameters": config.observe_parameters,
        "its observations": (task.observed_props(), task.terms()),
    }


def with_lessons(task: Task, lessons: Mapping[str, Any]) -> EnvConfig:
    """Settings of the environments to learn in: those of ``task``, but for the lessons.

    Raises:
        ConfigError: a lesson is no setting, or changes what the policy is made for.
    """
    settings = load_config(type(task.config), task.config, dict(lessons))
    then = interface(type(task)(settings))
    changed = [name for name, now in interface(task).items() if now != then[name]]
    if changed:
        raise ConfigError(
            f"lessons={dict(lessons)} change {', '.join(changed)}: what is learned would not fit the "
            "environment that it is for; give such settings as env"
        )
    return settings
