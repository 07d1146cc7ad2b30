"""PPO on Reach with the steps of ``make demo``, over several seeds, beside agents that do not learn.

``python -m benchmarks.learning.reach_ppo --seeds 3 --out benchmarks/results/reach_demo.json``. Every seed trains its
own policy; the episodes that are evaluated are the same for all seeds and agents. The last row is the mean over the
policies.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from agents.demo import CONFIG, play_references
from agents.evaluate import Evaluation, evaluate, separated
from agents.intervals import mean_and_interval
from agents.report import draw_curve
from agents.sb3.config import TrainingConfig, load_training
from agents.sb3.policy import policy_agent
from agents.sb3.train import Curve, train
from agents.sb3.workers import factory, prepare, start_workers
from benchmarks import runner
from piavatar_envs.config import parse_assignments

_BINS = 18  # points of a learning curve in the JSON


@dataclass(frozen=True)
class Options(runner.Options):
    """Options of the Reach benchmark."""

    #: policies to train, from seeds 0, 1, ...
    seeds: int = 3
    #: folder for the policies and learning curves
    folder: Path = Path("runs/reach_ppo")
    #: settings that override configs/sb3/reach_ppo.yaml, such as total_steps=1000
    settings: tuple[str, ...] = ()


def cases(options: Options) -> Iterator[dict[str, Any]]:
    """Yield a row for every agent that does not learn, for every seed's policy, and for their mean."""
    config = load_training(CONFIG, parse_assignments(options.settings))
    make = factory(config, options.device)
    facts = prepare(make)
    venv = start_workers(make, config.num_workers)
    try:
        references = play_references(config, venv, facts)
        yield from (evaluation.row() for evaluation in references)
        returns = []
        for seed in range(options.seeds):
            folder = options.folder / f"seed_{seed}"
            folder.mkdir(parents=True, exist_ok=True)
            chosen = config.model_copy(update={"seed": seed})
            model, curve = train(chosen, venv, facts, folder)
            settings = config.evaluation
            name = f"PPO seed {seed}"
            trained = evaluate(name, policy_agent(model), venv, settings.episodes, settings.first_seed)
            estimates = {each.agent: each.estimate() for each in (*references, trained)}
            draw_curve(folder / "curve.png", curve.steps, curve.returns, estimates, f"{config.env_id}, seed {seed}")
            returns.append(float(trained.returns.mean()))
            yield _row(trained, references, curve, chosen)
        if len(returns) > 1:
            yield _over_seeds(returns)
    finally:
        venv.close()


def _row(trained: Evaluation, references: Sequence[Evaluation], curve: Curve, config: TrainingConfig) -> dict[str, Any]:
    """Return the row of one policy: its evaluation, and the cost of its training."""
    parts = [part for part in np.array_split(np.arange(len(curve.steps)), _BINS) if part.size]
    return {
        **trained.row(),
        "above_zero_and_random": separated(trained, references[:2]),
        "seed": config.seed,
        "train_steps": config.total_steps,
        "train_s": curve.seconds,
        "train_steps_per_s": config.total_steps / curve.seconds,
        "curve_steps": [curve.steps[part[-1]] for part in parts],
        "curve_returns": [float(np.mean(np.take(curve.returns, part))) for part in parts],
    }


def _over_seeds(returns: Sequence[float]) -> dict[str, Any]:
    """Return the mean of the policies' mean returns, and its interval over seeds."""
    estimate = mean_and_interval(returns)
    return {
        "case": "PPO over seeds",
        "return_mean": estimate.mean,
        "return_interval": [estimate.low, estimate.high],
        "return_std": float(np.std(returns, ddof=1)),
        "seeds": len(returns),
    }


if __name__ == "__main__":
    runner.main("reach_ppo", cases, Options)
