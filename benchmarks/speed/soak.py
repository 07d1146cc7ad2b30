"""A long run: does memory stay where it is, and does a step stay as fast as it was?

``python -m benchmarks.speed.soak --device cuda --out benchmarks/results/soak.json``: 100,000 steps of 64 environments,
random actions and new episodes all along, nothing read back but at the end of a window of steps. A run that was
stopped goes on where it was when it is given the same file again.

A row a window, and a last one with the verdict: slopes by least squares over all windows but the first tenth of each
process, an own level for each process, Student's t for the interval. Windows count as independent of each other.
"""

from __future__ import annotations

import json
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import warp as wp
from scipy import stats

from agents import files
from agents.intervals import Estimate
from benchmarks import runner
from benchmarks.speed import timing
from benchmarks.speed.vector import Stepper, make_task
from piavatar_envs.envs.batch_env import BatchEnv

#: Growth over the whole run up to which a quantity counts as flat: device and host memory [MB], time of a step (share).
FLAT = {"device_mb": 2.0, "host_mb": 16.0, "ms_per_step": 0.02}
WARM_UP_SHARE = 0.1  # of the windows of a process: caches fill, clocks settle


@dataclass(frozen=True)
class Options(runner.Options):
    """Options of the long run."""

    #: an id, or a module of piavatar_envs.multi
    world: str = "PIAvatar/Reach-v0"
    #: control steps of every environment
    steps: int = 100_000
    #: environments
    num_envs: int = 64
    #: steps between two samples
    window: int = 1000
    #: resolution of the bodies
    fidelity: str = "coarse"


def cases(options: Options) -> Iterator[dict[str, Any]]:
    """Yield a row for each window, and the verdict.

    Raises:
        ValueError: the file to go on with is of another run.
    """
    samples = resumed(options)
    yield from samples
    done = samples[-1]["steps"] if samples else 0
    if done < options.steps:
        process = samples[-1]["process"] + 1 if samples else 0
        for row in run(options, done, process):
            samples.append(row)
            yield row
    yield verdict(samples, options.steps)


def resumed(options: Options) -> list[dict[str, Any]]:
    """Return the windows of a run that was stopped, from its file; none if there is no such file.

    Raises:
        ValueError: it is of another commit, another device or other options.
    """
    if options.out is None or not options.out.exists():
        return []
    report = json.loads(options.out.read_text(encoding="utf-8"))
    if report["complete"]:
        return []
    wanted = {key: value for key, value in asdict(options).items() if key not in ("out", "device")}
    now = files.describe_run("soak", options.device) | {"options": files.plain(wanted, "options")}
    for key in ("benchmark", "commit", "device", "options"):
        if report.get(key) != now[key]:
            raise ValueError(
                f"{options.out} holds a run with {key}={report.get(key)}, this one has {now[key]}; "
                f"give another --out, or remove the file"
            )
    return [row for row in report["results"] if row["case"] != "verdict"]


def run(options: Options, done: int, process: int) -> Iterator[dict[str, Any]]:
    """Step on from ``done`` steps, in the ``process``-th process of this run, and yield a row for each window."""
    batch = BatchEnv(make_task(options.world, options.fidelity), options.num_envs, options.device, seed=done)
    batch.reset()
    stepper = Stepper(batch)
    stepper.step()  # captures the graphs
    windows = range(done, options.steps, options.window)
    for start in runner.progress(windows, "soak"):
        steps = min(options.window, options.steps - start)
        wp.synchronize_device(options.device)
        clock = time.perf_counter()
        for _ in range(steps):
            stepper.step()
        wp.synchronize_device(options.device)
        seconds = time.perf_counter() - clock
        used = timing.device_bytes(options.device)
        yield {
            "case": f"steps {start} to {start + steps}",
            "steps": start + steps,
            "process": process,
            "ms_per_step": 1e3 * seconds / steps,
            "device_mb": None if used is None else used / 1e6,
            "arrays_mb": timing.array_bytes(options.device) / 1e6,
            "host_mb": timing.resident_bytes() / 1e6,
            "failed_envs": int(stepper.failed.numpy()[0]),
        }


def verdict(samples: Sequence[dict[str, Any]], steps: int) -> dict[str, Any]:
    """Return growth over ``steps`` steps, with 95 % intervals: of memory [MB], and of the step's time as a share."""
    kept = [row for process in {row["process"] for row in samples} for row in _settled(samples, process)]
    row: dict[str, Any] = {"case": "verdict", "steps": steps, "windows": len(samples), "windows_used": len(kept)}
    decisions = {}
    for name, limit in FLAT.items():
        values = [sample[name] for sample in kept]
        if not values or None in values:
            continue
        level = float(np.median(values))
        found = slope([s["steps"] for s in kept], values, [s["process"] for s in kept])
        scale = steps / level if name == "ms_per_step" else float(steps)
        growth = None if found is None else [scale * value for value in (found.mean, found.low, found.high)]
        decisions[name] = _decide(growth, limit)
        row |= {name: level, f"{name}_growth": growth, f"{name}_limit": limit, f"{name}_verdict": decisions[name]}
    last = {sample["process"]: sample["failed_envs"] for sample in samples}
    flat = all(decision == "flat" for decision in decisions.values())
    bad = any(decision == "grows" for decision in decisions.values())
    return row | {"failed_envs": sum(last.values()), "verdict": "flat" if flat else "grows" if bad else "undecided"}


def slope(steps: Sequence[float], values: Sequence[float], process: Sequence[int]) -> Estimate | None:
    """Return growth per step by least squares, with a level for each process; None with too few samples."""
    x, y, groups = np.asarray(steps, float), np.asarray(values, float), np.asarray(process)
    for group in np.unique(groups):
        own = groups == group
        x[own] -= x[own].mean()
        y[own] -= y[own].mean()
    freedom = len(x) - len(np.unique(groups)) - 1
    spread = float((x**2).sum())
    if freedom < 1 or spread == 0.0:
        return None
    mean = float((x * y).sum()) / spread
    error = np.sqrt(((y - mean * x) ** 2).sum() / freedom / spread)
    return Estimate(mean, float(stats.t.ppf(0.975, freedom) * error))


def _settled(samples: Sequence[dict[str, Any]], process: int) -> list[dict[str, Any]]:
    """Return the windows of a process without its first tenth."""
    own = [row for row in samples if row["process"] == process]
    return own[int(np.ceil(WARM_UP_SHARE * len(own))) :]


def _decide(growth: Sequence[float] | None, limit: float) -> str:
    """Return ``flat`` if the growth is surely below the limit, ``grows`` if surely above it, else ``undecided``."""
    if growth is None:
        return "undecided"
    _, low, high = growth
    return "flat" if high < limit else "grows" if low > limit else "undecided"


if __name__ == "__main__":
    runner.main("soak", cases, Options)
