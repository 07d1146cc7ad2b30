"""The benchmarks of physics as smoke runs, and the laws that hold at any resolution."""

from __future__ import annotations

import math

import numpy as np
import pytest

from benchmarks.physics import contact, elastodynamics, torque
from benchmarks.physics.limbs import Options


def check_finite(rows: list[dict]) -> None:
    """Assert that rows have distinct names or settings, and finite numbers."""
    assert rows and all(
        math.isfinite(v) for row in rows for v in row.values() if isinstance(v, (int, float, np.number))
    )
    assert not any(row.get("failed") for row in rows)


@pytest.fixture(scope="module")
def under_torques(device: str) -> dict[str, dict]:
    """Rows of the benchmark of joint torques by case, a smoke run."""
    found = list(torque.cases(Options(device=device, fidelity="tiny", steps=3, refresh=1, halvings=1, poses=1)))
    check_finite(found)
    return {row["case"]: row for row in found}


def test_bodies_under_torques_keep_their_momentum(under_torques):
    floats = [row for case, row in under_torques.items() if case.startswith("free_float")]
    assert floats and all(row["momentum_scale"] > 1.0 for row in floats)
    assert max(max(row["linear_momentum_rel"], row["angular_momentum_rel"]) for row in floats) < 1e-5


@pytest.mark.parametrize("hold", ["", "_slipping"])
def test_the_body_gains_what_a_ball_loses(under_torques, hold):
    """Heavier balls bend joints more, stiffer joints bend less; an elastic wall would take ``2 m v``."""
    masses = ("0.45", "1.5", "8")
    peak = np.array([[under_torques[f"ball_{m}_kp_{k}{hold}"]["peak_deg"] for k in (100, 300, 1000)] for m in masses])
    assert np.all(np.diff(peak, axis=0) > 0.0) and np.all(np.diff(peak, axis=1) < 0.0)
    for mass in masses:
        row = under_torques[f"ball_{mass}_kp_300{hold}"]
        assert row["mismatch_rel"] < 1e-4
        assert 0.5 < row["ball_lost_n_s"] / (float(mass) * 5.0) < 2.0


def test_a_kick_recoils(under_torques):
    kicks = {case: row for case, row in under_torques.items() if case.startswith("kick")}
    assert kicks
    for case, row in kicks.items():
        assert row["ball_n_s"] > 1.0 and row["mismatch_rel"] < 1e-4 and row["pelvis_recoil_m_s"] > 0.01
        assert (row["support_n_s"] > 1.0) == ("held" in case)


def test_shared_normals_keep_momentum_and_gain_no_energy(device):
    if device != "cpu":
        pytest.skip("a smoke run; the benchmark itself runs on a GPU with --device")
    rows = list(contact.cases(contact.Options(quick=True, only_contact=True)))
    check_finite(rows)
    assert {row["normals"] for row in rows} == {"shared", "own"}
    kept = [row for row in rows if row["normals"] == "shared" and "linear_momentum_rel" in row]
    assert kept and all(row["linear_momentum_rel"] < 1e-5 and row["angular_momentum_rel"] < 1e-5 for row in kept)
    assert all(row["energy_ratio_max"] <= 1.01 for row in kept)


def test_elastodynamics_as_a_smoke_run(device, tmp_path):
    if device != "cpu":
        pytest.skip("a smoke run; the benchmark itself runs on a GPU with --device")
    rows = list(elastodynamics.cases(elastodynamics.Options(quick=True)))
    check_finite(rows)
    assert {"bar", "cantilever", "bar on wall", "ball on plane"} <= {row["case"] for row in rows}
    pytest.importorskip("matplotlib", reason="needs the extra train")
    elastodynamics.draw(rows, tmp_path / "picture.png")
    assert (tmp_path / "picture.png").stat().st_size > 20_000
