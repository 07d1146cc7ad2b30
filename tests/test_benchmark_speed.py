"""The benchmarks of speed measure what they say: counts and trends against theory, and every command as a smoke run."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import warp as wp

from agents import files
from benchmarks import runner
from benchmarks.speed import profile, soak, timing, vector
from piavatar_envs.core.launch_graph import LaunchGraph
from piavatar_envs.envs.batch_env import BatchEnv
from piavatar_envs.mpm.types import FAILURE_CFL

RUNS = {
    "vector.json": (vector, ["--fidelity", "tiny", "--num-envs", "1", "3", "--seconds", "0.01", "--repeats", "2"]),
    "profile_reach.json": (profile, ["--fidelity", "tiny", "--num-envs", "2", "--repeats", "2"]),
    "profile_stand.json": (
        profile,
        ["--case", "PIAvatar/Stand-v0", "--fidelity", "tiny", "--num-envs", "2", "--repeats", "1"],
    ),
    "profile_projection.json": (
        profile,
        ["--case", "PIAvatar/Stand-v0", "--fidelity", "tiny", "--num-envs", "2", "--repeats", "1"]
        + ["--settings", "control.bone_contact=false"],
    ),
    "soak.json": (soak, ["--fidelity", "tiny", "--num-envs", "2", "--steps", "50", "--window", "5"]),
}


@pytest.fixture(scope="module")
def results(tmp_path_factory, device: str) -> Path:
    """A folder with the results of all benchmarks, each a smoke run."""
    folder = tmp_path_factory.mktemp("results")
    for file, (module, arguments) in RUNS.items():
        name = module.__name__.rpartition(".")[2]
        arguments = [*arguments, "--out", str(folder / file), "--device", device]
        report = runner.main(name, module.cases, module.Options, arguments)
        assert json.loads((folder / file).read_text()) == report and report["complete"]
        assert len({(row["case"], row.get("num_envs")) for row in report["results"]}) == len(report["results"])
    shutil.copy(folder / "vector.json", folder / "vector_cpu.json")
    return folder


def rows_of(results: Path, file: str) -> list[dict]:
    return json.loads((results / file).read_text())["results"]


# --- clocks ----------------------------------------------------------------------------------------------------------


def test_times_of_kernels_name_every_kernel(device: str):
    graph = LaunchGraph(device)
    clock, action = wp.zeros(1, dtype=int, device=device), wp.zeros((4, 1, 3), dtype=float, device=device)
    for _ in range(3):
        graph.launch(vector.draw_actions, action.shape, [clock], [action])
    graph.launch(vector.advance_clock, 1, [], [clock])
    found = timing.kernel_times(graph, repeats=2)
    assert set(found) == {"draw_actions", "advance_clock"} and all(kernel.ms >= 0.0 for kernel in found.values())
    assert found["draw_actions"].launches in (3, None)
    assert clock.numpy()[0] == 2


def test_memory_in_use_grows_by_what_is_allocated(device: str):
    before = timing.array_bytes(device)
    array = wp.zeros(250_000, dtype=wp.vec4, device=device)
    assert timing.array_bytes(device) - before == pytest.approx(4e6, rel=0.1)
    del array
    assert timing.array_bytes(device) == pytest.approx(before, abs=1e5)


# --- batches ---------------------------------------------------------------------------------------------------------


def test_vector_as_a_smoke_run(results: Path, device: str):
    rows = rows_of(results, "vector.json")
    batches = [row for row in rows if row["case"] != "cpu_scaling"]
    assert [(row["case"], row["num_envs"]) for row in batches] == [(w, n) for w in vector.WORLDS for n in (1, 3)]
    for row in batches:
        assert row["refused"] is None and row["failed_envs"] == 0 and row["mb_per_env"] > 0.0
        product = row["env_steps_per_s"] * row["particles"] * row["substeps"]
        assert row["particle_substeps_per_s"] == pytest.approx(product)
        assert row["ms_per_step"] * row["env_steps_per_s"] == pytest.approx(1e3 * row["num_envs"])
        assert min(row["step_only"], row["with_autoreset"]) > 0.0
    if wp.get_device(device).is_cpu:
        (scaling,) = (row for row in rows if row["case"] == "cpu_scaling")
        assert scaling["speed_up"] > 0.0


@pytest.fixture
def batch(device: str) -> BatchEnv:
    batch = BatchEnv(vector.make_task("PIAvatar/Reach-v0", "tiny"), 3, device)
    batch.reset()
    return batch


def test_random_actions_fill_the_range_and_never_repeat(batch: BatchEnv):
    stepper = vector.Stepper(batch)
    seen = []
    for _ in range(8):
        stepper.step_only()
        seen.append(batch.action.numpy().copy())
    values = np.concatenate([action.ravel() for action in seen])
    assert values.min() >= -1.0 and values.max() <= 1.0
    assert values.mean() == pytest.approx(0.0, abs=4.0 / np.sqrt(3.0 * values.size))
    assert values.std() == pytest.approx(1.0 / np.sqrt(3.0), rel=0.1)
    assert len(np.unique(values)) > 0.99 * values.size


def test_episodes_that_end_begin_anew_and_failures_are_counted(batch: BatchEnv):
    stepper = vector.Stepper(batch)
    stepper.step()
    batch.step_count.assign(np.array([1, batch.max_steps - 1, 1], np.int32))
    stepper.step()
    stepper.step()
    assert batch.step_count.numpy().tolist() == [3, 1, 3] and stepper.failed.numpy()[0] == 0
    batch.failure.assign(np.array([0, 0, FAILURE_CFL], np.int32))
    stepper.step()  # ends the episode
    stepper.step()
    assert stepper.failed.numpy()[0] == 1
    assert batch.step_count.numpy().tolist() == [5, 3, 1] and not batch.failure.numpy().any()


def test_a_batch_that_is_refused_says_why_and_ends_its_world(monkeypatch, device: str):
    def refuse(*_args, **_kwargs):
        raise ValueError("8192 environments need 200 GiB; use num_envs <= 4096")

    monkeypatch.setattr(vector, "BatchedEpisodes", refuse)
    options = vector.Options(worlds=vector.WORLDS[:2], num_envs=(4, 8), fidelity="tiny", device=device)
    monkeypatch.setattr(vector, "scaling", lambda *_: {"case": "cpu_scaling"})
    rows = [row for row in vector.cases(options) if row["case"] != "cpu_scaling"]
    assert [(row["case"], row["num_envs"]) for row in rows] == [(world, 4) for world in vector.WORLDS[:2]]
    assert all("4096" in row["refused"] and row["env_steps_per_s"] is None for row in rows)


# --- a long run ------------------------------------------------------------------------------------------------------


def test_soak_as_a_smoke_run(results: Path, device: str):
    *windows, verdict = rows_of(results, "soak.json")
    assert [row["steps"] for row in windows] == list(range(5, 51, 5))
    assert verdict["case"] == "verdict" and verdict["windows"] == 10 and verdict["failed_envs"] == 0
    assert verdict["verdict"] in ("flat", "grows", "undecided")
    arrays = {row["arrays_mb"] for row in windows}
    assert max(arrays) - min(arrays) < 0.01, "a step allocates"


def test_a_long_run_goes_on_where_it_was_stopped(tmp_path: Path, device: str):
    out = tmp_path / "soak.json"
    arguments = ["--fidelity", "tiny", "--num-envs", "1", "--steps", "6", "--window", "2", "--device", device]
    arguments += ["--out", str(out)]
    report = runner.main("soak", soak.cases, soak.Options, arguments)
    files.write_json(out, report | {"complete": False, "results": report["results"][:2]})
    again = runner.main("soak", soak.cases, soak.Options, arguments)
    assert again["results"][:2] == report["results"][:2]
    assert [(row["steps"], row["process"]) for row in again["results"][:-1]] == [(2, 0), (4, 0), (6, 1)]
    files.write_json(out, report | {"complete": False, "results": report["results"][:2]})
    with pytest.raises(ValueError, match="options"):
        runner.main("soak", soak.cases, soak.Options, [*arguments, "--steps", "8"])


def test_slopes_of_known_lines():
    steps, rng = np.arange(1.0, 41.0), np.random.default_rng(0)
    process = np.repeat([0, 1], 20)
    level = np.where(process == 0, 5.0, 90.0)  # another process starts elsewhere
    exact = soak.slope(steps, level + 0.25 * steps, process)
    assert exact.mean == pytest.approx(0.25) and exact.half_width < 1e-9
    inside = 0
    for _ in range(200):
        found = soak.slope(steps, level + 0.25 * steps + rng.normal(0.0, 1.0, 40), process)
        inside += found.low <= 0.25 <= found.high
    assert 180 <= inside <= 199  # of 95 %
    assert soak.slope([1.0, 2.0], [1.0, 1.0], [0, 0]) is None


@pytest.mark.parametrize(
    ("growth", "expected"), [(0.0, "flat"), (30.0, "grows"), (16.0, "undecided"), (None, "undecided")]
)
def test_verdict_on_memory_of_the_host(growth: float | None, expected: str):
    rng, samples = np.random.default_rng(1), []
    for index in range(2 if growth is None else 50):
        host = 300.0 + (growth or 0.0) * index / 50 + rng.normal(0.0, 1.0)
        samples.append({"steps": index + 1, "process": 0, "ms_per_step": 2.0, "device_mb": None, "host_mb": host})
        samples[-1]["failed_envs"] = 0
    found = soak.verdict(samples, 50)
    assert found["host_mb_verdict"] == found["verdict"] == expected


# --- profile and tables ----------------------------------------------------------------------------------------------


def test_profile_as_a_smoke_run(results: Path):
    step, *kernels = rows_of(results, "profile_reach.json")
    assert step["case"] == profile.STEP and step["failed_envs"] == 0 and step["ms_per_step"] > 0.0
    assert sum(row["share"] for row in kernels) == pytest.approx(1.0)
    assert (results / "profile_reach.png").stat().st_size > 10_000
