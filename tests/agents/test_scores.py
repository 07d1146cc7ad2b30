"""Runs of several agents, environments and seeds in one table."""

from __future__ import annotations

import copy
import io
import json
import sys
from pathlib import Path

import pytest

from agents import compare, scores


def row(case: str, value: float, **more) -> dict:
    """An agent's figures over 10 episodes."""
    return {
        "case": case, "return_mean": value, "return_interval": [value - 1.0, value + 1.0], "return_std": 1.0,
        "success_once": 1.0, "success_once_interval": [0.7, 1.0], "success_at_end": 0.5,
        "success_at_end_interval": [0.2, 0.8], "mean_steps": 30.0, "steps_interval": [20.0, 40.0], "failures": 0,
        "episodes": 10, "first_seed": 7, **more,
    }  # fmt: skip


def run(script: str, env_id: str, seed: int, *rows: dict, seconds: float = 60.0) -> dict:
    return {
        "benchmark": script, "commit": "abc", "device": {"name": "some GPU"}, "versions": {}, "seed": seed,
        "config": {"env_id": env_id, "seed": seed, "ppo": {"epochs": 5}, "env": {"physics": {"fidelity": "coarse"}}},
        "training_s": seconds, "train_steps": 2_000_000,
        "results": [row("zero", 3.0), row("random", 2.0), *rows],
    }  # fmt: skip


@pytest.fixture
def runs() -> dict[str, dict]:
    """Two seeds and another script in one environment, and one run in another."""
    followed = {"followed": 0.75, "followed_interval": [0.5, 0.9], "g_mpjpe_mm": 31.26, "mpjpe_mm": 20.0}
    followed |= {"acceleration_error_mm": 3.0}
    pushes = {"by_push": [{"impulse_n_s": [0.0, 5.0], "episodes": 10, "lasted": 0.5, "lasted_interval": [0.2, 0.8]}]}
    return {
        "stand_0": run("rsl_rl.train", "Stand-v0", 0, row("trained", 80.0)),
        "stand_1": run("rsl_rl.train", "Stand-v0", 1, row("trained", 90.0), seconds=80.0),
        "stand_pid": {
            key: value
            for key, value in run("pid.score", "Stand-v0", 0, row("PID", 40.0)).items()
            if key not in ("training_s", "train_steps")
        },
        "push": run("sb3.train", "Push-v0", 0, row("trained", 10.0, **pushes, **followed)),
    }


def test_seeds_become_one_row_and_the_untrained_stand_once(runs):
    rows = scores.scores(runs)
    assert [(r["env_id"], r["agent"], r["seeds"]) for r in rows] == [
        ("Push-v0", "random", None), ("Push-v0", "zero", None), ("Push-v0", "sb3_ppo", 1),
        ("Stand-v0", "random", None), ("Stand-v0", "zero", None), ("Stand-v0", "PID", None), ("Stand-v0", "rsl_ppo", 2),
    ]  # fmt: skip
    trained = rows[-1]
    assert (
        trained["return_mean"] == 85.0 and trained["training_s"] == 70.0 and trained["runs"] == ["stand_0", "stand_1"]
    )
    # Student's t of one degree of freedom: 12.7 standard errors, of 5 each
    assert trained["return_interval"] == pytest.approx([85.0 - 12.706 * 5.0, 85.0 + 12.706 * 5.0], rel=1e-3)
    assert rows[2]["by_push"][0]["lasted"] == 0.5


def streams(env_id: str, value: float, **env) -> dict:
    """A run of random actions of several seeds."""
    content = run("score_random", env_id, 0)
    content["config"]["env"] |= env
    return content | {"results": [row("random", value, seeds=5, episodes=4)]}


def test_several_streams_of_random_actions_take_the_place_of_single_ones(runs):
    """In all runs of their settings: of one that has others, the single stream stays."""
    runs["stand_pid"]["config"]["env"]["joints"] = ["head"]
    runs["stand_pid"]["results"][1]["return_mean"] = 1.5
    rows = scores.scores(
        runs
        | {"a": streams("Push-v0", 2.5), "b": streams("Stand-v0", 2.7, joints=None)}
        | {"c": streams("Stand-v0", 2.9, joints=["neck"])}
    )
    found = {(r["env_id"], r["agent"]): (r["return_mean"], r["seeds"], r["episodes"]) for r in rows}
    assert found["Push-v0", "random"] == (2.5, 5, 4)
    assert found["Stand-v0", "random"] == (2.7, 5, 4)
    assert found["Stand-v0", "random, as PID"] == (1.5, None, 10)
    assert found["Stand-v0", "random, as score_random"] == (2.9, 5, 4)
    assert len(rows) == 9 and found["Stand-v0", "zero"] == (3.0, None, 10)


def test_a_table_an_environment_in_both_files(runs, tmp_path, capsys):
    """With what drives the avatar; what an environment does not say is as by default."""
    runs["push"]["config"]["env"]["control"] = {"mode": "pd", "firm_bones": False}
    runs["stand_pid"]["config"]["env"]["control"] = {"mode": "torque", "bone_contact": False}
    for name, content in runs.items():
        (tmp_path / name).mkdir()
        (tmp_path / name / "results.json").write_text(json.dumps(content))
    scores.main([*(str(tmp_path / name) for name in runs), "--out", str(tmp_path / "table.json")])
    report = json.loads((tmp_path / "table.json").read_text())
    assert len(report["results"]) == 7 and report["devices"] == ["some GPU"] and report["commits"] == ["abc"]
    text = (tmp_path / "table.md").read_text()
    assert text.index("## Push-v0") < text.index("## Stand-v0")
    assert "| rsl_ppo | pd | solid | 2 | 10 | 85.0 (21.5 to 148.5) |" in text and "2 M steps, 70 s" in text
    assert "| sb3_ppo | pd | slipping | 1 |" in text and "| PID | torque | firm |" in text
    assert "| 0 to 5 | 50% of 10 |" in text and "| sb3_ppo | pd | 75% (50% to 90%) | 31.3 | 20.0 | 3.0 |" in text
    assert "some GPU; commits abc." in text and "Zero actions and the PID agent have no seeds" in text
    with pytest.raises(SystemExit, match=r"error: .*nowhere"):
        scores.main([str(tmp_path / "nowhere")])


def later(folder, **more) -> None:
    """Leave an evaluation of a run as ``agents.play`` does."""
    about = {"benchmark": "play", "commit": "def", "device": {"name": "another GPU"}, "run": folder.name}
    env = {"physics": {"fidelity": "coarse"}}
    content = about | {"env": env, "results": [row("trained", 60.0, failures=1)]} | more
    (folder / "evaluation.json").write_text(json.dumps(content))


def test_a_later_evaluation_takes_the_place_of_the_trainings_own(runs, tmp_path, capsys):
    for name in ("stand_0", "stand_1"):
        (tmp_path / "runs" / name).mkdir(parents=True)
        (tmp_path / "runs" / name / "results.json").write_text(json.dumps(runs[name]))
    later(tmp_path / "runs" / "stand_0")
    (tmp_path / "link").symlink_to(tmp_path / "runs" / "stand_0")
    scores.main([str(tmp_path / "link"), str(tmp_path / "runs" / "stand_1"), "--out", str(tmp_path / "table.json")])
    report = json.loads((tmp_path / "table.json").read_text())
    *untrained, trained = report["results"]
    assert trained["return_mean"] == 75.0 and trained["failures"] == 1, "60 in place of 80, beside 90"
    assert trained["training_s"] == 70.0 and trained["train_steps"] == 2_000_000
    assert [r["return_mean"] for r in untrained] == [2.0, 3.0]
    assert report["commits"] == ["abc", "def"] and report["devices"] == ["another GPU", "some GPU"]


@pytest.mark.parametrize(
    ("run_name", "more", "words"),
    [
        ("push", {"benchmark": "sb3.train"}, "benchmark='sb3.train', of this run it would have 'play'"),
        ("push", {"run": "push_1"}, "run='push_1', of this run it would have 'push'"),
        ("push", {"env": {"physics": {"fidelity": "tiny"}}}, "env.physics.fidelity='tiny', .* 'coarse'"),
        ("push", {"results": [row("trained", 60.0, first_seed=8)]}, "first_seed.trained=8, .* 7"),
        ("push", {"date": "2026-01-01T00:00:01+00:00"}, "is older than .*results.json"),
        ("stand_pid", {}, r"is of a policy, but .*results.json has no row 'trained'; remove"),
    ],
)
def test_evaluations_of_something_else_are_refused(run_name, more, words, runs, tmp_path):
    folder = tmp_path / run_name
    folder.mkdir()
    (folder / "results.json").write_text(json.dumps(runs[run_name] | {"date": "2026-01-01T00:00:02+00:00"}))
    later(folder, **{"date": "2026-01-01T00:00:02+00:00"} | more)
    with pytest.raises(SystemExit, match=f"error: .*evaluation.json (has )?{words}") as refused:
        scores.main([str(folder)])
    assert run_name == "stand_pid" or f"python -m agents.play {folder} --out" in str(refused.value)


def test_other_environments_keep_their_rows(runs, tmp_path, capsys):
    for name, content in runs.items():
        (tmp_path / name).mkdir()
        (tmp_path / name / "results.json").write_text(json.dumps(content | {"commit": name}))
    first, second = tmp_path / "first.json", tmp_path / "second.json"
    scores.main([*(str(tmp_path / name) for name in runs), "--out", str(first)])
    scores.main([str(tmp_path / "stand_1"), "--keep", str(first), "--out", str(second)])
    before, after = (json.loads(path.read_text()) for path in (first, second))
    pushed = [row for row in before["results"] if row["env_id"] == "Push-v0"]
    assert after["results"][:3] == pushed and {row["env_id"] for row in after["results"][3:]} == {"Stand-v0"}
    assert after["results"][-1]["return_mean"] == 90.0
    assert after["commits"] == sorted(name[:12] for name in runs)
    with pytest.raises(SystemExit, match=r"results.json has no 'devices'"):
        scores.main([str(tmp_path / "stand_1"), "--keep", str(tmp_path / "push" / "results.json")])


def test_other_settings_are_refused(runs):
    other = copy.deepcopy(runs)
    other["stand_1"]["config"]["ppo"]["epochs"] = 6
    with pytest.raises(ValueError, match=r"ppo\.epochs=6"):
        scores.scores(other)
    with pytest.raises(ValueError, match="there are no runs"):
        scores.scores({})


def test_runs_of_several_seeds_are_compared(tmp_path, capsys):
    found = [run("sb3.train", "Reach-v0", seed, row("trained", value)) for seed, value in enumerate((4.0, 5.0, 9.0))]
    for seed, content in enumerate(found):
        (tmp_path / f"{seed}.json").write_text(json.dumps(content))
    files = [str(tmp_path / f"{seed}.json") for seed in range(3)]
    compare.main([*files, "--out", str(tmp_path / "scores.json")])
    report = json.loads((tmp_path / "scores.json").read_text())
    assert report["seeds"] == [0, 1, 2] and report["of"] == "sb3.train" and "seed" not in report["config"]
    zero, random, trained = report["results"]
    assert [zero["return_mean"], random["return_mean"], trained["return_mean"]] == [3.0, 2.0, 6.0]
    assert zero["seeds"] is None and trained["seeds"] == 3
    low, high = trained["return_interval"]
    assert low < 4.0 and high > 9.0  # three seeds are few
    assert "trained with 3 seeds" in capsys.readouterr().out
    other = copy.deepcopy(found[1])
    other["config"]["ppo"]["epochs"] = 7
    match = [one | {"results": [{"case": "a against b", "win_rate": 0.5}]} for one in found[:2]]
    for given, words in (
        ({"a": found[0], "b": other}, r"b has ppo\.epochs=7"),
        ({"a": found[0], "b": found[0]}, r"seeds \[0, 0\]"),
        ({"a": found[0]}, "1 runs"),
        (dict(zip("ab", match, strict=True)), "match of competing agents"),
    ):
        with pytest.raises(ValueError, match=words):
            compare.summarize(given)
    (tmp_path / "other.json").write_text("{}")
    for name in ("nowhere.json", "other.json"):
        with pytest.raises(SystemExit, match=rf"error: .*{name}"):
            compare.main([files[0], str(tmp_path / name)])


def test_a_terminal_without_unicode_shows_the_table(monkeypatch):
    results = Path(__file__).parents[2] / "benchmarks" / "results" / "ppo"
    shown = io.BytesIO()
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(shown, "ascii", write_through=True))
    monkeypatch.setenv("COLUMNS", "60")
    scores.main([str(folder) for folder in sorted(results.glob("stand_?"))])
    assert "PIAvatar/Stand-v0" in shown.getvalue().decode("ascii").replace("\n", "")
