"""When each kernel of a captured control step begins and ends, and what goes beside what; on a CUDA GPU.

``python -m benchmarks.trace --device cuda --case 300000x4 --out trace.json`` writes a row a kernel of a world of
``benchmarks.substep``, and draws ``trace.png`` beside it. The program runs as it is captured, with branches beside each
other. What tells the times is torch's profiler (CUPTI): a control step of 28.1 ms took 28.2 to 28.3 with it.
"""

from __future__ import annotations

import importlib.util
import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import warp as wp

from benchmarks import runner, substep, timing
from benchmarks.crowd import SMALL, Crowd, Scale
from piavatar_envs.mpm.program import Program

STEP = "control step"  # the first row
WARM_UP = 4  # control steps before the one that is traced


@dataclass(frozen=True)
class Options(runner.Options):
    """Options of the trace."""

    #: a world of benchmarks.substep, such as 10475x4; the largest if not given
    case: str | None = None
    #: what part of the control step is drawn, from its middle on [us]
    shown: float = 600.0
    #: a smoke run: small bodies on a coarse grid, few substeps; its figures mean nothing
    small: bool = False


@dataclass(frozen=True)
class Span:
    """A launch: its kernel, its begin and its end since the first one's begin [us]."""

    kernel: str
    begin: float
    end: float


def cases(options: Options) -> Iterator[dict[str, Any]]:
    """A row for the control step, and one for each kernel, the one that takes longest first; then the picture.

    Raises:
        ValueError: there is no such case, the device is no CUDA GPU, or a body has failed.
    """
    if not wp.get_device(options.device).is_cuda:
        raise ValueError(f"device={options.device!r} has no kernels that could be traced; use --device cuda")
    scale = SMALL if options.small else Scale()
    worlds = substep.worlds(scale)
    name = options.case or list(worlds)[-1]
    if name not in worlds:
        raise ValueError(f"case={name!r}: the cases are {', '.join(worlds)}")
    make_body, points, count = worlds[name]
    crowd = Crowd(*make_body(points), count, scale, options.device)
    for n in range(WARM_UP):
        crowd.command(1 if n % 2 else -1)
        crowd.once.run()
    spans = traced(crowd.once)
    if crowd.failure:
        raise ValueError(f"a body of {name} has failed: {crowd.failure}")
    yield from rows_of(spans, name)
    if options.out is not None and importlib.util.find_spec("matplotlib") is not None:
        draw(spans, f"{name}: what a GPU does at once", options.shown, options.out.with_suffix(".png"))


def traced(program: Program) -> list[Span]:
    """The launches of one run of a program on a GPU, in the order in which they begin.

    Should be the last that a process does there: closing CUPTI and CUDA graphs do not always go together, as torch says
    of its ``TEARDOWN_CUPTI``.
    """
    import torch

    wp.synchronize_device(program.device)
    with torch.profiler.profile(activities=[torch.profiler.ProfilerActivity.CUDA]) as profiler:
        program.run()
        wp.synchronize_device(program.device)
    with TemporaryDirectory() as folder:
        path = Path(folder) / "trace.json"
        profiler.export_chrome_trace(str(path))
        return spans_of(json.loads(path.read_text())["traceEvents"])


def spans_of(events: Sequence[dict[str, Any]]) -> list[Span]:
    """The kernels among the events of a Chrome trace.

    Raises:
        ValueError: there is none.
    """
    kernels = sorted((e for e in events if e.get("cat") == "kernel"), key=lambda e: e["ts"])
    if not kernels:
        raise ValueError("the trace has no kernels: has another profiler taken CUPTI? Close it and run again")
    first = kernels[0]["ts"]
    names = [timing.HASH.sub("", e["name"].partition("_cuda_kernel_")[0]) for e in kernels]
    return [Span(n, e["ts"] - first, e["ts"] + e["dur"] - first) for n, e in zip(names, kernels, strict=True)]


def rows_of(spans: Sequence[Span], case: str) -> list[dict[str, Any]]:
    """The row of the control step, then those of its kernels."""
    names = dict.fromkeys(span.kernel for span in spans)
    kernels = [
        {
            "case": name,
            "launches": len(own := [span for span in spans if span.kernel == name]),
            "sum_us": sum(span.end - span.begin for span in own),
            "begins_us": [span.begin for span in own],
            "ends_us": [span.end for span in own],
        }
        for name in names
    ]
    step = {"case": STEP, "world": case, "launches": len(spans), "span_us": max(span.end for span in spans)}
    return [step, *sorted(kernels, key=lambda row: -row["sum_us"])]


def draw(spans: Sequence[Span], title: str, microseconds: float, path: Path) -> None:
    """Bars of the launches from the middle on, a line a kernel, those that begin first on top. Needs matplotlib."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    middle = 0.5 * max(span.end for span in spans)
    shown = [span for span in spans if span.end > middle and span.begin < middle + microseconds]
    names = list(dict.fromkeys(span.kernel for span in shown))
    figure, axes = pyplot.subplots(figsize=(10.0, 0.9 + 0.3 * len(names)), layout="constrained")
    for span in shown:
        line, others = names.index(span.kernel), [s for s in shown if s.kernel == span.kernel and s.begin < span.begin]
        high = 0.2 if any(other.end > span.begin for other in others) else -0.2  # beside another of the same kernel
        axes.barh(line + high, span.end - span.begin, 0.38, span.begin - middle, color="#1b7f79", edgecolor="white")
    axes.set_yticks(range(len(names)), names, fontsize=8)
    axes.invert_yaxis()
    axes.set_xlim(0.0, microseconds)
    axes.set_xlabel(f"time since {1e-3 * middle:.3g} ms after the control step began [us]")
    axes.grid(axis="x", alpha=0.3)
    axes.spines[["top", "right"]].set_visible(False)
    axes.set_title(title, fontsize=9, loc="left")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=150)
    pyplot.close(figure)


if __name__ == "__main__":
    runner.main("trace", cases, Options)
