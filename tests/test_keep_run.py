"""Runs kept beside the results: what is left of them says the same."""

from __future__ import annotations

import io
import json
import shutil
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml

from scripts import keep_run


@pytest.fixture
def run(tmp_path):
    """A training that has ended, as it lies in its folder."""
    folder = tmp_path / "runs" / "walk_1"
    folder.mkdir(parents=True)
    config = {"env_id": "Walk-v0", "total_steps": 200, "env": {"physics": {"friction": 0.8}}, "observe": None}
    (folder / "config.yaml").write_text(yaml.safe_dump(config))
    (folder / "results.json").write_text(json.dumps({"benchmark": "train", "config": config}))
    (folder / "evaluation.json").write_text("of evaluation.json\n")
    rng = np.random.default_rng(2)
    rows = [f"{10 * n},{value:.6g}" for n, value in enumerate(rng.normal(100.0, 9.0, 4321), 1)]
    (folder / "curve.csv").write_text("\n".join(["step,return", *rows]) + "\n")
    held = io.BytesIO()
    torch.save({"weight": torch.arange(600.0)}, held)
    with zipfile.ZipFile(folder / "policy.zip", "w") as content:
        content.writestr("policy.pth", held.getvalue())
        content.writestr("policy.optimizer.pth", bytes(10000))
    return folder


def read(path):
    return np.loadtxt(path, delimiter=",", skiprows=1)


def test_what_is_kept_says_the_same(run, tmp_path):
    kept = tmp_path / "results" / "walk_1"
    assert keep_run.main((run,), kept.parent) == 0
    for name in ("config.yaml", "results.json", "evaluation.json"):
        assert (kept / name).read_bytes() == (run / name).read_bytes()
    with zipfile.ZipFile(kept / "policy.zip") as content:
        assert content.namelist() == ["policy.pth"]
        weight = torch.load(io.BytesIO(content.read("policy.pth")), weights_only=True)["weight"]
    torch.testing.assert_close(weight, torch.arange(600.0))
    whole, short = read(run / "curve.csv"), read(kept / "curve.csv")
    assert len(short) == keep_run.ROWS and (np.diff(short[:, 0]) > 0).all()
    assert short[-1, 0] == whole[-1, 0]
    counts = np.diff(np.searchsorted(whole[:, 0], short[:, 0], side="right"), prepend=0)
    assert counts.min() >= 4 and counts.sum() == len(whole)
    assert counts @ short[:, 1] / len(whole) == pytest.approx(whole[:, 1].mean(), rel=1e-5)


def test_a_short_curve_stays(run, tmp_path):
    (run / "curve.csv").write_text("step,return\n10,1.5\n20,2\n")
    keep_run.main((run,), tmp_path)
    assert (tmp_path / "walk_1" / "curve.csv").read_text() == "step,return\n10,1.5\n20,2\n"


def spoilt(run, name, change):
    """A copy of a run beside it, with something wrong."""
    other = shutil.copytree(run, run.parent / name)
    change(other)
    return other


def only_an_optimizer(folder):
    with zipfile.ZipFile(folder / "policy.zip", "w") as content:
        content.writestr("policy.optimizer.pth", b"")


def goes_on(folder):
    """It was to be longer when it had ended, and has not ended again."""
    path = folder / "config.yaml"
    path.write_text(path.read_text().replace("total_steps: 200", "total_steps: 400"))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda folder: (folder / "results.json").unlink(), r"walk_2 has no results\.json"),
        (lambda folder: (folder / "results.json").write_text("{}"), "walk_2 has something else"),
        (goes_on, r"walk_2/results\.json is of total_steps=200, and config\.yaml says 400: go on with the training"),
        (lambda folder: (folder / "policy.zip").write_bytes(b"no archive"), "walk_2 has something else"),
        (only_an_optimizer, r"policy\.pth"),
        (lambda folder: (folder / "curve.csv").write_text(""), r"curve\.csv is empty"),
        (lambda folder: (folder / "curve.csv").write_text("step,return\n1,2,3\n"), "walk_2 has something else"),
    ],
)
def test_nothing_is_written_where_something_is_wrong(run, tmp_path, change, message):
    with pytest.raises(ValueError, match=message):
        keep_run.main((run, spoilt(run, "walk_2", change)), tmp_path / "results")
    assert not (tmp_path / "results").exists()


def test_names_are_taken_once(run, tmp_path, monkeypatch):
    to = tmp_path / "results"
    with pytest.raises(ValueError, match="no runs"):
        keep_run.main((), to)
    with pytest.raises(ValueError, match="is there already"):
        keep_run.main((run, run), to)
    assert not to.exists()
    monkeypatch.chdir(run)
    keep_run.main((Path("."),), to)
    assert (to / "walk_1" / "results.json").is_file()
    with pytest.raises(ValueError, match="is there already"):
        keep_run.main((run,), to)
