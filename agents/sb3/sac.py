"""Soft Actor-Critic (Haarnoja et al., 2018) with stable-baselines3: settings and construction.

It learns from a memory of steps, so that it needs fewer of them than PPO and more arithmetic for each. The weight of
the entropy adapts to the target -dim(action) (Haarnoja et al., "Soft Actor-Critic Algorithms and Applications", 2019,
section 5).
"""

from __future__ import annotations

from collections.abc import Sequence

from pydantic import BaseModel, Field
from stable_baselines3 import SAC
from stable_baselines3.common.vec_env import VecEnv

from agents.config import Discount, Widths, first_training_seed
from agents.sb3.ppo import networks
from piavatar_envs.config import FROZEN


class SACSettings(BaseModel):
    """Hyper-parameters of SAC."""

    model_config = FROZEN

    memory_size: int = Field(100_000, ge=2, description="steps that are remembered, over all workers")
    batch_size: int = Field(256, ge=2, description="steps in a minibatch")
    first_random: int = Field(
        1_000, ge=0, description="steps with uniformly random actions, before which none is learned"
    )
    train_every: int = Field(1, ge=1, description="steps a worker plays between two updates")
    minibatches: int = Field(1, ge=1, description="minibatches in an update")
    learning_rate: float = Field(7.0e-4, gt=0.0, description="Adam's learning rate [-]")
    discount: Discount = 0.9
    reward_scale: float = Field(
        1.0, gt=0.0, description="factor on what the networks see of a reward [-]; discounted returns should be about 1"
    )
    averaging: float = Field(0.01, gt=0.0, le=1.0, description="share of the critics in an update of their average [-]")
    hidden: Widths = Field((128, 128), description="widths of the hidden layers of all networks")


def build(settings: SACSettings, venv: VecEnv, components: Sequence[int], seed: int) -> SAC:
    """Build an untrained agent on the CPU.

    Args:
        settings: hyper-parameters.
        venv: environments to train in.
        components: of the flat observation, those that the networks see.
        seed: of the networks, the actions and the training episodes.
    """
    model = SAC(
        "MlpPolicy",
        venv,
        buffer_size=settings.memory_size,
        batch_size=settings.batch_size,
        learning_starts=settings.first_random,
        train_freq=settings.train_every,
        gradient_steps=settings.minibatches,
        learning_rate=settings.learning_rate,
        gamma=settings.discount,
        tau=settings.averaging,
        policy_kwargs=networks(settings.hidden, components),
        seed=seed,
        device="cpu",
    )
    venv.seed(first_training_seed(seed))
    return model
