"""Baselines of a dataset: ``python -m agents.datasets.baselines runs/datasets piavatar/walk/medium-v0``.

Behaviour cloning and implicit Q-learning learn from the dataset alone, and play the same fresh episodes as random
actions, the agent that was recorded, and the expert. A normalized score is 0 for the return of random actions and 100
for the expert's (Fu et al., "D4RL: datasets for deep data-driven reinforcement learning", 2020).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import tyro
from rich.console import Console

from agents.checkpoint import Diverged
from agents.command import one_line_errors
from agents.config import EvaluationSettings
from agents.datasets.levels import LEVELS, PLAYERS, open_source
from agents.datasets.record import datasets_in, import_minari
from agents.evaluate import Evaluation, play
from agents.files import check_figures
from agents.report import show_table, versions, write_results
from piavatar_envs.api.host import EpisodeHost
from piavatar_envs.cli import print_any_text
from piavatar_envs.config import ConfigError, load_config
from piavatar_envs.core.extras import missing
from piavatar_envs.core.writing import check_writable
from piavatar_envs.doctor import package_version, quiet_warp
from piavatar_envs.tasks import load_task


@dataclass(frozen=True)
class Options:
    """Learn policies from a dataset and score them against its expert."""

    #: folder of the datasets
    folder: tyro.conf.Positional[Path]
    #: name of the dataset, as piavatar/walk/medium-v0
    dataset: tyro.conf.Positional[str]
    #: learners: bc for behaviour cloning, iql for implicit Q-learning
    learners: tuple[str, ...] = ("bc", "iql")
    #: gradient steps of each
    updates: int = 10_000
    #: of networks and batches
    seed: int = 0
    #: how many episodes every agent plays, and from which seed on
    evaluation: EvaluationSettings = field(default_factory=EvaluationSettings)
    #: JSON file for the figures
    out: Path | None = None
    #: where to simulate
    device: str = "cpu"
    #: where to learn, by default where to simulate: small networks learn as fast on a CPU
    learn_device: Literal["cpu", "cuda"] | None = None


def open_dataset(folder: Path, name: str) -> Any:
    """Open a dataset.

    Raises:
        ConfigError: there is no such dataset, or it is not of a single environment with flat observations.
        ImportError: Minari is not installed.
    """
    minari = import_minari()
    with datasets_in(folder):
        try:
            dataset = minari.load_dataset(name)
        except (FileNotFoundError, ValueError) as error:
            files = folder.glob("**/data/metadata.json")
            known = ", ".join(sorted(str(path.parents[1].relative_to(folder)) for path in files)) or "none"
            raise ConfigError(f"{folder} has no dataset {name!r} ({error}); it has {known}") from None
    if dataset.env_spec is None or dataset.observation_space.shape is None:
        raise ConfigError(
            f"{name} has no environment with flat observations; record one with python -m agents.datasets"
        )
    return dataset


def score(dataset: Any, level: str, agents: dict[str, Any], options: Options) -> list[Evaluation]:
    """Play random actions, the level, the expert and the learners in the same episodes.

    Args:
        dataset: its environment is played.
        level: that was recorded, or None if it is not one of :data:`agents.datasets.levels.LEVELS`.
        agents: learned ones by name.
        options: of the command line.
    """
    env_id = dataset.env_spec.id
    task_class = load_task(env_id)
    task = task_class(load_config(task_class.Config, dataset.env_spec.kwargs.get("config", {})))
    host = EpisodeHost(task, options.evaluation.episodes, options.device)
    names = list(dict.fromkeys(["random", level, "expert"])) if env_id in PLAYERS else []
    players = {name: open_source(env_id, name).make(host) for name in names}
    found = [play(name, agent, host, options.evaluation.first_seed) for name, agent in (players | agents).items()]
    host.close()
    return found


def normalized(evaluations: list[Evaluation]) -> dict[str, float]:
    """Return the mean return of every agent, 0 for random actions and 100 for the expert."""
    means = {evaluation.agent: evaluation.estimate().mean for evaluation in evaluations}
    if not {"random", "expert"} <= means.keys():
        return {}
    span = means["expert"] - means["random"]
    return {name: 100.0 * (mean - means["random"]) / span for name, mean in means.items()}


def main(args: list[str] | None = None) -> None:
    """Run the command line."""
    print_any_text()
    options = tyro.cli(Options, prog="python -m agents.datasets.baselines", args=args)
    quiet_warp()
    with one_line_errors(ValueError, ImportError, OSError, Diverged):
        if options.updates < 1:
            raise ConfigError(f"updates={options.updates} must be >= 1")
        if options.out:
            check_figures(options.out, "datasets.baselines")
            check_writable(options.out)
        dataset = open_dataset(options.folder, options.dataset)
        try:
            import torchrl  # noqa: F401 - which the learners import

            from agents.datasets.learners import LEARNERS, learn, transitions
        except ImportError as error:
            raise missing("learning from a dataset", "torchrl", "datasets") from error
        if unknown := set(options.learners) - LEARNERS.keys():
            raise ConfigError(f"learners={sorted(unknown)} must be some of {', '.join(LEARNERS)}")
        data = transitions(dataset)
        where = options.learn_device or options.device
        learned = {name: learn(name, data, options.updates, options.seed, where) for name in options.learners}
        word = options.dataset.rpartition("/")[2].rpartition("-v")[0]
        level = word if word in LEVELS else "expert"
        evaluations = score(dataset, level, learned, options)
    show_table(evaluations, Console(highlight=False, soft_wrap=True))
    scores = normalized(evaluations)
    print("normalized: " + ", ".join(f"{name} {value:.0f}" for name, value in scores.items()))
    if options.out:
        about = versions("datasets.baselines", options.device) | {
            "dataset": options.dataset,
            "behaviour": dataset.storage.metadata.get("algorithm_name"),
            "dataset_episodes": int(dataset.total_episodes),
            "dataset_steps": int(dataset.total_steps),
            "updates": options.updates,
            "seed": options.seed,
            "libraries": {name: package_version(name) for name in ("minari", "torchrl", "tensordict")},
        }
        with one_line_errors(OSError):
            write_results(options.out, about, evaluations, {"normalized": scores})


if __name__ == "__main__":
    main()
