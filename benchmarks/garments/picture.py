"""Picture of a table: every measured value over its tolerance, holding and failing ones in two colours."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.physics.checks import HOLDS

#: Colours of the file.
SHADES = 64
#: Shares of the tolerance that the axis shows.
LEAST, MOST = 1e-3, 30.0
#: Colours of values that hold and that fail.
COLORS = {True: "#2b6cb0", False: "#c05621"}


def share(row: Mapping[str, Any]) -> float:
    """Return the deviation of a row from theory over its tolerance, or its value over or under its bound.

    1 is at the limit, less within it; infinite where there is no value.
    """
    value, tolerance = row["value"], row["tolerance"]
    if value is None:
        return math.inf
    if row["bound"] == "=":
        value = abs(value - row["theory"])
    elif row["bound"] == ">=":
        value, tolerance = tolerance, value
    return value / tolerance if tolerance > 0.0 else (0.0 if value <= tolerance else math.inf)


def draw(rows: Sequence[Mapping[str, Any]], path: Path) -> None:
    """Write a picture of a table's rows, in its order."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot
    from PIL import Image

    figure, axes = pyplot.subplots(figsize=(9.0, 0.9 + 0.19 * len(rows)))
    places = -np.arange(len(rows))
    shares = [share(row) for row in rows]
    holds = [row["verdict"] == HOLDS for row in rows]
    shown = np.where([row["value"] is None for row in rows], np.nan, np.clip(shares, LEAST, MOST))
    colors = [COLORS[held] for held in holds]
    axes.hlines(places, LEAST, shown, colors=colors, linewidth=2.0, alpha=0.35)
    axes.scatter(shown, places, c=colors, s=22, zorder=3)
    axes.axvline(1.0, color="#555555", linewidth=1.0)
    axes.set_yticks(places, [f"{row['title']}: {row['quantity']}" for row in rows], fontsize=7)
    for place, row in zip(places, rows, strict=True):
        value = "no value" if row["value"] is None else f"{row['value']:.3g}"
        theory = "" if row["theory"] is None else f", theory {row['theory']:.3g}"
        unit = f" {row['unit']}" if row["unit"] else ""
        axes.text(1.02, place, f"{value}{unit}{theory} ({row['limit']})", fontsize=6.5, va="center",
                  transform=axes.get_yaxis_transform())  # fmt: skip
    axes.set(xscale="log", xlim=(LEAST, MOST), ylim=(places[-1] - 0.7, 0.7))
    axes.set_xlabel("deviation over tolerance (value over its bound); 1 is the limit")
    axes.grid(axis="x", alpha=0.25)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    figure.savefig(path, dpi=110, bbox_inches="tight")
    pyplot.close(figure)
    with Image.open(path) as drawn:
        small = drawn.convert("RGB").quantize(SHADES, kmeans=4, dither=Image.Dither.NONE)
    small.save(path, optimize=True)
