"""What trainings on one batch share: evaluations are those of single environments, configurations are refused alike."""

from __future__ import annotations

import numpy as np
import pytest
from pydantic import Field

from agents.batch_training import BatchTraining, load_batched, run
from agents.evaluate import Episode, in_every_seat, play, zero_agent
from piavatar_envs.api.batched import BatchedEpisodes
from piavatar_envs.config import ConfigError, load_config
from piavatar_envs.tasks import load_task

SETTINGS = {"fidelity": "tiny", "episode_seconds": 0.3}


class Training(BatchTraining):
    """A training as any library has it."""

    env_id: str = Field("PIAvatar/Reach-v0", description="registered id")


def rowing(observation: np.ndarray) -> np.ndarray:
    """An agent whose actions depend on what it sees."""
    return np.sin(37.0 * observation[..., :63]).astype(np.float32)


def test_every_episode_is_the_one_a_single_env_would_play(make_env, device):
    """Environments of a batch end at different times, but no step after the end counts."""
    task = load_task("PIAvatar/Reach-v0")
    batch = BatchedEpisodes(task(load_config(task.Config, None, SETTINGS)), 3, device)
    calls = []

    def agent(observation: np.ndarray) -> np.ndarray:
        calls.append(observation)
        actions = rowing(observation)
        if len(calls) == 4:
            let_go = batch.groups[0].simulation.avatars[0].state.let_go
            let_go.assign([1] + [0] * (len(let_go) - 1))  # the first one falls
        return actions

    found = play("rowing", agent, batch, first_seed=50)
    assert [episode.seed for episode in found.episodes] == [50, 51, 52]
    assert [episode.steps for episode in found.episodes] == [4, 9, 9]
    single = make_env("PIAvatar/Reach-v0", episode_seconds=0.3)
    for episode in found.episodes[1:]:
        expected = Episode(episode.seed)
        observation, _ = single.reset(seed=episode.seed)
        over = False
        while not over:
            observation, reward, terminated, truncated, info = single.step(rowing(observation))
            expected.book(reward, info)
            over = terminated or truncated
        assert (episode.steps, episode.successes, episode.failure) == (expected.steps, expected.successes, None)
        assert episode.total == pytest.approx(expected.total, abs=1e-5)
        assert episode.distance == pytest.approx(expected.distance, abs=1e-6)
    batch.close()


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"iteration": 10}, ["iteration is no setting of Training", "did you mean iterations"]),
        ({"num_envs": 0}, ["num_envs=0", ">= 1"]),
        ({"env": {"tone": 7.0}}, ["env:", "control.tone=7.0", "<= 1"]),
        ({"env_id": "PIAvatar/Fly-v0"}, ["env_id", "Fly-v0", "PIAvatar/Reach-v0"]),
        ({"env": {"obs_mode": "dict"}}, ["obs_mode='dict'", "flat", "observe"]),
    ],
)
def test_errors_are_one_line_with_key_value_and_limit(settings, words):
    with pytest.raises(ConfigError) as caught:
        load_batched(Training, load_task, settings)
    assert "\n" not in str(caught.value) and all(word in str(caught.value) for word in words), caught.value


def test_the_command_line_wins_over_the_file(tmp_path):
    path = tmp_path / "run.yaml"
    path.write_text("iterations: 7\nenv: {fidelity: tiny, tone: 0.5}\n")
    config = load_batched(Training, load_task, path, {"env.tone": 0.25, "iterations": 3})
    assert config.iterations == 3 and config.env["control"]["tone"] == 0.25
    assert config.env["physics"]["density"] == 1000.0, "defaults are said, too"


def test_a_device_that_is_not_there_is_refused_before_anything_is_written(tmp_path):
    (tmp_path / "run.yaml").write_text("env_id: Reach-v0\n")
    line = [str(tmp_path / "run.yaml"), "--device", "cuda:99", "--out", str(tmp_path / "run")]
    with pytest.raises(SystemExit, match=r"^error: device='cuda:99' is not available .*; use one of cpu"):
        run("rsl_rl.train", Training, load_task, pytest.fail, line)
    assert not (tmp_path / "run").exists()


def test_an_environment_is_known_without_its_namespace():
    assert load_batched(Training, load_task, {"env_id": "Stand-v0"}).env_id == "PIAvatar/Stand-v0"


def test_falls_and_pushes_are_told(device):
    """Without any action a body falls, before its time."""
    task = load_task("PIAvatar/PushRecovery-v0")
    config = load_config(task.Config, {"fidelity": "tiny", "throw_interval": 0.4, "episode_seconds": 3.0})
    batch = BatchedEpisodes(task(config), 4, device)
    found = play("zero", in_every_seat(zero_agent(batch.action_size)), batch, first_seed=3)
    assert all(episode.terminated and episode.steps < 90 for episode in found.episodes)
    assert sum(row["episodes"] for row in found.row()["by_push"]) == 4
    assert max(episode.push for episode in found.episodes) > config.hit_impulse
    short = load_config(task.Config, {"fidelity": "tiny", "episode_seconds": 0.1})
    still = BatchedEpisodes(task(short), 2, device)
    for episode in play("zero", in_every_seat(zero_agent(batch.action_size)), still, first_seed=3).episodes:
        assert not episode.terminated and episode.steps == 3 and episode.push == 0.0
    batch.close()
    still.close()
