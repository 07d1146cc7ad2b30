"""Elastic bodies against textbooks, on finer and finer grids: a bar that rings, a cantilever, bars and balls that meet.

``python -m benchmarks.physics.elastodynamics --out benchmarks/results/elastodynamics.json`` writes a row a case and
resolution, and draws ``elastodynamics.png`` beside it. Errors are relative to the theory in ``textbook.py``; ``cells``
are grid spacings along a side of a bar, through the cantilever, and in the radius of a ball. Bars have two particles
to a cell along every axis; what is in ``impacts.py`` meets something.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import runner
from benchmarks.physics.impacts import DENSITY, SHIFTS, YOUNG_MODULUS, ball_impact, bar_impact
from benchmarks.physics.matter import Matter, build_matter
from benchmarks.physics.textbook import BarImpact, HertzImpact, bar_frequency, beam_deflection


@dataclass(frozen=True)
class Options(runner.Options):
    """Options of the benchmark of elastic bodies."""

    #: cells of the bar and of the cantilever
    cells: tuple[int, ...] = (2, 3, 4, 6, 8)
    #: cells in the radius of a ball
    radius_cells: tuple[int, ...] = (6, 8, 12)
    #: substeps of the bar, as multiples of what the environments would choose
    time_steps: tuple[int, ...] = (1, 2, 4)
    #: a smoke run of the coarsest grids
    quick: bool = False


def cases(options: Options) -> Iterator[dict[str, Any]]:
    """Yield all rows, then draw the picture."""
    device, rows = options.device, []
    cells = options.cells[:1] if options.quick else options.cells
    radius_cells = options.radius_cells[:1] if options.quick else options.radius_cells
    runs = [("bar", bar, (count, material), {}) for material in ("neo_hookean", "fixed_corotated") for count in cells]
    runs += [("bar, Poisson's ratio 0.3", bar, (count, "neo_hookean", 0.3), {}) for count in cells]
    runs += [("bar, finer time steps", bar, (4,), {"finer": n}) for n in options.time_steps if not options.quick]
    runs += [("cantilever", cantilever, (count,), {}) for count in cells]
    shifts = SHIFTS[:1] if options.quick else SHIFTS
    for mirrored, other in ((False, "wall"), (True, "bar")):
        runs += [(f"bar on {other}", bar_impact, (count, mirrored, shifts), {}) for count in cells]
    for mirrored, other in ((False, "plane"), (True, "ball")):
        runs += [(f"ball on {other}", ball_impact, (count, mirrored, shifts), {}) for count in radius_cells]
    for name, measure, about, more in runner.progress(runs, "elastodynamics"):
        row = {"case": name, **measure(*about, device=device, **more)}
        rows.append(row)
        yield row
    if options.out is not None and not options.quick:
        draw(rows, options.out.with_suffix(".png"))


def _period(times: np.ndarray, signal: np.ndarray) -> float:
    """Return the mean period of an oscillation about zero, from its interpolated zero crossings.

    Raises:
        ValueError: there are fewer than four.
    """
    n = np.flatnonzero(signal[:-1] * signal[1:] < 0.0)
    if len(n) < 4:
        raise ValueError(f"{len(n)} zero crossings; a period takes at least 4")
    crossings = times[n] - signal[n] * (times[n + 1] - times[n]) / (signal[n + 1] - signal[n])
    return float(2.0 * np.diff(crossings).mean())


def bar(
    cells: int, material: str = "neo_hookean", poisson_ratio: float = 0.0, finer: int = 1, device: str = "cpu"
) -> dict[str, Any]:
    """Measure the first longitudinal frequency of a free bar, six sides long.

    Args:
        cells: along a side.
        material: of the bar.
        poisson_ratio: likewise; its sides are free.
        finer: factor on the number of substeps.
        device: Warp device.
    """
    side = 0.1
    length, dx = 6.0 * side, side / cells
    theory = bar_frequency(length, side, YOUNG_MODULUS, poisson_ratio, DENSITY)
    corner = np.array([length, side, side]) / 2.0

    def build(**more: Any) -> Matter:
        about = {"material": material, "poisson_ratio": poisson_ratio, "control_dt": 1.0 / (24.0 * theory), **more}
        return build_matter(-corner, corner, dx / 2, dx, margin=0.1, device=device, **about)

    sim = build()
    if finer > 1:
        sim = build(num_substeps=finer * sim.model.num_substeps)
    mode = np.sin(np.pi * sim.rest[:, 0] / length)
    sim.set(u=0.02 * mode[:, None] * [1.0, 0.0, 0.0])
    times = np.arange(80) * sim.model.control_dt
    signal = np.array([sim.get("u")[:, 0] @ mode if n == 0 else sim.run().get("u")[:, 0] @ mode for n in range(80)])
    return {
        "material": material,
        "cells": cells,
        "dt_s": float(sim.model.step.dt),
        "error": 1.0 / (_period(times, signal) * theory) - 1.0,
    }


def cantilever(cells: int, device: str = "cpu") -> dict[str, Any]:
    """Measure the tip deflection of a cantilever under a small weight, five sides long: 4 % of its length.

    It is one half of a free beam that is pushed up in the middle as much as it weighs: symmetry is a perfect clamp.
    """
    side, length, weight = 0.2, 1.0, 0.1
    spacing, band = 0.5 * side / cells, 0.5 * side
    pulsation = 22.4 / (2 * length) ** 2 * np.sqrt(YOUNG_MODULUS / DENSITY * side**2 / 12.0)  # first mode [rad/s]

    def acceleration(x: np.ndarray) -> np.ndarray:
        return np.where(np.abs(x) < band, weight * (length - band) / band, -weight)

    corner = np.array([length, side / 2, side / 2])
    about = {"poisson_ratio": 0.0, "control_dt": 16.0 / pulsation, "pushed": True, "device": device}
    sim = build_matter(-corner, corner, spacing, side / cells, margin=0.2, **about)
    x = sim.rest[:, 0]
    sim.push(damping=2.0 * pulsation, acceleration=acceleration(x)[:, None] * [0.0, 0.0, 1.0]).run()
    sag = sim.get("x")[:, 2] - sim.rest[:, 2]
    tip, middle = sag[np.abs(x) > length - spacing].mean(), sag[np.abs(x) < spacing].mean()
    line = np.linspace(0.0, length, 4001)[:-1] + 0.5 * length / 4000
    theory = beam_deflection(line, acceleration(line), side, YOUNG_MODULUS, DENSITY)
    theory = np.interp([0.5 * spacing, length - 0.5 * spacing], line, theory)
    return {"cells": cells, "error": float((tip - middle) / (theory[1] - theory[0]) - 1.0)}


def draw(rows: Sequence[dict[str, Any]], path: Path) -> None:
    """Draw errors over the resolution, and forces of a bar and of a ball that bounce."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, 3, figsize=(15.0, 4.4), layout="constrained")
    _draw_errors(rows, axes[0])
    _draw_forces([row for row in rows if row["case"] == "bar on wall"], BarImpact(1.0, 1.0, 1.0, 1.0, 1.0), axes[1])
    _draw_forces([row for row in rows if row["case"] == "ball on plane"], HertzImpact(1.0, 1.0, 1.0, 0.0, 0.1), axes[2])
    figure.savefig(path, dpi=110)
    plt.close(figure)


def _draw_errors(rows: Sequence[dict[str, Any]], axes: Any) -> None:
    """Draw errors; of impacts the largest over the places of the grid."""
    for name, label, color in (
        ("bar", "frequency of a bar", "#1b7f79"),
        ("cantilever", "sag of a cantilever", "#d1495b"),
        ("bar on wall", "time to turn, bar on wall", "#472b62"),
        ("bar on bar", "time to turn, bar on bar", "#8d6a9f"),
        ("ball on plane", "time to turn, ball on plane", "#f2a65a"),
        ("ball on ball", "time to turn, ball on ball", "#c9b037"),
    ):
        found = [row for row in rows if row["case"] == name and row.get("material", "neo_hookean") == "neo_hookean"]
        errors = [np.abs(row.get("time_error_range", row.get("error"))).max() for row in found]
        axes.loglog([row["cells"] for row in found], errors, "o-", color=color, label=label)
    line = np.array([2.0, 12.0])
    axes.loglog(line, 0.06 * line**-2.0, "k:", label="second order")
    axes.set(xlabel="cells through the body; in the radius of a ball", ylabel="relative error")
    axes.set_xticks([2, 3, 4, 6, 8, 12], ["2", "3", "4", "6", "8", "12"])
    axes.minorticks_off()
    axes.set_ylim(2e-5, 1.0)  # room for the legend
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8, loc="lower left")


def _draw_forces(rows: Sequence[dict[str, Any]], theory: BarImpact | HertzImpact, axes: Any) -> None:
    """Draw the force of an impact over time."""
    from matplotlib import colormaps

    for row, shade in zip(rows, np.linspace(0.85, 0.0, len(rows)), strict=True):
        color = colormaps["viridis"](shade)
        axes.plot(row["time_of_duration"], row["force_of_theory"], color=color, label=f"{row['cells']} cells")
    times, force = theory.history
    axes.plot(times / theory.duration - 0.5, force / theory.force, "k--", label="theory")
    name = rows[0]["case"] if rows else ""
    axes.set(title=name, xlabel="time [durations of contact by theory]", ylabel="force [greatest by theory]")
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)


if __name__ == "__main__":
    runner.main("elastodynamics", cases, Options)
