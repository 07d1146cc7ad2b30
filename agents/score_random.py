"""Scores of random actions, of several seeds: ``python -m agents.score_random RUN --out FOLDER``.

Plays the environment of a run, which is any folder with the ``results.json`` of a training run or of
``agents.pid.score``. Every seed is a stream of actions of its own, in the episodes that all agents are evaluated in,
and counts as a training run does: intervals are over seeds. ``agents.scores`` puts this row in the place of those of
single streams, in all runs of these settings.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import tyro

from agents.command import one_line_errors, read_options
from agents.config import MOST_RUNS, EvaluationSettings, check_imports, first_training_seed
from agents.evaluate import for_all_seats, over_seeds, play, random_agent
from agents.files import RESULTS, claim, plain, read_json, write_json
from agents.report import versions
from piavatar_envs.api.host import EpisodeHost
from piavatar_envs.config import ConfigError, load_config, parse_assignments
from piavatar_envs.doctor import quiet_warp
from piavatar_envs.tasks import load_task


@dataclass(frozen=True)
class Options:
    """Score random actions in the environment of a run with one avatar."""

    #: folder of the run
    run: tyro.conf.Positional[Path]
    #: settings of the environment that override the run's: fidelity=tiny
    settings: tyro.conf.Positional[tuple[str, ...]] = ()
    #: streams of random actions
    seeds: int = 5
    #: how many episodes each, and from which seed on
    evaluation: EvaluationSettings = field(default_factory=EvaluationSettings)
    #: module of a task of your own, which the run may import
    imports: tuple[str, ...] = ()
    #: folder to write to; by default runs/random_ and the name of the run
    out: Path | None = None
    #: where to simulate
    device: str = "cpu"


def score(batch: EpisodeHost, first_seed: int, count: int) -> dict[str, Any]:
    """Evaluate ``count`` streams of random actions as one row.

    Args:
        batch: plays an episode in each of its environments.
        first_seed: of the episodes, the same for all streams.
        count: of streams; the seed of each is the one with which a training run of that place would begin.
    """
    streams = [random_agent(batch.action_size, first_training_seed(stream)) for stream in range(count)]
    return over_seeds([play("random", for_all_seats(stream), batch, first_seed).row() for stream in streams])


def check_streams(count: int) -> None:
    """Refuse a number of streams that is out of range.

    Raises:
        ConfigError: a count that has no interval, or is larger than that of the seeds that training runs can have.
    """
    if not 2 <= count <= MOST_RUNS:
        raise ConfigError(f"seeds={count} must be >= 2 and <= {MOST_RUNS}: of one there is no interval")


def main(args: list[str] | None = None) -> None:
    """Run the command line."""
    options = read_options(Options, "score_random", args)
    quiet_warp()
    folder = options.out or Path("runs") / f"random_{options.run.resolve().name}"
    with one_line_errors(ValueError, OSError):
        check_streams(options.seeds)
        claim(folder, "score_random")
        env_id, env = environment_of(options.run)
        check_imports(env_id, options.run / RESULTS, options.imports)
        task_class = load_task(env_id)
        config = load_config(task_class.Config, dict(env), parse_assignments(options.settings))
        batch = EpisodeHost(task_class(config), options.evaluation.episodes, options.device)
    row = score(batch, options.evaluation.first_seed, options.seeds)
    batch.close()
    row["first_seed"] = options.evaluation.first_seed
    settings = {"env_id": env_id, "env": config.model_dump(mode="json")}
    about = versions("score_random", options.device) | {"seed": 0, "config": settings}
    with one_line_errors(OSError):
        write_json(folder / RESULTS, plain({**about, "results": [row]}, "results"))
    low, high = row["return_interval"]
    print(f"random, {options.seeds} seeds: {row['return_mean']:.1f} ({low:.1f} to {high:.1f})")
    print(f"in {folder}: results.json")


def environment_of(folder: Path) -> tuple[str, Mapping[str, Any]]:
    """Return id and settings of a run's environment.

    Raises:
        ConfigError: the folder's file is not that of a run.
        OSError: the folder has no ``results.json``.
    """
    path = folder / RESULTS
    run = read_json(path)
    config = run.get("config", {}) if isinstance(run, dict) else {}
    if not {"env_id", "env"} <= set(config):
        raise ConfigError(
            f"{path} has no config.env_id and config.env; give the folder of a training run or of score_pid"
        )
    return config["env_id"], config["env"]


if __name__ == "__main__":
    main()
