"""Environments that have a page: the registered Gymnasium ids and the games; and the facts on a page.

Sizes, names and the keys of ``info`` come from an environment that is built and stepped once, so that a page agrees
with the code. The resolution does not matter for them; pages state the default settings.
"""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np

import piavatar_envs  # noqa: F401 - registers the ids
from piavatar_envs.config import EnvConfig
from piavatar_envs.envs.actions import ActionSpec
from piavatar_envs.envs.observations import ObservationLayout
from piavatar_envs.envs.task import Task
from piavatar_envs.multi import load_game
from piavatar_envs.tasks import load_task, task_modules
from piavatar_envs.tasks.games import game_modules

ROOT = Path(__file__).resolve().parents[2]
MULTI = "piavatar_envs.multi"


@dataclass(frozen=True)
class Entry:
    """An environment that users make.

    Attributes:
        name: of its page and its picture.
        title: the Gymnasium id, or the dotted name of the PettingZoo module.
        task: its task class.
        multi: whether it is a PettingZoo environment.
    """

    name: str
    title: str
    task: type[Task]
    multi: bool = False

    @property
    def source(self) -> Path:
        """File of the task class, from the root of the checkout."""
        return Path(inspect.getfile(self.task)).resolve().relative_to(ROOT)

    def make(self, **settings: Any) -> Any:
        """Build the environment: a ``gymnasium.Env`` without wrappers, or a ``pettingzoo.ParallelEnv``."""
        if self.multi:
            return load_game(self.name).parallel_env(**settings)
        return gymnasium.make(self.title, **settings).unwrapped


@dataclass(frozen=True)
class Facts:
    """Facts on the page of an environment.

    Attributes:
        task: the task at its default settings.
        layout: of the flat observation.
        agents: names of the agents; empty for a Gymnasium environment.
        info: an agent's, after a step.
    """

    task: Task
    layout: ObservationLayout
    agents: tuple[str, ...]
    info: Mapping[str, Any]

    @property
    def config(self) -> EnvConfig:
        """The default settings."""
        return self.task.config

    @property
    def actions(self) -> ActionSpec:
        """The action at the default settings."""
        return self.task.action_spec().under(self.config.control.mode)


def single_entries() -> list[Entry]:
    """Return one for each registered Gymnasium id."""
    return [Entry(name, env_id, load_task(env_id)) for env_id, name in task_modules().items()]


def multi_entries() -> list[Entry]:
    """Return one for each game of this package."""
    return [Entry(name, f"{MULTI}.{name}", load_game(name).TASK, True) for name in game_modules()]


def entries() -> list[Entry]:
    """Return everything that has a page."""
    return single_entries() + multi_entries()


def gather(entry: Entry, env: Any) -> Facts:
    """Reset and step an environment of ``entry``, at any resolution, and return its facts."""
    env.reset(seed=0)
    _, _, _, _, info = step(env, np.zeros(env.batch.action_spec.size, np.float32))
    agents = tuple(env.possible_agents) if entry.multi else ()
    if agents:
        info = info[agents[0]]
    return Facts(entry.task(entry.task.Config()), env.batch.layout, agents, info)


def step(env: Any, action: np.ndarray) -> tuple:
    """Step either kind of environment; every agent takes the same action."""
    if isinstance(env, gymnasium.Env):
        return env.step(action)
    return env.step({agent: action for agent in env.agents})
