"""Kept agents are scored anew as they were recorded."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

pytest.importorskip("torch", reason="needs the extra train")

from agents import score_random
from agents.pid import score as score_pid
from scripts import rescore

RESULTS = Path(__file__).parents[2] / "benchmarks" / "results"


def test_every_kept_agent_has_a_job():
    jobs = rescore.find_jobs(RESULTS, Path("out"), "cuda")
    policies = {path.parent for path in RESULTS.glob("ppo/*/policy.*")}
    kept = {*policies, *RESULTS.glob("pid/*"), *RESULTS.glob("random/*")}
    assert {job.source for job in jobs} == kept and len(jobs) == len(kept)
    assert len(policies) == len({path.name.rpartition("_")[0] for path in RESULTS.glob("ppo/*")}) >= 9
    assert all("cuda" in job.command for job in jobs)


def test_scoring_again_comes_to_the_same(tmp_path, device):
    """Score two agents of a small body: the same scores, a new date, one table, and the record untouched."""
    pid, stream = tmp_path / "pid" / "pid_Stand", tmp_path / "random" / "Stand"
    small = ("PIAvatar/Stand-v0", "fidelity=tiny", "episode_seconds=0.2", "control.firm_bones=false")
    episodes = ("--evaluation.episodes", "3", "--evaluation.first-seed", "7", "--device", device)
    score_pid.main([*small, *episodes, "--design.hip-share", "0.25", "--out", str(pid)])
    score_random.main([str(pid), "--seeds", "2", *episodes, "--out", str(stream)])
    before = [(folder / "results.json").read_bytes() for folder in (pid, stream)]
    out = tmp_path / "out"
    assert rescore.main(tmp_path, out, device, 2) == 0
    assert [(folder / "results.json").read_bytes() for folder in (pid, stream)] == before
    for old, folder in zip(map(json.loads, before), ("pid/pid_Stand", "random/Stand"), strict=True):
        new = json.loads((out / folder / "results.json").read_text())
        assert new["results"] == old["results"] and new["config"] == old["config"] and new["date"] > old["date"]
    table = json.loads((out / rescore.TABLE).read_text())
    assert {row["agent"] for row in table["results"]} >= {"PID", "random"}


def test_a_job_that_fails_is_told_and_leaves_the_table(tmp_path, device, capsys):
    folder = tmp_path / "ppo" / "stand_0"
    folder.mkdir(parents=True)
    (folder / "config.yaml").write_text("env_id: PIAvatar/Stand-v0\n")
    (folder / "policy.pt").write_bytes(b"no policy")
    assert rescore.main(tmp_path, tmp_path / "out", device) == 1
    words = capsys.readouterr().err
    assert "policy.pt" in words and "1 of 1 failed" in words
    assert not (tmp_path / "out" / rescore.TABLE).exists()
