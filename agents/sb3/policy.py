"""Agents out of what training runs with stable-baselines3 leave."""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from stable_baselines3.common.policies import ActorCriticPolicy, BasePolicy
from stable_baselines3.sac.policies import SACPolicy

from agents.checkpoint import policy_mismatch, read_checkpoint
from agents.evaluate import Agent
from agents.files import CHECKPOINT
from agents.sb3 import ppo
from agents.sb3.config import TrainingConfig
from agents.sb3.workers import components
from piavatar_envs.core.reading import UNREADABLE
from piavatar_envs.envs.observations import ObservationLayout

#: Name of the policy's parameters within ``policy.zip``.
PARAMETERS = "policy.pth"
#: Prefixes of the critics' parameters, which no action needs; kept runs leave them out (``scripts.keep_run``).
CRITICS = ("mlp_extractor.value_net.", "value_net.", "vf_features_extractor.", "critic.", "critic_target.")


def policy_agent(model: Any) -> Agent:
    """Return an agent of the mean actions of a trained stable-baselines3 policy."""
    return lambda observation: model.predict(observation, deterministic=True)[0]


def load_agent(path: Path, config: TrainingConfig, layout: ObservationLayout, action_size: int) -> Agent:
    """Load the agent of an earlier training: the mean action of its policy, on the CPU.

    Only parameters are read, into a policy that is built as the configuration says. Nothing is unpickled, as
    stable-baselines3's own ``load`` would.

    Args:
        path: of its ``policy.zip``, or of the checkpoint of one that was interrupted.
        config: resolved, of one agent.
        layout: of the observation.
        action_size: length of an action.

    Raises:
        ConfigError: the file holds no policy of that configuration.
    """
    policy = _untrained(config, layout, action_size)
    try:
        loaded = policy.load_state_dict(_parameters(path), strict=False)
        unlike = [name for name in loaded.missing_keys if not name.startswith(CRITICS)] + loaded.unexpected_keys
        if unlike:
            raise KeyError(f"missing or unknown parameters: {', '.join(unlike)}")
    except UNREADABLE as error:
        raise policy_mismatch(path, len(components(layout, config.observe)), action_size, error) from None
    return policy_agent(policy.eval())


def _parameters(path: Path) -> dict[str, torch.Tensor]:
    """Read the parameters of a policy."""
    if path.name == CHECKPOINT:
        return read_checkpoint(path)["state"]["modules"]["policy"]
    with zipfile.ZipFile(path) as content, content.open(PARAMETERS) as file:
        return torch.load(file, map_location="cpu", weights_only=True)


def _untrained(config: TrainingConfig, layout: ObservationLayout, action_size: int) -> BasePolicy:
    seen = gym.spaces.Box(-np.inf, np.inf, (layout.size,), np.float32)
    done = gym.spaces.Box(-1.0, 1.0, (action_size,), np.float32)
    shown = components(layout, config.observe)
    if config.sac:
        return SACPolicy(seen, done, lambda _: 0.0, **ppo.networks(config.sac.hidden, shown))
    return ActorCriticPolicy(seen, done, lambda _: 0.0, **ppo.policy_settings(config.ppo, shown))
