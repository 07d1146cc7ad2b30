"""A recording of known parameters, from the command line to the parameters that a study finds again."""

from __future__ import annotations

import json

import numpy as np
import pytest
import yaml

pytest.importorskip("torch", reason="needs the extra fit")
pytest.importorskip("optuna", reason="needs the extra fit")

from agents.fit import __main__ as fit
from agents.fit import record
from agents.fit.study import RESIDUALS
from tests.agents.test_fit import STUDY


def test_a_hidden_mass_is_found_again(tmp_path, device):
    study, motion, folder = tmp_path / "mass.yaml", tmp_path / "motion.npz", tmp_path / "run"
    study.write_text(yaml.safe_dump({**STUDY, "scorer": "recorded", "scorers": {"recorded": {"path": str(motion)}}}))
    given = ["--values", "scene.props.0.mass=3.0", "--markers", "20", "--device", device]
    record.main([str(study), str(motion), *given])
    with np.load(motion) as file:
        shapes = {name: file[name].shape for name in file.files}
        exact = file["marker_position"]
    assert shapes["bone_position"] == (4, 22, 3) and shapes["prop_position"] == (4, 1, 3)
    assert shapes["marker_position"] == (4, 20, 3) and shapes["time"] == (4,)
    fit.main([str(study), "trials=8", "startup=8", "--out", str(folder), "--device", device])
    found = json.loads((folder / "results.json").read_text())
    best = found["best"]
    assert best["values"]["scene.props.0.mass"] == pytest.approx(3.0, rel=0.05)
    low, high = best["intervals"]["scene.props.0.mass"]
    assert low <= 3.0 * 1.01 and high >= 3.0 * 0.99 and found["config"]["direction"] is None
    assert len(list((folder / RESIDUALS).glob("*.npy"))) == 8
    record.main([str(study), str(motion), *given, "--noise", "0.005"])
    with np.load(motion) as file:
        assert np.std(file["marker_position"] - exact) == pytest.approx(0.005, rel=0.2)


def test_values_out_of_range_and_other_files_are_refused(tmp_path):
    study = tmp_path / "mass.yaml"
    study.write_text(yaml.safe_dump(STUDY))
    for arguments, message in (
        ([str(tmp_path / "m.npz"), "--values", "scene.props.0.mass=30.0"], r"mass=30.0 must be given, in \[1, 8\]"),
        ([str(tmp_path / "m.npz")], "mass=None must be given"),
        ([str(tmp_path / "m.csv")], "must be a .npz file"),
    ):
        with pytest.raises(SystemExit, match=message):
            record.main([str(study), *arguments])
