"""Levels of play and the episodes that they record; Minari itself is tested in tests/clients/minari."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest

from agents.datasets import __main__ as datasets
from agents.datasets import levels
from agents.datasets.levels import LEVELS, PLAYERS, open_source
from agents.datasets.record import VERSION, check_new, dataset_id, record
from piavatar_envs.config import ConfigError

REACH = "PIAvatar/Reach-v0"
QUICK = ("fidelity=tiny", "episode_seconds=0.2")


def test_every_task_has_an_expert_and_a_weaker_medium():
    for env_id, players in PLAYERS.items():
        assert gymnasium.spec(env_id).id == env_id
        assert set(players) == set(LEVELS) - {"random"}
        assert players["medium"] != players["expert"] and not players["expert"].noise
        for player in players.values():
            assert player.run is None or (levels.RESULTS / player.run / "config.yaml").is_file()


@pytest.mark.parametrize("task_id", PLAYERS)
@pytest.mark.parametrize("level", LEVELS)
def test_levels_of_a_task_share_its_environment(task_id, level):
    expert, other = (open_source(task_id, name, ("fidelity=tiny",)) for name in ("expert", level))
    assert other.task.config == expert.task.config and other.name


def test_names_of_datasets():
    assert dataset_id("PIAvatar/KickBall-v0", "medium") == f"piavatar/kick-ball/medium-v{VERSION}"
    assert dataset_id("PIAvatar/Reach-v0", "expert") == f"piavatar/reach/expert-v{VERSION}"


@pytest.mark.parametrize("level", LEVELS)
def test_recorded_episodes_are_those_of_the_environment(level, device):
    plays = record(open_source(REACH, level, QUICK), 3, 7, 2, device)
    assert [play.seed for play in plays] == [7, 8, 9]
    env = gymnasium.make(REACH, fidelity="tiny", episode_seconds=0.2, device=device)
    for play in plays:
        assert play.observations.shape == (7, *env.observation_space.shape)
        assert play.actions.shape == (6, *env.action_space.shape) and np.abs(play.actions).max() <= 1.0
        observation, _ = env.reset(seed=play.seed)
        np.testing.assert_array_equal(observation, play.observations[0])
        for step, action in enumerate(play.actions):
            observation, reward, terminated, truncated, info = env.step(action)
            np.testing.assert_array_equal(observation, play.observations[step + 1])
            assert reward == play.rewards[step] and info["success"] == play.success[step]
        assert truncated and terminated == play.terminated
    env.close()


def test_medium_differs_from_expert_by_its_noise():
    expert, medium = (record(open_source(REACH, level, QUICK), 1, 0, 1, "cpu")[0] for level in ("expert", "medium"))
    assert not np.array_equal(expert.actions, medium.actions)
    again = record(open_source(REACH, "medium", QUICK), 1, 0, 1, "cpu")[0]
    np.testing.assert_array_equal(medium.actions, again.actions)


@pytest.mark.parametrize(
    ("task_id", "level", "more", "named"),
    [
        (REACH, "best", {}, "expert, medium, random"),
        ("PIAvatar/Dodge-v0", "expert", {}, "--run"),
        (REACH, "expert", {"noise": -1.0}, "noise"),
        (REACH, "expert", {"noise": float("nan")}, "noise"),
        (REACH, "expert", {"run": levels.RESULTS / "kick_ball"}, "KickBall"),
        ("PIAvatar/KickBall-v0", "expert", {"settings": ("control.mode=torque",)}, "control.mode"),
    ],
)
def test_what_cannot_be_recorded_is_refused(task_id, level, more, named):
    with pytest.raises(ConfigError, match=named):
        open_source(task_id, level, **more)


def test_existing_datasets_and_wrong_numbers_are_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(datasets, "import_minari", lambda: None)
    name = dataset_id(REACH, "expert")
    (tmp_path / name).mkdir(parents=True)
    with pytest.raises(ConfigError, match="--out"):
        check_new(tmp_path, name)
    for options in (["--episodes", "0"], ["--num-envs", "0"], ["--first-seed", "-1"], []):
        with pytest.raises(SystemExit, match="error: "):
            datasets.main([REACH, "--out", str(tmp_path), *options])
