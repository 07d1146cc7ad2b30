"""Views for skrl's wrappers: dictionaries of torch tensors, a row per environment. Needs torch.

One avatar::

    from skrl.envs.wrappers.torch import wrap_env
    env = wrap_env(AvatarSkrlEnv("PIAvatar/Reach-v0", num_envs=2048, device="cuda"), wrapper="isaaclab-single-agent")

Several, for MAPPO and IPPO::

    from piavatar_envs.multi import high_five_v0
    env = AvatarSkrlMultiEnv(high_five_v0.TASK, num_envs=1024, device="cuda")
    env = wrap_env(env, wrapper="isaaclab-multi-agent")
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import gymnasium as gym

from piavatar_envs.api.arrays import Array
from piavatar_envs.api.host import EpisodeHost, HostView, Settings, Transition
from piavatar_envs.config import load_keywords
from piavatar_envs.core.extras import missing
from piavatar_envs.envs.task import Task
from piavatar_envs.tasks import load_task

try:
    import torch
except ImportError as error:
    raise missing("this view", "torch", "skrl") from error


class _TorchView(HostView):
    """Hold environments whose arrays are tensors, as both views for skrl do."""

    def _open(
        self,
        build: Callable[..., None],
        task: type[Task],
        num_envs: int,
        device: str,
        config: Settings,
        num_threads: int | None,
        overrides: Mapping[str, Any],
    ) -> None:
        """Build the environments; ``build`` is the constructor that builds copies of the view."""
        self.config = load_keywords(task.Config, config, overrides)
        made = {"num_envs": num_envs, "device": device, "num_threads": num_threads, "config": self.config}
        self._build = partial(build, task=task, **made)
        self.host = EpisodeHost(self._played(task(self.config)), num_envs, device, "torch", num_threads)
        self.num_envs, self.device = num_envs, self.host.api.device

    def _played(self, task: Task) -> Task:
        """Return the task that the environments play."""
        return task


class AvatarSkrlEnv(_TorchView):
    """One avatar in each environment, for skrl's wrapper ``"isaaclab-single-agent"``.

    An environment that ends is reset in the same step: the observation returned is the first of its next episode, and
    ``info["final_obs"]`` is the last one of the episode, where ``info["_final_obs"]`` is True. Elsewhere the two are
    the same. All tensors are copies on ``device``.

    Attributes:
        num_envs: number of environments.
        device: torch's, of all tensors.
        single_observation_space: ``{"policy": space}`` of one environment.
        single_action_space: of one environment.
        config: the settings.
        host: holds the environments.
    """

    def __init__(
        self,
        task: str | type[Task] = "Reach-v0",
        num_envs: int = 1,
        device: str = "cpu",
        config: Settings = None,
        num_threads: int | None = None,
        **overrides: Any,
    ) -> None:
        """Build the environments.

        Args:
            task: id of the task, this suite's with or without the namespace, or its class.
            num_envs: number of environments.
            device: Warp device, ``"cpu"`` or ``"cuda:0"``.
            config: settings as a mapping, a YAML file or a configuration.
            num_threads: threads on a CPU; as many as there are cores if not given.
            **overrides: settings that override ``config``, such as ``fidelity="tiny"``.

        Raises:
            ConfigError: a setting that is unknown (a TypeError, too), of the wrong type or out of range.
            ImportError: torch is not installed.
            ValueError: an unknown task or device, or no environments.
        """
        self._open(AvatarSkrlEnv.__init__, load_task(task), num_envs, device, config, num_threads, overrides)
        self.single_observation_space = gym.spaces.Dict({"policy": self.host.observation_space()})
        self.single_action_space = self.host.action_space()

    def _played(self, task: Task) -> Task:
        """Return the task, which must have one agent."""
        return task.alone()

    @property
    def unwrapped(self) -> AvatarSkrlEnv:
        """This view."""
        return self

    def reset(self, seed: int | None = None, options: Any = None) -> tuple[dict[str, Any], dict[str, Any]]:
        """Begin an episode in every environment.

        Args:
            seed: environment ``i`` plays the episodes of ``seed + i``. Without one, the next of the seed before.
            options: ignored.

        Returns:
            ``{"policy": observation}``, the observation ``(num_envs, size)``, or a dictionary of such with
            ``obs_mode="dict"``; and an empty info.

        Raises:
            ValueError: a seed outside [0, 2^32).
        """
        self.host.reset(seed)
        return {"policy": self._named(self.host.observation(), self.host.observed_pictures(0))}, {}

    def step(self, actions: Array) -> tuple[dict[str, Any], Array, Array, Array, dict[str, Any]]:
        """Advance by one control step.

        Args:
            actions: ``(num_envs, action_size)`` float32 on :attr:`device`. A component that is not finite acts as zero
                and ends its environment with a failure.

        Returns:
            ``{"policy": observation}``, then reward, terminated and truncated, each ``(num_envs,)``, and the info:
            beside the final observation the entries of Gymnasium's view (metrics, ``reward_<name>``, ``success``,
            ``failure``, ...), a row per environment.

        Raises:
            ValueError: actions of a wrong shape, type or device; nothing has changed then.
            gymnasium.error.ResetNeeded: before the first reset.
        """
        done = self.host.step_and_reset(_joint([actions], self.num_envs, self.host.action_size))
        info = {
            **done.infos[0],
            "final_obs": {"policy": self._named(done.final_observation, done.final_pictures[0])},
            "_final_obs": done.ended,
            "episode": done.means(self.host.task.metric_names),
        }
        outcome = done.reward[:, 0], done.terminated[:, 0], done.truncated[:, 0]
        return {"policy": self._named(done.observation, done.pictures[0])}, *outcome, info

    def _named(self, observation: Array, pictures: Mapping[str, Array]) -> Any:
        return self.host.named(observation[:, 0], pictures)

    def close(self) -> None:
        """End the threads."""
        self.host.close()


class AvatarSkrlMultiEnv(_TorchView):
    """Several avatars in each environment, dictionaries by agent, for skrl's wrapper ``"isaaclab-multi-agent"``.

    The arrays always have rows for all agents: an agent that is out keeps its rows while the others of its environment
    go on. There its reward is 0, ``terminated`` stays True, its actions are ignored, and its observation is that of its
    passive body. An environment ends with its last agent, or with its clock (then ``truncated`` is True for agents
    still in), and is reset in the same step. A learner needs these entries of ``infos``:

    - ``infos["acted"][agent]`` ``(num_envs,)`` bool: the agent acted in this step; do not learn from other rows.
    - ``infos["alive"][agent]`` ``(num_envs,)`` bool: it acts in the next step.
    - ``infos["final_obs"][agent]``, ``infos["final_state"]``: the observations to which the step led, also where the
      environment was reset (``infos["_final_obs"]``, ``(num_envs,)`` bool); elsewhere the same as those returned.
    - ``infos[agent]``: metrics, ``reward_<name>``, ``success``, ``failure`` and the root's wrench, a row for
      each environment.

    All tensors are copies on ``device``.

    Attributes:
        num_envs: number of environments.
        device: torch's, of all tensors.
        possible_agents: names of the agents.
        observation_spaces, action_spaces: of one environment, by agent.
        state_space: of :meth:`state`, of one environment.
        config: the settings.
        host: holds the environments.
    """

    def __init__(
        self,
        task: str | type[Task],
        num_envs: int = 1,
        device: str = "cpu",
        config: Settings = None,
        num_threads: int | None = None,
        **overrides: Any,
    ) -> None:
        """Build the environments.

        Args:
            task: its class, such as ``piavatar_envs.multi.high_five_v0.TASK``, or the id of a registered task.
            num_envs: number of environments.
            device: Warp device, ``"cpu"`` or ``"cuda:0"``.
            config: settings as a mapping, a YAML file or a configuration.
            num_threads: threads on a CPU; as many as there are cores if not given.
            **overrides: settings that override ``config``, such as ``fidelity="tiny"``.

        Raises:
            ConfigError: a setting that is unknown (a TypeError, too), of the wrong type or out of range.
            ImportError: torch is not installed.
            ValueError: an unknown task or device, or no environments.
        """
        self._open(AvatarSkrlMultiEnv.__init__, load_task(task), num_envs, device, config, num_threads, overrides)
        self.possible_agents = list(self.host.task.agent_names)
        self.action_spaces = {name: self.host.action_space() for name in self.possible_agents}
        self.observation_spaces = {name: self.host.observation_space() for name in self.possible_agents}
        self.state_space = self.host.state_space()

    @property
    def unwrapped(self) -> AvatarSkrlMultiEnv:
        """This view."""
        return self

    @property
    def agents(self) -> list[str]:
        """Names of all agents: an environment without any has been reset."""
        return list(self.possible_agents)

    @property
    def num_agents(self) -> int:
        """Number of agents."""
        return len(self.possible_agents)

    def reset(self, seed: int | None = None, options: Any = None) -> tuple[dict[str, Any], dict[str, Any]]:
        """Begin an episode in every environment.

        Args:
            seed: environment ``i`` plays the episodes of ``seed + i``. Without one, the next episode of the seed
                before.
            options: ignored.

        Returns:
            Observations ``(num_envs, size)`` by agent, or dictionaries of such with ``obs_mode="dict"``; and infos.

        Raises:
            ValueError: a seed outside [0, 2^32).
        """
        self.host.reset(seed)
        return self._now()

    def _now(self) -> tuple[dict[str, Any], dict[str, Any]]:
        """Return the present observations and the info of a reset."""
        pictures = [self.host.observed_pictures(agent) for agent in range(self.num_agents)]
        return self._named(self.host.observation(), pictures), {"alive": self._by_agent(self.host.alive())}

    def step(self, actions: Mapping[str, Array]) -> tuple[dict[str, Any], ...]:
        """Advance by one control step.

        Args:
            actions: of every agent, ``(num_envs, action_size)`` float32 on :attr:`device`. A component that is not
                finite acts as zero and ends its environment with a failure.

        Returns:
            Observations, rewards, terminated and truncated (each of the latter ``(num_envs,)``) by agent, and infos.

        Raises:
            ValueError: actions that are missing, of no agent, or of a wrong shape, type or device; nothing has changed
                then.
            gymnasium.error.ResetNeeded: before the first reset.
        """
        if set(actions) != set(self.possible_agents):
            raise ValueError(f"actions of {sorted(actions)}; give one for each of {', '.join(self.possible_agents)}")
        rows = [actions[name] for name in self.possible_agents]
        done = self.host.step_and_reset(_joint(rows, self.num_envs, self.host.action_size))
        flags = (self._by_agent(values) for values in (done.reward, done.terminated, done.truncated))
        return self._named(done.observation, done.pictures), *flags, self._infos(done)

    def _infos(self, done: Transition) -> dict[str, Any]:
        return {
            **dict(zip(self.possible_agents, done.infos, strict=True)),
            "acted": self._by_agent(done.acted),
            "alive": self._by_agent(self.host.alive()),
            "final_obs": self._named(done.final_observation, done.final_pictures),
            "final_state": done.final_observation.flatten(1),
            "_final_obs": done.ended,
            "episode": done.means(self.host.task.metric_names),
        }

    def state(self) -> Array:
        """Return the flat observations of all agents, ``(num_envs, size)``, for central critics."""
        self.host.check_ready("state")
        return self.host.observation().flatten(1)

    def _named(self, observation: Array, pictures: Sequence[Mapping[str, Array]]) -> dict[str, Any]:
        flat = self._by_agent(observation).items()
        return {name: self.host.named(own, seen) for (name, own), seen in zip(flat, pictures, strict=True)}

    def _by_agent(self, values: Array) -> dict[str, Array]:
        """Split ``values`` ``(num_envs, num_agents, ...)`` by agent into separate copies."""
        return {name: values[:, index].clone() for index, name in enumerate(self.possible_agents)}

    def close(self) -> None:
        """End the threads."""
        self.host.close()


def _joint(rows: list[Array], num_envs: int, size: int) -> Array:
    """Stack the actions of every agent to ``(num_envs, num_agents, size)``.

    Raises:
        ValueError: the actions of an agent have a wrong shape.
    """
    for row in rows:
        if tuple(row.shape) != (num_envs, size):
            raise ValueError(f"an agent's actions have shape {tuple(row.shape)}, expected {(num_envs, size)}")
    return torch.stack([torch.as_tensor(row) for row in rows], dim=1)
