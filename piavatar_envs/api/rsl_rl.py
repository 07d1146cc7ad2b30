"""View for rsl_rl: its ``VecEnv``, with observations as TensorDicts of groups.

::

    from rsl_rl.runners import OnPolicyRunner
    env = AvatarRslEnv("PIAvatar/Reach-v0", num_envs=4096, device="cuda", seed=0)
    OnPolicyRunner(env, train_cfg, log_dir="runs/reach", device="cuda").learn(300)
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

from piavatar_envs.api.host import EpisodeHost, HostView, Settings
from piavatar_envs.config import ConfigError, EnvConfig, load_keywords
from piavatar_envs.core.extras import missing
from piavatar_envs.envs.task import Task
from piavatar_envs.tasks import load_task

try:
    import torch
    from rsl_rl.env import VecEnv
    from tensordict import TensorDict
except ImportError as error:
    raise missing("this view", "rsl_rl", "rsl") from error


class AvatarRslEnv(HostView, VecEnv):
    """One avatar in each environment, for rsl_rl's runners.

    Episodes begin when the view is built, because runners never reset. An environment that ends is reset in the same
    step; ``extras["final_observations"]`` holds its last observation, although rsl_rl does not use it (it bootstraps a
    time-out from the value before the step). All tensors are copies on ``device``.

    Attributes:
        num_envs, num_actions: numbers of environments and of an action's components.
        max_episode_length: control steps until the clock runs out.
        device: torch's, of all tensors.
        cfg: the settings as plain values, for rsl_rl's loggers.
        config: the settings.
        groups: names of the terms in every observation group; those of pictures are not among them.
        host: holds the environments.
    """

    def __init__(
        self,
        task: str | type[Task] = "Reach-v0",
        num_envs: int = 1,
        device: str = "cpu",
        config: Settings = None,
        groups: Mapping[str, Sequence[str]] | None = None,
        seed: int | None = None,
        num_threads: int | None = None,
        **overrides: Any,
    ) -> None:
        """Build the environments, and begin their first episodes.

        Args:
            task: id of the task, this suite's with or without the namespace, or its class.
            num_envs: number of environments.
            device: Warp device, ``"cpu"`` or ``"cuda:0"``.
            config: settings as a mapping, a YAML file or a configuration.
            groups: terms of the observation by observation group, such as ``{"policy": ["target_position"]}``, to be
                named in the runner's ``obs_groups``. By default all of it is ``policy``; with ``obs_mode="dict"`` every
                term is a group of its own; with ``"pixels"`` there is none, and groups given here are for a critic that
                sees more than the actor. Pictures are always groups of their own, ``pixels``, ``depth`` and
                ``segmentation``.
            seed: environment ``i`` plays the episodes of ``seed + i``; without one they differ every time.
            num_threads: threads on a CPU; as many as there are cores if not given.
            **overrides: settings that override ``config``, such as ``fidelity="tiny"``.

        Raises:
            ConfigError: a setting that is unknown (a TypeError, too), of the wrong type or out of range, or an unknown
                term in a group.
            ValueError: an unknown task or device, no environments, or a seed outside [0, 2^32).
        """
        task_class = load_task(task)
        self.config = load_keywords(task_class.Config, config, overrides)
        # a copy is built by _make, which begins no episodes
        made: dict[str, Any] = {
            "num_envs": num_envs,
            "device": device,
            "num_threads": num_threads,
            "config": self.config,
        }
        self._build = partial(AvatarRslEnv._make, task=task_class, **made)
        self._make(task_class, **made)
        self.num_envs, self.num_actions = num_envs, self.host.action_size
        self.device = self.host.api.device
        self.max_episode_length = self.host.groups[0].max_steps
        self.cfg = self.config.model_dump(mode="json")
        self.groups = self._checked_groups(groups)
        self.reset(seed)

    def _make(self, task: type[Task], num_envs: int, device: str, num_threads: int | None, config: EnvConfig) -> None:
        """Build the environments."""
        self.host = EpisodeHost(task(config).alone(), num_envs, device, "torch", num_threads)

    def _checked_groups(self, groups: Mapping[str, Sequence[str]] | None) -> dict[str, tuple[str, ...]]:
        layout = self.host.layout
        if groups is None:
            by_term: dict[str, tuple[str, ...]] = {name: (name,) for name in layout}
            return {"dict": by_term, "pixels": {}}.get(self.config.obs_mode, {"policy": tuple(layout)})
        taken = self.host.observed_pictures(0)
        for group, names in groups.items():
            if group in taken:
                raise ConfigError(f"groups: {group!r} is that of the pictures; choose another name")
            unknown = [name for name in names if name not in layout]
            if unknown or not names:
                what = f"has no term {unknown[0]!r}" if unknown else "is empty"
                raise ConfigError(f"groups: {group!r} {what}; use some of {', '.join(layout)}")
        return {group: tuple(names) for group, names in groups.items()}

    @property
    def unwrapped(self) -> AvatarRslEnv:
        """This view."""
        return self

    @property
    def step_dt(self) -> float:
        """Time of a control step [s], which rsl_rl's random network distillation reads."""
        return self.config.physics.control_dt

    @property
    def episode_length_buf(self) -> torch.Tensor:
        """Control steps of every episode counted towards its time limit, ``(num_envs,)`` int64.

        Runners set it to spread the ends of the first episodes (``init_at_random_ep_len``). This brings the time limits
        nearer, and leaves the clock by which clips and gaits advance.
        """
        ahead = self.host.read(lambda group: group.head_start)
        return (self.host.read(lambda group: group.step_count) + ahead).long()

    @episode_length_buf.setter
    def episode_length_buf(self, steps: torch.Tensor) -> None:
        steps = torch.as_tensor(steps)
        if tuple(steps.shape) != (self.num_envs,):
            raise ValueError(f"episode_length_buf has shape {tuple(steps.shape)}, expected {(self.num_envs,)}")
        if steps.is_floating_point() and not bool((steps == steps.round()).all()):
            raise ValueError(f"episode_length_buf={steps.tolist()} must be whole numbers of control steps")
        clocks = steps.to(self.device).clamp(0, self.max_episode_length - 1)
        ahead = clocks - self.host.read(lambda group: group.step_count)
        self.host.api.write(ahead, [group.head_start for group in self.host.groups])

    def reset(self, seed: int | None = None) -> tuple[TensorDict, dict[str, Any]]:
        """Begin an episode in every environment; returns the observations and empty extras.

        Args:
            seed: environment ``i`` plays the episodes of ``seed + i``. Without one, the next of the seed before.

        Raises:
            ValueError: a seed outside [0, 2^32).
        """
        self.host.reset(seed)
        return self.get_observations(), {}

    def get_observations(self) -> TensorDict:
        """Return the observations by group, each ``(num_envs, size)``; for pictures see :func:`picture_groups`."""
        return self.grouped(self.host.observation(), self.host.observed_pictures(0))

    def step(self, actions: torch.Tensor) -> tuple[TensorDict, torch.Tensor, torch.Tensor, dict[str, Any]]:
        """Advance by one control step.

        Args:
            actions: ``(num_envs, num_actions)`` float32 on :attr:`device`. A component that is not finite acts as zero
                and ends its environment with a failure.

        Returns:
            Observations by group; reward and done (int64), each ``(num_envs,)``; and extras: ``time_outs``
            ``(num_envs,)`` bool, ``log`` (means of success, metrics and the reward's terms), ``final_observations``
            (to which the step led, also where an environment was reset), and ``info``, a row per environment.

        Raises:
            ValueError: actions of a wrong shape, type or device; nothing has changed then.
        """
        done = self.host.step_and_reset(actions[:, None])
        extras = {
            "time_outs": done.truncated[:, 0],
            "log": done.means(self.host.task.metric_names),
            "final_observations": self.grouped(done.final_observation, done.final_pictures[0]),
            "info": done.infos[0],
        }
        now = self.grouped(done.observation, done.pictures[0])
        return now, done.reward[:, 0], done.ended.long(), extras

    def grouped(self, observation: torch.Tensor, pictures: Mapping[str, torch.Tensor]) -> TensorDict:
        """Return the groups that the runner's networks take.

        Args:
            observation: flat, ``(n, 1, observation_size)``.
            pictures: by name, see :func:`picture_groups`.
        """
        layout = self.host.layout
        groups = {
            group: torch.cat([observation[:, 0, layout[name].slice] for name in names], dim=-1)
            for group, names in self.groups.items()
        }
        groups |= picture_groups(pictures)
        return TensorDict(groups, batch_size=[len(observation)], device=self.device)

    def close(self) -> None:
        """End the threads."""
        self.host.close()


def picture_groups(pictures: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """Return pictures as networks take them: float32, channels first, colours in [0, 1].

    Args:
        pictures: ``(n, height, width, channels)`` by name.
    """
    groups = {}
    for name, picture in pictures.items():
        values = picture.permute(0, 3, 1, 2).to(torch.float32, memory_format=torch.contiguous_format)
        groups[name] = values / 255.0 if name == "pixels" else values
    return groups
