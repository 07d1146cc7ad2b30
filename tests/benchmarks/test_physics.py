"""The checks of the physics: verdicts, the table, measurements of known motions, and a smoke run of each check."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from agents.files import ROOT
from benchmarks import runner
from benchmarks.physics import __main__ as command
from benchmarks.physics import checks, flesh, loads, resolution
from benchmarks.physics.checks import CHECKS, Check, Options, SimulationFailed, at_least, at_most, equal, table
from benchmarks.physics.probe import EMPTY, Probe, ball, empty
from piavatar_envs.avatar.body.skeleton import BEYOND, joint_index


def test_verdicts_follow_the_bounds():
    assert equal("a", 1.04, 1.0, 0.05).verdict == "holds" and equal("a", 1.06, 1.0, 0.05).verdict == "fails"
    assert at_most("a", 0.3, 0.3).verdict == "holds" and at_most("a", 0.31, 0.3).verdict == "fails"
    assert at_least("a", 0.3, 0.3).verdict == "holds" and at_least("a", 0.29, 0.3).verdict == "fails"
    assert at_most("a", math.nan, 1.0).verdict == "fails"


def test_a_check_whose_simulation_ends_fails_with_the_reason():
    def measure(_options):
        yield at_most("before", 0.0, 1.0)
        raise SimulationFailed("failure 'cfl'")

    rows = list(Check("name", "title", measure).rows(Options()))
    assert [row["verdict"] for row in rows] == ["holds", "fails"]
    assert rows[1]["value"] is None and "cfl" in rows[1]["note"]
    lines = table(rows).splitlines()
    assert len(lines) == 4 and "**fails** (failure 'cfl')" in lines[3]


def test_the_command_writes_rows_beside_those_of_an_earlier_commit(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(checks, "CHECKS", {"one": Check("one", "first", lambda _: iter([equal("a", 2.0, 1.0, 0.5)]))})
    earlier = tmp_path / "earlier.json"
    arguments = ["--out", str(earlier)]
    runner.main("physics", command.cases, Options, arguments)
    runner.main("physics", command.cases, Options, ["--before", str(earlier), "--out", str(tmp_path / "now.json")])
    (row,) = json.loads((tmp_path / "now.json").read_text())["results"]
    assert row["before"] == 2.0 and row["theory"] == 1.0 and row["verdict"] == "fails"
    assert "0 of 1 hold, 1 fail" in capsys.readouterr().out
    with pytest.raises(SystemExit, match="two"):
        checks.chosen(["two"])


def test_the_page_has_the_table_of_the_committed_results():
    rows = json.loads((ROOT / "benchmarks" / "results" / "physics.json").read_text())["results"]
    page = (ROOT / "docs" / "physics.md").read_text()
    assert checks.with_table(page, rows) == page
    with pytest.raises(ValueError, match="comments"):
        checks.with_table("text", rows)


@pytest.fixture(scope="module")
def options(device: str) -> Options:
    return Options(fidelity="tiny", device=device, seconds=2.0)


def test_a_probe_measures_known_states(options):
    probe = Probe.under(options, "pd", **empty(ball(1.5, 0.0, (1.0, 1.2))))
    assert probe.displacement().max() < 1e-4 and probe.strain().max() < 1e-4
    assert probe.elastic_energy(probe.body) == pytest.approx(0.0, abs=1e-4)
    assert probe.mass[probe.prop()].sum() == pytest.approx(1.5, rel=1e-3)
    assert probe.overlap(probe.prop(), probe.body) == (0.0, 0.0)
    x = probe.simulation.state.x.numpy()
    x[0, probe.prop()] += (probe.center(probe.body) - probe.center(probe.prop())).astype(np.float32)
    probe.simulation.state.x.assign(x)
    share, depth = probe.overlap(probe.prop(), probe.body)
    assert share > 0.5 and depth > 0.05
    F = probe.simulation.state.F.numpy()
    F[:] = 1.1 * np.eye(3, dtype=np.float32).reshape(9, 1)
    probe.simulation.state.F.assign(F)
    np.testing.assert_allclose(probe.strain(), math.sqrt(3.0) * 0.1, rtol=1e-5)
    np.testing.assert_allclose(probe.volume_ratio(probe.body), 1.331, rtol=1e-5)


def test_volumes_of_tetrahedra_follow_a_stretch_and_a_fold():
    rng = np.random.default_rng(0)
    rest = np.stack(np.meshgrid(*[np.linspace(0.0, 0.1, 6)] * 3), -1).reshape(-1, 3) + 0.002 * rng.uniform(
        size=(216, 3)
    )
    corners, before = flesh.tetrahedra(rest)
    assert before.min() > 0.0 and before.sum() == pytest.approx(1e-3, rel=0.1)
    np.testing.assert_allclose(flesh.volumes(rest * [1.0, 1.0, 0.5], corners), 0.5 * before, rtol=1e-9)
    assert (flesh.volumes(rest * [1.0, 1.0, -1.0], corners) < 0.0).all()


def test_the_rigid_response_lifts_the_toes(options):
    probe = Probe.under(options, "torque", held=False, **EMPTY)
    at = probe.pose[1][joint_index("left_foot")]
    turned = loads.rigid_response(probe, "left_ankle", np.array([0.0, 0.0, 1.0]), at, 0.05)
    assert turned[joint_index("left_ankle"), 0] < 0.0  # an impulse in front of the ankle lifts the toes
    assert np.abs(turned[joint_index("right_wrist")]).max() < 0.1 * np.abs(turned[joint_index("left_ankle")]).max()
    beyond = np.flatnonzero(BEYOND[joint_index("left_knee")])
    assert set(beyond) == {joint_index(f"left_{name}") for name in ("knee", "ankle", "foot")}


def test_gates_are_spacings_or_lengths():
    assert resolution.gate_in_spacings("0.15 dx", 0.05) == 0.15
    assert resolution.gate_in_spacings("8 mm", 0.05) == pytest.approx(0.16)
    with pytest.raises(SystemExit, match=r"0\.15 dx"):
        resolution.gate_in_spacings("8", 0.05)


def test_the_study_of_resolution_reads_other_rows_and_draws(tmp_path, device):
    pytest.importorskip("matplotlib")
    first, second = tmp_path / "first.json", tmp_path / "second.json"
    small = ["--device", device, "--balls", "chest"]
    report = runner.main(
        "resolution", resolution.cases, resolution.Options, [*small, "--fidelities", "tiny", "--out", str(first)]
    )
    (row,) = report["results"]
    # momentum of a ball that stops is 6 N s; one that bounces gives up to twice that
    assert 6.0 < row["impulse_n_s"] < 12.0 and 0.0 < row["restitution"] < 1.0 and row["dent_mm"] > 1.0
    arguments = [*small, "--fidelities", "--also", str(first), "--out", str(second)]
    assert (
        runner.main("resolution", resolution.cases, resolution.Options, arguments)["results"][0]["dent_mm"]
        == row["dent_mm"]
    )
    assert second.with_suffix(".png").stat().st_size > 5_000


@pytest.mark.parametrize("name", ["wear_prop", "stiffness_ankle_pd", "springs_weight", "root_force_pd", "fast_chest"])
def test_checks_run(options, name):
    rows = list(CHECKS[name].rows(options))
    assert rows and all(row["verdict"] in ("holds", "fails") for row in rows)
    assert all(row["value"] is None or math.isfinite(row["value"]) for row in rows)


def test_a_spring_of_the_table_is_that_of_the_simulation(options):
    probe = Probe.under(options, "pd", **EMPTY)
    probe.step()
    found = probe.simulation.controllers[0].joints.springs.stiffness.numpy()[0, 1 + joint_index("left_knee")]
    assert probe.spring("left_knee") == pytest.approx(float(found), rel=1e-3)


def test_commanded_and_tracked_poses_differ_by_the_errors(options):
    probe = Probe.under(options, "pd", **EMPTY)
    bent = Rotation.from_rotvec([0.2, 0.0, 0.0]).as_quat()
    goal = probe.simulation.avatar.state.goal_rotation.numpy()
    goal[0, joint_index("left_knee")] = bent
    probe.simulation.avatar.state.goal_rotation.assign(goal)
    np.testing.assert_allclose(probe.errors[joint_index("left_knee")], [-0.2, 0.0, 0.0], atol=1e-3)
