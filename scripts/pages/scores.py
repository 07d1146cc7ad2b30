"""Scores of committed agents on the page of their environment, from ``benchmarks/results``."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

from agents.intervals import NORMAL
from scripts.pages.entries import ROOT, Entry
from scripts.pages.markdown import page, table

RESULTS = ROOT / "benchmarks" / "results"
#: Result of short training runs of all ids, for those without a training run of their own.
BRIEF = RESULTS / "scores.json"
#: Names of programs that write results, as readers know them.
_PROGRAMS = {"rsl_rl.train": "PPO, rsl_rl", "sb3.train": "stable-baselines3", "skrl.train": "skrl"}
_SIMPLE = ("zero", "random")


class Score(NamedTuple):
    """A row of a result.

    Attributes:
        agent: its name.
        control: what its actions command.
        row: of the result's JSON file.
        file: that the row is in.
        commit: of the code that was scored.
        date: of the score, ISO.
    """

    agent: str
    control: str
    row: Mapping[str, Any]
    file: Path
    commit: str
    date: str


def scores_section(entry: Entry, folder: Path) -> str:
    """Return the section of an environment's scores, empty without any.

    Args:
        entry: the environment.
        folder: of the page, which links are relative to.
    """
    rows = [score for score in _scores() if score[0] == entry.title.rpartition(".")[2]]
    if not rows:
        return ""
    found = [_cells(score, folder) for _, score in rows]
    head = ("agent", "control", "return", "success: once, at the end, share of time", "episodes", "result, commit")
    text = (
        "All agents play complete episodes of the same seeds; the mean return of an episode has its 95 % interval. "
        "Scores were measured at the commit that is named; they change with the bodies and the task. "
        "[Training](../training.md) says how the policies were made, and how to play those that are committed."
    )
    return page(["## Baseline scores", text, table(head, found)])


@cache
def _scores() -> tuple[tuple[str, Score], ...]:
    """Return the scores to show, each after the last part of its environment's name."""
    runs = sorted(_runs(), key=lambda pair: pair[1].date, reverse=True)
    shown: dict[tuple[str, str, str, Path | None], tuple[str, Score]] = {}
    for name, score in runs:
        one_each = None if score.agent in _SIMPLE else score.file.parent  # zero and random actions once for a control
        shown.setdefault((name, score.agent, score.control, one_each), (name, score))
    trained = {name for name, _ in shown.values()}
    brief = json.loads(BRIEF.read_text(encoding="utf-8"))
    for row in brief["results"]:
        name = row["case"].rpartition(".")[2]
        if name not in trained:
            steps = row["trained_for_steps"]
            agent = f"PPO, {steps:,} steps" if steps else row["agent"]
            score = Score(agent, "pose", row, BRIEF, row["commit"], brief["date"])
            shown[(name, agent, "pose", None)] = (name, score)
    order = {agent: index for index, agent in enumerate(_SIMPLE)}
    return tuple(
        sorted(shown.values(), key=lambda pair: (pair[0], pair[1].control, order.get(pair[1].agent, 9), pair[1].agent))
    )


def _runs() -> Iterator[tuple[str, Score]]:
    """Yield the rows of all training runs and their later evaluations, each after its environment's name."""
    for path in sorted(RESULTS.rglob("results.json")):
        result = json.loads(path.read_text(encoding="utf-8"))
        config = result.get("config") or {}
        if "env_id" not in config:
            continue
        control = config.get("env", {}).get("control") or config.get("control") or {}
        mode = control if isinstance(control, str) else control.get("mode", "pose")
        later = path.with_name("evaluation.json")
        files = [(path, result)]
        if later.is_file():
            files.append((later, json.loads(later.read_text(encoding="utf-8"))))
        rows = {row["case"]: (row, file, each) for file, each in files for row in each["results"]}
        for case, (row, file, each) in rows.items():
            agent = case
            if case.startswith("trained"):
                agent = _PROGRAMS.get(result["benchmark"], result["benchmark"]) + case.removeprefix("trained")
            name = config["env_id"].rpartition(".")[2]
            yield name, Score(agent, mode, row, file, str(each["commit"]), str(each.get("date", "")))


def _cells(score: Score, folder: Path) -> tuple[str, ...]:
    """Return the cells of a score."""
    row, count = score.row, score.row.get("episodes") or 0
    mean, spread = row["return_mean"], row.get("return_std")
    digits = 1 if abs(mean) >= 10.0 else 2
    shown = f"{mean:.{digits}f}"
    if spread is not None and count > 1:
        half = NORMAL * spread / math.sqrt(count)
        shown += f" ({mean - half:.{digits}f} to {mean + half:.{digits}f})"
    shares = [row.get(f"success_{when}") for when in ("once", "at_end", "share_of_steps")]
    success = "" if None in shares[:2] else ", ".join("-" if s is None else f"{100.0 * s:.0f} %" for s in shares)
    link = os.path.relpath(score.file, folder).replace(os.sep, "/")
    place = score.file.parent if score.file != BRIEF else score.file
    name = place.relative_to(RESULTS).as_posix()
    return score.agent, score.control, shown, success, str(count or ""), f"[{name}]({link}), {score.commit[:7]}"
