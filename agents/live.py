"""Agents for the live view, ``python -m piavatar_envs watch ID --agent NAME``: the PID agent and trained policies.

Policies and their libraries are imported with the first that is opened, so that the view starts quickly.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from piavatar_envs.api.host import EpisodeHost
from piavatar_envs.config import ConfigError
from piavatar_envs.live.agents import AgentKind
from piavatar_envs.tasks import load_task

if TYPE_CHECKING:
    from agents.play import Run


class Balancing:
    """PID agents, one for each body."""

    def __init__(self, host: EpisodeHost) -> None:
        from agents.pid.agent import PIDAgent

        batch = host.groups[0]
        self._host = host
        self._agents = [[PIDAgent(batch) for _ in range(host.num_agents)] for _ in range(host.num_envs)]

    def begin(self, mask: np.ndarray) -> None:
        """Clear the integrals of the masked environments."""
        for env in np.flatnonzero(mask):
            for agent in self._agents[env]:
                agent.begin(1)

    def act(self, step: int) -> np.ndarray:
        """Return torques of all bodies."""
        seen = self._host.observation()
        pairs = [zip(agents, rows, strict=True) for agents, rows in zip(self._agents, seen, strict=True)]
        return np.array([[agent(row[None])[0] for agent, row in own] for own in pairs], np.float32)


class Policy:
    """A trained policy; one with a memory has a copy for each environment."""

    def __init__(self, run: Run, host: EpisodeHost) -> None:
        first = run.make_agent(host.layout, host.action_size)
        copies = host.num_envs if hasattr(first, "begin") else 1
        more = [run.make_agent(host.layout, host.action_size) for _ in range(copies - 1)]
        self._host, self._agents = host, [first, *more]

    def begin(self, mask: np.ndarray) -> None:
        """Clear the memories of the masked environments."""
        from agents.evaluate import begin_round

        for env in np.flatnonzero(mask):
            begin_round(self._agents[env % len(self._agents)], 1)

    def act(self, step: int) -> np.ndarray:
        """Return the actions of the policy for the present observations."""
        from agents.evaluate import each_array, seen_by

        seen = seen_by(self._host)
        if len(self._agents) == 1:
            return self._agents[0](seen)

        def row(env: int, agent: Any) -> np.ndarray:
            return agent(each_array(lambda own: own[env : env + 1], seen))

        return np.concatenate([row(env, agent) for env, agent in enumerate(self._agents)])


def policy_kind(run: Run) -> AgentKind:
    """Return the agent of a training run, with the settings that it was trained under."""
    return AgentKind(lambda host, _seed: Policy(run, host), {"config": run.env})


def live_agents(env_id: str, name: str = "") -> dict[str, AgentKind]:
    """Return the agents of this package for an environment, by name.

    Args:
        env_id: of the environment.
        name: the folder of a training run that is to be among them, if it is one.

    Raises:
        ConfigError: the training is of another environment.
    """
    kinds = {"pid": AgentKind(lambda host, _seed: Balancing(host), controls=("torque",))}
    if name and Path(name).is_dir():
        from agents.play import open_run

        run = open_run(Path(name))
        if load_task(run.env_id) is not load_task(env_id):
            raise ConfigError(f"{name} was trained for {run.env_id}; watch that one, or choose another agent")
        kinds[name] = policy_kind(run)
    return kinds
