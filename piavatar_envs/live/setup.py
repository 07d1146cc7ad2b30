"""Description of what is watched, from which the environments are built: id, settings, number, seed and agent."""

from __future__ import annotations

import importlib
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

import gymnasium
import numpy as np

from piavatar_envs.api.host import EpisodeHost, limited
from piavatar_envs.config import EnvConfig, PropConfig, load_keywords, replace
from piavatar_envs.config.load import plain
from piavatar_envs.envs.batch_env import check_count
from piavatar_envs.envs.task import Task
from piavatar_envs.multi import load_game
from piavatar_envs.render.panel import BALL_MASS, BALL_SPEED
from piavatar_envs.sim.scene import Domain
from piavatar_envs.tasks import listed_name, load_registered, task_modules

#: Name of the ball that viewers throw.
BALL = "thrown_ball"
#: Its radius, and the distance of its first place from two walls [m].
BALL_RADIUS, _CORNER = 0.11, 0.25


@dataclass(frozen=True)
class Setup:
    """Environments, and the agent that plays them.

    Attributes:
        env_id: a registered id, or a game of several agents such as ``sumo_v0``.
        settings: of the environment's configuration.
        agent: name of the agent.
        num_envs: number of environments.
        seed: of the first environment's first episode; the others count up from there.
        device: Warp device.
        ball: whether there is a ball to throw, which no agent observes.
    """

    env_id: str
    settings: Mapping[str, Any] = field(default_factory=dict)
    agent: str = "random"
    num_envs: int = 1
    seed: int = 0
    device: str = "cpu"
    ball: bool = False

    def task(self) -> Task:
        """Return the task with its settings.

        Raises:
            ConfigError: a setting is unknown or out of range.
            ImportError: a module is not there.
            ValueError: there is no such environment.
        """
        name = listed_name(self.env_id)
        if "/" in name:
            kind, config = self._single(name)
        else:
            kind = load_game(name, task_modules()).TASK
            config = load_keywords(kind.Config, None, self.settings)
        return _with_ball(kind, config) if self.ball else kind(config)

    def _single(self, name: str) -> tuple[type[Task], EnvConfig]:
        """Return the task of a registered id, and its settings over those that it is registered with."""
        module, _, own = name.rpartition(":")
        if module:
            importlib.import_module(module)
        if own not in gymnasium.registry:
            raise ValueError(f"no environment {self.env_id!r} is registered")
        spec = gymnasium.registry[own]
        given = dict(spec.kwargs)
        kind = load_registered(given.pop("task"), given.pop("registered", None))
        config, steps = given.pop("config", None), given.pop("max_episode_steps", spec.max_episode_steps)
        settings = dict(self.settings)
        # settings of a training run are whole configurations
        config = settings.pop("config", config)
        loaded = load_keywords(kind.Config, config, given | settings)
        return kind, limited(loaded, "max_episode_steps", steps)

    def make(self) -> EpisodeHost:
        """Build the environments.

        Raises:
            ConfigError: a setting is unknown or out of range.
            ImportError: a module or an extra is not installed.
            ValueError: there is no such environment or device, or too many do not fit.
        """
        check_count("num_envs", self.num_envs)
        host = EpisodeHost(self.task(), self.num_envs, self.device)
        for group in host.groups:
            _ = group.tuning  # it reads the moduli of the beginning
        return host

    def plain(self) -> dict[str, Any]:
        """Return everything as JSON holds it."""
        return plain(asdict(self))


def _with_ball(kind: type[Task], config: EnvConfig) -> Task:
    """Return a task whose scene has a ball in a corner, which its agents do not observe."""

    class Watched(kind):
        __doc__ = kind.__doc__

        def observed_props(self) -> tuple[str, ...]:
            return tuple(name for name in super().observed_props() if name != BALL)

    task = kind(config)
    domain = task.domain() or Domain().around([avatar.position for avatar in task.scene.avatars])
    x, y, _ = np.subtract(domain.upper, _CORNER + BALL_RADIUS)
    ball = PropConfig(
        name=BALL,
        size=(BALL_RADIUS,),
        mass=BALL_MASS[2],
        position=(float(x), float(y), BALL_RADIUS),
        # a lob starts faster than it flies
        top_speed=math.sqrt(2.0) * BALL_SPEED[1],
    )
    return Watched(replace(config, {"scene.props": [*config.scene.props, ball]}))
