"""The single-environment view: ``gymnasium.Env`` over a batch of one."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np

from piavatar_envs.api.copies import Copied
from piavatar_envs.api.episode import RENDER_MODES, Episode, Settings
from piavatar_envs.api.seeds import checked_seed
from piavatar_envs.api.view import EpisodeView
from piavatar_envs.config import load_config
from piavatar_envs.envs.task import Task
from piavatar_envs.tasks import load_registered


class AvatarEnv(Copied, EpisodeView, gym.Env):
    """One soft avatar and a task.

    Observations are a flat float32 vector, or a dictionary with ``obs_mode="dict"``; ``observation_layout`` says what
    lies where. Actions are in [-1, 1], see ``action_names``: increments of the joints' rotations, their
    targets or torques on them, as ``control`` says.

    ``info`` holds the reward's terms (``info["reward_terms"]``), the task's metrics, ``success``, ``failure`` (None, or
    why the simulation gave up: then ``terminated`` is True and the next reset starts afresh), and the root wrench used.
    """

    metadata: ClassVar[dict[str, Any]] = {"render_modes": list(RENDER_MODES), "render_fps": 30}

    def __init__(
        self,
        task: str | type[Task] = "Reach-v0",
        render_mode: str | None = None,
        device: str = "cpu",
        config: Settings = None,
        registered: Sequence[str] | None = None,
        **overrides: Any,
    ) -> None:
        """Build the environment.

        Args:
            task: id of the task, this suite's with or without the namespace, or its class.
            render_mode: None, ``"rgb_array"`` or ``"human"``: a live view in a web browser, in real time at most.
            device: Warp device, ``"cpu"`` or ``"cuda:0"``.
            config: settings as a mapping, a YAML file or a configuration.
            registered: for Gymnasium alone: the id that is made, and the task that it was registered for.
            **overrides: settings that win over ``config``, such as ``fidelity="tiny"``.

        Raises:
            ConfigError: a setting that is unknown, of the wrong type or out of range.
            ImportError: ``render_mode="human"`` without the extra ``live``.
            ValueError: an unknown task or one that is not the id's, an unknown render mode or device.
        """
        task_class = load_registered(task, registered)
        settings = load_config(task_class.Config, config, overrides)
        made = {"task": task_class, "render_mode": render_mode, "device": device, "config": settings}
        self._build = partial(AvatarEnv.__init__, **made)
        self._episode = Episode(task_class(settings).alone(), render_mode, device)
        self.batch, self.config = self._episode.batch, settings
        self.render_mode, self._over = render_mode, False
        self.metadata = {**self.metadata, "render_fps": self._episode.frame_rate}
        self.action_names: tuple[str, ...] = self._episode.action_names
        self.action_space = self._episode.action_space()
        self.observation_space = self._episode.observation_space()

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Begin an episode.

        Args:
            seed: of this and all following episodes. Without one, the next episode of the seed before.
            options: none are known.

        Raises:
            ValueError: an option that is not known, or a seed outside [0, 2^32).
        """
        if options:
            raise ValueError(f"unknown reset options {sorted(options)}; there are none")
        if seed is not None:
            seed = checked_seed(seed)  # before it changes the generator
        super().reset(seed=seed)
        self._episode.begin(seed)
        self._over = False
        return self._episode.observation(0), self._episode.info(0)

    def step(self, action: np.ndarray) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Advance by one control step; warns if the episode has ended before.

        Raises:
            ValueError: an action of the wrong shape, or one that is not finite; nothing has changed then.
            gymnasium.error.ResetNeeded: before the first reset.
        """
        episode = self._episode
        episode.check_ready("step")
        if self._over:
            gym.logger.warn("step() after the end of the episode, which goes on as it was; call reset() before")
        episode.advance(episode.check_action(action)[None])
        outcome = episode.reward(0), episode.terminated(0), episode.truncated()
        self._over = outcome[1] or outcome[2]
        return episode.observation(0), *outcome, episode.step_info(0)

    def set_state(self, state: dict[str, np.ndarray]) -> Any:
        """Restore what :meth:`get_state` returned; returns the observation.

        Raises:
            ValueError: the state is of another environment, of other settings or not finite; nothing has changed then.
        """
        self._episode.restore(state)
        self._over = False
        return self._episode.observation(0)
