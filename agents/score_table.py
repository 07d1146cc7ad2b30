"""Scores as Markdown: what :mod:`agents.scores` has summed up, for people."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

_RESULTS = ("return", "succeeds at the end", "at some time", "steps", "trained for")
_COLUMNS = ("agent", "control", "bones", "seeds", "episodes", *_RESULTS)


def markdown(rows: Sequence[Mapping[str, Any]], about: str) -> str:
    """The rows as Markdown: a table an environment, and one of pushes where there are any."""
    lines = ["# Scores", "", about, ""]
    for env_id in sorted({row["env_id"] for row in rows}):
        own = [row for row in rows if row["env_id"] == env_id]
        lines += [f"## {env_id}", "", _line(_COLUMNS), _line(["---"] * len(_COLUMNS))]
        lines += [_line(_cells(row)) for row in own]
        pushed = [row for row in own if row.get("by_push")]
        if pushed:
            lines += ["", *_pushes(pushed)]
        lines.append("")
    return "\n".join(lines)


def _bones(row: Mapping[str, Any]) -> str:
    """What holds the bones of a row's avatar; nothing where its environment does not say."""
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


def _pushes(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Share of episodes that lasted, by the greatest impulse of a push."""
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
