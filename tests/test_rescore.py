"""Kept agents are scored anew as they were recorded."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

pytest.importorskip("torch", reason="needs the extra train")

from agents import score_random
from agents.pid import score as score_pid
from agents.pid.agent import Design
from piavatar_envs.config import load_config, parse_assignments
from piavatar_envs.tasks import load_task
from scripts import rescore

RESULTS = Path(__file__).parents[1] / "benchmarks" / "results"


def test_every_kept_agent_has_a_job():
    jobs = rescore.find_jobs(RESULTS, Path("out"), "cuda")
    policies = {path.parent for path in RESULTS.glob("ppo/*/policy.*")}
    kept = {*policies, *RESULTS.glob("pid/*"), *RESULTS.glob("random/*")}
    assert {job.source for job in jobs} == kept and len(jobs) == len(kept)
    assert len(policies) == len({path.name.rpartition("_")[0] for path in RESULTS.glob("ppo/*")}) >= 9
    assert all("cuda" in job.command for job in jobs)


@pytest.mark.parametrize("folder", sorted(RESULTS.glob("pid/*")), ids=lambda path: path.name)
def test_the_arguments_of_a_pid_agent_are_its_settings(folder):
    recorded = json.loads((folder / "results.json").read_text())["config"]
    env_id, *rest = rescore.pid_arguments(folder)
    settings = [word for word in rest if "=" in word]
    config = load_config(load_task(env_id).Config, {"control": "torque"}, parse_assignments(settings))
    resolved = config.model_dump(mode="json")
    assert [name for name, _ in rescore.differences(recorded["env"], resolved)] == []
    said = dict(zip(rest[len(settings) :: 2], rest[len(settings) + 1 :: 2], strict=True))
    changed = {
        f"--design.{name.replace('_', '-')}": str(value)
        for name, value in recorded["design"].items()
        if value != json.loads(json.dumps(getattr(Design(), name)))
    }
    assert said == changed


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


def test_policies_are_scored_on_the_bones_of_last_time_or_on_others(tmp_path):
    folder = tmp_path / "ppo" / "stand_0"
    folder.mkdir(parents=True)
    (folder / "policy.pt").touch()

    def command(bones: bool | None = None) -> tuple[str, ...]:
        (job,) = rescore.find_jobs(tmp_path, tmp_path, "cpu", bones)
        return job.command

    as_trained = command()
    assert not any("bone_contact" in word for word in as_trained)
    assert set(command(True)) - set(as_trained) == {"control.bone_contact=true"}
    (folder / "evaluation.json").write_text(json.dumps({"env": {"physics": {"fidelity": "coarse"}}}))
    assert command() == as_trained  # from before there was this setting
    (folder / "evaluation.json").write_text(json.dumps({"env": {"control": {"bone_contact": False}}}))
    assert set(command()) - set(as_trained) == {"control.bone_contact=false"}
    assert command(True) == (*as_trained[:2], "control.bone_contact=true", *as_trained[2:])


def test_kept_policies_were_scored_in_the_environment_as_it_comes():
    bones = [rescore.scored_on(path.parent) for path in RESULTS.glob("ppo/*/evaluation.json")]
    assert len(bones) > 40 and all(bones)


def test_nothing_to_score_is_refused(tmp_path):
    with pytest.raises(ValueError, match="has 0 agents and jobs=1; both must be >= 1"):
        rescore.main(tmp_path)
