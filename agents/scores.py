"""A table of scores out of many runs: ``python -m agents.scores runs/* --out benchmarks/results/NAME.json``.

Every run is a folder with the ``results.json`` of ``agents.sb3.train``, ``agents.rsl_rl.train``, ``agents.pid.score``
or ``agents.score_random``. Runs of one configuration that differ in their seed become one row (:mod:`agents.compare`),
runs of one environment one table; what no training changes (zero and random actions) stands in it once, unless an
environment's settings change what an action means. A run has played one stream of random actions; the row of an
``agents.score_random`` of the same settings, which is of several, takes its place. Beside the JSON file comes the same
as Markdown. Environments that none of the runs is about can keep the rows that an earlier table has of them
(``--keep FILE.json``).

A policy can be scored anew without training it anew: ``python -m agents.play RUN --out RUN/evaluation.json``. Its row
then takes the place of the training's own; what the training took, and zero and random actions, stay as they were. If
it was scored on other bones than those that it was trained on, zero and random actions of the training are left out:
they were not played where the policy was.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro
from rich.console import Console
from rich.markdown import Markdown

from agents import compare
from agents.checkpoint import flattened
from agents.command import one_line_errors
from agents.config import check_imports
from agents.evaluate import TRACKING
from agents.files import (
    RESULTS,
    check_figures,
    describe_run,
    plain,
    read_json,
    write_atomically,
    write_json,
)
from piavatar_envs.cli import print_any_text
from piavatar_envs.config import load_config
from piavatar_envs.core.writing import check_writable
from piavatar_envs.tasks import load_task

#: Script of runs that are random actions of several streams.
STREAMS = "score_random"
#: Names of agents by the script of their run: of a training run, library and algorithm.
_LEARNERS = {"pid.score": "PID", "rsl_rl.train": "rsl_ppo", "sb3.train": "sb3_ppo", "skrl.train": "skrl_mappo"}
#: Returns of the same actions in the same episodes, on another device.
_ALIKE = 1.0e-3
#: Setting of the bones, in which an evaluation may differ from the training; the row has its value.
_PLAYED = "env.control.bone_contact"


def scores(runs: Mapping[str, Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return rows of the table, by environment and then by agent.

    Args:
        runs: contents of their ``results.json``, by folder.

    Returns:
        A row for each agent in each environment: ``env_id``, ``agent``, the ``control`` of the avatar and whether it
        has ``firm_bones`` and ``bone_contact``, the names of its ``runs``, ``train_steps`` and ``training_s`` of one of
        them on average, and the figures as in :func:`agents.evaluate.over_seeds`.

    Raises:
        ValueError: no runs; or runs of one script and environment, not all of the same settings but for the seed.
    """
    if not runs:
        raise ValueError("there are no runs; give folders with a results.json")
    groups: dict[tuple[str, str], dict[str, Mapping[str, Any]]] = {}
    for name, run in runs.items():
        groups.setdefault((run["config"]["env_id"], _learner(run)), {})[name] = run
    streams = [run for run in runs.values() if run["benchmark"] == STREAMS]
    rows: list[dict[str, Any]] = []
    shown: list[tuple[str, Mapping[str, Any]]] = []
    for (env_id, script), group in sorted(groups.items(), key=lambda item: _order(*item[0])):
        for run, row in _rows(group, streams):
            agent = row["case"] if row["case"] != "trained" else script
            if agent in compare.UNTRAINED:
                if any(other == agent and _same_environment(one, run) for other, one in shown):
                    continue
                shown.append((agent, run))
                twins = [r for r in rows if r["env_id"] == env_id and r["agent"].startswith(agent)]
                if any(math.isclose(r["return_mean"], row["return_mean"], rel_tol=_ALIKE) for r in twins):
                    continue
                # other settings of the environment, where an action means something else
                agent = f"{agent}, as {script}" if twins else agent
            else:
                _check_alike(group)
                row = {"runs": list(group), **_cost(group), **row}
            played = {"env_id": env_id, "agent": agent, **_drive(run)}
            rows.append(played | {key: row[key] for key in row if key != "case"})
    return sorted(rows, key=lambda row: (row["env_id"], "runs" in row, row["agent"]))


def _order(env_id: str, script: str) -> tuple[str, bool, str]:
    """Order training runs before other runs, whose baselines count only where no training run has any."""
    return env_id, script in ("PID", STREAMS), script


def _learner(run: Mapping[str, Any]) -> str:
    """Name the library and the algorithm of a training run, or the script of another run."""
    if run["benchmark"] == "sb3.train" and run["config"].get("sac"):
        return "sb3_sac"
    return _LEARNERS.get(run["benchmark"], run["benchmark"])


def _rows(
    group: Mapping[str, Mapping[str, Any]], streams: Sequence[Mapping[str, Any]]
) -> list[tuple[Mapping[str, Any], Mapping[str, Any]]]:
    """Return rows of the runs of one script in one environment, each with a run of its settings.

    Random actions are those of several streams, where there are any of these settings.
    """
    first = next(iter(group.values()))
    if first["benchmark"] == STREAMS:
        return [(run, row) for run in group.values() for row in run["results"]]
    if len(group) > 1:
        rows = compare.summarize(group)["results"]
    else:
        own = 1 if "training_s" in first else None
        rows = [row | {"seeds": None if row["case"] in compare.UNTRAINED else own} for row in first["results"]]
    if _drive(first) != _drive({"config": first["config"]}):
        rows = [row for row in rows if row["case"] not in compare.UNTRAINED]
    several = next((run["results"][0] for run in streams if _same_environment(run, first)), None)
    return [(first, several if several and row["case"] == several["case"] else row) for row in rows]


def _same_environment(one: Mapping[str, Any], other: Mapping[str, Any]) -> bool:
    """Return whether two runs have the same environment."""
    first, second = one["config"], other["config"]
    alike = first["env_id"] == second["env_id"]
    return alike and _known(first["env_id"], first["env"]) == _known(second["env_id"], second["env"])


def _known(env_id: str, settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return all settings of an environment by dotted name; settings that a run does not have take their defaults.

    Settings that follow from others where they are null get that value, which older runs recorded.
    """
    # a world of several agents, settings that are no longer there, or a module that nothing has imported
    with contextlib.suppress(ValueError):
        check_imports(env_id, Path(RESULTS), ())
        config = load_config(load_task(env_id).Config, settings)
        settings = config.model_dump(mode="json")
        if config.control.mode == "pose":
            settings["control"]["free_motion"] = config.control.moves_freely
    return flattened({"env": settings})


def _drive(run: Mapping[str, Any]) -> dict[str, Any]:
    """Return control and bone settings of the scored avatar; None where its environment has none."""
    known = _known(run["config"]["env_id"], run.get("evaluation", run["config"])["env"])
    keys = {"control": "mode", "firm_bones": "firm_bones", "bone_contact": "bone_contact"}
    return {name: known.get(f"env.control.{key}") for name, key in keys.items()}


def _check_alike(group: Mapping[str, Mapping[str, Any]]) -> None:
    """Refuse seeds that were scored with different bones."""
    bones = {name: _drive(run)["bone_contact"] for name, run in group.items()}
    if len(set(bones.values())) > 1:
        raise ValueError(f"control.bone_contact of what was scored differs: {bones}; score all of them alike")


def _cost(group: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """Return the mean time and steps of the training runs; None where nothing is trained."""
    seconds = [run.get("training_s") for run in group.values()]
    steps = [run.get("train_steps") for run in group.values()]
    return {
        "training_s": None if None in seconds else sum(seconds) / len(seconds),
        "train_steps": None if None in steps else sum(steps) / len(steps),
    }


def _read_run(folder: Path) -> dict[str, Any]:
    """Read ``results.json``; a later evaluation replaces the row of the policy and is returned as ``evaluation``."""
    run, path = compare.read_run(folder / RESULTS), folder / "evaluation.json"
    if not all("success_once" in row for row in run["results"]):
        raise ValueError(f"{folder / RESULTS} holds matches of competing agents; give runs of agents with one aim")
    if not path.is_file():
        return run
    evaluation = read_json(path)
    _check_evaluation(evaluation, run, folder, path)
    (trained,) = evaluation["results"]
    rows = [trained if row["case"] == "trained" else row for row in run["results"]]
    return run | {"results": rows, "evaluation": evaluation}


def _check_evaluation(evaluation: Mapping[str, Any], run: Mapping[str, Any], folder: Path, path: Path) -> None:
    """Refuse an evaluation of another policy, other settings or other episodes."""
    anew = f"write it anew: python -m agents.play {folder} --out {path}"
    if evaluation.get("date", "") < run.get("date", ""):
        raise ValueError(f"{path} is older than {folder / RESULTS}: the policy may have learned since; {anew}")
    seeds = {row["case"]: row["first_seed"] for row in run["results"] if row["case"] == "trained"}
    if not seeds:
        raise ValueError(f"{path} is of a policy, but {folder / 'results.json'} has no row 'trained'; remove {path}")
    # a run that is named by a link has the name of its folder
    wanted = {"benchmark": "play", "run": folder.resolve().name}
    env_id = run["config"]["env_id"]
    wanted |= _known(env_id, run["config"]["env"]) | flattened({"first_seed": seeds})
    found = {key: evaluation.get(key) for key in ("benchmark", "run")}
    seeds = {row["case"]: row["first_seed"] for row in evaluation.get("results", ())}
    env = evaluation.get("env")  # what names none has not got the defaults
    found |= (_known(env_id, env) if env else {}) | flattened({"first_seed": seeds})
    for key in wanted | found:
        if found.get(key) != wanted.get(key) and key != _PLAYED:
            raise ValueError(
                f"{path} has {key}={found.get(key)!r}, of this run it would have {wanted.get(key)!r}; {anew}"
            )


def _kept(path: Path | None, rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return the rows of an earlier table about other environments, with its devices and commits."""
    if path is None:
        return {"results": [], "devices": [], "commits": []}
    table = read_json(path)
    missing = [name for name in ("results", "devices", "commits") if name not in table]
    if missing:
        raise ValueError(f"{path} has no {missing[0]!r}; give a table that agents.scores has written")
    known = {row["env_id"] for row in rows}
    return table | {"results": [row for row in table["results"] if row["env_id"] not in known]}


def _check_out(path: Path) -> None:
    """Refuse a file for the table that has another suffix, cannot be written, or would replace something else."""
    if path.suffix != ".json":
        raise ValueError(f"out={path} must be a .json file; the table is written next to it as .md")
    check_figures(path, "scores")
    beside = path.with_suffix(".md")
    check_writable(beside)
    if beside.exists() and not path.exists():
        raise ValueError(f"{beside} is of something else, and the table would take its place; give --out another name")


_RESULTS = ("return", "succeeds at the end", "at some time", "steps", "trained for")
_COLUMNS = ("agent", "control", "bones", "seeds", "episodes", *_RESULTS)


def markdown(rows: Sequence[Mapping[str, Any]], about: str) -> str:
    """Format the rows as Markdown: a table per environment, and one of pushes where there are any."""
    lines = ["# Scores", "", about, ""]
    for env_id in sorted({row["env_id"] for row in rows}):
        own = [row for row in rows if row["env_id"] == env_id]
        lines += [f"## {env_id}", "", _line(_COLUMNS), _line(["---"] * len(_COLUMNS))]
        lines += [_line(_cells(row)) for row in own]
        followed = [row for row in own if row.get("followed") is not None]
        if followed:
            lines += ["", *_tracking(followed)]
        pushed = [row for row in own if row.get("by_push")]
        if pushed:
            lines += ["", *_pushes(pushed)]
        lines.append("")
    return "\n".join(lines)


def _bones(row: Mapping[str, Any]) -> str:
    """Describe the bones of a row's avatar; empty where its environment does not say."""
    if row.get("firm_bones") is None:
        return ""
    if not row["firm_bones"]:
        return "slipping"
    return "solid" if row.get("bone_contact") else "firm"


def _cells(row: Mapping[str, Any]) -> list[str]:
    trained = "" if row.get("training_s") is None else f"{row['training_s']:.0f} s"
    if row.get("train_steps"):
        trained = f"{row['train_steps'] / 1e6:.2g} M steps, {trained}"
    return [
        row["agent"],
        row.get("control") or "",
        _bones(row),
        str(row["seeds"] or ""),
        str(row["episodes"]),
        _with(row["return_mean"], row["return_interval"], ".1f"),
        _with(row["success_at_end"], row["success_at_end_interval"], ".0%"),
        _with(row["success_once"], row["success_once_interval"], ".0%"),
        _with(row["mean_steps"], row["steps_interval"], ".0f"),
        trained,
    ]


def _tracking(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Format how closely motions were followed, in the terms of PHC."""
    columns = ("agent", "control", "followed to the end", "G-MPJPE [mm]", "MPJPE [mm]", "acceleration [mm/frame^2]")
    lines = [_line(columns), _line(["---"] * len(columns))]
    for row in rows:
        share = _with(row["followed"], row["followed_interval"], ".0%")
        figures = [f"{row[key]:.1f}" for key, _ in TRACKING.values()]
        lines.append(_line([row["agent"], row.get("control") or "", share, *figures]))
    return ["How closely the motions were followed:", "", *lines]


def _pushes(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Format the share of episodes that lasted, by the greatest impulse of a push."""
    classes = sorted({tuple(push["impulse_n_s"]) for row in rows for push in row["by_push"]})
    lines = [_line(["strongest push [N s]", *(row["agent"] for row in rows)]), _line(["---"] * (1 + len(rows)))]
    for bounds in classes:
        cells = [f"{bounds[0]:g} to {bounds[1]:g}"]
        for row in rows:
            push = next((push for push in row["by_push"] if tuple(push["impulse_n_s"]) == bounds), None)
            cells.append("" if push is None else f"{push['lasted']:.0%} of {push['episodes']}")
        lines.append(_line(cells))
    return ["Episodes that lasted, by the strongest push in them:", "", *lines]


def _with(mean: float, interval: Sequence[float] | None, form: str) -> str:
    return f"{mean:{form}}" if interval is None else f"{mean:{form}} ({interval[0]:{form}} to {interval[1]:{form}})"


def _line(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |"


@dataclass(frozen=True)
class Options:
    """Sum up runs of several agents, environments and seeds in a table."""

    #: folders of the runs
    runs: tyro.conf.Positional[tuple[Path, ...]]
    #: JSON file to write; the table is written next to it, as .md
    out: Path | None = None
    #: earlier JSON file, whose rows of other environments stay
    keep: Path | None = None


def main(args: list[str] | None = None) -> None:
    """Run the command line."""
    print_any_text()
    options = tyro.cli(Options, prog="python -m agents.scores", args=args)
    with one_line_errors(ValueError, OSError):
        if options.out is not None:
            _check_out(options.out)
        runs = {str(path): _read_run(path) for path in options.runs}
        rows = scores(runs)
        kept = _kept(options.keep, rows)
    rows = sorted([*kept["results"], *rows], key=lambda row: row["env_id"])
    measured = [*runs.values(), *(run["evaluation"] for run in runs.values() if "evaluation" in run)]
    devices = sorted({one["device"]["name"] for one in measured} | set(kept["devices"]))
    commits = sorted({str(one["commit"])[:12] for one in measured} | set(kept["commits"]))
    about = (
        f"{', '.join(devices)}; commits {', '.join(commits)}. Brackets are 95 % intervals: over seeds and episodes "
        "where there are several seeds, else over episodes; all seeds have played the same, so many each. Zero actions "
        "and the PID agent have no seeds: they draw nothing at random, so they play an episode in one way. Bones are "
        "solid by default, firm without `bone_contact`, and slipping without `firm_bones`."
    )
    text = markdown(rows, about)
    if options.out is not None:
        report = {**describe_run("scores", "cpu"), "devices": devices, "commits": commits, "results": rows}
        with one_line_errors(OSError):
            write_json(options.out, plain(report, "scores"))
            write_atomically(options.out.with_suffix(".md"), lambda file: file.write(text.encode()))
    Console(soft_wrap=True).print(Markdown(text))


if __name__ == "__main__":
    main()
