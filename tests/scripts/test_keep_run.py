"""Runs copied to the committed results: scores of all seeds, the policy of one."""

from __future__ import annotations

import io
import json
import shutil
import zipfile

import pytest
import torch
import yaml

from scripts import keep_run

CONFIG = {"env_id": "Walk-v0", "total_steps": 200, "env": {"physics": {"friction": 0.8}}, "observe": None}


def make_run(folder, value):
    """Write a finished training whose policy returns ``value``."""
    folder.mkdir(parents=True)
    rows = [{"case": "zero", "return_mean": 1000.0}, {"case": "trained", "return_mean": value}]
    (folder / "config.yaml").write_text(yaml.safe_dump(CONFIG))
    (folder / "results.json").write_text(json.dumps({"benchmark": "sb3.train", "config": CONFIG, "results": rows}))
    (folder / "curve.csv").write_text("step,return\n10,1.5\n")
    held = io.BytesIO()
    torch.save({"action_net.weight": torch.arange(600.0), "value_net.weight": torch.arange(3.0)}, held)
    with zipfile.ZipFile(folder / "policy.zip", "w") as content:
        content.writestr("policy.pth", held.getvalue())
        content.writestr("policy.optimizer.pth", bytes(10000))
    return folder


@pytest.fixture
def run(tmp_path):
    return make_run(tmp_path / "runs" / "walk_1", 5.0)


def files(folder):
    return {path.name for path in folder.iterdir()}


def test_the_scores_of_a_run_are_kept_and_of_its_policy_the_actor(run, tmp_path):
    kept = tmp_path / "results" / "walk_1"
    assert keep_run.main((run,), kept.parent) == 0
    assert files(kept) == {"config.yaml", "results.json", "policy.zip"}
    for name in ("config.yaml", "results.json"):
        assert (kept / name).read_bytes() == (run / name).read_bytes()
    with zipfile.ZipFile(kept / "policy.zip") as content:
        assert content.namelist() == ["policy.pth"]
        parameters = torch.load(io.BytesIO(content.read("policy.pth")), weights_only=True)
    assert list(parameters) == ["action_net.weight"]
    torch.testing.assert_close(parameters["action_net.weight"], torch.arange(600.0))


def test_the_policy_of_the_median_seed_is_kept_by_its_last_score(tmp_path):
    runs = tuple(make_run(tmp_path / "runs" / f"walk_{n}", value) for n, value in enumerate((9.0, 1.0, 5.0)))
    rows = [{"case": "trained", "return_mean": 2.0}]
    (runs[0] / "evaluation.json").write_text(json.dumps({"results": rows}))  # 2, 1, 5: the first is the median
    assert keep_run.main(runs, tmp_path / "results") == 0
    with_policy = [
        folder.name for folder in sorted((tmp_path / "results").iterdir()) if (folder / "policy.zip").exists()
    ]
    assert with_policy == ["walk_0"]
    assert files(tmp_path / "results" / "walk_0") == {"config.yaml", "results.json", "evaluation.json", "policy.zip"}
    assert files(tmp_path / "results" / "walk_2") == {"results.json"}


def spoilt(run, name, change):
    """Copy a run beside it and damage the copy."""
    other = shutil.copytree(run, run.parent / name)
    change(other)
    return other


def only_an_optimizer(folder):
    with zipfile.ZipFile(folder / "policy.zip", "w") as content:
        content.writestr("policy.optimizer.pth", b"")


def goes_on(folder):
    """Make a training longer than its scores are of."""
    path = folder / "config.yaml"
    path.write_text(path.read_text().replace("total_steps: 200", "total_steps: 400"))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda folder: (folder / "results.json").unlink(), r"walk_2 has no results\.json"),
        (lambda folder: (folder / "results.json").write_text("{}"), "walk_2 has unreadable"),
        (goes_on, r"walk_2/results\.json is of total_steps=200, and config\.yaml says 400"),
        (lambda folder: (folder / "policy.zip").write_bytes(b"no archive"), r"walk_2/policy\.zip"),
        (only_an_optimizer, r"policy\.pth"),
    ],
)
def test_nothing_is_written_where_something_is_wrong(run, tmp_path, change, message):
    with pytest.raises(ValueError, match=message):
        keep_run.main((run, spoilt(run, "walk_2", change)), tmp_path / "results")
    assert not (tmp_path / "results").exists()
