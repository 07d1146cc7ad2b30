"""Trainings that differ in their seed are summed up, and others are not."""

from __future__ import annotations

import copy
import json

import pytest

from agents import compare
from agents.sb3 import train
from agents.sb3.config import load_training
from piavatar_envs.config import dump_yaml
from tests.agents.conftest import TINY


@pytest.fixture(scope="module")
def runs(device, tmp_path_factory):
    """Folders of three short trainings."""
    root = tmp_path_factory.mktemp("compare")
    path = root / "short.yaml"
    path.write_text(dump_yaml(load_training(TINY)))
    for seed in range(3):
        train.main([str(path), f"seed={seed}", "total_steps=32", "--out", str(root / str(seed)), "--device", device])
    return [root / str(seed) for seed in range(3)]


def test_runs_of_several_seeds_become_one_table(runs, tmp_path, capsys):
    compare.main([*map(str, runs), "--out", str(tmp_path / "scores.json")])
    report = json.loads((tmp_path / "scores.json").read_text())
    assert report["seeds"] == [0, 1, 2] and report["of"] == "sb3.train" and "seed" not in report["config"]
    zero, random, trained = report["results"]
    own = [json.loads((run / "results.json").read_text())["results"] for run in runs]
    assert zero == {**own[0][0], "seeds": None} and random == {**own[0][1], "seeds": None}
    assert trained["seeds"] == 3
    means = [rows[2]["return_mean"] for rows in own]
    assert len(set(means)) == 3 and trained["return_mean"] == pytest.approx(sum(means) / 3)
    low, high = trained["return_interval"]
    assert low < min(means) and max(means) < high  # three seeds are few
    shown = capsys.readouterr().out
    assert "trained with 3 seeds" in shown and "zero" in shown and "random" in shown


def test_what_cannot_be_compared_is_refused(runs, tmp_path):
    first, second = (json.loads((run / "results.json").read_text()) for run in runs[:2])
    other = copy.deepcopy(second)
    other["config"]["ppo"]["epochs"] = 7
    with pytest.raises(ValueError, match=r"b has ppo.epochs=7, a has 2; only seeds may differ"):
        compare.summarize({"a": first, "b": other})
    with pytest.raises(ValueError, match=r"the runs have the seeds \[0, 0\]"):
        compare.summarize({"a": first, "b": first})
    with pytest.raises(ValueError, match="there are 1 runs"):
        compare.summarize({"a": first})
    games = [{**run, "results": [{"case": "a against b", "win_rate": 0.5}]} for run in (first, second)]
    with pytest.raises(ValueError, match="match of competing agents"):
        compare.summarize({"a": games[0], "b": games[1]})
    with pytest.raises(SystemExit, match=r"error: .*nowhere"):
        compare.main([str(runs[0]), "nowhere.json"])
    for content in ("[]", "{}"):
        (tmp_path / "other.json").write_text(content)
        with pytest.raises(SystemExit, match=r"error: .*other\.json has no 'benchmark'; give runs of"):
            compare.main([str(runs[0]), str(tmp_path / "other.json")])
