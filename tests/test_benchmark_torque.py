"""The benchmark of bodies under torques, as a smoke run."""

from __future__ import annotations

import math

import numpy as np
import pytest

from benchmarks import torque


@pytest.fixture(scope="module")
def rows(device: str) -> dict[str, dict]:
    found = torque.cases(torque.Options(device=device, fidelity="tiny", steps=3, refresh=1))
    return {row.pop("case"): row for row in found}


def test_every_case_is_measured(rows):
    assert set(rows) == {
        "free_float_loose",
        "free_float_attached",
        "t_pose_kp_50",
        "t_pose_kp_200",
        "t_pose_kp_1000",
        "press_kd_2",
        "press_kd_20",
        "press_kd_200",
        "stand_assist_0",
        "stand_assist_1",
        "cost",
    }
    assert all(math.isfinite(value) for row in rows.values() for value in row.values())


def test_momentum_stays(rows):
    for case in ("free_float_loose", "free_float_attached"):
        assert rows[case]["momentum_scale"] > 1.0 and not rows[case]["failed"]
        assert rows[case]["linear_momentum_rel"] < 1e-5 and rows[case]["angular_momentum_rel"] < 1e-5


def test_stiffer_arms_sag_less(rows):
    sags = [rows[f"t_pose_kp_{k}"]["arm_sag_deg"] for k in (50, 200, 1000)]
    assert np.all(np.diff(sags) < 0.0) and sags[0] > 0.1
    assert rows["cost"]["joints_ms"] > 0.0


def test_an_assisted_body_stands_and_another_one_falls(rows):
    assert rows["stand_assist_1"]["stood_s"] == pytest.approx(10.0, abs=0.05)
    assert 0.2 < rows["stand_assist_0"]["stood_s"] < 9.0
