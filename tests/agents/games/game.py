"""Base of the toy worlds: the PettingZoo Parallel API in pure NumPy, seeded as the suite's own."""

from __future__ import annotations

import copy
from typing import Any

import gymnasium as gym
import numpy as np
from pettingzoo import ParallelEnv

from piavatar_envs.config import EnvConfig, load_config
from piavatar_envs.envs.observations import ObservationLayout, ObservationTerm

#: What no game changes while it is played.
_FIXED = ("config", "device", "render_mode", "possible_agents", "observation_layout", "action_names")


class Game(ParallelEnv):
    """A world of ``names``; a game fills in :meth:`begin`, :meth:`observe` and :meth:`play`."""

    metadata = {"name": "game_v0", "render_modes": []}  # noqa: RUF012 - PettingZoo's own
    names: tuple[str, ...] = ("left", "right")
    observed: tuple[str, ...] = ()
    Config: type[EnvConfig] = EnvConfig

    def __init__(self, config: Any = None, device: str = "cpu", render_mode: str | None = None) -> None:
        self.config = load_config(self.Config, config)
        self.device, self.render_mode = device, render_mode
        self.possible_agents = list(self.names)
        self.agents: list[str] = []
        self.observation_layout = ObservationLayout(ObservationTerm(name, 1, "-", "-", "") for name in self.observed)
        self.action_names = ("action",)
        self.seed, self.episode = 0, -1

    def observation_space(self, agent: str) -> gym.Space:
        """The same for all."""
        return gym.spaces.Box(-np.inf, np.inf, (len(self.observed),), np.float32)

    def action_space(self, agent: str) -> gym.Space:
        """The same for all."""
        return gym.spaces.Box(-1.0, 1.0, (1,), np.float32)

    def reset(self, seed: int | None = None, options: dict | None = None) -> tuple[dict, dict]:
        """Begin an episode: of ``seed``, or the next one of the seed before."""
        self.seed, self.episode = (self.seed, self.episode + 1) if seed is None else (seed, 0)
        self.agents, self.time = list(self.names), 0
        self.begin(np.random.default_rng((self.seed, self.episode)))
        return self._observations(), {name: {} for name in self.names}

    def step(self, actions: dict[str, np.ndarray]) -> tuple[dict, dict, dict, dict, dict]:
        """Advance; only agents that play may act."""
        assert list(actions) == self.agents, f"{list(actions)} act, {self.agents} play"
        self.time += 1
        rewards, terminations, truncations, infos = self.play({name: float(a[0]) for name, a in actions.items()})
        observations = self._observations()
        self.agents = [name for name in self.agents if not terminations[name] and not truncations[name]]
        return observations, rewards, terminations, truncations, infos

    def get_state(self) -> dict[str, Any]:
        """Everything that the future depends on: what a game has set in :meth:`begin` as well."""
        return {name: copy.deepcopy(value) for name, value in vars(self).items() if name not in _FIXED}

    def set_state(self, state: dict[str, Any]) -> dict:
        """Restore what :meth:`get_state` returned."""
        vars(self).update(copy.deepcopy(state))
        return self._observations()

    def _observations(self) -> dict[str, np.ndarray]:
        return {name: np.array(self.observe(name), np.float32) for name in self.agents}

    def begin(self, rng: np.random.Generator) -> None:
        """Draw the episode."""

    def observe(self, name: str) -> list[float]:
        """Return an agent's observation."""
        raise NotImplementedError

    def play(self, actions: dict[str, float]) -> tuple[dict, dict, dict, dict]:
        """Rewards, terminations, truncations and infos of those who play."""
        raise NotImplementedError
