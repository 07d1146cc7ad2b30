"""One environment as the host sees it: what the views of a batch of one have in common."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
import warp as wp
from gymnasium.utils import seeding

from piavatar_envs.api import spaces
from piavatar_envs.api.arrays import NumpyArrays
from piavatar_envs.api.copies import check_state
from piavatar_envs.api.infos import failure_names, outcome, standing
from piavatar_envs.api.picture import Pictures
from piavatar_envs.api.seeds import checked_seed
from piavatar_envs.config import EnvConfig
from piavatar_envs.core.rng import NUM_SEEDS
from piavatar_envs.envs.actions import check_actions
from piavatar_envs.envs.batch_env import BatchEnv
from piavatar_envs.envs.task import Task

if TYPE_CHECKING:
    from piavatar_envs.api.live import Live

#: How settings may be given.
Settings = EnvConfig | Mapping[str, Any] | str | Path | None

#: Of one environment, and of a batch of them: there is one live view, and it shows one.
RENDER_MODES = ("rgb_array", "human")
BATCH_RENDER_MODES = ("rgb_array",)


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
            ImportError: ``render_mode="human"`` without the extra ``live``.
            ValueError: an unknown render mode or device.
        """
        self.config, self.render_mode = task.config, check_render_mode(render_mode)
        self.batch = BatchEnv(task, 1, device)
        self._live: Live | None = None
        if render_mode == "human":
            from piavatar_envs.api.live import Live  # nothing of the renderer without a picture

            self._live = Live(self.batch, self.config.render.color)
        self.action_names: tuple[str, ...] = tuple(self.batch.action_spec.names())
        self.ready = False
        self._arrays = NumpyArrays()
        self._pictures = Pictures(lambda env: (self.batch, env), self.config.render)

    @property
    def frame_rate(self) -> int:
        """Control steps a second."""
        return round(1.0 / self.config.physics.control_dt)

    def action_space(self) -> gym.spaces.Box:
        """A new space for the actions of an agent."""
        return spaces.action_space(self.batch)

    def observation_space(self) -> gym.Space:
        """A new space for the observations of an agent. They have no honest limits."""
        return spaces.observation_space(self.batch)

    def state_space(self) -> gym.spaces.Box:
        """A new space for :meth:`flat_observations`."""
        return spaces.state_space(self.batch)

    def begin(self, seed: int | None) -> None:
        """Reset: an episode of ``seed``, or the next one of the seed before.

        An environment that was never seeded is different every time, as Gymnasium asks.

        Raises:
            ValueError: a seed outside [0, 2^32).
            gymnasium.error.Error: what is no seed.
        """
        if seed is not None:
            seed = checked_seed(seed)
        elif not self.ready:
            seed = int(seeding.np_random(None)[0].integers(NUM_SEEDS))
        self.batch.reset(seeds=None if seed is None else [seed])
        self.ready = True
        if self._live:
            self._live.begin()

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
        """One control step under checked ``actions`` ``(agents, action_size)``; in real time, if somebody watches."""
        self.batch.action.assign(actions[None])
        self.batch.step()
        if self._live:
            self._live.step()

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
        return _of_host(standing(self._read, self._arrays, agent))

    def step_info(self, agent: int) -> dict[str, Any]:
        """:meth:`info` and what the last step was worth: the task's metrics, the terms of reward and cost."""
        return self.info(agent) | _of_host(outcome(self._read, self.batch.task, agent))

    def _read(self, array_of: Callable[[BatchEnv], wp.array]) -> np.ndarray:
        return self._arrays.read([array_of(self.batch)])

    def render(self) -> np.ndarray | None:
        """The scene as ``(height, width, 3)`` uint8 with ``render_mode="rgb_array"``, else None.

        With ``"human"`` there is nothing to do: resets and steps update the live view.

        Raises:
            ImportError: the extra ``render`` is not installed.
            gymnasium.error.ResetNeeded: before the first reset.
        """
        if self.render_mode is None:
            gym.logger.warn('render() needs an environment made with render_mode="rgb_array"')
            return None
        self.check_ready("render")
        return None if self._live else self._pictures.frame(0)

    def close(self) -> None:
        """Free the renderer's window, and stop the live view; closing twice is fine."""
        self._pictures.close()
        if self._live:
            self._live.close()

    def get_state(self) -> dict[str, np.ndarray]:
        """Everything that the future depends on, on the host."""
        return self.batch.get_state()

    def restore(self, state: dict[str, np.ndarray]) -> None:
        """Go on from what :meth:`get_state` returned.

        Raises:
            ValueError: the state is of another environment, of other settings or not finite; nothing has changed then.
        """
        check_state(state, 1)
        self.adopt(state, ready=True)
        if self._live:
            self._live.begin()

    def adopt(self, state: dict[str, np.ndarray], ready: bool) -> None:
        """Be a copy of another, given its state and whether it is ready. Nobody watches before the next reset."""
        self.batch.set_state(state)
        self.ready = ready


def check_render_mode(render_mode: str | None, modes: tuple[str, ...] = RENDER_MODES) -> str | None:
    """The mode itself, of one environment.

    Raises:
        ValueError: an unknown one.
    """
    if render_mode is not None and render_mode not in modes:
        known = f"{', '.join(['None', *modes[:-1]])} or {modes[-1]}"
        raise ValueError(f"render_mode={render_mode!r} is not known; use {known}")
    return render_mode


def check_batch_render_mode(render_mode: str | None) -> str | None:
    """The mode itself, of a batch of environments.

    Raises:
        ValueError: an unknown one, or the live view.
    """
    if render_mode == "human":
        raise ValueError(
            "render_mode='human' is a live view of one environment, and this is a batch; use rgb_array here, or "
            "watch one: gym.make(id, render_mode='human') or python -m piavatar_envs watch ID"
        )
    return check_render_mode(render_mode, BATCH_RENDER_MODES)


def _of_host(values: Mapping[str, Any]) -> dict[str, Any]:
    """The only environment's values as Python's numbers, vectors as arrays."""
    found: dict[str, Any] = {}
    for name, value in values.items():
        if isinstance(value, Mapping):
            found[name] = _of_host(value)
        elif name == "failure":
            found[name] = failure_names(value)[0]
        else:
            found[name] = value[0] if value.ndim > 1 else value[0].item()
    return found
