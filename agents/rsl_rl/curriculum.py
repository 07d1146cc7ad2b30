"""Curricula: a root assist that declines while bodies under torques learn, and easier settings of the environment."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from pydantic import BaseModel, Field, model_validator
from tensordict import TensorDict

from agents.config import changed
from piavatar_envs.api.rsl_rl import AvatarRslEnv
from piavatar_envs.config import FROZEN, ConfigError, EnvConfig, load_config
from piavatar_envs.envs.task import Task


class AssistSchedule(BaseModel):
    """Schedule of ``root_assist``: by time (``rollouts``), or by success (``step``)."""

    model_config = FROZEN

    first: float = Field(gt=0.0, le=1.0, description="greatest assist in the first rollout, as root_assist [-]")
    rollouts: int | None = Field(
        None, ge=1, description="rollouts over which it falls to nothing, in equal steps; null to give step"
    )
    step: float | None = Field(
        None,
        gt=0.0,
        le=1.0,
        description="by which the assist of an environment falls after an episode that ends in success, and rises, up "
        "to first, after any other [-]; null to give rollouts",
    )

    @model_validator(mode="after")
    def _one_of_them(self) -> AssistSchedule:
        if (self.rollouts is None) == (self.step is None):
            raise ValueError(f"rollouts={self.rollouts} and step={self.step}: give one of them")
        return self


class AssistedEnv(AvatarRslEnv):
    """Environments whose root assist declines while an agent learns.

    Environment ``i`` of ``n`` begins with ``i / (n - 1)`` of the greatest assist, so that some train almost without it
    from the start; a single one has all of it. By time it keeps that share of a greatest assist that falls. By success,
    every environment settles where half of its episodes succeed, and loses its assist where more do, as the pulling
    force of Huang et al., "Learning Humanoid Standing-up Control across Diverse Postures" (2025), which never rises.
    Evaluations have no assist.

    Attributes:
        steps: control steps of every environment so far; to be set when a training resumes.
        assist: of every environment, ``(num_envs,)`` float32 on the device; likewise.
    """

    def __init__(self, settings: AssistSchedule, rollout_steps: int, *args: Any, **kwargs: Any) -> None:
        """Build the environments; all but the first two arguments are those of the base."""
        super().__init__(*args, **kwargs)
        self.settings, self.rollout_steps, self.steps = settings, rollout_steps, 0
        n = self.num_envs
        self._spread = torch.linspace(0.0, 1.0, n, device=self.device) if n > 1 else torch.ones(1, device=self.device)
        self.assist = settings.first * self._spread

    def share(self) -> float:
        """Return the greatest assist in the current rollout, by time."""
        return self.settings.first * max(0.0, 1.0 - self.steps // self.rollout_steps / self.settings.rollouts)

    def step(self, actions: torch.Tensor) -> tuple[TensorDict, torch.Tensor, torch.Tensor, dict[str, Any]]:
        """Advance by one control step; the assist changes before the first step of a rollout, or of an episode.

        ``extras["log"]`` also holds the mean assist.
        """
        if self.settings.rollouts is not None and self.steps % self.rollout_steps == 0:
            self.assist = self.share() * self._spread
        self.host.api.write(self.assist, [group.simulation.controllers[0].assist for group in self.host.groups])
        self.steps += 1
        stepped = super().step(actions)
        _, _, ended, extras = stepped
        extras["log"]["Task/root_assist"] = self.assist.mean()
        if self.settings.step is not None:
            change = torch.where(extras["info"]["success"], -self.settings.step, self.settings.step)
            changed = (self.assist + change).clamp(0.0, self.settings.first)
            self.assist = torch.where(ended.bool(), changed, self.assist)
        return stepped


def training_settings(task: Task, curriculum: Mapping[str, Any]) -> EnvConfig:
    """Return the settings of the training environments: those of ``task``, changed by the curriculum.

    Raises:
        ConfigError: a setting is unknown, or changes the policy's actions or observations.
    """
    settings = load_config(type(task.config), task.config, dict(curriculum))
    if unlike := changed(task, type(task)(settings)):
        raise ConfigError(
            f"curriculum={dict(curriculum)} changes {', '.join(unlike)}, and the policy would not fit the environment "
            "that is evaluated; give such settings as env"
        )
    return settings
