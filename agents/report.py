"""Reports of a training run: tables, the learning curve, and JSON."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from agents.evaluate import TRACKING, Evaluation
from agents.files import describe_run, plain, write_atomically, write_json
from agents.intervals import Estimate
from agents.sb3.matches import Match

_COLORS = ("tab:blue", "tab:green", "tab:purple", "tab:orange")
_MOTIONS = 20  # that a table shows
_SMOOTH = 20  # episodes in the moving mean of a learning curve, at least; of many, one in a hundred


def show_table(evaluations: Sequence[Evaluation], console: Console) -> None:
    """Print a table of the agents, one of how they follow motions, and one of each motion for the last agent."""
    count = len(evaluations[0].episodes)
    table = Table(title=f"{count} fresh episodes each, the same for all", title_justify="left", caption_justify="left")
    table.caption = "once, at end, of time: task fulfilled in the episode, in its last step, share of all steps"
    table.add_column("agent", no_wrap=True)
    for column in ("return", "95 % interval", "once", "at end", "of time", "distance"):
        table.add_column(column, justify="right", no_wrap=True)
    rows = [evaluation.row() for evaluation in evaluations]
    for row in rows:
        low, high = row["return_interval"]
        distance = row["mean_distance_m"]
        table.add_row(
            row["case"],
            f"{row['return_mean']:.1f}",
            f"{low:.1f} to {high:.1f}",
            f"{row['success_once']:.0%}",
            f"{row['success_at_end']:.0%}",
            f"{row['success_share_of_steps']:.0%}",
            "" if distance is None else f"{distance:.2f} m",
        )
    console.print(table)
    if "followed" in rows[0]:
        _show_tracking("agent", "case", rows, "how closely motions were followed", console)
    if "by_motion" in rows[-1]:
        shown, agent = rows[-1]["by_motion"], rows[-1]["case"]
        title = f"{agent}, by motion, the least followed first"
        title += f": {_MOTIONS} of {len(shown)}, all are in the JSON file" if len(shown) > _MOTIONS else ""
        _show_tracking("motion", "motion", shown[:_MOTIONS], title, console)


def _show_tracking(column: str, key: str, rows: Sequence[Mapping[str, Any]], title: str, console: Console) -> None:
    """Print a table of how closely motions were followed, in the terms of PHC; ``key`` names the rows."""
    table = Table(title=title, title_justify="left", caption_justify="left")
    table.caption = "followed: to the end; G-MPJPE and MPJPE in mm, acceleration error in mm/frame^2"
    table.add_column(column, overflow="fold")
    for name in ("episodes", "followed", "G-MPJPE", "MPJPE", "accel."):
        table.add_column(name, justify="right", no_wrap=True)
    for row in rows:
        figures = (f"{row[name]:.1f}" for name, _ in TRACKING.values())
        table.add_row(escape(row[key]), str(row["episodes"]), f"{row['followed']:.0%}", *figures)
    console.print(table)


def show_matches(matches: Sequence[Match], console: Console) -> None:
    """Print a table of the matches."""
    table = Table(title=f"{len(matches[0].games)} fresh games each", title_justify="left", caption_justify="left")
    table.caption = "the first sits in every seat equally often; 95 % interval; theirs: the others' return, each"
    table.add_column("game", no_wrap=True)
    for column in ("won", "interval", "lost", "drawn", "return", "theirs"):
        table.add_column(column, justify="right", no_wrap=True)
    for match in matches:
        row = match.row()
        low, high = row["win_interval"]
        table.add_row(
            row["case"],
            f"{row['win_rate']:.0%}",
            f"{low:.0%} to {high:.0%}",
            f"{row['loss_rate']:.0%}",
            f"{row['draw_rate']:.0%}",
            f"{row['return_mean']:.1f}",
            f"{row['opponent_return_mean']:.1f}",
        )
    console.print(table)


def draw_curve(
    path: Path, steps: Sequence[int], returns: Sequence[float], references: Mapping[str, Estimate], title: str
) -> None:
    """Draw the learning curve.

    Args:
        path: the PNG to write.
        steps: control steps at the ends of the training episodes.
        returns: their returns.
        references: returns of other agents, drawn as bands.
        title: of the picture.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.0, 4.2), layout="constrained")
    axes = figure.subplots()
    axes.plot(steps, returns, ".", color="0.75", markersize=4, label="training episode")
    window = min(max(_SMOOTH, len(returns) // 100), len(returns))
    if window > 1:
        mean = np.convolve(returns, np.full(window, 1.0 / window), mode="valid")
        axes.plot(steps[window - 1 :], mean, color="tab:red", label=f"mean of {window}")
    for index, (name, estimate) in enumerate(references.items()):
        color = _COLORS[index % len(_COLORS)]
        axes.axhline(estimate.mean, color=color, linewidth=1.2, label=name)
        axes.axhspan(estimate.low, estimate.high, color=color, alpha=0.12, linewidth=0)
    axes.set(xlabel="control steps", ylabel="return of an episode", title=title)
    axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False)
    figure.savefig(path, dpi=130)


def versions(name: str, device: str) -> dict[str, Any]:
    """Return commit, versions, device and date, as in every benchmark's JSON."""
    return describe_run(name, device)


def write_results(
    path: Path, run: Mapping[str, Any], evaluations: Sequence[Evaluation | Match], extra: Mapping[str, Any]
) -> None:
    """Write the evaluations as JSON, in the schema of the benchmarks."""
    rows = [evaluation.row() for evaluation in evaluations]
    write_json(path, plain({**run, **extra, "results": rows}, "results"))


def conclude(
    folder: Path,
    run: Mapping[str, Any],
    results: Sequence[Evaluation] | Sequence[Match],
    extra: Mapping[str, Any],
    files: str,
) -> None:
    """Write ``results.json``, print it, and list the files that the script has left.

    Args:
        folder: of the run.
        run: :func:`versions`, and the seed and the settings.
        results: of all agents, or of all matches.
        extra: other figures of the run.
        files: names of what it has left.
    """
    write_results(folder / "results.json", run, results, extra)
    console = Console(highlight=False, soft_wrap=True)
    show = show_matches if isinstance(results[0], Match) else show_table
    show(results, console)
    console.print(f"in {folder}: {files}")


@dataclass
class Curve:
    """Learning curve: returns of the training episodes, in the order in which they ended.

    Attributes:
        steps: control steps taken by then, over all workers and their learning agents.
        returns: undiscounted returns, of actions that were drawn at random from the policy.
        seconds: time that the training took [s], over all its parts where it was resumed.
        train_steps: control steps of all of it, set when it is over; the last episode that ended did so earlier.
    """

    steps: list[int] = field(default_factory=list)
    returns: list[float] = field(default_factory=list)
    seconds: float = 0.0
    train_steps: int = 0

    def csv(self) -> str:
        """Format the curve as CSV, a row per episode."""
        rows = [f"{step},{value:.6g}" for step, value in zip(self.steps, self.returns, strict=True)]
        return "\n".join(["step,return", *rows]) + "\n"

    def save(self, path: Path) -> None:
        """Write the curve as CSV."""
        write_atomically(path, lambda file: file.write(self.csv().encode()))

    def state(self) -> dict[str, Any]:
        """Return the state for a checkpoint."""
        return {"steps": list(self.steps), "returns": list(self.returns), "seconds": self.seconds}

    def load(self, state: dict[str, Any]) -> None:
        """Restore what :meth:`state` returned."""
        self.steps, self.returns, self.seconds = list(state["steps"]), list(state["returns"]), state["seconds"]
