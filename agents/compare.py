"""Sum up runs that differ in their seed: ``python -m agents.compare runs/reach_*/results.json --out FILE.json``.

The runs are of ``agents.sb3.train``, ``agents.rsl_rl.train`` or ``agents.skrl.train``, each with a seed of its own.
What no seed of a training run changes (zero and random actions) is shown once, with its interval over episodes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro
from rich.console import Console
from rich.table import Table

from agents.checkpoint import differences
from agents.command import one_line_errors
from agents.evaluate import over_seeds
from agents.files import check_figures, plain, read_json, write_json
from piavatar_envs.cli import print_any_text

#: Settings that may differ: nothing that is learned depends on how often a training run is saved.
FREE = ("seed", "checkpoint_every")
#: Agents that are not trained: every run has played the same episodes with the same actions.
UNTRAINED = ("zero", "random")


def read_run(path: Path) -> dict[str, Any]:
    """Read the ``results.json`` of a run.

    Raises:
        OSError: there is no such file.
        ValueError: the file is something else.
    """
    run = read_json(path)
    needed = ("benchmark", "config", "seed", "results", "commit", "device", "versions")
    missing = [name for name in needed if not (isinstance(run, dict) and name in run)]
    if missing:
        raise ValueError(
            f"{path} has no {missing[0]!r}; give runs of agents.sb3.train, agents.rsl_rl.train or agents.pid.score"
        )
    return run


def summarize(runs: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """Summarise several runs in one report.

    Args:
        runs: contents of their ``results.json``, by name.

    Returns:
        What is common to the runs, their ``seeds``, and a row for every agent in ``results``.

    Raises:
        ValueError: fewer than two runs, two of the same seed, other settings than :data:`FREE`, or competing agents.
    """
    if len(runs) < 2:
        raise ValueError(f"there are {len(runs)} runs; give at least two, of different seeds")
    (first_name, first), *others = runs.items()
    settings = _settings(first)
    for name, run in others:
        for key, here, there in differences(settings, _settings(run)):
            raise ValueError(f"{name} has {key}={there}, {first_name} has {here}; only seeds may differ")
    seeds = [run["seed"] for run in runs.values()]
    if len(set(seeds)) < len(seeds):
        raise ValueError(f"the runs have the seeds {seeds}; each must have one of its own")
    rows = [_row([run["results"][place] for run in runs.values()]) for place in range(len(first["results"]))]
    config = {key: value for key, value in first["config"].items() if key not in FREE}
    commits = sorted({str(run["commit"]) for run in runs.values()})
    about = {"benchmark": "compare", "of": first["benchmark"], "commits": commits, "device": first["device"]}
    return about | {"versions": first["versions"], "seeds": seeds, "config": config, "results": rows}


def _settings(run: Mapping[str, Any]) -> dict[str, Any]:
    """Return the settings that all runs must share."""
    config = {key: run["config"][key] for key in run["config"] if key not in FREE}
    return {"script": run["benchmark"], **config}


def _row(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    if "success_once" not in rows[0]:
        raise ValueError(f"{rows[0]['case']!r} is a match of competing agents; compare the runs' tables instead")
    if rows[0]["case"] in UNTRAINED:  # what differs is round-off, of other devices or commits: no sample of anything
        return {**rows[0], "seeds": None}
    return over_seeds(rows)


def show(report: Mapping[str, Any], console: Console) -> None:
    """Print a table of the agents."""
    title = f"{report['config']['env_id']}, trained with {len(report['seeds'])} seeds; mean and 95 % interval over them"
    table = Table(title=title, title_justify="left", caption_justify="left")
    table.caption = "once, at end: task fulfilled in an episode, in its last step"
    table.add_column("agent", no_wrap=True)
    for column in ("return", "once", "at end", "steps"):
        table.add_column(column, justify="right", no_wrap=True)
    for row in report["results"]:
        table.add_row(
            row["case"],
            _shown(row["return_mean"], row["return_interval"], ".1f"),
            _shown(row["success_once"], row["success_once_interval"], ".0%"),
            _shown(row["success_at_end"], row["success_at_end_interval"], ".0%"),
            _shown(row["mean_steps"], row["steps_interval"], ".0f"),
        )
    console.print(table)


def _shown(mean: float, interval: Sequence[float], form: str) -> str:
    return f"{mean:{form}} ({interval[0]:{form}} to {interval[1]:{form}})"


@dataclass(frozen=True)
class Options:
    """Sum up training runs that differ in their seed."""

    #: results.json of every run, or its folder
    runs: tyro.conf.Positional[tuple[Path, ...]]
    #: JSON file to write
    out: Path | None = None


def main(args: list[str] | None = None) -> None:
    """Run the command line."""
    print_any_text()
    options = tyro.cli(Options, prog="python -m agents.compare", args=args)
    with one_line_errors(ValueError, OSError):
        if options.out is not None:
            check_figures(options.out, "compare")
        files = [path / "results.json" if path.is_dir() else path for path in options.runs]
        report = summarize({str(path): read_run(path) for path in files})
    if options.out is not None:
        with one_line_errors(OSError):
            write_json(options.out, plain(report, "compare"))
    show(report, Console(highlight=False, soft_wrap=True))


if __name__ == "__main__":
    main()
