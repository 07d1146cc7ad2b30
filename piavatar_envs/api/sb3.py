"""Stable-Baselines3's view: its ``VecEnv`` over the vector of environments, SAME_STEP."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode

from piavatar_envs.api.host import EpisodeHost
from piavatar_envs.api.vector_env import AvatarVectorEnv, single_infos
from piavatar_envs.core.extras import missing
from piavatar_envs.envs.task import Task

try:
    from stable_baselines3.common.vec_env import VecEnv
except ImportError as error:
    raise missing("this view", "Stable-Baselines3", "train") from error

#: Indices of environments as Stable-Baselines3 gives them; None for all.
Indices = int | Iterable[int] | None


class SB3VecEnv(VecEnv):
    """Many environments for ``PPO("MlpPolicy", SB3VecEnv("KickBall-v0", num_envs=64, device="cuda"))``.

    An environment that ends begins its next episode in the same step: its last observation is
    ``info["terminal_observation"]``, and ``info["TimeLimit.truncated"]`` is True if only the clock has run out.
    Stable-Baselines3 logs ``info["is_success"]`` as ``rollout/success_rate``; wrap this in a ``VecMonitor`` for returns
    and lengths.

    Attributes:
        vector: the environments.
    """

    def __init__(
        self,
        task: str | type[Task] = "Reach-v0",
        num_envs: int = 1,
        render_mode: str | None = None,
        device: str = "cpu",
        config: Any = None,
        num_threads: int | None = None,
        step_infos: bool = True,
        **overrides: Any,
    ) -> None:
        """Build the environments.

        Args:
            task: id of the task, this suite's with or without the namespace, or its class.
            num_envs: number of environments.
            render_mode: None or ``"rgb_array"``.
            device: Warp device, ``"cpu"`` or ``"cuda:0"``; the arrays are NumPy's either way.
            config: settings as a mapping, a YAML file or a configuration.
            num_threads: threads that share the environments on a CPU; one per core if not given.
            step_infos: whether every step has infos, or only the last one of an episode. A thousand dictionaries a
                step cost more than the thousand environments on a GPU.
            **overrides: settings that override ``config``, such as ``fidelity="tiny"``.

        Raises:
            ConfigError: a setting that is unknown, of the wrong type or out of range.
            ValueError: an unknown task, render mode or device, or no environments.
        """
        self.vector = AvatarVectorEnv(
            task,
            num_envs,
            render_mode,
            device,
            config,
            autoreset_mode=AutoresetMode.SAME_STEP,
            num_threads=num_threads,
            **overrides,
        )
        self._step_infos = step_infos
        self._actions: np.ndarray | None = None
        super().__init__(num_envs, self.vector.single_observation_space, self.vector.single_action_space)
        self.metadata = {**self.metadata, "render_fps": self.vector.metadata["render_fps"]}

    @property
    def host(self) -> EpisodeHost:
        """Holds the environments."""
        return self.vector.host

    @property
    def segmentation_names(self) -> tuple[str, ...]:
        """Names by label of the observed ``segmentation``, the ground first; empty where no pictures are observed."""
        return self.vector.segmentation_names

    def reset(self) -> Any:
        """Begin episodes: of the seed given to :meth:`seed` before, or the next ones.

        Raises:
            ValueError: options were set; none are accepted.
        """
        if any(self._options):
            raise ValueError(f"unknown reset options {sorted(set().union(*self._options))}; there are none")
        observation, infos = self.vector.reset(seed=self._seeds)
        self.reset_infos = single_infos(infos, self.num_envs)
        self._reset_seeds()
        return observation

    def step_async(self, actions: np.ndarray) -> None:
        """Keep the actions ``(num_envs, action_size)`` for :meth:`step_wait`."""
        self._actions = actions

    def step_wait(self) -> tuple[Any, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """Advance all environments by one control step.

        Returns:
            Observations, rewards (float32), whether episodes ended, and an info for every environment.

        Raises:
            ValueError: actions of the wrong shape, or that are not finite; nothing has changed then.
            gymnasium.error.ResetNeeded: before the first reset.
        """
        observation, reward, terminated, truncated, infos = self.vector.step(self._actions)
        ended = terminated | truncated
        final, last = infos.pop("final_info", {}), infos.pop("final_obs", None)
        now = single_infos(infos, self.num_envs) if self._step_infos or ended.any() else []
        rows = [row | {"TimeLimit.truncated": False} if self._step_infos else {} for row in now]
        rows = rows or [{} for _ in range(self.num_envs)]
        for env, info in enumerate(single_infos(final, self.num_envs)):
            if ended[env]:
                self.reset_infos[env] = now[env]
                rows[env] = info | {
                    "is_success": info["success"],
                    "terminal_observation": last[env],
                    "TimeLimit.truncated": bool(truncated[env] and not terminated[env]),
                }
        return observation, reward.astype(np.float32), ended, rows

    def assist_root(self, share: float | np.ndarray) -> None:
        """Set the share of root assistance from now on: one in [0, 1], or one per environment; resets keep it.

        Raises:
            ValueError: it is out of range, of another shape, or the control is ``"pose"``.
        """
        self.vector.assist_root(share)

    def weigh_motions(self, weights: Any) -> None:
        """Set the weights by which episodes draw motions; see :meth:`piavatar_envs.api.host.HostView.weigh_motions`."""
        self.vector.weigh_motions(weights)

    def apply_force(self, *args: Any, **kwargs: Any) -> None:
        """Let a force act on a bone or a prop; see :meth:`piavatar_envs.api.host.HostView.apply_force`."""
        self.vector.apply_force(*args, **kwargs)

    def read(self, name: str, agent: str | None = None) -> np.ndarray:
        """Return a copy of a quantity of the world; see :meth:`piavatar_envs.api.host.HostView.read`."""
        return self.vector.read(name, agent)

    def close(self) -> None:
        """Free the renderers and end the threads."""
        self.vector.close()

    def get_images(self) -> Sequence[np.ndarray | None]:
        """Draw every environment, or with ``render.mosaic`` one picture; None without ``render_mode="rgb_array"``."""
        frames = self.vector.render() or [None] * self.num_envs
        return frames[:1] if self.vector.config.render.mosaic else frames

    def get_attr(self, attr_name: str, indices: Indices = None) -> list[Any]:
        """Return an attribute of the vector, once for every environment: they share it.

        Raises:
            AttributeError: there is none of this name.
            IndexError: there is no such environment.
        """
        return self.vector.attr_of_some(self._some(indices), attr_name)

    def set_attr(self, attr_name: str, value: Any, indices: Indices = None) -> None:
        """Set an attribute of your own, which all environments share and this package does not read.

        Raises:
            ValueError: ``indices`` are not all of them, or the name is a setting or an attribute of the vector itself.
        """
        if set(self._some(indices)) != set(range(self.num_envs)):
            raise ValueError(f"set_attr({attr_name!r}): environments of a batch share their attributes; leave indices")
        self.vector.set_attr(attr_name, [value] * self.num_envs)

    def env_method(self, method_name: str, *method_args: Any, indices: Indices = None, **method_kwargs: Any) -> list:
        """Call a method of single environments, for some of them; see :meth:`AvatarVectorEnv.call`.

        ``env_method("reset", seed=7, indices=2)`` begins an episode in one environment and returns a list of its
        observation and info, as :meth:`AvatarEnv.reset` does; the others go on.

        Raises:
            AttributeError: there is no such method of single environments.
            IndexError: there is no such environment.
        """
        envs = self._some(indices)
        if method_name == "reset" and not self.vector.host.ready:
            self.reset()  # the other environments begin by their own seeds
        return self.vector.call_some(envs, method_name, *method_args, **method_kwargs)

    def env_is_wrapped(self, wrapper_class: type[gym.Wrapper], indices: Indices = None) -> list[bool]:
        """Return False for every environment: environments of a batch are never wrapped."""
        return [False for _ in self._some(indices)]

    def _some(self, indices: Indices) -> list[int]:
        """Return the environments that ``indices`` select, counted from 0; negative ones count from the end.

        Raises:
            IndexError: there is no such environment.
        """
        envs = list(self._get_indices(indices))
        unknown = [env for env in envs if not -self.num_envs <= env < self.num_envs]
        if unknown:
            raise IndexError(f"indices={unknown}: there are num_envs={self.num_envs}; use 0 to {self.num_envs - 1}")
        return [env % self.num_envs for env in envs]
