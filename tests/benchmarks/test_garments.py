"""The table of garments: rows, files and the picture."""

from __future__ import annotations

import json

import numpy as np
import pytest

from benchmarks import runner
from benchmarks.garments import theory, worn
from benchmarks.garments.__main__ import cases
from benchmarks.garments.picture import share
from benchmarks.garments.rows import CHECKS, Options
from benchmarks.physics import checks


def test_the_command_writes_rows_and_a_picture(tmp_path, capsys):
    pytest.importorskip("matplotlib", reason="needs the extra train")
    out, picture = tmp_path / "garments.json", tmp_path / "garments.png"
    report = runner.main("garments", cases, Options, ["--only", "air", "--out", str(out), "--picture", str(picture)])
    assert json.loads(out.read_text()) == report and report["complete"] and report["commit"]
    assert all(row["verdict"] == "holds" and row["tolerance"] > 0.0 for row in report["results"])
    assert "terminal speed" in capsys.readouterr().out and picture.stat().st_size > 5_000
    assert not set(CHECKS) & set(checks.CHECKS)
    with pytest.raises(SystemExit, match="no such check"):
        runner.main("garments", cases, Options, ["--only", "gravity"])


@pytest.mark.parametrize(
    ("bound", "value", "theory", "tolerance", "expected"),
    [("=", 1.5, 1.0, 1.0, 0.5), ("<=", 3.0, None, 2.0, 1.5), (">=", 4.0, None, 2.0, 0.5), ("<=", 0.0, None, 0.0, 0.0)],
)
def test_shares_of_the_tolerance(bound, value, theory, tolerance, expected):
    assert share({"bound": bound, "value": value, "theory": theory, "tolerance": tolerance}) == expected


def test_theory():
    """Check the solutions against the equations that they solve."""
    assert theory.swing_frequency(1, 0.5) == pytest.approx(1.2024 * np.sqrt(9.81 / 0.5), rel=1e-4)
    np.testing.assert_allclose(theory.swing_shape(2, 0.5, np.array([0.0, 0.5])), [1.0, 0.0], atol=1e-9)
    # angles at which the bending length is half the overhang, and of a nearly stiff strip, D y'''' = sigma g
    assert np.tan(theory.peirce_angle(0.1, 0.05)) == pytest.approx(np.cos(0.5 * theory.peirce_angle(0.1, 0.05)))
    assert theory.peirce_angle(0.1, 1.0) == pytest.approx(0.1**3 / 8.0, rel=1e-3)
    time, step = np.array([0.1, 0.3]), 1e-6
    speed = theory.falling_speed(time, 0.2, 0.6)
    gained = (theory.falling_speed(time + step, 0.2, 0.6) - speed) / step
    np.testing.assert_allclose(gained, 9.81 - 0.6 / 0.2 * speed**2, rtol=1e-4)
    assert theory.falling_speed(10.0, 0.2, 0.6) == pytest.approx(theory.terminal_speed(0.2, 0.6))
    lost = (theory.slowed_speed(3.0, step, 0.2, 0.6) - 3.0) / step
    assert lost == pytest.approx(-0.6 / 0.2 * 9.0, rel=1e-4)
    assert theory.sliding_acceleration(0.2, 0.3) == 0.0
    angle, step = 0.02, 0.005
    for _ in range(400):
        angle = np.arctan(np.sin(angle) / (2.0 - np.cos(angle)))
    assert angle / step == pytest.approx(theory.implicit_spin(4.0, 2.0, step), rel=1e-2)


def test_a_dressed_body_is_measured(device):
    """Run a row with a body: what the cloth gives it is what it receives."""
    pytest.importorskip("pybullet_data", reason="needs the extra motions: the body walks in a DeepMimic clip")
    rows = list(CHECKS["momentum"].measure(Options(fidelity="tiny", device=device)))
    assert [row.verdict for row in rows] == ["holds", "holds"]
    walking = worn.Dressed([worn.SKIRT], Options(fidelity="tiny", device=device), motion="deepmimic:walk", loop=True)
    assert 0.0 <= worn.looks(walking, 0.2).max() < 0.05 and 0.0 < walking.strain() < 0.02
    assert np.isfinite(walking.impulse()).all() and worn.bytes_of(walking) > 1e5


def test_the_hem_of_a_shirt_is_not_caught_between_belly_and_thighs(device):
    """Crouch as far as before a jump: cloth that did not touch the legs went 7 cm deep into the folded hips."""
    settings = {"motion": "deepmimic:jump", "random_start": False}
    crouched = worn.Dressed([worn.SHIRT | {"edge": 0.04}], Options(fidelity="tiny", device=device), **settings)
    assert worn.looks(crouched, 0.6).max() < 0.04
