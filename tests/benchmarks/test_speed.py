"""The benchmarks of speed as smoke runs: figures that fit each other, and runs that continue."""

from __future__ import annotations

import json
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from agents import files
from benchmarks import runner
from benchmarks.speed import cpu, plain_mpm, profile, soak, steps, vector
from piavatar_envs.envs.batch_env import BatchEnv
from piavatar_envs.mpm.types import FAILURE_CFL


def run(module: ModuleType, path: Path, device: str, *arguments: str) -> list[dict]:
    """Run a benchmark and return the rows that its file holds."""
    name = module.__name__.rpartition(".")[2]
    report = runner.main(name, module.cases, module.Options, [*arguments, "--out", str(path), "--device", device])
    assert json.loads(path.read_text()) == report and report["complete"]
    return report["results"]


def test_vector(tmp_path: Path, device: str):
    batches = ["--num-envs", "1", "3", "--seconds", "0.01", "--repeats", "2"]
    rows = run(vector, tmp_path / "vector.json", device, "--fidelity", "tiny", *batches)
    batches = [row for row in rows if row["case"] != "cpu_scaling"]
    assert [(row["case"], row["num_envs"]) for row in batches] == [(w, n) for w in vector.WORLDS for n in (1, 3)]
    for row in batches:
        assert row["refused"] is None and row["failed_envs"] == 0 and row["mb_per_env"] > 0.0
        product = row["env_steps_per_s"] * row["particles"] * row["substeps"]
        assert row["particle_substeps_per_s"] == pytest.approx(product)
        assert min(row["step_only"], row["with_autoreset"]) > 0.0


def test_episodes_that_end_begin_anew_and_failures_are_counted(device: str):
    batch = BatchEnv(vector.make_task("PIAvatar/Reach-v0", "tiny"), 3, device)
    batch.reset()
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


def test_profile(tmp_path: Path, device: str):
    small = ["--fidelity", "tiny", "--num-envs", "2", "--repeats", "2"]
    step, *kernels = run(profile, tmp_path / "profile.json", device, *small)
    assert step["case"] == profile.STEP and step["failed_envs"] == 0 and step["ms_per_step"] > 0.0
    assert sum(row["share"] for row in kernels) == pytest.approx(1.0)
    assert (tmp_path / "profile.png").stat().st_size > 10_000


def test_a_long_run_continues_where_it_was_stopped(tmp_path: Path, device: str):
    out = tmp_path / "soak.json"
    small = ["--fidelity", "tiny", "--num-envs", "1", "--steps", "6", "--window", "2"]
    first = run(soak, out, device, *small)
    assert first[-1]["case"] == "verdict" and first[-1]["failed_envs"] == 0
    arrays = {row["arrays_mb"] for row in first[:-1]}
    assert max(arrays) - min(arrays) < 0.01, "a step allocates"
    files.write_json(out, json.loads(out.read_text()) | {"complete": False, "results": first[:2]})
    again = run(soak, out, device, *small)
    assert again[:2] == first[:2]
    assert [(row["steps"], row["process"]) for row in again[:-1]] == [(2, 0), (4, 0), (6, 1)]
    files.write_json(out, json.loads(out.read_text()) | {"complete": False, "results": first[:2]})
    with pytest.raises(ValueError, match="options"):
        run(soak, out, device, *small, "--steps", "8")


def test_cpu(tmp_path: Path, monkeypatch):
    monkeypatch.setattr(cpu, "ENVIRONMENTS", {"PIAvatar/Reach-v0": 10})
    reach, stages = run(cpu, tmp_path / "cpu.json", "cpu", "--quick")
    product = reach["env_steps_per_s"] * reach["particles"] * reach["substeps"] * reach["us_per_particle_substep"]
    assert product == pytest.approx(1e6) and 0.0 < reach["cfl"] <= 0.5
    assert set(cpu.CONTINUUM) <= set(stages["stages_ms"]), "a kernel was renamed; name it in cpu.CONTINUUM"


def test_steps(tmp_path: Path, device: str):
    (one,) = run(steps, tmp_path / "steps.json", device, "--small", "--avatars", "1")
    batch, several = (steps.measure("tiny", avatars, count, device, 2, 1) for avatars, count in ((1, 2), (4, 1)))
    assert [row["through"].partition(",")[0] for row in (one, batch, several)] == [
        "gym.make",
        "gym.make_vec",
        "sumo_v0.parallel_env",
    ]
    for row, num_envs in ((one, 1), (batch, 2), (several, 1)):
        assert row["ms_per_step"] == pytest.approx(row["ms_per_substep"] * row["substeps"])
        assert row["ms_per_step"] * row["env_steps_per_s"] == pytest.approx(1e3 * num_envs)
        assert min(row["first_make_s"], row["arrays_mb"]) > 0.0 and row["failed_envs"] == 0
    assert several["particles"] == 4 * one["particles"]


def test_the_plain_method_falls_as_gravity_says(device: str):
    x = plain_mpm.boxes(500, plain_mpm.SIZE / 32)
    method = plain_mpm.WarpMPM(x, 32, device, substeps=50)
    method.run()
    before = method.positions().copy()
    method.run()
    # n substeps from rest at semi-implicit steps: g dt^2 n (n + 1) / 2; a GPU has run once more before the capture
    runs = (1, 2) if device == "cpu" else (2, 3)
    fall = [plain_mpm.GRAVITY * plain_mpm.DT**2 * n * (n + 1) / 2.0 for n in (50 * count for count in runs)]
    moved = (before - method.positions())[:, 2].mean()
    assert moved == pytest.approx(fall[1] - fall[0], rel=1e-2)
