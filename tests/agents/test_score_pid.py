"""The PID agent's scores from the command line."""

from __future__ import annotations

import json

import pytest

pytest.importorskip("torch", reason="needs the extra train")

from agents import scores
from agents.pid import score as score_pid

SHORT = ("PIAvatar/Stand-v0", "fidelity=tiny", "episode_seconds=0.2")


def test_scores_are_those_of_the_episodes_and_go_into_the_table(device, tmp_path, capsys):
    out = tmp_path / "pid_stand"
    score_pid.main(
        [*SHORT, "--evaluation.episodes", "3", "--out", str(out), "--device", device, "--design.unloaded", "0.5"]
    )
    report = json.loads((out / "results.json").read_text())
    assert [row["case"] for row in report["results"]] == ["zero", "random", "PID"]
    assert all(row["episodes"] == 3 and row["first_seed"] == 1_000_000 for row in report["results"])
    assert report["results"][2]["return_mean"] != report["results"][0]["return_mean"]
    assert report["config"]["design"]["unloaded"] == 0.5
    assert (out / "config.yaml").read_text().count("mode: torque") == 1
    table = scores.scores({"pid_stand": report})
    assert [row["agent"] for row in table] == ["random", "zero", "PID"]
