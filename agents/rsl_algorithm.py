"""rsl_rl's PPO, with what trainings of the suite ask of it besides."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from rsl_rl.algorithms import PPO
from tensordict import TensorDict


class ScaledPPO(PPO):
    """rsl_rl's PPO, which learns from scaled rewards and noisy observations, and in smaller and smaller updates.

    What is logged are the environment's own rewards.

    Attributes:
        updates: how many there have been; to be set where a training goes on.
        check: is called after each, also after one that torch has refused to end; to be set.
    """

    check: Callable[[], None]

    def __init__(
        self, *args: Any, reward_scale: float, observation_noise: float, kl_targets: Sequence[float], **settings: Any
    ) -> None:
        """As rsl_rl's.

        Args:
            args: of the base.
            reward_scale: the factor.
            observation_noise: standard deviation of what is added to every component.
            kl_targets: of the first update and all that follow, in place of ``desired_kl``; none for a fixed one.
            settings: of the base.
        """
        super().__init__(*args, **settings)
        self.reward_scale, self.kl_targets, self.updates = reward_scale, kl_targets, 0
        self.observation_noise = observation_noise

    def update(self) -> dict[str, float]:
        """Learn from a rollout.

        Raises:
            Diverged: the networks are not finite any more.
        """
        if self.kl_targets:
            self.desired_kl = self.kl_targets[min(self.updates, len(self.kl_targets) - 1)]
        self.updates += 1
        try:
            losses = super().update()
        except (RuntimeError, ValueError):  # what torch says of broken networks says nothing to whoever trains
            self.check()
            raise
        self.check()
        return losses

    def process_env_step(
        self, obs: TensorDict, rewards: torch.Tensor, dones: torch.Tensor, extras: dict[str, torch.Tensor]
    ) -> None:
        """Record a step."""
        super().process_env_step(obs, self.reward_scale * rewards, dones, extras)

    def act(self, obs: TensorDict) -> torch.Tensor:
        """Draw actions, and record what they are drawn for."""
        if self.observation_noise > 0.0:
            obs = obs.apply(lambda seen: seen + self.observation_noise * torch.randn_like(seen))
        return super().act(obs)
