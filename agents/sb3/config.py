"""Configuration of a training run: which environment, which algorithm, how long, from which seed."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

from pydantic import AfterValidator, BaseModel, Field, field_validator

from agents.config import MOST_RUNS, EvaluationSettings, load_resolved, multi_game
from agents.sb3.ppo import PPOSettings
from agents.sb3.sac import SACSettings
from agents.sb3.selfplay import SelfPlaySettings
from piavatar_envs.config import FROZEN, ConfigError, EnvConfig, FrozenDict, load_config
from piavatar_envs.tasks import listed_name, load_task

_MULTI_ID = re.compile(r"\w+_v\d+")


#: Workers that are processes of their own.
MOST_PROCESSES = 256


class TrainingConfig(BaseModel):
    """Settings of a training run with stable-baselines3."""

    model_config = FROZEN

    env_id: str = Field(
        "PIAvatar/Reach-v0", description="registered id, or a PettingZoo module of piavatar_envs.multi such as sumo_v0"
    )
    env: Annotated[dict[str, Any], AfterValidator(FrozenDict)] = Field(
        default_factory=dict, description="settings of the environment that differ from its defaults"
    )
    observe: tuple[str, ...] | None = Field(
        None, description="terms of the observation that the networks see; null for all of it"
    )
    total_steps: int = Field(
        100_000, ge=1, description="control steps to train for, over all workers and their learning agents"
    )
    num_workers: int = Field(4, ge=1, le=16_384, description="environments, each in a process of its own")
    vector: bool = Field(
        False, description="step the environments as one batch (a GPU's, or on the threads of a CPU), not in processes"
    )
    seed: int = Field(0, ge=0, lt=MOST_RUNS, description="of the networks, the actions and the training episodes")
    checkpoint_every: int = Field(
        50_000, ge=1, description="control steps between two checkpoints; they are written between rollouts"
    )
    ppo: PPOSettings = Field(default_factory=PPOSettings, description="the algorithm")
    sac: SACSettings | None = Field(None, description="the algorithm in place of ppo, for one agent; null for ppo")
    selfplay: SelfPlaySettings | None = Field(
        None, description="agents compete, also with earlier policies; null where there is one, or they have one aim"
    )
    evaluation: EvaluationSettings = Field(default_factory=EvaluationSettings, description="how agents are compared")

    _list_env_id = field_validator("env_id")(listed_name)

    @property
    def is_multi(self) -> bool:
        """Return whether the environment has several agents."""
        return _MULTI_ID.fullmatch(self.env_id) is not None


def load_training(
    source: Mapping[str, Any] | str | Path | None = None, overrides: Mapping[str, Any] | None = None
) -> TrainingConfig:
    """Load a configuration and fill in the task's defaults for what ``env`` leaves open.

    Args:
        source: a YAML file or a mapping.
        overrides: settings that override it, as from a command line; ``env.NAME`` for those of the environment.

    Raises:
        ConfigError: a setting that is unknown, of the wrong type or out of range, also of the environment.
    """
    config = load_resolved(TrainingConfig, _env_class, source, overrides)
    if config.selfplay and not config.is_multi:
        raise ConfigError(f"selfplay is given, but env_id={config.env_id!r} has one agent; use a world such as sumo_v0")
    if config.vector and config.is_multi:
        raise ConfigError(f"vector is for one agent; env_id={config.env_id!r} is a world of several")
    if config.num_workers > MOST_PROCESSES and not config.vector:
        raise ConfigError(f"num_workers={config.num_workers} must be <= {MOST_PROCESSES} processes; use vector=true")
    if config.sac and config.is_multi:
        raise ConfigError(f"sac is for one agent; env_id={config.env_id!r} is a world of several, use ppo")
    batch, rollout = config.ppo.batch_size, config.num_workers * config.ppo.rollout_steps
    if batch > rollout and not config.sac:
        raise ConfigError(
            f"ppo.batch_size={batch} must be <= {rollout}, the steps of a rollout (num_workers * ppo.rollout_steps)"
        )
    return config


def env_config(config: TrainingConfig) -> EnvConfig:
    """Return the environment's part of a resolved configuration."""
    return load_config(_env_class(config), config.env)


def _env_class(config: TrainingConfig) -> type[EnvConfig]:
    task = multi_game(config.env_id).TASK if config.is_multi else load_task(config.env_id)
    return task.Config
