"""Commands that are refused say so in one line, early, and leave what lies where they would have written."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path

import pytest

pytest.importorskip("stable_baselines3", reason="needs the extra train")

from agents import compare, demo, play, score_random, scores
from agents.batch_training import BatchTraining, load_batched, run
from agents.checkpoint import Checkpoint
from agents.files import made
from agents.pid import score as score_pid
from agents.sb3 import train
from agents.sb3.config import load_training
from piavatar_envs.config import dump_yaml
from piavatar_envs.tasks import load_task
from tests.agents.conftest import TINY

STAND = ("PIAvatar/Stand-v0", "fidelity=tiny", "episode_seconds=0.2")


def contents(folder: Path) -> dict[str, bytes]:
    """All files below a folder."""
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def refused(main, *line: str) -> str:
    """The line with which a command ends."""
    with pytest.raises(SystemExit) as stop:
        main(list(line))
    assert str(stop.value).startswith("error: ") and "\n" not in str(stop.value)
    return str(stop.value)


@pytest.fixture(scope="module")
def ended(device, tmp_path_factory) -> Path:
    """The folder of a training run that has ended, of 64 steps in episodes that are longer."""
    folder = tmp_path_factory.mktemp("ended")
    (folder / "tiny.yaml").write_text(dump_yaml(load_training(TINY)))
    train.main([str(folder / "tiny.yaml"), "env.episode_seconds=9", "--out", str(folder / "run"), "--device", device])
    return folder / "run"


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        (("total_steps=1",), "has had 64 steps, total_steps=1; ask for as many or more"),
        (("observe=[tail]",), "observe"),
        (("observe=[]",), "was written with observe=None, now it is []"),
        (("seed=5",), "was written with seed=0, now it is 5"),
    ],
)
def test_a_resumed_training_that_is_refused_changes_nothing(ended, settings, words, device):
    before = contents(ended)
    line = (str(ended / "config.yaml"), *settings, "--resume", "--out", str(ended), "--device", device)
    assert words in refused(train.main, *line)
    assert contents(ended) == before


def test_a_resumed_batch_that_is_refused_changes_nothing(tmp_path):
    """Of any library: it is refused before that learns."""
    settings = {"env_id": "PIAvatar/Reach-v0", "iterations": 5}
    config = load_batched(BatchTraining, load_task, settings)
    (tmp_path / "run.yaml").write_text(dump_yaml(config))
    out = tmp_path / "run"
    out.mkdir()
    (out / "config.yaml").write_text("as it was")
    Checkpoint(out, "some", config, "cpu", resume=False).save({"iterations": 5})
    line = (str(tmp_path / "run.yaml"), "iterations=3", "--resume", "--out", str(out))
    before = contents(out)
    assert "has had 5 iterations, iterations=3" in refused(
        lambda args: run("some", BatchTraining, load_task, pytest.fail, args), *line
    )
    assert contents(out) == before


@pytest.mark.parametrize(
    ("setting", "words"),
    [
        ("observe=[tail]", "there is no term 'tail'"),
        ("observe=[]", "observe=[] shows the networks nothing; use some of root_height"),
        ("ppo.hidden=[8, 0]", "must be >= 1"),
    ],
)
def test_a_training_that_is_refused_leaves_no_folder(setting, words, device, tmp_path):
    path = tmp_path / "tiny.yaml"
    path.write_text(dump_yaml(load_training(TINY)))
    line = (str(path), setting, "--out", str(tmp_path / "new" / "run"), "--device", device)
    assert words in refused(train.main, *line)
    assert not (tmp_path / "new" / "run").exists()


def test_scores_are_not_written_over_a_training(ended, tmp_path, device, monkeypatch):
    for module in (score_pid, score_random):
        monkeypatch.setattr(module, "EpisodeHost", None)  # nothing is built
    monkeypatch.setattr(demo, "prepare", None)
    kept = {name: tmp_path / name for name in ("checkpoint.pt", "policy.pt", "policy.zip")}
    for name, folder in kept.items():
        folder.mkdir()
        (folder / name).write_text("of a training run")
    for folder in (ended, *kept.values()):
        before, out = contents(folder), ("--out", str(folder), "--device", device)
        lines = (score_pid.main, *STAND, *out), (score_random.main, str(ended), *out), (demo.main, *out)
        for line in lines:
            said = refused(*line)
            assert " is of " in said and "write elsewhere with --out" in said
        assert contents(folder) == before


@pytest.mark.parametrize("place", ["file/x.json", "folder.json", "x" * 300 + ".json"])
def test_figures_that_cannot_be_written_are_refused_before_anything_is_played(place, ended, tmp_path, monkeypatch):
    (tmp_path / "file").touch()
    (tmp_path / "folder.json").mkdir()
    for module in (play, score_pid, score_random):
        monkeypatch.setattr(module, "EpisodeHost", None)
    out = str(tmp_path / place)
    for main in (play.main, scores.main, compare.main):
        assert any(words in refused(main, str(ended), "--out", out) for words in ("cannot be written", "is a folder"))
    film = str((tmp_path / place).with_suffix(".gif"))
    if place != "folder.json":
        assert "cannot be written" in refused(play.main, str(ended), "--film", film)
        assert "cannot be written" in refused(score_pid.main, *STAND, "--film", film)
        assert "cannot be written" in refused(score_pid.main, *STAND, "--out", out)
        assert "cannot be written" in refused(score_random.main, str(ended), "--out", out)
    assert {path.name for path in tmp_path.iterdir()} == {"file", "folder.json"}


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        (
            ("control=torque",),
            "control=torque changes control.mode, its actions: the policy was trained for other ones",
        ),
        (("joints=[left_knee]",), "changes its actions"),
        (("joint_speed_limit=3", "color=strain"), "error: joint_speed_limit=3 changes its actions"),
        (("env.observe_parameters=true",), "changes observe_parameters"),
        (("fidelity=tiny", "env.fidelity=tiny"), "fidelity is given twice"),
        (("fidelity=tiny", "physics.fidelity=tiny"), "fidelity is given twice"),
    ],
)
def test_policies_play_only_what_they_were_trained_for(settings, words, ended, device, monkeypatch):
    monkeypatch.setattr(play, "EpisodeHost", None)
    assert words in refused(play.main, str(ended), *settings, "--device", device)


def test_a_policy_that_does_not_see_a_prop_plays_beside_it(ended):
    """The observed components keep their meaning."""
    run = play.open_run(ended)
    ball = ('scene.props=[{"name": "ball", "position": [0, -2, 0.2]}]',)
    with pytest.raises(ValueError, match="changes its observations"):
        play.environment(run, ball)
    assert play.environment(replace(run, observe=("target_position",)), ball).observed_props() == ("ball",)


def test_what_a_run_imports_is_asked_for(tmp_path, monkeypatch):
    """A run's files name an environment; code of a module that they name runs only where the user names it, too."""
    named = "spy:ReachTask"
    (tmp_path / "spy.py").write_text("from piavatar_envs.tasks.reach import ReachTask\n")
    monkeypatch.syspath_prepend(tmp_path)
    settings = {"env_id": named, "env": {"fidelity": "tiny"}}
    (tmp_path / "config.yaml").write_text(f"env_id: {named}\nenv: {{fidelity: tiny}}\n")
    for name in ("policy.zip", "policy.pt"):
        (tmp_path / name).write_bytes(b"")
        assert "--imports spy" in refused(play.main, str(tmp_path))
        (tmp_path / name).unlink()
    (tmp_path / "policy.zip").write_bytes(b"")
    row = {"agent": "trained", "episodes": 1, "return_mean": 0.0}
    (tmp_path / "results.json").write_text(json.dumps({"config": settings, "results": [row]}))
    assert "--imports spy" in refused(score_random.main, str(tmp_path), "--out", str(tmp_path / "random"))
    scores._known(named, settings["env"])
    assert "spy" not in sys.modules
    assert "policy.zip holds no policy" in refused(play.main, str(tmp_path), "--imports", "spy")
    assert sys.modules.pop("spy", None)


@pytest.mark.parametrize("place", ["file", "file/run", "/proc/run"])
def test_a_folder_that_cannot_be_made_is_refused_with_the_remedy(place, tmp_path):
    """Every training run and study makes its folder so."""
    (tmp_path / "file").touch()
    with pytest.raises(ValueError, match=r"cannot be written \(.*\); write elsewhere"), made(tmp_path / place):
        pass
    assert [path.name for path in tmp_path.iterdir()] == ["file"]
