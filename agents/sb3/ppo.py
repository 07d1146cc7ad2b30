"""Proximal Policy Optimization (Schulman et al., 2017) with stable-baselines3: settings and construction.

Observations are not normalised by running statistics: they are metres, radians and metres a second of order one
already, while some (the height of a root that is held up) hardly vary, and dividing by their spread makes them noise.

Of worlds whose agents leave early, a rollout buffer keeps only the steps that were played.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from pydantic import BaseModel, Field
from stable_baselines3 import PPO
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.type_aliases import RolloutBufferSamples
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env import VecEnv

from agents.config import ClipRange, Discount, EntropyWeight, GaeLambda, LogStd, Widths, first_training_seed
from agents.sb3.parallel import WAITING
from piavatar_envs.config import FROZEN


class PPOSettings(BaseModel):
    """Hyper-parameters of PPO."""

    model_config = FROZEN

    rollout_steps: int = Field(512, ge=2, description="steps a worker plays between two updates")
    batch_size: int = Field(128, ge=2, description="steps in a minibatch")
    epochs: int = Field(10, ge=1, description="passes over a rollout")
    learning_rate: float = Field(7.0e-4, gt=0.0, description="Adam's first learning rate [-]")
    final_learning_rate: float | None = Field(
        None, gt=0.0, description="what it falls to by the last update, evenly; null for a fixed one [-]"
    )
    discount: Discount = 0.9
    reward_scale: float = Field(
        1.0, gt=0.0, description="factor on what the networks see of a reward [-]; discounted returns should be about 1"
    )
    gae_lambda: GaeLambda = 0.8
    clip_range: ClipRange = 0.2
    entropy_weight: EntropyWeight = 0.0
    log_std: LogStd = -0.5
    hidden: Widths = Field((128, 128), description="widths of the hidden layers of both networks")


class SelectTerms(BaseFeaturesExtractor):
    """Feature extractor that selects components, so that the policy takes the environment's whole observation."""

    def __init__(self, observation_space: gym.Space, components: Sequence[int]) -> None:
        super().__init__(observation_space, len(components))
        self.register_buffer("components", torch.as_tensor(list(components), dtype=torch.long))

    def forward(self, observations: torch.Tensor) -> torch.Tensor:
        """Select from shape ``(n, observation_size)`` to ``(n, len(components))``."""
        return observations[:, self.components]


def networks(hidden: Sequence[int], components: Sequence[int]) -> dict[str, Any]:
    """Return settings of networks: the components that they see, and the widths of their hidden layers."""
    return {
        "net_arch": list(hidden),
        "features_extractor_class": SelectTerms,
        "features_extractor_kwargs": {"components": list(components)},
    }


def policy_settings(settings: PPOSettings, components: Sequence[int]) -> dict[str, Any]:
    """Return the policy's settings as stable-baselines3 takes them."""
    return networks(settings.hidden, components) | {
        "activation_fn": torch.nn.Tanh,
        "log_std_init": settings.log_std,
    }


def build(settings: PPOSettings, venv: VecEnv, components: Sequence[int], seed: int) -> PPO:
    """Build an untrained agent on the CPU.

    Args:
        settings: hyper-parameters.
        venv: environments to train in.
        components: of the flat observation, those that the networks see.
        seed: of the networks, the actions and the training episodes.
    """
    first, last = settings.learning_rate, settings.final_learning_rate
    model = PPO(
        "MlpPolicy",
        venv,
        n_steps=settings.rollout_steps,
        batch_size=settings.batch_size,
        n_epochs=settings.epochs,
        learning_rate=first if last is None else LinearSchedule(first, last, 1.0),
        gamma=settings.discount,
        gae_lambda=settings.gae_lambda,
        clip_range=settings.clip_range,
        rollout_buffer_class=PlayedBuffer,
        ent_coef=settings.entropy_weight,
        policy_kwargs=policy_settings(settings, components),
        seed=seed,
        device="cpu",
    )
    venv.seed(first_training_seed(seed))
    return model


_COLUMNS = ("observations", "actions", "values", "log_probs", "advantages", "returns")


class PlayedBuffer(RolloutBuffer):
    """Rollout buffer that yields only the steps that were played, as :class:`MarkPlayed` marks them.

    Where all were, the minibatches are those of its base, as long as their size divides the rollout; else they are
    of nearly equal sizes, without a last one of a few steps.
    """

    def reset(self) -> None:
        """Empty the buffer."""
        super().reset()
        self.played = np.zeros((self.buffer_size, self.n_envs), bool)

    def get(self, batch_size: int | None = None) -> Iterator[RolloutBufferSamples]:
        """Yield minibatches of at most ``batch_size`` steps, in random order; one of all steps for None.

        Raises:
            RuntimeError: the buffer is not full, or no step is marked as played.
        """
        if not self.full or not self.played.any():
            raise RuntimeError(f"{self.pos} of {self.buffer_size} steps, {self.played.sum()} of them marked as played")
        if not self.generator_ready:
            for name in _COLUMNS:
                setattr(self, name, self.swap_and_flatten(getattr(self, name)))
            self.generator_ready = True
        rows = np.random.permutation(np.flatnonzero(self.swap_and_flatten(self.played)))
        for batch in np.array_split(rows, -(-len(rows) // (batch_size or len(rows)))):
            yield self._get_samples(batch)


class MarkPlayed(BaseCallback):
    """Callback that marks in a :class:`PlayedBuffer` the slots that played the current step."""

    def _on_step(self) -> bool:
        buffer = self.model.rollout_buffer
        buffer.played[buffer.pos] = [WAITING not in info for info in self.locals["infos"]]
        return True
