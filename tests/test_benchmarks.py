"""The benchmarks measure what they say: rigs and metrics against theory, and both commands as smoke runs."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks import runner
from benchmarks.paper import disturbance, metrics, poses, tracking
from benchmarks.paper import metrics as paper
from benchmarks.physics.rig import Rig, World
from benchmarks.speed import cpu
from piavatar_envs.avatar.body.skeleton import joint_index, joint_limits
from piavatar_envs.avatar.body.sources import load_asset
from piavatar_envs.avatar.types import DriveSettings
from piavatar_envs.core.arrays import components_of
from piavatar_envs.mpm.diagnostics import totals

TABLE_1 = {"table", "decoupling", "substeps", "mean_distance_m", "rmse_m", "acc_at_1cm", "disturbed"}
TABLE_2 = {
    "table", "decoupling", "substeps", "root_rotation_deg", "root_translation_m", "relative_rotation_deg",
    "relative_translation_m", "distance_m", "disturbed",
}  # fmt: skip
CPU = {"case", "env_steps_per_s", "us_per_particle_substep", "particles", "substeps", "peak_memory_mb"}


@pytest.fixture(scope="module")
def tiny(device: str) -> World:
    return World(fidelity="tiny", device=device)


def mean_shapes(count: int) -> np.ndarray:
    return np.zeros((count, len(load_asset().shape_names)))


# --- poses -----------------------------------------------------------------------------------------------------------


def test_random_poses_stay_within_their_share_of_the_joints_ranges():
    rotations, shifts = poses.random_poses(np.random.default_rng(0), 50, joint_range=0.5)
    lower, upper = joint_limits()
    assert rotations.shape == (50, 22, 3) and shifts.shape == (50, 3)
    assert (rotations[:, 1:] >= 0.5 * lower[1:] - 1e-12).all() and (rotations[:, 1:] <= 0.5 * upper[1:] + 1e-12).all()
    assert np.ptp(rotations[:, joint_index("left_knee"), 0]) > 0.4 * np.ptp([lower[4, 0], upper[4, 0]])


def test_a_smooth_sequence_passes_through_its_poses_in_even_turns():
    rotations, shifts = poses.random_poses(np.random.default_rng(1), 2)
    turned, moved = poses.passing_through(rotations, shifts, 4)
    np.testing.assert_allclose(turned[[3, 7]], rotations, atol=1e-9)
    np.testing.assert_allclose(moved[[3, 7]], shifts, atol=1e-12)
    elbow = Rotation.from_rotvec(turned[3:, joint_index("left_elbow")])
    np.testing.assert_allclose(np.diff((elbow[:-1].inv() * elbow[1:]).magnitude()), 0.0, atol=1e-9)


def test_random_shapes_alternate_the_sexes():
    shapes = poses.random_shapes(load_asset(), np.random.default_rng(0), 4)
    assert shapes[:, load_asset().shape_names.index("sex")].tolist() == [-1.0, 1.0, -1.0, 1.0]


# --- metrics ---------------------------------------------------------------------------------------------------------


def test_distances_of_a_known_sample():
    found = metrics.distance_metrics([np.array([0.0, 0.004]), np.array([0.02, 0.004])])
    assert found == pytest.approx({"mean_distance_m": 0.007, "rmse_m": math.sqrt(1.08e-4), "acc_at_1cm": 0.75})


def test_spread_over_seeds_leaves_out_what_is_missing():
    row = metrics.spread([{"a": 1.0, "b": math.nan}, {"a": 3.0, "b": math.nan}, {"a": math.nan, "b": math.nan}])
    assert row["a"] == 2.0 and row["a_std"] == pytest.approx(math.sqrt(2.0))
    assert row["a_ci95"] == pytest.approx(12.7062, rel=1e-4)  # t(0.975, 1) sqrt(2) / sqrt(2)
    assert row["b"] is None and row["b_std"] is None and row["b_ci95"] is None


def test_recovery_time_is_that_of_the_last_crossing():
    error = np.array([1.0, 5.0, 1.0, 3.0, 1.9, 0.5])
    assert disturbance._recovery_time(error) == pytest.approx(4 / 30)
    assert disturbance._recovery_time(np.array([0.1, 0.2])) == 0.0
    assert disturbance._recovery_time(np.array([0.1, 2.0])) is None


def test_the_impulse_of_a_ball():
    # a ball much lighter than the chest bounces off it as off a wall: J = (1 + e) m v
    light = disturbance.Ball(1e-6, 10.0, {})
    assert light.impulse == pytest.approx((1.0 + disturbance.RESTITUTION) * 1e-5, rel=1e-6)
    assert disturbance.Ball(8.0, 5.0, {}).impulse == pytest.approx(44.0, abs=0.5)


def test_the_papers_table_rises_and_says_what_it_lacks():
    values = [paper.table_1("paper", substeps)["mean_distance_m"] for substeps in (100, 200, 300, 400)]
    assert values == sorted(values) and values[0] == 0.013
    assert paper.table_1("paper", 200)["acc_at_1cm"] is None


# --- rig -------------------------------------------------------------------------------------------------------------


def test_errors_of_a_body_that_was_moved_by_hand(tiny: World):
    rig = Rig(tiny, tracking.BARE, mean_shapes(1))
    rig.step()
    assert rig.distances().max() < 1e-5 and rig.strain().max() < 1e-4
    turn = Rotation.from_rotvec([0.0, 0.0, math.radians(3.0)])
    pelvis = rig.points.joints[0, 0]
    x = rig.state.x.numpy().copy()
    rig.state.x.assign((turn.apply(x[0] - pelvis) + pelvis + [0.02, 0.0, 0.0]).astype(np.float32)[None])
    rig.avatar.record_tracking(graph := tracking.LaunchGraph(rig.model.device), rig.state)
    graph.run()
    errors = rig.pose_errors()
    assert math.degrees(errors["root_rotation"][0]) == pytest.approx(3.0, abs=0.02)
    assert errors["root_translation"][0] == pytest.approx(0.02, abs=1e-4)
    # a rigid motion of the whole body is none of the joints' doing
    assert np.degrees(errors["relative_rotation"]).max() < 0.05 and errors["relative_translation"].max() < 1e-4
    assert rig.shape_errors().max() < 1e-4
    expected = np.linalg.norm((rig.state.x.numpy() - x)[0][rig.flesh], axis=1)
    np.testing.assert_allclose(rig.distances()[0], expected, atol=1e-4)


def test_strain_ignores_turns_and_sees_stretch(tiny: World):
    rig = Rig(tiny, tracking.BARE, mean_shapes(1))
    turn = Rotation.from_rotvec([0.4, -0.2, 0.9]).as_matrix()
    count = rig.points.num_points
    rig.state.F.assign(components_of(np.tile(turn, (1, count, 1, 1))))
    assert rig.strain()[0] < 1e-5
    rig.state.F.assign(components_of(np.tile(turn @ np.diag([1.3, 1.0, 0.6]), (1, count, 1, 1))))
    assert rig.strain()[0] == pytest.approx(0.5, abs=1e-4)


def test_a_strike_brings_its_impulse_once_and_to_its_body_only(tiny: World):
    rig = Rig(tiny, DriveSettings(root="free"), mean_shapes(2))
    impulse = np.array([[0.0, 0.0, 0.0], [1.0, -2.0, 0.5]])
    rig.strike([joint_index("head"), joint_index("left_elbow")], impulse)
    for _ in range(2):
        found = np.array([totals(rig.model, rig.state, env).momentum for env in range(2)])
        # a GPU's integers count what the fastest and the heaviest particle have, and these are light
        np.testing.assert_allclose(found, impulse, atol=2e-5 if rig.model.device == "cpu" else 2e-4)
        rig.step()


def test_a_reset_touches_its_bodies_only(tiny: World):
    rig = Rig(tiny, tracking.BARE, mean_shapes(2))
    rotations = np.tile(poses.random_pose(np.random.default_rng(0))[0], (2, 1, 1))
    rig.step(rotations)
    before = rig.state.x.numpy().copy()
    rig.reset(bodies=np.array([True, False]))
    after = rig.state.x.numpy()
    np.testing.assert_allclose(after[0], rig.points.rest[0], atol=1e-5)
    np.testing.assert_array_equal(after[1], before[1])


@pytest.mark.parametrize("decoupling", ["paper", "none"])
def test_the_open_loop_drive_ignores_where_the_body_is(tiny: World, decoupling: str):
    """From the last commanded pose to the next: what moved the body before must not show in the kinematic velocity."""
    from dataclasses import replace

    velocities = []
    for mode in ("reference", "increment"):
        rig = Rig(replace(tiny, decoupling=decoupling), replace(tracking.BARE, mode=mode), mean_shapes(2))
        x, rotations = rig.state.x.numpy().copy(), np.zeros((2, 22, 3))
        x[1] = Rotation.from_rotvec([0.3, 0.0, 0.4]).apply(x[1] - x[1].mean(0)) + x[1].mean(0)
        rig.state.x.assign(x)
        rig.avatar.record_tracking(graph := tracking.LaunchGraph(rig.model.device), rig.state)
        graph.run()
        rotations[:, joint_index("left_elbow")] = (0.0, 0.0, -0.5)
        rig.step(rotations)
        velocities.append(rig.state.vk.numpy().copy())
    reference, increment = velocities
    np.testing.assert_allclose(reference[1], reference[0], atol=1e-3)
    assert np.abs(increment[1] - increment[0]).max() > 0.5  # turned with the body that it starts from


# --- commands --------------------------------------------------------------------------------------------------------


def test_tracking_as_a_smoke_run(tmp_path: Path, device: str):
    out = tmp_path / "tracking.json"
    arguments = ["--quick", "--no-pictures", "--out", str(out), "--device", device]
    report = runner.main("tracking", tracking.cases, tracking.Options, arguments)
    assert json.loads(out.read_text()) == report and report["complete"]
    tables = {1: TABLE_1, 2: TABLE_2}
    for table, keys in tables.items():
        rows = [row for row in report["results"] if row["table"] == table]
        assert all(keys <= set(row) for row in rows)
        for disturbed in (False, True):
            assert {r["decoupling"] for r in rows if r["disturbed"] is disturbed} == {"split", "paper", "none"}
        split = [row for row in rows if row["decoupling"] == "split" and not row["disturbed"]]
        distance = "mean_distance_m" if table == 1 else "distance_m"
        assert split and all(row[distance] < 2e-4 and row["acc_at_1cm"] == 1.0 for row in split)
        assert all(f"{distance}_std" in row and f"{distance}_ci95" in row for row in rows)
    recovery = [row for row in report["results"] if row.get("study") == "recovery"]
    assert {(row["tone"], row["alpha"]) for row in recovery} >= {
        (t, a) for t in (0.0, 0.3, 1.0) for a in (0.0, 0.3, 1.0)
    }
    adrift = [row for row in recovery if "momentum_error" in row]
    assert adrift and max(row["momentum_error"] for row in adrift) < 1e-4
    assert len({row["case"] for row in report["results"]}) == len(report["results"])


def test_cpu_as_a_smoke_run(tmp_path: Path, device: str):
    pytest.importorskip("mujoco")
    out = tmp_path / "cpu.json"
    report = runner.main("cpu", cpu.cases, cpu.Options, ["--quick", "--out", str(out)])
    assert json.loads(out.read_text()) == report and report["complete"]
    rows = {row["case"]: row for row in report["results"]}
    assert all(set(row) >= CPU for row in rows.values())
    reach = rows["PIAvatar/Reach-v0"]
    product = reach["env_steps_per_s"] * reach["particles"] * reach["substeps"] * reach["us_per_particle_substep"]
    assert product == pytest.approx(1e6)
    assert reach["particles"] >= 2500 and 0.0 < reach["cfl"] <= 0.5
    assert rows["Humanoid-v5"]["env_steps_per_s"] > 0.0 and rows["Humanoid-v5"]["particles"] is None
    (stages,) = (row for case, row in rows.items() if "stages" in case)
    assert set(cpu.CONTINUUM) <= set(stages["stages_ms"]), "a kernel was renamed; name it in cpu.CONTINUUM"


def test_cpu_refuses_a_gpu():
    with pytest.raises(ValueError, match="cuda"):
        next(cpu.cases(cpu.Options(device="cuda")))
