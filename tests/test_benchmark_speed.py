"""The benchmarks of speed measure what they say: counts and trends against theory, and every command as a smoke run."""

from __future__ import annotations

import json
import shutil
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import warp as wp

from benchmarks import crowd, performance, profile, roofline, runner, soak, substep, timing, vector
from piavatar_envs.avatar.asset import load_body, mesh_volume
from piavatar_envs.avatar.surface import ClosedSurface
from piavatar_envs.envs.batch_env import BatchEnv
from piavatar_envs.mpm.build import MaterialPoints, build_model, make_grid
from piavatar_envs.mpm.fields import Fields
from piavatar_envs.mpm.memory import allocate
from piavatar_envs.mpm.program import Program
from piavatar_envs.mpm.types import FAILURE_CFL

RUNS = {
    "substep.json": (substep, ["--small", "--repeats", "2", "--warm-up", "1"]),
    "vector.json": (vector, ["--fidelity", "tiny", "--num-envs", "1", "3", "--seconds", "0.01", "--repeats", "2"]),
    "profile_reach.json": (profile, ["--fidelity", "tiny", "--num-envs", "2", "--repeats", "2"]),
    "profile_stand.json": (
        profile,
        ["--case", "PIAvatar/Stand-v0", "--fidelity", "tiny", "--num-envs", "2", "--repeats", "1"],
    ),
    "profile_projection.json": (
        profile,
        ["--case", "PIAvatar/Stand-v0", "--fidelity", "tiny", "--num-envs", "2", "--repeats", "1"]
        + ["--settings", "drive.bone_contact=false"],
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


# --- bodies ----------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def skin() -> tuple[ClosedSurface, float]:
    body = load_body().mean_body()
    return ClosedSurface(body.vertices, load_body().faces), mesh_volume(body.vertices, load_body().faces)


def test_particles_on_the_skin_lie_on_it_evenly_and_weigh_what_the_body_weighs(skin):
    points, volume = crowd.skin_body(3000)
    surface, total = skin
    assert points.num_points == len(volume) == 3000
    assert np.abs(surface.distance(points.rest[0])).max() < 1e-4
    assert volume.sum() == pytest.approx(total, rel=1e-4) and np.ptp(volume) == 0.0
    assert points.mass.sum() == pytest.approx(1000.0 * total, rel=1e-4)
    np.testing.assert_allclose(points.skin_weights.sum(1), 1.0, atol=1e-5)
    body = load_body().mean_body()
    corners = body.vertices[load_body().faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    for axis in range(3):
        # as much of the skin's area as of the particles is below any height; triangles are small
        for cut in np.quantile(points.rest[0, :, axis], [0.1, 0.5, 0.9]):
            share = area[corners[:, :, axis].mean(1) < cut].sum() / area.sum()
            assert (points.rest[0, :, axis] < cut).mean() == pytest.approx(share, abs=0.015)


def test_particles_inside_are_as_many_as_asked_for_and_fill_the_body(skin):
    points, volume = crowd.interior_body(700)
    surface, total = skin
    assert points.num_points == 700 and surface.distance(points.rest[0]).max() < 0.0
    assert volume.sum() == pytest.approx(total, rel=1e-4)
    with pytest.raises(ValueError, match="440 bone particles"):
        crowd.interior_body(440)


@pytest.mark.parametrize("body", [crowd.skin_body, crowd.interior_body])
def test_every_bone_is_tracked_by_particles_that_spread(body):
    points, _ = body(1000)
    for bone in range(22):
        own = points.rest[0][points.bone == bone]
        assert len(own) == crowd.TRACKERS
        assert np.linalg.matrix_rank(own - own.mean(0), tol=1e-4) == 3


def test_a_queue_stands_as_close_as_it_should():
    lattice = np.stack(np.meshgrid(*[np.arange(4) * 0.1] * 3, indexing="ij"), -1).reshape(-1, 3)
    assert crowd.queue_step(lattice, 0.02) == pytest.approx(0.32, abs=0.002)


# --- the bound -------------------------------------------------------------------------------------------------------


def one_world(positions: np.ndarray, field: list[int], device: str, num_envs: int = 1):
    points = replace(MaterialPoints.uniform(np.full(len(field), 1e-6)), field=np.array(field))
    grid = make_grid((0.0, 0.0, 0.0), (2.0, 2.0, 2.0), 0.1)
    model = build_model(points, grid, num_envs=num_envs, device=device, fields=Fields(tuple(range(max(field) + 1))))
    state, _ = allocate(model)
    state.x.assign(np.broadcast_to(positions.astype(np.float32), (num_envs, *positions.shape)).copy())
    return model, state


def test_counts_of_a_few_particles(device: str):
    # nodes start at -0.2: this particle's stencil is nodes 4 to 6 along each axis, in one block
    model, state = one_world(np.array([[0.3, 0.3, 0.3]]), [0], device)
    assert roofline.count(model, state) == roofline.Counts(1, 1, 27, 1, 0)
    # nodes 3 to 5 along x: two blocks
    model, state = one_world(np.array([[0.2, 0.3, 0.3]]), [0], device)
    assert roofline.count(model, state) == roofline.Counts(1, 1, 27, 2, 0)
    # two of a field in one cell, one of another field a cell further: 18 nodes in common
    positions = np.array([[0.3, 0.3, 0.3], [0.31, 0.3, 0.3], [0.4, 0.3, 0.3]])
    model, state = one_world(positions, [0, 0, 1], device)
    assert roofline.count(model, state) == roofline.Counts(3, 2, 54, 1, 18)
    model, state = one_world(positions, [0, 0, 1], device, num_envs=6)
    assert roofline.count(model, state, most_envs=2) == roofline.Counts(18, 12, 324, 6, 108)


def test_the_bound_is_the_largest_of_four_times():
    counts = roofline.Counts(particles=1000, cells=100, nodes=2000, blocks=50, shared_nodes=0)
    peaks = roofline.Peaks("a device", bandwidth=1e9, flops=1e9, additions=1e6, launch=1e-6)
    found = roofline.bound(counts, 5.0, peaks)
    assert found["bytes"] == 1000 * 244 + 2000 * 128 and found["additions"] == 2700
    assert found["memory_us"] == pytest.approx(500.0) and found["launch_us"] == pytest.approx(5.0)
    assert found["additions_us"] == pytest.approx(2700.0)
    assert found["bound_by"] == "additions" and found["bound_ms"] == pytest.approx(2.7)
    assert roofline.bound(counts, 5e4, peaks)["bound_by"] == "launch"


# --- clocks ----------------------------------------------------------------------------------------------------------


def test_times_of_kernels_name_every_kernel(device: str):
    program = Program(device)
    clock, action = wp.zeros(1, dtype=int, device=device), wp.zeros((4, 1, 3), dtype=float, device=device)
    for _ in range(3):
        program.launch(vector.draw_actions, action.shape, [clock], [action])
    program.launch(vector.advance_clock, 1, [], [clock])
    found = timing.kernel_times(program, repeats=2)
    assert set(found) == {"draw_actions", "advance_clock"} and all(kernel.ms >= 0.0 for kernel in found.values())
    assert found["draw_actions"].launches in (3, None)
    assert clock.numpy()[0] == 2


def test_memory_in_use_grows_by_what_is_allocated(device: str):
    before = timing.array_bytes(device)
    array = wp.zeros(250_000, dtype=wp.vec4, device=device)
    assert timing.array_bytes(device) - before == pytest.approx(4e6, rel=0.1)
    del array
    assert timing.array_bytes(device) == pytest.approx(before, abs=1e5)


# --- a substep -------------------------------------------------------------------------------------------------------


def test_substep_as_a_smoke_run(results: Path):
    rows = rows_of(results, "substep.json")
    small = crowd.SMALL
    assert [row["case"] for row in rows] == [f"{n}x{count}" for n in (small.skin, small.interior) for count in (1, 4)]
    for row in rows:
        assert row["failed"] is None and row["ms_per_substep"] > 0.0 and row["ms_per_substep_full_drive"] > 0.0
        assert row["particles"] == int(row["case"].split("x")[0]) * row["avatars"]
        assert row["velocity_fields"] == row["avatars"] and row["touching_pairs"] == row["avatars"] - 1
        assert row["mean_way_mm"] > 1.0 and row["cfl"] < 0.5 and row["memory_gb"] > 0.0
        assert row["stages_sum_ms"] == pytest.approx(sum(row["stages_ms"].values()))
        assert row["roofline"]["shared_nodes"] > 0 or row["avatars"] == 1
        assert row["expected_ms"] is None


def test_the_papers_scale_is_the_papers():
    scale, grid = crowd.Scale(), crowd.Scale().grid()
    assert tuple(grid.nodes) == (200, 200, 200) and grid.dx == pytest.approx(0.01)
    cases = [f"{points}x{count}" for points in (scale.skin, scale.interior) for count in substep.AVATARS]
    for case in cases:
        found = substep.references(case)
        assert all(value > 0.0 for value in found.values())
        assert found["expected_ms"] < found["rebuilt_ms"] < found["paper_ms"]
    assert substep.references("300000x4")["paper_memory_gb"] == pytest.approx(5.4 + 4 * 0.122)


def small_crowd(device: str) -> crowd.Crowd:
    return crowd.Crowd(*crowd.interior_body(crowd.SMALL.interior), 1, crowd.SMALL, device)


def test_a_run_that_fails_or_stands_still_has_no_time(device: str, monkeypatch):
    options = substep.Options(repeats=1, warm_up=0, device=device, full_drive=False)
    world = small_crowd(device)
    world.state.failure.assign(np.array([FAILURE_CFL], np.int32))
    row = substep.measure(world, options, 0)
    assert row["failed"] == "cfl" and row["ms_per_substep"] is None
    monkeypatch.setattr(crowd, "SWAY", 0.0)
    monkeypatch.setattr(crowd, "TURN", 0.0)
    row = substep.measure(small_crowd(device), options, 0)
    assert "moved" in row["failed"] and row["ms_per_substep"] is None


@pytest.mark.parametrize("when", [2, 3])  # commands: before the steps that are timed, of either program
def test_a_failure_in_the_timed_steps_is_not_forgiven(when: int, device: str, monkeypatch):
    command, calls = crowd.Crowd.command, []

    def fail(world: crowd.Crowd, sign: int) -> None:
        command(world, sign)
        calls.append(sign)
        world.state.failure.assign(np.array([FAILURE_CFL if len(calls) == when else 0], np.int32))

    monkeypatch.setattr(crowd.Crowd, "command", fail)
    options = substep.Options(repeats=1, warm_up=0, device=device, full_drive=True)
    row = substep.measure(small_crowd(device), options, 0)
    assert len(calls) == 3 and row["failed"] == "cfl" and row["ms_per_substep"] is None


def test_a_reset_puts_the_bodies_back(device: str):
    world = small_crowd(device)
    start = world.state.x.numpy().copy()
    for sign in (1, -1):
        world.command(sign)
        world.once.run()
    assert np.abs(world.state.x.numpy() - start).max() > 1e-3
    world.reset()
    np.testing.assert_allclose(world.state.x.numpy(), start, atol=1e-6)
    assert not world.state.u.numpy().any()


def test_unknown_cases_are_refused():
    with pytest.raises(ValueError, match="10475x4"):
        next(substep.cases(substep.Options(only=("10475x5",))))


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
    runner.write_json(out, report | {"complete": False, "results": report["results"][:2]})
    again = runner.main("soak", soak.cases, soak.Options, arguments)
    assert again["results"][:2] == report["results"][:2]
    assert [(row["steps"], row["process"]) for row in again["results"][:-1]] == [(2, 0), (4, 0), (6, 1)]
    runner.write_json(out, report | {"complete": False, "results": report["results"][:2]})
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
    known = [row for row in kernels if row["bytes_per_step"]]
    assert known, "no kernel has a formula in roofline.kernel_bytes; kernels were renamed"
    assert all(row["gb_per_s"] * row["ms_per_step"] == pytest.approx(row["bytes_per_step"] / 1e6) for row in known)
    assert (results / "profile_reach.png").stat().st_size > 10_000


def test_every_kernel_of_a_step_under_torques_is_known(results: Path):
    """What joints take beside the Material Point Method is told by names: no kernel of either may be missing."""
    names = {row["case"] for row in rows_of(results, "profile_stand.json")}
    assert names >= performance.JOINTS
    of_matter = {name for module in kernels_by_module("piavatar_envs.mpm.") for name in module} & names
    assert of_matter - performance.MATTER <= {"clear_sensors", "read_impulses"}  # which only tell what has been
    of_joints = {name for module in kernels_by_module("piavatar_envs.avatar.joint_") for name in module} & names
    assert of_joints - performance.JOINTS <= {"set_springs"}  # once a step


def kernels_by_module(prefix: str) -> list[set[str]]:
    """Names of the kernels of all modules that have been imported, whose names begin so."""
    modules = [module for name, module in sys.modules.items() if name.startswith(prefix)]
    return [{value.key for value in vars(module).values() if isinstance(value, wp.Kernel)} for module in modules]


def test_tables_are_those_of_the_results(results: Path):
    text = performance.fill(performance.DOCUMENT.read_text(encoding="utf-8"), results)
    assert "not measured yet" not in text and performance.fill(text, results) == text
    row = rows_of(results, "substep.json")[1]
    assert f"| {row['case']} | {performance.number(row['ms_per_substep'])} |" in text
    verdict = rows_of(results, "soak.json")[-1]
    assert f"50 steps: **{verdict['verdict']}**" in text
    for table in performance.TABLES:
        assert f"<!-- table: {table} -->" in text


def test_tables_refuse_what_is_missing_or_unfinished(results: Path, tmp_path: Path):
    text = "<!-- table: substep -->\n<!-- end -->\n<!-- table: soak -->\n<!-- end -->\n"
    with pytest.raises(FileNotFoundError, match=r"soak\.json, substep\.json .*benchmarks\.soak --device cuda --out"):
        performance.fill(text, tmp_path)
    report = json.loads((results / "substep.json").read_text())
    runner.write_json(tmp_path / "substep.json", report | {"complete": False})
    with pytest.raises(FileNotFoundError, match=r"no soak\.json"):
        performance.fill(text, tmp_path)
    shutil.copy(results / "soak.json", tmp_path)
    with pytest.raises(ValueError, match=r"substep\.json .*stopped"):
        performance.fill(text, tmp_path)
    filled = performance.fill(text, tmp_path, only=["soak"])  # the other one stays as it was
    assert filled.startswith("<!-- table: substep -->\n<!-- end -->\n") and "verdict" in filled
    with pytest.raises(ValueError, match="sonnet"):
        performance.fill(text, tmp_path, only=["sonnet"])
    with pytest.raises(ValueError, match="sonnet"):
        performance.fill("<!-- table: sonnet -->\n<!-- end -->\n", results)


@pytest.mark.parametrize(
    ("value", "text"), [(None, "-"), (0.0, "0"), (0.01234, "0.0123"), (75_432.0, "75,400"), (1.5e-6, "1.5e-06")]
)
def test_numbers_in_tables(value: float | None, text: str):
    assert performance.number(value) == text


def test_committed_tables_follow_the_committed_results():
    """A result that is committed without its table, or a table typed by hand, shows here."""
    text = performance.DOCUMENT.read_text(encoding="utf-8")
    for match in performance.MARKED.finditer(text):
        if (performance.RESULTS / performance.TABLES[match["name"]].file).exists():
            assert performance.fill(match[0]) == match[0], match["name"]
