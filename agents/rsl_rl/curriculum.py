"""Help that wanes: bodies under torques learn with a pelvis that is held a little, and then without."""

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


class HelpSettings(BaseModel):
    """Schedule of ``root_assist``: by time (``rollouts``), or by success (``step``)."""

    model_config = FROZEN

    first: float = Field(gt=0.0, le=1.0, description="greatest help in the first rollout, as root_assist [-]")
    rollouts: int | None = Field(
        None, ge=1, description="rollouts over which it falls to nothing, in equal steps; null to give step"
    )
    step: float | None = Field(
        None,
        gt=0.0,
        le=1.0,
        description="by which the help of an environment falls after an episode that ends in success, and rises, up to "
        "the first, after any other [-]; null to give rollouts",
    )

    @model_validator(mode="after")
    def _one_of_them(self) -> HelpSettings:
        if (self.rollouts is None) == (self.step is None):
            raise ValueError(f"rollouts={self.rollouts} and step={self.step}: give one of them")
        return self


class HelpedEnv(AvatarRslEnv):
    """Environments whose root assist declines while an agent learns.

    At first environment ``i`` of ``n`` has ``i / (n - 1)`` of the greatest help, so that some have next to none from
    the start, and what is learned with help is tried without; a single one has all of it. By the clock it keeps that
    share of a greatest help that falls. By what is achieved, every environment comes to where half of its episodes end
    in success, and to none where more do; the idea of the pulling force of Huang et al., "Learning Humanoid Standing-up
    Control across Diverse Postures" (2025), which never rises again. Evaluations have none.

    Attributes:
        steps: control steps of every environment so far; to be set where a training goes on.
        help: of every environment, ``(num_envs,)`` float32 on the device; likewise.
    """

    def __init__(self, settings: HelpSettings, rollout_steps: int, *args: Any, **kwargs: Any) -> None:
        """Build the environments; all but the first two arguments are those of the base."""
        super().__init__(*args, **kwargs)
        self.settings, self.rollout_steps, self.steps = settings, rollout_steps, 0
        n = self.num_envs
        self._spread = torch.linspace(0.0, 1.0, n, device=self.device) if n > 1 else torch.ones(1, device=self.device)
        self.help = settings.first * self._spread

    def share(self) -> float:
        """Return the greatest assist in the current rollout, by time."""
        return self.settings.first * max(0.0, 1.0 - self.steps // self.rollout_steps / self.settings.rollouts)

    def step(self, actions: torch.Tensor) -> tuple[TensorDict, torch.Tensor, torch.Tensor, dict[str, Any]]:
        """Advance by one control step; the assist changes before the first step of a rollout, or of an episode.

        ``extras["log"]`` also holds the mean help.
        """
        if self.settings.rollouts is not None and self.steps % self.rollout_steps == 0:
            self.help = self.share() * self._spread
        self.host.api.write(self.help, [group.simulation.controllers[0].assist for group in self.host.groups])
        self.steps += 1
        stepped = super().step(actions)
        _, _, ended, extras = stepped
        extras["log"]["Task/help"] = self.help.mean()
        if self.settings.step is not None:
            change = torch.where(extras["info"]["success"], -self.settings.step, self.settings.step)
            changed = (self.help + change).clamp(0.0, self.settings.first)
            self.help = torch.where(ended.bool(), changed, self.help)
        return stepped


def with_lessons(task: Task, lessons: Mapping[str, Any]) -> EnvConfig:
    """Return the settings of the training environments: those of ``task``, changed by the curriculum.

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
