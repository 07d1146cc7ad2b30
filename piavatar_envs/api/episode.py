"""One environment as the host sees it: what the views of a batch of one have in common."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.utils import seeding

from piavatar_envs.api.picture import Picture
from piavatar_envs.envs.actions import check_actions
from piavatar_envs.envs.batch_env import BatchEnv
from piavatar_envs.envs.config import EnvConfig
from piavatar_envs.mpm.types import failure_name
from piavatar_envs.tasks.base import Task

#: How settings may be given.
Settings = EnvConfig | Mapping[str, Any] | str | Path | None

RENDER_MODES = ("rgb_array",)


class Episode:
    """A batch of one: its spaces, what its agents see and are told, its pictures. Agents are counted from 0.

    Attributes:
        batch: the environment.
        config: its settings.
        action_names: of every component of an agent's action.
        ready: whether there has been a reset.
    """

    def __init__(self, task: Task, render_mode: str | None, device: str) -> None:
        """Build the environment.

        Raises:
            ConfigError: a scene that cannot be.
            ValueError: an unknown render mode or device.
        """
        if render_mode is not None and render_mode not in RENDER_MODES:
            modes = ", ".join(RENDER_MODES)
            raise ValueError(f"render_mode={render_mode!r} is not known; use None or {modes}")
        self.config, self.render_mode = task.config, render_mode
        self.batch = BatchEnv(task, 1, device)
        self.action_names: tuple[str, ...] = tuple(self.batch.action_spec.names())
        self.ready = False
        self._picture: Picture | None = None

    @property
    def frame_rate(self) -> int:
        """Control steps a second."""
        return round(1.0 / self.config.physics.control_dt)

    def action_space(self) -> gym.spaces.Box:
        """A new space for the actions of an agent."""
        return gym.spaces.Box(-1.0, 1.0, (self.batch.action_spec.size,), np.float32)

    def observation_space(self) -> gym.Space:
        """A new space for the observations of an agent. They have no honest limits."""
        layout = self.batch.layout
        if self.config.obs_mode == "dict":
            return gym.spaces.Dict({name: _unbounded(term.size) for name, term in layout.items()})
        return _unbounded(layout.size)

    def state_space(self) -> gym.spaces.Box:
        """A new space for :meth:`flat_observations`."""
        return _unbounded(self.batch.num_agents * self.batch.layout.size)

    def begin(self, seed: int | None) -> None:
        """Reset: an episode of ``seed``, or the next one of the seed before.

        An environment that was never seeded is different every time, as Gymnasium asks.

        Raises:
            ValueError: a seed outside [0, 2^32).
            gymnasium.error.Error: what is no seed.
        """
        rng, _ = seeding.np_random(seed)
        if seed is None and not self.ready:
            seed = int(rng.integers(2**32))
        self.batch.reset(seeds=None if seed is None else [seed])
        self.ready = True
        if self._picture:
            self._picture.cut()

    def check_ready(self, call: str) -> None:
        """Refuse ``call`` before the first reset.

        Raises:
            gymnasium.error.ResetNeeded: there was none.
        """
        if not self.ready:
            raise gym.error.ResetNeeded(f"call reset() before {call}()")

    def check_action(self, action: np.ndarray) -> np.ndarray:
        """An agent's action as float32.

        Raises:
            ValueError: a wrong shape, or a component that is not finite.
        """
        return check_actions(action, (self.batch.action_spec.size,), self.action_names)

    def advance(self, actions: np.ndarray) -> None:
        """One control step under checked ``actions`` ``(agents, action_size)``."""
        self.batch.action.assign(actions[None])
        self.batch.step()

    def observation(self, agent: int) -> Any:
        """What an agent sees, as copies: a flat vector, or a dictionary with ``obs_mode="dict"``."""
        flat = self.batch.observation.numpy()[0, agent].copy()
        return self.batch.layout.split(flat) if self.config.obs_mode == "dict" else flat

    def flat_observations(self) -> np.ndarray:
        """The flat observations of all agents one after the other, a copy."""
        return self.batch.observation.numpy()[0].flatten()

    def reward(self, agent: int) -> float:
        """Of the last step."""
        return float(self.batch.reward.numpy()[0, agent])

    def terminated(self, agent: int) -> bool:
        """Whether the episode has ended for an agent."""
        return bool(self.batch.terminated.numpy()[0, agent])

    def truncated(self) -> bool:
        """Whether the clock has run out for those still in."""
        return bool(self.batch.truncated.numpy()[0])

    def info(self, agent: int) -> dict[str, Any]:
        """What is known of an agent at any time."""
        batch = self.batch
        drive = batch.simulation.avatars[agent].state
        return {
            "success": bool(batch.success.numpy()[0, agent]),
            "failure": failure_name(int(batch.failure.numpy()[0])),
            # a failed environment may hold values that are not finite; what leaves the suite never does
            "root_force": np.nan_to_num(drive.wrench_force.numpy()[0], posinf=0.0, neginf=0.0),
            "root_torque": np.nan_to_num(drive.wrench_torque.numpy()[0], posinf=0.0, neginf=0.0),
            "root_let_go": bool(drive.let_go.numpy()[0]),
        }

    def step_info(self, agent: int) -> dict[str, Any]:
        """:meth:`info` and what the last step was worth: the task's metrics, the terms of reward and cost."""
        batch, task = self.batch, self.batch.task
        info = self.info(agent) | _row(task.metrics, batch.metrics, agent)
        info["reward_terms"] = _row(task.reward_terms, batch.terms, agent)
        if task.cost_terms:
            info["cost"] = float(batch.cost.numpy()[0, agent])
            info["cost_terms"] = _row(task.cost_terms, batch.cost_terms, agent)
        return info

    def render(self) -> np.ndarray | None:
        """The scene as ``(height, width, 3)`` uint8 with ``render_mode="rgb_array"``, else None.

        Raises:
            ImportError: the extra ``render`` is not installed.
            gymnasium.error.ResetNeeded: before the first reset.
        """
        if self.render_mode is None:
            gym.logger.warn('render() needs an environment made with render_mode="rgb_array"')
            return None
        self.check_ready("render")
        if self._picture is None:
            self._picture = Picture(self.batch, self.config.render)
        return self._picture.frame(0)

    def close(self) -> None:
        """Free the renderer's window."""
        if self._picture:
            self._picture.close()
            self._picture = None

    def restore(self, state: dict[str, np.ndarray]) -> None:
        """Go on from what ``batch.get_state()`` returned.

        Raises:
            ValueError: the state is of another environment; nothing has changed then.
        """
        self.batch.set_state(state)
        self.ready = True


def _unbounded(size: int) -> gym.spaces.Box:
    return gym.spaces.Box(-np.inf, np.inf, (size,), np.float32)


def _row(names: tuple[str, ...], array: Any, agent: int) -> dict[str, float]:
    """An agent's numbers by name; without names there is a column that means nothing."""
    return {name: float(value) for name, value in zip(names, array.numpy()[0, agent], strict=False)}
