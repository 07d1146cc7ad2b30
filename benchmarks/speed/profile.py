"""Time and launches of every kernel of a control step.

``python -m benchmarks.speed.profile --device cuda --num-envs 4096 --out benchmarks/results/profile_reach.json``
writes a row per kernel and draws ``profile_reach.png`` beside it. The kernels are launched one by one to be timed; the
first row has the captured step as a whole, which is what counts.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import runner
from benchmarks.speed import timing
from benchmarks.speed.vector import LEAST_STEPS, Stepper, make_task
from piavatar_envs.envs.batch_env import BatchEnv

#: Short names of the worlds that are profiled most.
WORLDS = {"reach": "PIAvatar/Reach-v0", "kickball": "PIAvatar/KickBall-v0", "sumo": "sumo_v0"}
STEP = "step"  # the first row
MOST_BARS = 16


@dataclass(frozen=True)
class Options(runner.Options):
    """Options of the profile."""

    #: reach, kickball, sumo, an id, or a module of piavatar_envs.multi
    case: str = "reach"
    #: environments
    num_envs: int = 1024
    #: resolution of the bodies
    fidelity: str = "coarse"
    #: settings of the environment, as control.bone_contact=false
    settings: tuple[str, ...] = ()
    #: steps that are timed, each way
    repeats: int = 10


def cases(options: Options) -> Iterator[dict[str, Any]]:
    """Yield a row for the whole step and one for each kernel, the slowest first; then draw the picture."""
    world = WORLDS.get(options.case, options.case)
    batch = BatchEnv(make_task(world, options.fidelity, options.settings), options.num_envs, options.device)
    batch.reset()
    stepper = Stepper(batch)
    for _ in range(LEAST_STEPS):
        stepper.step_only()
    captured = 1e3 * timing.wall_times(options.device, batch.step, options.repeats)
    kernels = timing.kernel_times(batch.step_graph, options.repeats)
    total = sum(kernel.ms for kernel in kernels.values())
    model = batch.simulation.model
    rows: list[dict[str, Any]] = [
        {
            "case": STEP,
            "world": world,
            "num_envs": options.num_envs,
            "particles": model.num_particles,
            "substeps": model.num_substeps,
            "ms_per_step": float(np.median(captured)),
            "kernels_sum_ms": total,
            "launches_per_step": len(batch.step_graph),
            "failed_envs": int((batch.failure.numpy() != 0).sum()),
        }
    ]
    rows += [
        {
            "case": name,
            "ms_per_step": kernel.ms,
            "share": kernel.ms / total,
            "launches_per_step": kernel.launches,
        }
        for name, kernel in sorted(kernels.items(), key=lambda item: -item[1].ms)
    ]
    yield from rows
    if options.out is not None and importlib.util.find_spec("matplotlib") is not None:
        draw(rows, options.out.with_suffix(".png"))


def draw(rows: Sequence[dict[str, Any]], path: Path) -> None:
    """Draw the kernels' times as bars, the smallest as one. Needs matplotlib (extra ``train``)."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    (step,) = (row for row in rows if row["case"] == STEP)
    kernels = [row for row in rows if row["case"] != STEP]
    shown, rest = kernels[:MOST_BARS], kernels[MOST_BARS:]
    labels, times = [row["case"] for row in shown], [row["ms_per_step"] for row in shown]
    if rest:
        labels.append(f"{len(rest)} others")
        times.append(sum(row["ms_per_step"] for row in rest))
    figure, axes = pyplot.subplots(figsize=(8.0, 0.8 + 0.27 * len(labels)), layout="constrained")
    bars = axes.barh(labels[::-1], times[::-1], color="#1b7f79")
    axes.bar_label(bars, [f" {ms:.3g} ms" for ms in times][::-1], fontsize=7)
    axes.set_xlim(0.0, 1.15 * max(times))
    axes.set_xlabel("time in one step [ms], kernels launched one by one")
    axes.tick_params(axis="y", labelsize=8)
    axes.spines[["top", "right"]].set_visible(False)
    captured, total = step["ms_per_step"], step["kernels_sum_ms"]
    title = f"{step['world']}, {step['num_envs']} environments: captured step {captured:.3g} ms, kernels {total:.3g} ms"
    axes.set_title(title, fontsize=9, loc="left")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=150)
    pyplot.close(figure)


if __name__ == "__main__":
    runner.main("profile", cases, Options)
