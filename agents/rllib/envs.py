"""Environments of a training run with RLlib, built by its env runners: a batch of single avatars, or a game."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector.utils import batch_space
from pettingzoo.utils import BaseParallelWrapper

from agents.sb3.workers import components
from piavatar_envs.api.rllib import JointTruncation
from piavatar_envs.api.vector_env import AvatarVectorEnv
from piavatar_envs.multi import load_game


def _seen_space(space: gym.spaces.Box, seen: Sequence[int]) -> gym.spaces.Box:
    """Return the space of some components of a flat observation."""
    return gym.spaces.Box(space.low[seen], space.high[seen], dtype=space.dtype)


class SeenBatch(AvatarVectorEnv):
    """A batch of environments whose flat observations are reduced to some terms."""

    def __init__(self, *arguments: Any, observe: tuple[str, ...] | None, **named: Any) -> None:
        """Build the environments.

        Args:
            *arguments: of :class:`~piavatar_envs.api.vector_env.AvatarVectorEnv`.
            observe: terms to observe; None for all.
            **named: likewise.

        Raises:
            ConfigError: there is no such term, or a setting is wrong.
        """
        super().__init__(*arguments, **named)
        self.seen = components(self.host.layout, observe)
        self.single_observation_space = _seen_space(self.single_observation_space, self.seen)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)

    def reset(self, **arguments: Any) -> tuple[np.ndarray, dict[str, Any]]:
        """Begin episodes; arguments as for the whole observations."""
        observation, info = super().reset(**arguments)
        return observation[:, self.seen], info

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, ...]:
        """Advance by one control step."""
        observation, *others = super().step(actions)
        return observation[:, self.seen], *others


class SeenGame(BaseParallelWrapper):
    """A game whose agents observe some terms of their flat observations."""

    def __init__(self, env: Any, observe: tuple[str, ...] | None) -> None:
        """Wrap ``env``; the terms are as for :class:`SeenBatch`."""
        super().__init__(env)
        self.seen = components(env.unwrapped.host.layout, observe)
        whole = env.observation_space(env.possible_agents[0])
        self._spaces = dict.fromkeys(env.possible_agents, _seen_space(whole, self.seen))

    def observation_space(self, agent: str) -> gym.Space:
        """Return the space of the observed components."""
        return self._spaces[agent]

    def reset(self, seed: int | None = None, options: Any = None) -> tuple[dict[str, Any], dict[str, Any]]:
        """Begin an episode."""
        observations, infos = self.env.reset(seed, options)
        return self._reduced(observations), infos

    def step(self, actions: Mapping[str, Any]) -> tuple[dict[str, Any], ...]:
        """Advance by one control step."""
        observations, *others = self.env.step(actions)
        return self._reduced(observations), *others

    def _reduced(self, observations: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        return {name: own[self.seen] for name, own in observations.items()}


def make_batch(settings: Mapping[str, Any]) -> SeenBatch:
    """Build the batch of an env runner; ``settings`` has RLlib's ``num_envs`` and those of :func:`make_game`."""
    own = dict(settings)
    return SeenBatch(own.pop("env_id"), own.pop("num_envs"), config=own.pop("env"), **own)


def make_game(settings: Mapping[str, Any]) -> Any:
    """Build a game as RLlib's ``MultiAgentEnv``.

    Args:
        settings: ``env_id``, ``env`` (settings of the environment), ``observe`` and ``device``.
    """
    from ray.rllib.env.wrappers.pettingzoo_env import ParallelPettingZooEnv

    game = load_game(settings["env_id"]).parallel_env(config=settings["env"], device=settings["device"])
    return ParallelPettingZooEnv(JointTruncation(SeenGame(game, settings["observe"])))
