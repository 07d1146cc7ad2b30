"""The view of several agents: ``pettingzoo.ParallelEnv`` over a batch of one."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np

from piavatar_envs.api.copies import Copied
from piavatar_envs.api.episode import RENDER_MODES, Episode, Settings
from piavatar_envs.api.view import EpisodeView
from piavatar_envs.config import load_config, replace
from piavatar_envs.envs.batch_env import check_count
from piavatar_envs.envs.task import Task
from piavatar_envs.tasks import load_task

try:
    from pettingzoo import AECEnv, ParallelEnv
    from pettingzoo.utils.conversions import parallel_to_aec
except ImportError as error:
    raise ImportError("several agents need PettingZoo; install it with: pip install 'piavatar-envs[multi]'") from error

# the worlds have PettingZoo from here, so that each says what to install if it is not there
__all__ = ["AECEnv", "AvatarParallelEnv", "parallel_to_aec"]


class AvatarParallelEnv(Copied, EpisodeView, ParallelEnv):
    """Several soft avatars and a task; each avatar is an agent.

    Observations and actions are as those of :class:`~piavatar_envs.api.gym_env.AvatarEnv`, by agent, and so is
    ``info``. An agent that is terminated leaves ``agents``; its avatar stays in the world as a passive body. All leave
    when the clock has run out, and when the simulation gave up (``failure``).

    Attributes:
        possible_agents: names of all agents.
        agents: names of those that act in the next step.
        observation_spaces, action_spaces: by agent.
        state_space: of :meth:`state`.
        action_names: of every component of an agent's action.
        config: the settings.
        batch: the environment on the device.
    """

    def __init__(
        self,
        task: str | type[Task],
        render_mode: str | None = None,
        device: str = "cpu",
        config: Settings = None,
        max_cycles: int | None = None,
        name: str | None = None,
        **overrides: Any,
    ) -> None:
        """Build the environment.

        Args:
            task: its class, or for tasks of one's own the id.
            render_mode: None, ``"rgb_array"`` or ``"human"``: a live view in a web browser, in real time at most.
            device: Warp device, ``"cpu"`` or ``"cuda:0"``.
            config: settings as a mapping, a YAML file or a configuration.
            max_cycles: control steps until truncation; wins over ``episode_seconds``.
            name: of the environment in its ``metadata``; that of the task's module if not given.
            **overrides: settings that win over ``config``, such as ``fidelity="tiny"``.

        Raises:
            ConfigError: a setting that is unknown, of the wrong type or out of range.
            ImportError: ``render_mode="human"`` without the extra ``live``.
            ValueError: an unknown task, render mode or device, or no time at all.
        """
        task_class = load_task(task)
        self.config = load_config(task_class.Config, config, overrides)
        if max_cycles is not None:
            check_count("max_cycles", max_cycles, ", or None for episode_seconds")
            self.config = replace(self.config, episode_seconds=max_cycles * self.config.physics.control_dt)
        made = {"task": task_class, "render_mode": render_mode, "device": device, "config": self.config, "name": name}
        self._build = partial(AvatarParallelEnv.__init__, **made)
        self._episode = Episode(task_class(self.config), render_mode, device)
        self.batch, self.render_mode = self._episode.batch, render_mode
        self.metadata: dict[str, Any] = {
            "name": name or task_class.__module__.rpartition(".")[2],
            "render_modes": list(RENDER_MODES),
            "render_fps": self._episode.frame_rate,
            "is_parallelizable": True,
        }
        self.possible_agents = list(self.batch.task.agent_names)
        self.agents: list[str] = []
        self._index = {name: index for index, name in enumerate(self.possible_agents)}
        self.action_names = self._episode.action_names
        self.action_spaces = {name: self._episode.action_space() for name in self.possible_agents}
        self.observation_spaces = {name: self._episode.observation_space() for name in self.possible_agents}
        self.state_space = self._episode.state_space()

    def observation_space(self, agent: str) -> gym.Space:
        """Space of what ``agent`` sees: always the same object."""
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> gym.Space:
        """Space of what ``agent`` does: always the same object."""
        return self.action_spaces[agent]

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, dict[str, Any]]]:
        """Begin an episode with all agents.

        Args:
            seed: of this and all following episodes. Without one, the next episode of the seed before.
            options: none are known; ignored, as PettingZoo's own test asks.

        Returns:
            Observations and infos by agent.

        Raises:
            ValueError: a seed outside [0, 2^32).
            gymnasium.error.Error: what is no seed.
        """
        self._episode.begin(seed)
        self.agents = self._playing()
        return self._observations(), {name: self._episode.info(self._index[name]) for name in self.agents}

    def step(
        self, actions: Mapping[str, np.ndarray]
    ) -> tuple[dict[str, Any], dict[str, float], dict[str, bool], dict[str, bool], dict[str, dict[str, Any]]]:
        """Advance by one control step.

        Args:
            actions: of every agent in ``agents``, and of no other.

        Returns:
            Observations, rewards, terminations, truncations and infos of those who acted.

        Raises:
            ValueError: an action that is missing, of an agent that does not play, of the wrong shape or not finite;
                nothing has changed then.
            gymnasium.error.ResetNeeded: before the first reset, or all agents have left.
        """
        episode = self._episode
        episode.check_ready("step")
        if not self.agents:
            raise gym.error.ResetNeeded("all agents have left; call reset() before step()")
        episode.advance(self._checked(actions))
        acted, truncated = self.agents, episode.truncated()
        outcome = {name: self._index[name] for name in acted}
        terminations = {name: episode.terminated(agent) for name, agent in outcome.items()}
        truncations = {name: truncated and not terminations[name] for name in acted}
        observations = self._observations()
        rewards = {name: episode.reward(agent) for name, agent in outcome.items()}
        infos = {name: episode.step_info(agent) for name, agent in outcome.items()}
        self.agents = self._playing()
        return observations, rewards, terminations, truncations, infos

    def _checked(self, actions: Mapping[str, np.ndarray]) -> np.ndarray:
        """Actions ``(agents, action_size)``, zero for those who have left."""
        if not isinstance(actions, Mapping):
            kind = type(actions).__name__
            raise ValueError(f"actions are a {kind}; give a dictionary of one for each of {', '.join(self.agents)}")
        missing = [name for name in self.agents if name not in actions]
        strange = [name for name in actions if name not in self.agents]
        if missing or strange:
            what = f"no action for {', '.join(missing)}" if missing else f"an action for {', '.join(map(str, strange))}"
            raise ValueError(f"{what}; those who act are {', '.join(self.agents)}")
        rows = np.zeros((len(self.possible_agents), self.batch.action_spec.size), np.float32)
        for name in self.agents:
            try:
                rows[self._index[name]] = self._episode.check_action(actions[name])
            except ValueError as error:
                raise ValueError(f"{name}: {error}") from None
        return rows

    def _playing(self) -> list[str]:
        """Who acts in the next step."""
        alive = self.batch.alive.numpy()[0] & ~self.batch.truncated.numpy()[0]
        return [name for name, index in self._index.items() if alive[index]]

    def _observations(self) -> dict[str, Any]:
        return {name: self._episode.observation(self._index[name]) for name in self.agents}

    def state(self) -> np.ndarray:
        """The flat observations of all agents one after the other, also of those who have left, for central critics."""
        return self._episode.flat_observations()

    def set_state(self, state: dict[str, np.ndarray]) -> dict[str, Any]:
        """Restore what :meth:`get_state` returned, and who plays; returns the observations of these.

        Raises:
            ValueError: the state is of another environment, of other settings or not finite; nothing has changed then.
        """
        self._episode.restore(state)
        self.agents = self._playing()
        return self._observations()
