"""Motions that are drawn by their failures while an agent learns, and scores by motion."""

from __future__ import annotations

import json

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="needs the extras train and rsl")
for needed in ("rsl_rl", "tensordict", "git"):
    pytest.importorskip(needed, reason="needs the extra rsl")

from agents import play as play_script  # noqa: E402
from agents.rsl_rl import train as rsl_ppo  # noqa: E402
from agents.rsl_rl.curriculum import CurriculumEnv, MotionSchedule  # noqa: E402
from piavatar_envs.config import ConfigError  # noqa: E402
from tests.agents.killing import flat, killed_in_step  # noqa: E402

#: Targets without actions follow the slow motions to 4 cm, and are 9 cm behind the kick.
SETTINGS = {
    "fidelity": "tiny", "episode_seconds": 0.4, "control": {"mode": "pd"}, "motion": ["idle", "kick"],
    "impulse": 0.0, "fail_distance": 0.07, "random_start": False,
}  # fmt: skip
TRACK = "PIAvatar/TrackMotion-v0"


def shares_of(env: CurriculumEnv) -> np.ndarray:
    return np.concatenate([group.task.motion_shares.numpy() for group in env.host.groups])


def test_motions_that_fail_are_drawn_more_often(device):
    schedule = MotionSchedule(by="failures", memory=2, floor=0.05)
    env = CurriculumEnv({"motions": schedule}, 12, TRACK, 8, device, SETTINGS, seed=5)
    still = torch.zeros(8, env.num_actions, device=env.device)
    expected, logged = np.ones(2), []
    for _ in range(4):
        counted, failures = np.zeros(2), np.zeros(2)
        for _ in range(12):
            playing = env.host.read(lambda group: group.task.playing).cpu().numpy()
            _, _, ended, extras = env.step(still)
            over, failed = ended.bool().cpu().numpy(), (ended.bool() & ~extras["time_outs"]).cpu().numpy()
            np.add.at(counted, playing[over], 1)
            np.add.at(failures, playing[failed], 1)
        for motion in np.flatnonzero(counted):
            share = failures[motion] / counted[motion]
            expected[motion] = share + (expected[motion] - share) * 0.5 ** counted[motion]
        np.testing.assert_allclose(env.curricula["motions"].failed.cpu().numpy(), expected, rtol=1e-5)
        weights = np.maximum(expected, 0.05)
        np.testing.assert_allclose(shares_of(env), np.tile(weights.cumsum() / weights.sum(), (8, 1)), rtol=1e-5)
        logged.append(float(extras["log"]["Motions/failed"]))
    assert expected[0] < 0.05 < 0.95 < expected[1] and logged[-1] == pytest.approx(expected.mean(), rel=1e-5)
    assert env.host.read(lambda group: group.task.playing).cpu().numpy().mean() > 0.5
    env.close()


def test_one_motion_is_not_weighed(device):
    schedule = {"motions": MotionSchedule(by="failures")}
    for task, settings in (("Reach-v0", {"fidelity": "tiny"}), (TRACK, {**SETTINGS, "motion": "idle"})):
        with pytest.raises(ConfigError, match=r"motions\.by"):
            CurriculumEnv(schedule, 4, task, 1, device, settings)


def test_a_training_resumes_with_its_weights_and_is_scored_by_motion(device, tmp_path, capsys):
    """Bit for bit; ``step`` is held out, and the trained policy plays it."""
    config = {
        "env_id": TRACK, "num_envs": 4, "iterations": 4, "checkpoint_every": 1, "evaluation": {"episodes": 6},
        "env": {
            **SETTINGS, "fail_distance": 0.2, "motion": ["idle", "kick", "squat", "step"], "split": "train",
            "held_out_share": 0.45,
        },
        "ppo": {"rollout_steps": 8, "minibatches": 1, "epochs": 1}, "motions": {"by": "failures", "memory": 2},
    }  # fmt: skip
    path = tmp_path / "track.yaml"
    path.write_text(json.dumps(config))
    command = [str(path), "--device", device, "--out"]
    rsl_ppo.main([*command, str(tmp_path / "whole")])
    printed = capsys.readouterr().out
    assert "trained, by motion" in printed
    parts = tmp_path / "parts"
    with killed_in_step(rsl_ppo.AvatarRslEnv, 20):  # in the third iteration
        rsl_ppo.main([*command, str(parts)])
    rsl_ppo.main([*command, str(parts), "--resume"])
    whole, resumed = (
        torch.load(tmp_path / run / "checkpoint.pt", weights_only=True)["state"] for run in ("whole", "parts")
    )
    assert float(whole["curricula"]["motions"].min()) < 1.0 and whole["envs"]["task.motion_shares"].any()
    bits, others = flat(whole), flat(resumed)
    assert [n for n in bits if others[n] != bits[n] and n not in {".curve.seconds", ".logged.1"}] == []
    table = (parts / "motions.csv").read_text()
    assert table == (tmp_path / "whole" / "motions.csv").read_text()
    assert [line.split(",")[0] for line in table.split()] == ["motion", "idle", "kick", "squat"]

    row = json.loads((parts / "results.json").read_text())["results"][-1]
    motions = {one["motion"]: one for one in row["by_motion"]}
    assert {*motions} <= {"idle", "kick", "squat"} and sum(one["episodes"] for one in motions.values()) == 6
    for key in ("followed", "g_mpjpe_mm", "mpjpe_mm", "acceleration_error_mm"):
        mean = np.average([one[key] for one in row["by_motion"]], weights=[one["episodes"] for one in row["by_motion"]])
        assert mean == pytest.approx(row[key])
    out = tmp_path / "held_out.json"
    play_script.main([str(parts), "split=held_out", "--episodes", "2", "--device", device, "--out", str(out)])
    held_out = json.loads(out.read_text())
    assert held_out["env"]["split"] == "held_out" and "by_motion" not in held_out["results"][0]
