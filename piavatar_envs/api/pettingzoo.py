"""PettingZoo's view of several agents: ``pettingzoo.ParallelEnv`` of one environment."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np

from piavatar_envs.api.host import EpisodeHost, Settings, SingleView, checked_seed, limited
from piavatar_envs.api.pictures import RENDER_MODES, check_render_mode
from piavatar_envs.config import load_keywords
from piavatar_envs.core.extras import missing
from piavatar_envs.envs.task import Task
from piavatar_envs.tasks import load_task

try:
    from pettingzoo import AECEnv, ParallelEnv
    from pettingzoo.utils.conversions import parallel_to_aec
except ImportError as error:
    raise missing("a game of several agents", "PettingZoo", "multi") from error

# the modules in multi/ import PettingZoo from here, so that each reports the extra to install
__all__ = ["AECEnv", "AvatarParallelEnv", "parallel_to_aec"]


class AvatarParallelEnv(SingleView, ParallelEnv):
    """Several soft avatars and a task; each avatar is an agent.

    Observations, actions and ``info`` are those of :class:`~piavatar_envs.api.gym_env.AvatarEnv`, by agent. An agent
    that is terminated leaves ``agents``; its avatar stays in the world as a passive body. All leave when the clock has
    run out, and when the simulation has failed (``failure``).

    Attributes:
        possible_agents: names of all agents.
        agents: names of the agents that act in the next step.
        observation_spaces, action_spaces: by agent.
        state_space: of :meth:`state`.
        action_names: of every component of an agent's action.
        config: the settings.
        host: holds the environment.
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
            task: its class, or the id of a registered task of your own.
            render_mode: None, ``"rgb_array"`` or ``"human"``: a live view in a web browser, in real time at most.
            device: Warp device, ``"cpu"`` or ``"cuda:0"``.
            config: settings as a mapping, a YAML file or a configuration.
            max_cycles: control steps until truncation; overrides ``episode_seconds``.
            name: of the environment in its ``metadata``; that of the task's module if not given.
            **overrides: settings that override ``config``, such as ``fidelity="tiny"``.

        Raises:
            ConfigError: a setting that is unknown (a TypeError, too), of the wrong type or out of range.
            ImportError: a render mode without its extra: ``render`` or, for ``"human"``, ``live``.
            ValueError: an unknown task, render mode or device, or less than one control step.
        """
        task_class = load_task(task)
        self.config = limited(load_keywords(task_class.Config, config, overrides), "max_cycles", max_cycles)
        made: dict[str, Any] = {
            "task": task_class,
            "render_mode": render_mode,
            "device": device,
            "config": self.config,
            "name": name,
        }
        self._build = partial(AvatarParallelEnv.__init__, **made)
        self.render_mode = check_render_mode(render_mode)
        self.host = EpisodeHost(task_class(self.config), 1, device, render_mode=render_mode)
        self.metadata: dict[str, Any] = {
            "name": name or task_class.__module__.rpartition(".")[2],
            "render_modes": list(RENDER_MODES),
            "render_fps": self.host.frame_rate,
            "is_parallelizable": True,
        }
        self.possible_agents = list(self.host.task.agent_names)
        self.agents: list[str] = []
        self._index = {name: index for index, name in enumerate(self.possible_agents)}
        self.action_names = self.host.action_names
        self.action_spaces = {name: self.host.action_space() for name in self.possible_agents}
        self.observation_spaces = {name: self.host.observation_space() for name in self.possible_agents}
        self.state_space = self.host.state_space()

    def observation_space(self, agent: str) -> gym.Space:
        """Return the observation space of ``agent``, always the same object."""
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> gym.Space:
        """Return the action space of ``agent``, always the same object."""
        return self.action_spaces[agent]

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, dict[str, Any]]]:
        """Begin an episode with all agents.

        Args:
            seed: of this and all following episodes. Without one, the next episode of the seed before.
            options: ignored, as PettingZoo's own test requires.

        Returns:
            Observations and infos by agent.

        Raises:
            ValueError: a seed outside [0, 2^32).
            gymnasium.error.Error: a seed that is not a whole number.
        """
        self.host.reset(None if seed is None else checked_seed(seed))
        self.agents = self._acting()
        return self._observations(), {name: self._info(self._index[name]) for name in self.agents}

    def step(
        self, actions: Mapping[str, np.ndarray]
    ) -> tuple[dict[str, Any], dict[str, float], dict[str, bool], dict[str, bool], dict[str, dict[str, Any]]]:
        """Advance by one control step.

        Args:
            actions: of every agent in ``agents``, and of no other.

        Returns:
            Observations, rewards, terminations, truncations and infos of the agents that acted; empty, and nothing has
            changed, where all agents have left and there are no actions.

        Raises:
            ValueError: an action that is missing, of an agent that does not act, of the wrong shape or not finite;
                nothing has changed then.
            gymnasium.error.ResetNeeded: before the first reset, or for actions after all agents have left.
        """
        host = self.host
        host.check_ready("step")
        if not self.agents:
            if isinstance(actions, Mapping) and not actions:
                return {}, {}, {}, {}, {}
            raise gym.error.ResetNeeded("all agents have left; call reset() before step()")
        host.advance(self._checked(actions)[None])
        acted = {name: self._index[name] for name in self.agents}
        terminated, truncated, reward = host.terminated()[0], bool(host.truncated()[0]), host.reward()[0]
        terminations = {name: bool(terminated[agent]) for name, agent in acted.items()}
        truncations = {name: truncated and not terminations[name] for name in acted}
        observations = self._observations()
        rewards = {name: float(reward[agent]) for name, agent in acted.items()}
        infos = {name: self._info(agent, stepped=True) for name, agent in acted.items()}
        self.agents = self._acting()
        return observations, rewards, terminations, truncations, infos

    def _checked(self, actions: Mapping[str, np.ndarray]) -> np.ndarray:
        """Return actions ``(agents, action_size)``, zero for agents that have left."""
        if not isinstance(actions, Mapping):
            kind = type(actions).__name__
            raise ValueError(f"actions are a {kind}; give a dictionary of one for each of {', '.join(self.agents)}")
        missing = [name for name in self.agents if name not in actions]
        strange = [name for name in actions if name not in self.agents]
        if missing or strange:
            what = f"no action for {', '.join(missing)}" if missing else f"an action for {', '.join(map(str, strange))}"
            raise ValueError(f"{what}; the agents that act are {', '.join(self.agents)}")
        host = self.host
        rows = np.zeros((len(self.possible_agents), host.action_size), np.float32)
        for name in self.agents:
            try:
                rows[self._index[name]] = host.api.actions(actions[name], (host.action_size,), host.action_names)
            except ValueError as error:
                raise ValueError(f"{name}: {error}") from None
        return rows

    def _acting(self) -> list[str]:
        """Return the names of the agents that act in the next step."""
        alive = self.batch.alive.numpy()[0] & ~self.batch.truncated.numpy()[0]
        return [name for name, index in self._index.items() if alive[index]]

    def _observations(self) -> dict[str, Any]:
        return {name: self._observation(self._index[name]) for name in self.agents}

    def state(self) -> np.ndarray:
        """Return the flat observations of all agents, also of those that have left, for central critics."""
        return self.host.observation()[0].flatten()

    def set_state(self, state: dict[str, np.ndarray]) -> dict[str, Any]:
        """Restore the result of :meth:`get_state` and the acting agents; returns their observations.

        Raises:
            ValueError: the state is of another environment, of other settings or not finite; nothing has changed then.
        """
        self.host.set_state(state)
        self.agents = self._acting()
        return self._observations()
