"""A toy environment whose returns are known, and a training configuration of seconds."""

from __future__ import annotations

import importlib
from types import SimpleNamespace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from agents.sb3.config import TrainingConfig, load_training
from piavatar_envs.multi import load_game

TINY: dict[str, Any] = {
    "env": {"fidelity": "tiny", "episode_seconds": 0.5},
    "total_steps": 64,
    "num_workers": 1,
    "ppo": {"rollout_steps": 32, "batch_size": 16, "epochs": 2, "hidden": [8]},
    "evaluation": {"episodes": 2},
}


class Countdown(gym.Env):
    """An episode of ``2 + seed % 4`` steps that pays the first component of the action, then once the seed."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (1,), np.float32)
    action_space = gym.spaces.Box(-1.0, 1.0, (2,), np.float32)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None):
        """Begin."""
        super().reset(seed=seed)
        self.seed = 0 if seed is None else seed
        self.left = 2 + self.seed % 4
        return np.array([self.left], np.float32), {}

    def step(self, action: np.ndarray):
        """Count down."""
        self.left -= 1
        reward = float(action[0]) + (self.seed if self.left == 0 else 0.0)
        # the target is met in the first step, and in episodes of even seeds at the end
        info = {"success": self.left == 1 + self.seed % 4 or (self.left == 0 and self.seed % 2 == 0), "distance": 0.5}
        return np.array([self.left], np.float32), reward, False, self.left == 0, info


@pytest.fixture
def countdown() -> type[Countdown]:
    """The toy environment's class."""
    return Countdown


@pytest.fixture
def tiny() -> TrainingConfig:
    """A training run of seconds."""
    return load_training(TINY)


@pytest.fixture
def games(monkeypatch) -> None:
    """Let the toy worlds in ``games/`` be those that a configuration may name."""

    def load(name: str) -> Any:
        if name not in ("auction_v0", "ledger_v0", "rendezvous_v0"):
            return load_game(name)
        module = f"tests.agents.games.{name}"
        return SimpleNamespace(name=module, **vars(importlib.import_module(module)))

    monkeypatch.setattr("agents.config.load_game", load)
