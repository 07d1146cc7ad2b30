"""Training runs on one batch: evaluations equal those of single environments."""

from __future__ import annotations

import numpy as np
import pytest
from pydantic import Field

from agents.batch_training import BatchTraining
from agents.evaluate import Episode, for_all_seats, play, zero_agent
from piavatar_envs.api.host import EpisodeHost
from piavatar_envs.config import load_config
from piavatar_envs.tasks import load_task

SETTINGS = {"fidelity": "tiny", "episode_seconds": 0.3}


class Training(BatchTraining):
    """A training run as any library has it."""

    env_id: str = Field("PIAvatar/Reach-v0", description="registered id")


def rowing(observation: np.ndarray) -> np.ndarray:
    """An agent whose actions depend on what it sees."""
    return np.sin(37.0 * observation[..., :63]).astype(np.float32)


def test_every_episode_is_the_one_a_single_env_would_play(make_env, device):
    """Environments of a batch end at different times, but no step after the end counts."""
    task = load_task("PIAvatar/Reach-v0")
    batch = EpisodeHost(task(load_config(task.Config, None, SETTINGS)), 3, device)
    calls = []

    def agent(observation: np.ndarray) -> np.ndarray:
        calls.append(observation)
        actions = rowing(observation)
        if len(calls) == 4:
            released = batch.groups[0].simulation.avatars[0].state.released
            released.assign([1] + [0] * (len(released) - 1))  # the first one falls
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
        assert (episode.steps, episode.successes, episode.failure) == (expected.steps, expected.successes, False)
        assert episode.total == pytest.approx(expected.total, abs=1e-5)
        assert episode.distance == pytest.approx(expected.distance, abs=1e-6)
    batch.close()


def test_falls_and_pushes_are_told(device):
    """Without any action a body falls, before its time."""
    task = load_task("PIAvatar/PushRecovery-v0")
    config = load_config(task.Config, {"fidelity": "tiny", "throw_interval": 0.4, "episode_seconds": 3.0})
    batch = EpisodeHost(task(config), 4, device)
    found = play("zero", for_all_seats(zero_agent(batch.action_size)), batch, first_seed=3)
    assert all(episode.terminated and episode.steps < 90 for episode in found.episodes)
    assert sum(row["episodes"] for row in found.row()["by_push"]) == 4
    assert max(episode.push for episode in found.episodes) > config.hit_impulse
    short = load_config(task.Config, {"fidelity": "tiny", "episode_seconds": 0.1})
    still = EpisodeHost(task(short), 2, device)
    for episode in play("zero", for_all_seats(zero_agent(batch.action_size)), still, first_seed=3).episodes:
        assert not episode.terminated and episode.steps == 3 and episode.push == 0.0
    batch.close()
    still.close()
