"""Time of a substep at the paper's scale: 200^3 nodes, 10,475 or 300,000 particles a body, one body or four at once.

``python -m benchmarks.substep --device cuda --out benchmarks/results/substep.json``. All stages of the split scheme
with a velocity field a body, a floor, contact and its sensors; drive and tracking once in the 100 substeps of a
captured program, which is timed as a whole. The bodies move and touch, and a run that fails has no time.
"""

from __future__ import annotations

import gc
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from benchmarks import roofline, runner, timing
from benchmarks.crowd import SMALL, Crowd, Scale, interior_body, skin_body
from piavatar_envs.avatar.body import BodyPoints
from piavatar_envs.mpm.program import Program

AVATARS = (1, 4)
#: What the paper prints for an RTX 4090, all stages [ms a substep]; four bodies of 10,475 are its 41,900 particles.
PAPER_MS = {"10475x1": 0.492, "10475x4": 1.436, "300000x1": 3.764, "300000x4": 15.259}
#: Its memory [GB]: of the first body's kind, and what each avatar adds.
PAPER_GB = {"10475": 3.8, "300000": 5.4}
PAPER_GB_AVATAR = 0.122
#: Its loop rebuilt on a public solver, on an H200 under a CUDA graph, one velocity field [ms a substep].
REBUILT_MS = {"10475x1": 0.286, "10475x4": 0.888, "300000x1": 1.315, "300000x4": 4.564}
#: At most, on an H200: a fifteenth of that.
EXPECTED_MS = {"10475x1": 0.018, "10475x4": 0.045, "300000x1": 0.08, "300000x4": 0.28}
#: Scatters that add up in fixed point, and the same in floating point, which no run repeats bit for bit.
FLOATING = {name: f"{name}_float" for name in ("runs", "singles")}
STAGE_RUNS = 3  # control steps launched kernel by kernel
LEAST_MOTION = 1e-4  # mean way of the particles in the first control step that counts as moving [m]


@dataclass(frozen=True)
class Options(runner.Options):
    """Options of the substep benchmark."""

    #: timed control steps of 100 substeps
    repeats: int = 15
    #: control steps before them
    warm_up: int = 3
    #: cases by name, such as 10475x4; all if not given
    only: tuple[str, ...] = ()
    #: a smoke run: small bodies on a coarse grid, few substeps; its figures mean nothing
    small: bool = False
    #: also time the drive before every substep, as the environments have it
    full_drive: bool = True
    #: also time floating-point sums where the device's own way is fixed point: the price of runs that repeat
    float_sums: bool = True


def cases(options: Options) -> Iterator[dict[str, Any]]:
    """A row for each kind of body, alone and four at once.

    Raises:
        ValueError: ``only`` names a case that there is not.
    """
    scale = SMALL if options.small else Scale()
    jobs = worlds(scale)
    for name in options.only:
        if name not in jobs:
            raise ValueError(f"only={name!r}: the cases are {', '.join(jobs)}")
    for name in runner.progress([name for name in jobs if name in (options.only or jobs)], "substep"):
        make_body, points, count = jobs[name]
        body, volume = make_body(points)
        gc.collect()  # what the case before has left
        before = timing.array_bytes(options.device)
        crowd = Crowd(body, volume, count, scale, options.device)
        row = {"case": name} | measure(crowd, options, before) | references(name)
        del crowd
        other = FLOATING.get(row["scatter"]) if options.float_sums else None
        if other is not None:
            crowd = Crowd(body, volume, count, scale, options.device, other)
            times, _ = _control_steps(crowd, crowd.once, options, failures := [])
            row["ms_per_substep_float"] = None if any(failures) else float(np.median(times))
            del crowd  # or the next case would find its memory in use
        yield row


def worlds(scale: Scale) -> dict[str, tuple[Callable[[int], tuple[BodyPoints, np.ndarray]], int, int]]:
    """The cases by name: what makes the body, its particles, and how many of them there are."""
    bodies = ((skin_body, scale.skin), (interior_body, scale.interior))
    return {f"{points}x{count}": (make, points, count) for make, points in bodies for count in AVATARS}


def references(case: str) -> dict[str, float | None]:
    """What others need and what is expected, for a case of the paper's scale; None for others."""
    points, _, avatars = case.partition("x")
    memory = PAPER_GB.get(points)
    return {
        "paper_ms": PAPER_MS.get(case),
        "rebuilt_ms": REBUILT_MS.get(case),
        "expected_ms": EXPECTED_MS.get(case),
        "paper_memory_gb": memory and memory + int(avatars) * PAPER_GB_AVATAR,
    }


def measure(crowd: Crowd, options: Options, bytes_before: int) -> dict[str, Any]:
    """Everything about one world; ``bytes_before`` were in use before it was built."""
    model, steps = crowd.model, crowd.model.num_substeps
    start = crowd.state.x.numpy().copy()
    crowd.command(1)
    crowd.once.run()  # captures the graph
    moved = float(np.linalg.norm(crowd.state.x.numpy() - start, axis=2).mean())
    memory = timing.array_bytes(model.device) - bytes_before
    failures = [crowd.failure]
    milliseconds, touched = _control_steps(crowd, crowd.once, options, failures)
    launches = len(crowd.once) / steps
    counts = roofline.count(model, crowd.state)
    kernels = timing.kernel_times(crowd.once, STAGE_RUNS)
    failures.append(crowd.failure)
    full = np.median(_control_steps(crowd, crowd.each, options, failures)[0]) if options.full_drive else None
    failed = next(filter(None, failures), None) or _complaint(crowd, moved, touched)
    stages = {name: kernel.ms / steps for name, kernel in sorted(kernels.items(), key=lambda k: -k[1].ms)}
    return {
        "ms_per_substep": None if failed else float(np.median(milliseconds)),
        "failed": failed,
        "ms_per_substep_float": None,
        "ms_per_substep_range": [float(milliseconds.min()), float(milliseconds.max())],
        "ms_per_substep_full_drive": None if failed else full,
        "particles": model.num_particles,
        "avatars": crowd.count,
        "velocity_fields": model.contact.num_fields,
        "substeps": steps,
        "scatter": model.scatter,
        "nodes_of_the_grid": int(np.prod(np.asarray(model.grid.nodes))),
        "slots": model.max_slots,
        "cfl": model.sound_speed * model.step.dt / model.grid.dx,
        "mean_way_mm": 1e3 * moved,
        "touching_pairs": touched,
        "launches_per_substep": launches,
        "stages_ms": stages,
        "stages_sum_ms": sum(stages.values()),
        "memory_gb": memory / 1e9,
        "memory_of_the_device_gb": _in_gb(timing.device_bytes(model.device)),
        "roofline": roofline.bound(counts, launches),
    }


def _control_steps(
    crowd: Crowd, program: Program, options: Options, failures: list[str | None]
) -> tuple[np.ndarray, int]:
    """From the start, milliseconds a substep of each timed control step, and the most pairs that touched in one.

    What the simulation says of failures at the end is appended to ``failures``: a reset would forgive it.
    """
    seconds, touched = [], 0
    crowd.reset()
    for index in range(options.warm_up + options.repeats):
        crowd.command(1 if index % 2 else -1)
        seconds.append(timing.wall_times(crowd.model.device, program.run, 1))
        touched = max(touched, crowd.touching())
    failures.append(crowd.failure)
    return 1e3 * np.concatenate(seconds[options.warm_up :]) / crowd.model.num_substeps, touched


def _complaint(crowd: Crowd, moved: float, touched: int) -> str | None:
    """Why a run without failures does not count; None if it does."""
    if not moved > LEAST_MOTION:
        return f"the particles have moved by {moved:.1e} m only"
    if touched < crowd.count - 1:
        return f"{touched} of {crowd.count - 1} pairs of neighbours have touched"
    return None


def _in_gb(count: int | None) -> float | None:
    return None if count is None else count / 1e9


if __name__ == "__main__":
    runner.main("substep", cases, Options)
