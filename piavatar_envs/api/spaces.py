"""Spaces of what an agent does and sees."""

from __future__ import annotations

import gymnasium as gym
import numpy as np

from piavatar_envs.envs.batch_env import BatchEnv


def action_space(batch: BatchEnv) -> gym.spaces.Box:
    """A new space for the actions of an agent."""
    return gym.spaces.Box(-1.0, 1.0, (batch.action_spec.size,), np.float32)


def observation_space(batch: BatchEnv) -> gym.Space:
    """A new space for the observations of an agent. They have no honest limits."""
    layout = batch.layout
    if batch.config.obs_mode == "dict":
        return gym.spaces.Dict({name: unbounded(term.size) for name, term in layout.items()})
    return unbounded(layout.size)


def state_space(batch: BatchEnv) -> gym.spaces.Box:
    """A new space for the flat observations of all agents one after the other."""
    return unbounded(batch.num_agents * batch.layout.size)


def unbounded(size: int) -> gym.spaces.Box:
    """All vectors of ``size`` float32."""
    return gym.spaces.Box(-np.inf, np.inf, (size,), np.float32)
