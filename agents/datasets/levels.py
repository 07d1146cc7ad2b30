"""Levels of play: which agent stands behind the expert, medium and random dataset of a task."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

import numpy as np

from agents.evaluate import Agent, Seen, for_all_seats, random_agent
from agents.files import ROOT
from agents.play import Run, environment, open_run
from agents.reach_ik import ReachIK
from piavatar_envs.api.host import EpisodeHost
from piavatar_envs.config import ConfigError, load_config, parse_assignments
from piavatar_envs.envs.task import Task
from piavatar_envs.tasks import load_task

#: Names of the levels, the best first.
LEVELS = ("expert", "medium", "random")
RESULTS = ROOT / "benchmarks" / "results"


@dataclass(frozen=True)
class Player:
    """Source of the actions of a level.

    Attributes:
        run: folder of a committed run below ``benchmarks/results``; None for scripted inverse kinematics.
        noise: standard deviation of Gaussian noise on every component of an action, before it is clipped.
    """

    run: str | None
    noise: float = 0.0

    def describe(self) -> str:
        """Return its name, as datasets and tables have it."""
        source = "scripted inverse kinematics" if self.run is None else f"policy {self.run}"
        return source + (f" with Gaussian noise of {self.noise:g} on its actions" if self.noise else "")


#: Players of the tasks that have datasets. Medium is a weaker committed policy, or the expert with noise.
PLAYERS: Mapping[str, Mapping[str, Player]] = MappingProxyType(
    {
        "PIAvatar/Reach-v0": {"expert": Player(None), "medium": Player(None, noise=2.5)},
        "PIAvatar/Stand-v0": {"expert": Player("ppo/stand_0"), "medium": Player("ppo/stand_0", noise=0.4)},
        "PIAvatar/Walk-v0": {"expert": Player("ppo/walk_0"), "medium": Player("ppo/sb3_walk_3")},
        "PIAvatar/KickBall-v0": {"expert": Player("kick_ball"), "medium": Player("kick_ball", noise=0.8)},
    }
)


@dataclass(frozen=True)
class Source:
    """Environment and agent of a dataset.

    Attributes:
        task: with the settings of the episodes.
        name: of the agent.
        make: the agent, from the environments that it plays in.
    """

    task: Task
    name: str
    make: Callable[[EpisodeHost], Agent]


def open_source(
    env_id: str, level: str, settings: Sequence[str] = (), run: Path | None = None, noise: float | None = None
) -> Source:
    """Open the source of a dataset.

    Args:
        env_id: registered id.
        level: of :data:`LEVELS`.
        settings: assignments that override those of the expert's environment, as ``fidelity=tiny``.
        run: folder of another training run whose policy plays instead.
        noise: standard deviation of the noise on its actions, instead of the level's.

    Raises:
        ConfigError: no such level, no player of that task, a policy of another environment, or a noise below zero.
        ValueError: no such task.
    """
    if level not in LEVELS:
        raise ConfigError(f"level={level!r} must be one of {', '.join(LEVELS)}")
    if noise is not None and not 0.0 <= noise <= 10.0:
        raise ConfigError(f"noise={noise:g} must be >= 0 and <= 10, in units of the action space")
    load_task(env_id)
    known = PLAYERS.get(env_id)
    if run is None and known is None:
        raise ConfigError(f"{env_id} has no committed expert; name a training run of your own with --run FOLDER")
    reference = run or _folder(known["expert"])
    task = _task(env_id, reference, settings)
    if level == "random":
        return Source(task, "uniformly random actions", lambda host: for_all_seats(random_agent(host.action_size, 0)))
    player = Player(str(run.resolve())) if run else known[level]
    if noise is not None:
        player = Player(player.run, noise)
    return Source(task, player.describe(), lambda host: _noisy(_agent(player, host), player.noise))


def _folder(player: Player) -> Path | None:
    return None if player.run is None else RESULTS / player.run


def _task(env_id: str, folder: Path | None, settings: Sequence[str]) -> Task:
    """Build the task in which a run's policy plays; in its default settings without a run."""
    if folder is None:
        task_class = load_task(env_id)
        return task_class(load_config(task_class.Config, {}, parse_assignments(settings)))
    opened = open_run(folder)
    _check_task(opened, env_id, folder)
    return environment(opened, settings)


def _check_task(run: Run, env_id: str, folder: Path) -> None:
    if run.env_id != env_id:
        raise ConfigError(f"{folder} is of {run.env_id}, not of {env_id}")


def _agent(player: Player, host: EpisodeHost) -> Agent:
    """Build the agent of a player for the environments of ``host``."""
    if player.run is None:
        config = host.config
        step = config.control.joint_speed_limit * config.physics.control_dt
        return for_all_seats(ReachIK(host.layout, host.action_names, step, config.physics.control_dt))
    return open_run(RESULTS / player.run).make_agent(host.layout, host.action_size)


def _noisy(agent: Agent, noise: float, seed: int = 0) -> Agent:
    """Add Gaussian noise to the actions of an agent."""
    if not noise:
        return agent
    rng = np.random.default_rng(seed)

    def act(observation: Seen) -> np.ndarray:
        action = agent(observation)
        return action + rng.normal(0.0, noise, action.shape).astype(np.float32)

    return act
