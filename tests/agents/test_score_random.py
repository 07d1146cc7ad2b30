"""Scores of several streams of random actions, from the command line."""

from __future__ import annotations

import json

import numpy as np
import pytest

pytest.importorskip("torch", reason="needs the extra train")

from agents import score_random, scores
from agents.config import first_training_seed
from agents.evaluate import for_all_seats, over_seeds, play, random_agent
from agents.pid import score as score_pid
from piavatar_envs.api.host import EpisodeHost
from piavatar_envs.config import load_config
from piavatar_envs.tasks import load_task


@pytest.fixture(scope="module")
def run(device, tmp_path_factory):
    """A folder as a run leaves it."""
    folder = tmp_path_factory.mktemp("pid_stand")
    short = ("PIAvatar/Stand-v0", "fidelity=tiny", "episode_seconds=0.4", "--evaluation.episodes", "2")
    score_pid.main([*short, "--out", str(folder), "--device", device])
    return folder


def test_every_seed_is_a_stream_of_its_own_in_the_same_episodes(run, device, tmp_path, capsys):
    arguments = [str(run), "--seeds", "3", "--evaluation.episodes", "2", "--device", device]
    score_random.main([*arguments, "--out", str(tmp_path)])
    report = json.loads((tmp_path / "results.json").read_text())
    (row,) = report["results"]
    assert (row["case"], row["seeds"], row["episodes"], row["first_seed"]) == ("random", 3, 2, 1_000_000)
    env = report["config"]["env"]
    assert env == json.loads((run / "results.json").read_text())["config"]["env"]
    task = load_task("Stand-v0")
    batch = EpisodeHost(task(load_config(task.Config, env)), 2, device)
    agents = [random_agent(batch.action_size, first_training_seed(seed)) for seed in range(3)]
    rows = [play("random", for_all_seats(agent), batch, 1_000_000).row() for agent in agents]
    batch.close()
    means = [seed["return_mean"] for seed in rows]
    assert np.ptp(means) > 0.0
    assert row["return_mean"] == pytest.approx(np.mean(means))
    assert row["return_interval"] == pytest.approx(over_seeds(rows)["return_interval"])
    pid = json.loads((run / "results.json").read_text())
    table = {found["agent"]: found["seeds"] for found in scores.scores({"pid": pid, "random": report})}
    assert table == {"random": 3, "zero": None, "PID": None}


def test_what_is_no_run_and_one_seed_are_refused(run, tmp_path, monkeypatch):
    with pytest.raises(SystemExit, match=r"error: .*no file"):
        score_random.main([str(tmp_path)])
    (tmp_path / "results.json").write_text("{}")
    with pytest.raises(SystemExit, match=r"has no config.env_id and config.env"):
        score_random.main([str(tmp_path)])
    monkeypatch.setattr(score_random, "EpisodeHost", None)  # nothing is built
    with pytest.raises(SystemExit, match="seeds=1 must be >= 2"):
        score_random.main([str(run), "--seeds", "1"])
