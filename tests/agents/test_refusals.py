"""Commands that are refused say so in one line, early, and leave what lies where they would have written."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest

pytest.importorskip("stable_baselines3", reason="needs the extra train")

from agents import compare, demo, play, score_random, scores
from agents.batch_training import BatchTraining, load_batched, run
from agents.checkpoint import Checkpoint, learned_otherwise
from agents.config import changed
from agents.pid import score as score_pid
from agents.sb3 import train
from agents.sb3.config import load_training
from piavatar_envs.config import dump_yaml, load_config
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
    """The folder of a training that has ended, of 64 steps in episodes that are longer."""
    folder = tmp_path_factory.mktemp("ended")
    (folder / "tiny.yaml").write_text(dump_yaml(load_training(TINY)))
    train.main([str(folder / "tiny.yaml"), "env.episode_seconds=9", "--out", str(folder / "run"), "--device", device])
    return folder / "run"


def test_a_training_says_how_long_it_was_also_if_no_episode_ended(ended):
    assert json.loads((ended / "results.json").read_text())["train_steps"] == 64


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


def test_a_training_that_cannot_be_written_ends_in_a_line(tmp_path):
    (tmp_path / "file").touch()
    (tmp_path / "tiny.yaml").write_text(dump_yaml(load_training(TINY)))
    assert "file" in refused(train.main, str(tmp_path / "tiny.yaml"), "--out", str(tmp_path / "file" / "run"))


def test_scores_are_not_written_over_a_training(ended, tmp_path, device, monkeypatch):
    for module in (score_pid, score_random):
        monkeypatch.setattr(module, "BatchedEpisodes", None)  # nothing is built
    monkeypatch.setattr(demo, "prepare", None)
    kept = {name: tmp_path / name for name in ("checkpoint.pt", "policy.pt", "policy.zip")}
    for name, folder in kept.items():
        folder.mkdir()
        (folder / name).write_text("of a training")
    for folder in (ended, *kept.values()):
        before, out = contents(folder), ("--out", str(folder), "--device", device)
        lines = (score_pid.main, *STAND, *out), (score_random.main, str(ended), *out), (demo.main, *out)
        for line in lines:
            said = refused(*line)
            assert " is of " in said and "write elsewhere with --out" in said
        assert contents(folder) == before


def test_figures_take_only_the_place_of_figures_of_their_kind(ended, tmp_path, device):
    before = contents(ended)
    results, other = str(ended / "results.json"), tmp_path / "other.json"
    assert "is of train, not of scores" in refused(scores.main, str(ended), "--out", results)
    assert "is of train, not of compare" in refused(compare.main, str(ended), str(ended), "--out", results)
    for content in ("[1, 2]", "no JSON", '{"benchmark": "scores"}'):
        other.write_text(content)
        assert "not of play; write elsewhere" in refused(play.main, str(ended), "--out", str(other))
        assert other.read_text() == content
    (tmp_path / "NOTES.md").write_text("mine")
    assert "NOTES.md is of something else" in refused(scores.main, str(ended), "--out", str(tmp_path / "NOTES.json"))
    assert contents(ended) == before


@pytest.mark.parametrize("place", ["file/x.json", "folder.json", "x" * 300 + ".json"])
def test_figures_that_cannot_be_written_are_refused_before_anything_is_played(place, ended, tmp_path, monkeypatch):
    (tmp_path / "file").touch()
    (tmp_path / "folder.json").mkdir()
    for module in (play, score_pid, score_random):
        monkeypatch.setattr(module, "BatchedEpisodes", None)
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
    ("line", "words"),
    [
        (("--seconds", "nan"), "seconds=nan must be > 0"),
        (("--seconds", "0"), "seconds=0.0 must be > 0"),
        (("--device", "cuda:99"), "device='cuda:99' is not available"),
        (("env_id=Stand-v0",), "env_id='PIAvatar/Stand-v0': the demo is of PPO on PIAvatar/Reach-v0"),
        (("sac={}",), "the demo is of PPO"),
        (("env.control.mode=pd",), "env.control.mode='pd' must be 'pose'"),
        (("total_steps=-1",), "total_steps=-1 must be >= 1"),
    ],
)
def test_what_is_no_demo_is_refused(line, words, tmp_path, monkeypatch):
    monkeypatch.setattr(demo, "prepare", None)
    assert words in refused(demo.main, *line, "--out", str(tmp_path / "demo"))
    assert not (tmp_path / "demo").exists()


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
    monkeypatch.setattr(play, "BatchedEpisodes", None)
    assert words in refused(play.main, str(ended), *settings, "--device", device)


def test_under_torques_nothing_has_a_speed_that_could_change():
    stand = load_task("Stand-v0")
    made = [stand(load_config(stand.Config, {"control": "torque"}, more)) for more in ({}, {"joint_speed_limit": 3.0})]
    assert changed(*made) == []
    made = [stand(load_config(stand.Config, {"control": "pd"}, more)) for more in ({}, {"joints": ["left_knee"]})]
    assert changed(*made) == ["its actions"]


def test_files_that_are_no_figures_are_named(tmp_path):
    (tmp_path / "results.json").write_text("not json")
    for main in (scores.main, compare.main, score_random.main):
        assert f"{tmp_path / 'results.json'} is no JSON" in refused(main, str(tmp_path))


def test_what_pictures_look_like_is_free_when_a_training_goes_on(ended):
    had = load_training(ended / "config.yaml").model_dump(mode="json")
    other = load_training(ended / "config.yaml", {"env.render.width": 64, "env.physics.friction": 0.1})
    assert learned_otherwise(had, other.model_dump(mode="json")) == [("env.physics.friction", 0.8, 0.1)]


def test_a_policy_that_does_not_see_a_prop_plays_beside_it(ended):
    """What it does see keeps its meaning."""
    run = play.open_run(ended)
    ball = ('scene.props=[{"name": "ball", "position": [0, -2, 0.2]}]',)
    with pytest.raises(ValueError, match="changes its observations"):
        play.environment(run, ball)
    assert play.environment(replace(run, observe=("target_position",)), ball).observed_props() == ("ball",)


@pytest.mark.parametrize(
    ("option", "words"),
    [
        (("integrated", "nonsense"), "integrated: 'nonsense' is not a joint; use some of left_hip"),
        (("followed", "neck", "pelvis"), "followed: 'pelvis' is not a joint"),
        (("stiffness", "nan"), "stiffness=nan must be >= 0"),
        (("integral-time", "0"), "integral_time=0.0 must be > 0"),
        (("support", "0.01", "inf"), "support=(0.01, inf) must be >= 0, and finite"),
    ],
)
def test_what_is_no_controller_is_refused(option, words, tmp_path, device):
    name, *values = option
    line = (*STAND, f"--design.{name}", *values, "--out", str(tmp_path / "out"), "--device", device)
    assert words in refused(score_pid.main, *line)
    assert not (tmp_path / "out").exists()
