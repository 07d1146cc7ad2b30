"""Gymnasium's view of one environment: ``gymnasium.Env``."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np

from piavatar_envs.api.host import EpisodeHost, Settings, SingleView, checked_seed, limited
from piavatar_envs.api.pictures import RENDER_MODES, check_render_mode
from piavatar_envs.config import load_keywords
from piavatar_envs.envs.task import Task
from piavatar_envs.tasks import load_registered


class AvatarEnv(SingleView, gym.Env):
    """One soft avatar and a task.

    Observations are a flat float32 vector, or a dictionary with ``obs_mode="dict"``; ``observation_layout`` lists the
    terms. Actions are in [-1, 1], one component for each of ``action_names``. The setting ``control`` makes them
    increments of joint rotations, joint targets or joint torques.

    ``info`` holds numbers, booleans and vectors, under the same keys after a reset and after a step: ``success``,
    ``failure``, the root wrench, the task's metrics, the reward's terms (``reward_<name>``) and those of the cost
    (``cost_<name>``). Metrics and terms are zero after a reset. ``failure`` is 0, or a code whose cause
    :func:`piavatar_envs.failure_name` names: then ``terminated`` is True and the next reset begins a new episode.

    Attributes:
        host: holds the environment.
        batch: the environment on the device.
        config: the settings.
        action_names: of every component of the action.
    """

    # no ClassVar, because Gymnasium declares it of the instance
    metadata: dict[str, Any] = {"render_modes": list(RENDER_MODES), "render_fps": 30}  # noqa: RUF012

    def __init__(
        self,
        task: str | type[Task] = "Reach-v0",
        render_mode: str | None = None,
        device: str = "cpu",
        config: Settings = None,
        max_episode_steps: int | None = None,
        registered: Sequence[str] | None = None,
        **overrides: Any,
    ) -> None:
        """Build the environment.

        Args:
            task: id of the task, this suite's with or without the namespace, or its class.
            render_mode: None, ``"rgb_array"`` or ``"human"``: a live view in a web browser, in real time at most.
            device: Warp device, ``"cpu"`` or ``"cuda:0"``.
            config: settings as a mapping, a YAML file or a configuration.
            max_episode_steps: control steps until truncation; overrides ``episode_seconds``.
            registered: set by Gymnasium only: the id, and the task that it is registered for.
            **overrides: settings that override ``config``, such as ``fidelity="tiny"``.

        Raises:
            ConfigError: a setting that is unknown (a TypeError, too), of the wrong type or out of range.
            ImportError: a render mode without its extra: ``render`` or, for ``"human"``, ``live``.
            ValueError: an unknown task or one that the id is not registered for, an unknown render mode or device, or
                less than one control step.
        """
        task_class = load_registered(task, registered)
        settings = load_keywords(task_class.Config, config, overrides)
        settings = limited(settings, "max_episode_steps", max_episode_steps)
        made: dict[str, Any] = {"task": task_class, "render_mode": render_mode, "device": device, "config": settings}
        self._build = partial(AvatarEnv.__init__, **made)
        self.config, self.render_mode, self._over = settings, check_render_mode(render_mode), False
        self.host = EpisodeHost(task_class(settings).alone(), 1, device, render_mode=render_mode)
        self.metadata = {**self.metadata, "render_fps": self.host.frame_rate}
        self.action_names = self.host.action_names
        self.action_space = self.host.action_space()
        self.observation_space = self.host.observation_space()

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Begin an episode.

        Args:
            seed: of this and all following episodes. Without one, the next episode of the seed before.
            options: none are accepted.

        Raises:
            ValueError: any option, or a seed outside [0, 2^32).
        """
        if options:
            raise ValueError(f"unknown reset options {sorted(options)}; there are none")
        if seed is not None:
            seed = checked_seed(seed)  # before it changes Gymnasium's generator
        super().reset(seed=seed)
        self.host.reset(seed)
        self._over = False
        return self._observation(0), self._info(0)

    def step(self, action: np.ndarray) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Advance by one control step; warns if the episode has ended before.

        Raises:
            ValueError: an action of the wrong shape, or one that is not finite; nothing has changed then.
            gymnasium.error.ResetNeeded: before the first reset.
        """
        host = self.host
        host.check_ready("step")
        if self._over:
            gym.logger.warn("step() after the end of the episode, which goes on as it was; call reset() before")
        host.advance(host.api.actions(action, (host.action_size,), host.action_names)[None, None])
        terminated, truncated = bool(host.terminated()[0, 0]), bool(host.truncated()[0])
        self._over = terminated or truncated
        return self._observation(0), float(host.reward()[0, 0]), terminated, truncated, self._info(0, stepped=True)

    def set_state(self, state: dict[str, np.ndarray]) -> Any:
        """Restore the result of :meth:`get_state`; returns the observation.

        Raises:
            ValueError: the state is of another environment, of other settings or not finite; nothing has changed then.
        """
        self.host.set_state(state)
        self._over = False
        return self._observation(0)
