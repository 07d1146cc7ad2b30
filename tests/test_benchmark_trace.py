"""The trace of a control step: what is made of a profiler's events, and what is refused."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks import runner, trace


def event(name: str, begin: float, duration: float, cat: str = "kernel") -> dict:
    return {"cat": cat, "name": name, "ts": begin, "dur": duration}


EVENTS = [
    event("update_grid_b908d956_cuda_kernel_forward", 130.0, 20.0),
    event("cudaGraphLaunch", 90.0, 500.0, "cuda_runtime"),
    event("find_facing_57c414fa_cuda_kernel_forward", 130.5, 10.0),
    event("momenta_to_grid_21c03926_cuda_kernel_forward", 100.0, 25.0),
    event("momenta_to_grid_21c03926_cuda_kernel_forward", 110.0, 19.0),
    {"name": "process_name", "ph": "M"},
]


def test_spans_are_the_kernels_from_the_first_on():
    assert trace.spans_of(EVENTS) == [
        trace.Span("momenta_to_grid", 0.0, 25.0),
        trace.Span("momenta_to_grid", 10.0, 29.0),
        trace.Span("update_grid", 30.0, 50.0),
        trace.Span("find_facing", 30.5, 40.5),
    ]
    with pytest.raises(ValueError, match="no kernels"):
        trace.spans_of(EVENTS[1:2])


def test_rows_tell_of_each_kernel(tmp_path):
    step, *kernels = trace.rows_of(trace.spans_of(EVENTS), "300000x4")
    assert step == {"case": trace.STEP, "world": "300000x4", "launches": 4, "span_us": 50.0}
    assert [row["case"] for row in kernels] == ["momenta_to_grid", "update_grid", "find_facing"]
    assert kernels[0] == {
        "case": "momenta_to_grid", "launches": 2, "sum_us": 44.0, "begins_us": [0.0, 10.0], "ends_us": [25.0, 29.0]
    }  # fmt: skip
    for row in (step, *kernels):
        runner.plain(row, row["case"])
    pytest.importorskip("matplotlib")
    trace.draw(trace.spans_of(EVENTS), "a control step", 600.0, tmp_path / "trace.png")
    assert (tmp_path / "trace.png").stat().st_size > 5_000


def test_what_cannot_be_traced_is_refused():
    with pytest.raises(ValueError, match="use --device cuda"):
        next(trace.cases(trace.Options(device="cpu")))


def test_a_small_world_is_traced(device, tmp_path):
    """In a process of its own, which launches no graphs for other tests afterwards."""
    if not device.startswith("cuda"):
        pytest.skip("only a GPU's kernels are traced")
    out = tmp_path / "trace.json"
    command = [sys.executable, "-m", "benchmarks.trace", "--device", device, "--small", "--out", str(out)]
    subprocess.run(command, check=True, cwd=Path(trace.__file__).parents[1])
    step, *kernels = json.loads(out.read_text())["results"]
    assert step["launches"] == sum(row["launches"] for row in kernels) > 10 and out.with_suffix(".png").exists()
