"""The benchmark of bodies under torques, as a smoke run."""

from __future__ import annotations

import json
import math
from types import SimpleNamespace

import numpy as np
import pytest
import warp as wp
from scipy.spatial.transform import Rotation

from agents.files import ROOT
from benchmarks.physics import limbs, stability, torque, wear
from benchmarks.physics.limbs import Options
from benchmarks.physics.rig import joint_gaps
from piavatar_envs.avatar.body.skeleton import JOINT_NAMES, forward_kinematics, joint_index
from piavatar_envs.avatar.body.sources import load_asset

RESULTS = ROOT / "benchmarks" / "results" / "torque.json"
HOLDS = ("", "_slipping")
FLOATS = [f"free_float_{how}{hold}" for how in ("loose", "attached", "pd", "pd_loose") for hold in HOLDS]
KICKS = [f"kick_{mass}_{how}" for mass in ("0.45", "1.5", "8") for how in ("floating", "held")]
CASES = {
    *FLOATS,
    *(f"t_pose_kp_{k}{hold}" for k in (50, 200, 1000) for hold in HOLDS),
    *(f"press_kd_{d}{hold}" for d in (2, 20, 200) for hold in HOLDS),
    *(f"stand_assist_{share}{hold}" for share in (0, 1) for hold in HOLDS),
    *(f"ball_{mass}_kp_{k}{hold}" for mass in ("0.45", "1.5", "8") for k in (100, 300, 1000) for hold in HOLDS),
    *(kick + hold for kick in KICKS for hold in HOLDS),
    *(f"spin{hold}" for hold in HOLDS),
    *(f"thrash_{place}{hold}" for place in ("upright", "lying") for hold in HOLDS),
    *(f"floor_{way}{hold}" for way in ("standing", "falling", "lying") for hold in HOLDS),
    *(f"longest_step_{name}" for name in ("floating", "standing", "soft_floating")),
    *(f"largest_{kind}_{how}" for kind in ("kp", "kd", "kp_kd") for how in ("limited", "boundless")),
    *(f"cost{hold}" for hold in HOLDS),
}


@pytest.fixture(scope="module")
def rows(device: str) -> dict[str, dict]:
    found = torque.cases(Options(device=device, fidelity="tiny", steps=3, refresh=1, halvings=1, poses=1))
    return {row.pop("case"): row for row in found}


def test_every_case_is_measured(rows):
    assert set(rows) == CASES
    numbers = [v for row in rows.values() for v in row.values() if isinstance(v, (int, float, np.number))]
    assert all(math.isfinite(value) for value in numbers)
    assert not any(row.get("failed") for row in rows.values())


def test_the_committed_results_are_complete():
    report = json.loads(RESULTS.read_text(encoding="utf-8"))
    assert report["complete"] and {row["case"] for row in report["results"]} == CASES


def test_feet_that_press_come_to_rest_and_give_the_springs_torque():
    """Whatever the damper, and whether particles of bones are put in place or slip."""
    rows = {row["case"]: row for row in json.loads(RESULTS.read_text(encoding="utf-8"))["results"]}
    for case in (case for case in CASES if case.startswith("press")):
        assert rows[case]["torque_over_spring"] == pytest.approx(1.0, abs=0.01)
        assert rows[case]["speed_m_s"] < 0.01 and rows[case]["floor_n"] > 500.0


@pytest.mark.parametrize("hold", HOLDS)
def test_matter_stays_at_the_bones(hold):
    """What spins does not swell as it would on straight ways; nor do forearms after 10 s of random torques."""
    rows = {row["case"]: row for row in json.loads(RESULTS.read_text(encoding="utf-8"))["results"]}
    assert rows[f"spin{hold}"]["straight_growth"] > 0.1 > 0.02 > rows[f"spin{hold}"]["largest_growth"]
    assert rows[f"thrash_upright{hold}"]["forearms_off_mm"] < 5.0


def test_firm_bones_stay_together():
    """To a millimetre, also of bodies that fall on the floor and thrash about there; slipping ones do not."""
    gaps = {
        row["case"]: row["largest_gap_mm"]
        for row in json.loads(RESULTS.read_text(encoding="utf-8"))["results"]
        if "largest_gap_mm" in row
    }
    firm = {case: gap for case, gap in gaps.items() if not case.endswith("_slipping")}
    assert len(firm) == 4 + 3 + 2 + 9 + len(KICKS) + 3
    assert max(firm.values()) < 1.0
    assert max(gaps[f"{case}_slipping"] for case in firm) > 1.0


def test_feet_bear_a_standing_body_and_bones_stay_above_the_floor():
    """Feet that stand do not slide off or sink in; of bodies that fall or lie no bone comes through the floor."""
    rows = {row["case"]: row for row in json.loads(RESULTS.read_text(encoding="utf-8"))["results"]}
    for hold in HOLDS:
        standing = rows[f"floor_standing{hold}"]
        assert standing["pelvis_m"] > 0.8 and standing["feet_slid_mm"] < 5.0 and standing["bones_below_floor_mm"] < 1.0
    for way in ("falling", "lying"):
        firm, slipping = rows[f"floor_{way}"], rows[f"floor_{way}_slipping"]
        assert firm["pelvis_m"] < 0.3 and firm["bones_below_floor_mm"] < 0.5 < 3.0 < slipping["bones_below_floor_mm"]
        assert firm["share_of_time_beyond_wanted"] == 0.0 and slipping["share_of_time_beyond_wanted"] > 0.9


def test_no_bone_comes_below_the_floor_or_gapes(rows):
    for way in ("standing", "falling", "lying"):
        assert rows[f"floor_{way}"]["bones_below_floor_mm"] < 0.5 and rows[f"floor_{way}"]["largest_gap_mm"] < 0.1


def test_bones_have_their_particles_where_the_joints_are(device):
    """A body that is reset has none elsewhere; joints that sink take all of them along."""
    env = wear.make(Options(device=device, fidelity="tiny"), "PIAvatar/Stand-v0")
    assert wear.ways(env).max() < 1e-5
    before, position = wear.homes(env), env.simulation.controllers[0].state.position
    position.assign(position.numpy() - np.array([0.0, 0.0, 0.1], np.float32))
    np.testing.assert_allclose(before - wear.homes(env), np.broadcast_to([0.0, 0.0, 0.1], before.shape), atol=1e-6)


@pytest.mark.parametrize("case", FLOATS)
def test_momentum_stays(rows, case):
    assert rows[case]["momentum_scale"] > 1.0
    assert rows[case]["linear_momentum_rel"] < 1e-5 and rows[case]["angular_momentum_rel"] < 1e-5


@pytest.mark.parametrize("hold", HOLDS)
def test_stiffer_arms_sag_less(rows, hold):
    sags = [rows[f"t_pose_kp_{k}{hold}"]["arm_sag_deg"] for k in (50, 200, 1000)]
    assert np.all(np.diff(sags) < 0.0) and sags[0] > 0.1
    assert rows[f"cost{hold}"]["joints_ms"] > 0.0


@pytest.mark.parametrize("hold", HOLDS)
def test_an_assisted_body_stands_and_another_one_falls(rows, hold):
    assert rows[f"stand_assist_1{hold}"]["stood_s"] == pytest.approx(10.0, abs=0.05)
    assert 0.2 < rows[f"stand_assist_0{hold}"]["stood_s"] < 9.0


@pytest.mark.parametrize("hold", HOLDS)
def test_what_a_ball_loses_the_body_gets(rows, hold):
    """Heavier balls bend joints more, stiffer joints bend less; an elastic wall would take ``2 m v``."""
    masses = ("0.45", "1.5", "8")
    peak = np.array([[rows[f"ball_{m}_kp_{k}{hold}"]["peak_deg"] for k in (100, 300, 1000)] for m in masses])
    assert np.all(np.diff(peak, axis=0) > 0.0) and np.all(np.diff(peak, axis=1) < 0.0)
    for mass in masses:
        row = rows[f"ball_{mass}_kp_300{hold}"]
        assert row["mismatch_rel"] < 1e-4
        assert 0.5 < row["ball_lost_n_s"] / (float(mass) * 5.0) < 2.0


@pytest.mark.parametrize("hold", HOLDS)
@pytest.mark.parametrize("case", KICKS)
def test_a_kick_recoils(rows, case, hold):
    row = rows[case + hold]
    assert row["ball_n_s"] > 1.0 and row["mismatch_rel"] < 1e-4
    assert row["pelvis_recoil_m_s"] > 0.01
    assert (row["support_n_s"] > 1.0) == case.endswith("held")


@pytest.mark.parametrize("hold", HOLDS)
def test_heavier_balls_take_more_and_fly_slower(rows, hold):
    for how in ("floating", "held"):
        seen = [rows[f"kick_{mass}_{how}{hold}"] for mass in ("0.45", "1.5", "8")]
        assert np.all(np.diff([row["ball_n_s"] for row in seen]) > 0.0)
        assert np.all(np.diff([row["ball_m_s"] for row in seen]) < 0.0)


def test_slipping_bones_gape_little_where_they_rest_and_more_where_they_are_struck(rows):
    assert rows["t_pose_kp_1000_slipping"]["largest_gap_mm"] < rows["t_pose_kp_50_slipping"]["largest_gap_mm"]
    for row in (rows[case] for case in CASES if case.startswith(("free", "ball", "kick", "t_pose", "stand"))):
        assert 0.0 < row["largest_gap_mm"] < 100.0 and row["widest_joint"] in JOINT_NAMES[1:]
    for kp in (100, 300, 1000):
        slipping = [rows[f"ball_{mass}_kp_{kp}_slipping"]["largest_gap_mm"] for mass in ("0.45", "8")]
        assert slipping[1] > slipping[0] > 10.0 * rows[f"ball_0.45_kp_{kp}"]["largest_gap_mm"]
    for how in ("floating", "held"):
        row = rows[f"kick_8_{how}_slipping"]
        assert row["largest_gap_mm"] >= row["gap_without_ball_mm"]


def test_a_gap_is_what_a_joint_is_off_its_parent():
    """A bent body without gaps, but for an elbow that is moved: that joint is off, and the wrist is off the elbow."""
    rest = load_asset().mean_body().joints.astype(float)
    turns = Rotation.from_rotvec(np.random.default_rng(0).normal(0.0, 0.4, (len(JOINT_NAMES), 3)))
    world, position = forward_kinematics(turns.as_matrix(), np.array([0.3, -0.2, 1.1]), rest)
    elbow, moved = joint_index("left_elbow"), np.array([0.0, 0.003, -0.004])
    position[elbow] += moved
    tracked = SimpleNamespace(
        rotation=wp.array(Rotation.from_matrix(world).as_quat()[None].astype(np.float32), dtype=wp.quat, device="cpu"),
        position=wp.array(position[None].astype(np.float32), dtype=wp.vec3, device="cpu"),
    )
    gaps = joint_gaps(tracked, rest[None])[0]
    off = [elbow - 1, joint_index("left_wrist") - 1]
    np.testing.assert_allclose(gaps[off], 0.005, atol=1e-6)
    np.testing.assert_allclose(np.delete(gaps, off), 0.0, atol=1e-6)
    assert limbs.widest([0.5 * gaps, gaps])["largest_gap_mm"] == pytest.approx(5.0, abs=1e-3)


def test_halving_finds_an_edge():
    tried = []

    def fault(value):
        tried.append(value)
        return None if value < 0.7 else f"beyond {value:g}"

    edge = stability.halve(fault, 0.1, 10.0, 8)
    assert edge.stable < 0.7 <= edge.unstable and edge.unstable / edge.stable == pytest.approx(100.0 ** (1.0 / 256.0))
    assert len(tried) == 10 and edge.fault == f"beyond {edge.unstable:g}"
    assert stability.halve(fault, 0.1, 0.5, 8) == stability.Edge(0.5)
    with pytest.raises(RuntimeError, match="not stable"):
        stability.halve(fault, 1.0, 10.0, 8)


def test_stable_values_are_found_below_unstable_ones(rows):
    for name in ("floating", "standing", "soft_floating"):
        row = rows[f"longest_step_{name}"]
        assert 0.3 < row["stable_c_dt_over_dx"] < row["unstable_c_dt_over_dx"] < 1.7
    for kind in ("kp", "kd", "kp_kd"):
        assert rows[f"largest_{kind}_boundless"]["stable_factor"] >= 1e3
    # muscles with limits that are asked for more than they have hum: the search must be able to find that
    assert rows["largest_kp_limited"]["unstable_factor"] is not None


def test_a_body_that_hums_is_not_stable(device):
    """Without any damping but the tissue's it still moves after a second; with the environments' it is at rest."""
    options = Options(device=device, fidelity="tiny")
    assert stability.Trial().fault(options, 0) is None
    assert stability.Trial(damping=0.0).fault(options, 0) == "hum"
