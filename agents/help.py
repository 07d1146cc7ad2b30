"""Help that wanes: bodies under torques learn with a pelvis that is held a little, and then without."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from pydantic import BaseModel, Field

from piavatar_envs.api.rsl_rl import AvatarRslEnv
from piavatar_envs.envs.config import FROZEN

if TYPE_CHECKING:
    import torch
    from tensordict import TensorDict


class HelpSettings(BaseModel):
    """A curriculum of ``root_assist``."""

    model_config = FROZEN

    first: float = Field(gt=0.0, le=1.0, description="greatest help in the first rollout, as root_assist [-]")
    rollouts: int = Field(ge=1, description="rollouts over which it falls to nothing, in equal steps")


class HelpedEnv(AvatarRslEnv):
    """Environments whose help for the pelvis wanes while an agent learns.

    At any time environment ``i`` of ``n`` has ``i / (n - 1)`` of the greatest help, so that some have next to none from
    the start, and what is learned with help is tried without; a single one has all of it. Evaluations have none.

    Attributes:
        steps: control steps of every environment so far; to be set where a training goes on.
    """

    def __init__(self, settings: HelpSettings, rollout_steps: int, *args: Any, **kwargs: Any) -> None:
        """Build the environments; all but the first two arguments are those of the base."""
        super().__init__(*args, **kwargs)
        self.settings, self.rollout_steps, self.steps = settings, rollout_steps, 0
        self._spread = np.linspace(0.0, 1.0, self.num_envs, dtype=np.float32) if self.num_envs > 1 else np.ones(1)

    def share(self) -> float:
        """The greatest help in the current rollout."""
        return self.settings.first * max(0.0, 1.0 - self.steps // self.rollout_steps / self.settings.rollouts)

    def step(self, actions: torch.Tensor) -> tuple[TensorDict, torch.Tensor, torch.Tensor, dict[str, Any]]:
        """Advance by one control step; help changes before the first of a rollout."""
        if self.steps % self.rollout_steps == 0:
            self.assist_root(self.share() * self._spread)
        self.steps += 1
        return super().step(actions)
