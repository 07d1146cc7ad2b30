"""Actors of trials: scripted ones, whose actions depend on time and seed alone, and policies of training runs."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from agents.config import changed
from agents.evaluate import Seen
from agents.fit.config import ActorConfig
from piavatar_envs.api.host import EpisodeHost
from piavatar_envs.config import ConfigError, load_config
from piavatar_envs.tasks import load_task

#: From observations, as :func:`agents.evaluate.seen_by` returns them, to actions ``(num_envs, num_agents, size)``.
Actor = Callable[[Seen], np.ndarray]


def make_actor(config: ActorConfig, host: EpisodeHost, seeds: Sequence[int]) -> Actor:
    """Make the actor of a batch.

    Args:
        config: of the actor.
        host: that is played.
        seeds: of the episodes.

    Raises:
        ConfigError: an unknown component of the action, or a policy that was trained for another environment.
    """
    shape = host.num_envs, host.num_agents, host.action_size
    if config.kind == "run":
        return _trained(config, host)
    if config.kind == "random":
        drawn = [np.random.default_rng(seed) for seed in seeds]
        return lambda seen: np.stack([rng.uniform(-1.0, 1.0, shape[1:]) for rng in drawn]).astype(np.float32)
    if config.kind == "keyframes":
        return _Script(config, host)
    still = np.zeros(shape, np.float32)
    return lambda seen: still


class _Script:
    """Actor that holds the actions of each keyframe until the next one."""

    def __init__(self, config: ActorConfig, host: EpisodeHost) -> None:
        self.dt, self.step = host.config.physics.control_dt, 0
        self.times = [frame.time for frame in config.keyframes]
        self.actions = np.zeros((len(self.times) + 1, host.num_envs, host.num_agents, host.action_size), np.float32)
        for index, frame in enumerate(config.keyframes):
            for name, value in frame.actions.items():
                if name not in host.action_names:
                    raise ConfigError(
                        f"actor.keyframes.{index}.actions.{name} is not a component of the action; there are "
                        f"{', '.join(host.action_names)}"
                    )
                self.actions[index + 1, :, :, host.action_names.index(name)] = value

    def begin(self, num_envs: int) -> None:
        """Begin anew."""
        self.step = 0

    def __call__(self, seen: Seen) -> np.ndarray:
        """Return the actions of the next step."""
        now = np.searchsorted(self.times, self.step * self.dt + 1e-9, side="right")
        self.step += 1
        return self.actions[now]


def _trained(config: ActorConfig, host: EpisodeHost) -> Actor:
    """Load the policy of a training run for a batch.

    Raises:
        ConfigError: it was trained for other actions or observations.
    """
    from agents.play import open_run  # needs the extra train

    run = open_run(config.run, host.device)
    task_class = load_task(run.env_id)
    trained = task_class(load_config(task_class.Config, run.env))
    if task_class is not type(host.task):
        raise ConfigError(f"actor.run={config.run} was trained in {run.env_id}; set env_id to it, or take another run")
    if unlike := changed(trained, host.task, run.observe):
        raise ConfigError(f"actor.run={config.run} was trained for other {', '.join(unlike)} than those of env")
    return run.make_agent(host.layout, host.action_size)
