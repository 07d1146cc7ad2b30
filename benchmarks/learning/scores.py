"""Scores of every environment: zero actions, random actions and a briefly trained policy, on the same episodes.

``python -m benchmarks.learning.scores --out FILE.json`` plays all registered ids and all modules of several agents.
The policy is PPO's after ``train_steps`` control steps (of all agents together), with one setting for all
environments: it shows that a task can be learned at all, not how well. Returns are means over episodes with 95 %
intervals, in games the mean over the agents.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from agents.evaluate import Agent, Evaluation, evaluate, random_agent, zero_agent
from agents.sb3.config import TrainingConfig, load_training
from agents.sb3.matches import seated
from agents.sb3.parallel import AgentVecEnv
from agents.sb3.policy import policy_agent
from agents.sb3.train import train
from agents.sb3.workers import factory, prepare, start_workers
from benchmarks import runner
from piavatar_envs.multi import listed_games
from piavatar_envs.tasks import task_modules

#: One setting for all: short episodes and dense rewards want a short horizon.
GENERIC = {
    "ppo": {"rollout_steps": 512, "batch_size": 256, "discount": 0.95, "gae_lambda": 0.9, "log_std": -0.7},
}


@dataclass(frozen=True)
class Options(runner.Options):
    """Scores of all environments."""

    #: ids and modules; all if not given
    ids: tuple[str, ...] = ()
    #: agents that play: zero, random, trained
    agents: tuple[Literal["zero", "random", "trained"], ...] = ("zero", "random", "trained")
    #: episodes an agent plays
    episodes: int = 20
    #: control steps that PPO may learn for; 0 for no trained agent
    train_steps: int = 0
    #: environments side by side
    workers: int = 2
    #: settings of all environments, for smoke runs
    fidelity: str = "coarse"


def every_environment() -> list[str]:
    """Return the registered ids, then the modules of several agents."""
    return [*task_modules(), *listed_games()]


def training_config(env_id: str, options: Options) -> TrainingConfig:
    """Return the training configuration of an environment, with the generic settings."""
    changes = {
        "total_steps": max(1, options.train_steps),
        "num_workers": options.workers,
        "env.fidelity": options.fidelity,
        "evaluation.episodes": options.episodes,
    }
    return load_training({"env_id": env_id, **GENERIC}, changes)


def row(env_id: str, evaluation: Evaluation, trained_for: int | None = None) -> dict[str, Any]:
    """Return one row of the results."""
    figures = {key: value for key, value in evaluation.row().items() if key != "case"}
    return {"case": env_id, "agent": evaluation.agent, "trained_for_steps": trained_for, **figures}


def score(env_id: str, options: Options) -> Iterator[dict[str, Any]]:
    """Yield the rows of one environment."""
    config = training_config(env_id, options)
    make = factory(config, options.device)
    facts = prepare(make)
    workers = start_workers(make, config.num_workers)
    size, protocol = len(facts.action_names), config.evaluation
    try:
        for name, agent in (("zero", zero_agent(size)), ("random", random_agent(size, seed=0))):
            if name not in options.agents:
                continue
            agent = _in_every_seat(agent, len(facts.agents))
            yield row(env_id, evaluate(name, agent, workers, protocol.episodes, protocol.first_seed))
        if options.train_steps > 0 and "trained" in options.agents:
            venv = AgentVecEnv(workers) if config.is_multi else workers
            with tempfile.TemporaryDirectory() as folder:
                model, curve = train(config, venv, facts, Path(folder))
            agent = _in_every_seat(policy_agent(model), len(facts.agents))
            trained = evaluate("trained", agent, workers, protocol.episodes, protocol.first_seed)
            yield row(env_id, trained, config.total_steps) | {"training_s": curve.seconds}
    finally:
        workers.close()


def _in_every_seat(agent: Agent, agents: int) -> Agent:
    """Return the agent for all seats of a world, or the agent itself for a single one."""
    return seated([agent] * agents) if agents else agent


def cases(options: Options) -> Iterator[dict[str, Any]]:
    """Yield the rows of all environments."""
    for env_id in options.ids or every_environment():
        yield from score(env_id, options)


if __name__ == "__main__":
    runner.main("scores", cases, Options)
