"""The PID agent's scores from the command line."""

from __future__ import annotations

import json

import pytest

pytest.importorskip("torch", reason="needs the extra train")

from agents import scores
from agents.pid import score as score_pid
from piavatar_envs.avatar.motion import deepmimic

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
    assert (out / "config.yaml").read_text().count("control: torque") == 1
    table = scores.scores({"pid_stand": report})
    assert [row["agent"] for row in table] == ["random", "zero", "PID"]


@pytest.mark.skipif(deepmimic.clip_folder() is None, reason="needs the extra motions: DeepMimic's clips")
def test_it_plays_the_walk_of_deepmimic(device, tmp_path):
    walk = ("PIAvatar/TrackMotion-v0", "motion=deepmimic:walk", "impulse=0", "root_action=false", *SHORT[1:])
    score_pid.main([*walk, "--evaluation.episodes", "2", "--out", str(tmp_path), "--device", device])
    report = json.loads((tmp_path / "results.json").read_text())
    assert report["config"]["env"]["motion"] == "deepmimic:walk"
    assert report["config"]["env"]["control"]["mode"] == "torque"
    zero, _, pid = (row["return_mean"] for row in report["results"])
    assert pid > 0.0 and pid != zero


def test_bodies_that_no_torques_move_are_refused():
    with pytest.raises(SystemExit, match="error: control='pose'"):
        score_pid.main([*SHORT, "control.mode=pose"])
    with pytest.raises(SystemExit, match=r"error: .*Fly-v0"):
        score_pid.main(["PIAvatar/Fly-v0"])


@pytest.mark.parametrize(
    ("options", "told"),
    [
        (("--evaluation.episodes", "1"), "error: episodes=1 must be >= 2"),
        (("--film", "x.avi"), "error: video x.avi ends in '.avi'; use .mp4 or .gif"),
        (("--device", "cuda:99"), "error: device='cuda:99' is not available"),
    ],
)
def test_mistakes_end_in_one_line_and_leave_nothing(options, told, tmp_path, capsys):
    with pytest.raises(SystemExit) as stop:
        score_pid.main([*SHORT, *options, "--out", str(tmp_path / "out")])
    assert str(stop.value).startswith(told) and "\n" not in str(stop.value)
    assert "Value error" not in capsys.readouterr().err and not (tmp_path / "out").exists()
