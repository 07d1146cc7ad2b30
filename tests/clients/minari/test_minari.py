"""Minari: record by its collector, reload by name, and clone what was recorded."""

from __future__ import annotations

import gymnasium
import minari
import numpy as np
import pytest
import torch
from torch import nn

import piavatar_envs  # noqa: F401 - registers the ids
from agents.reach_ik import ReachIK

ENV_ID = "PIAvatar/Reach-v0"
SETTINGS = {"fidelity": "tiny", "device": "cpu", "joints": ["left_shoulder", "right_shoulder", "left_elbow"]}
EPISODES, SECONDS = 24, 2.0


def make_expert(env: gymnasium.Env) -> ReachIK:
    """Return scripted inverse kinematics for an environment."""
    bare = env.unwrapped
    dt = bare.config.physics.control_dt
    return ReachIK(bare.observation_layout, bare.action_names, bare.config.control.joint_speed_limit * dt, dt)


def play(env: gymnasium.Env, agent, seeds: range) -> float:
    """Play episodes and return the mean of their returns."""
    total = 0.0
    for seed in seeds:
        observation, _ = env.reset(seed=seed)
        over = False
        while not over:
            observation, reward, terminated, truncated, _ = env.step(agent(observation[None])[0])
            total += float(reward)
            over = terminated or truncated
    return total / len(seeds)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """Record episodes of the expert below a folder of their own, and yield the name of the dataset."""
    patch = pytest.MonkeyPatch()
    patch.setenv("MINARI_DATASETS_PATH", str(tmp_path_factory.mktemp("datasets")))
    env = minari.DataCollector(gymnasium.make(ENV_ID, episode_seconds=SECONDS, **SETTINGS), record_infos=True)
    play(env, make_expert(env), range(EPISODES))
    env.create_dataset("piavatar/reach-v0", algorithm_name="inverse kinematics", author="tests")
    env.close()
    yield "piavatar/reach-v0"
    patch.undo()


def test_dataset_is_reloaded_and_its_environment_rebuilt(recorded):
    dataset = minari.load_dataset(recorded)
    assert dataset.total_episodes == EPISODES and dataset.total_steps == EPISODES * round(SECONDS * 30)
    episode = dataset[0]
    assert len(episode.observations) == len(episode.actions) + 1 and "success" in episode.infos
    env = dataset.recover_environment()
    assert env.observation_space == dataset.observation_space and env.action_space == dataset.action_space
    observation, _ = env.reset(seed=0)
    np.testing.assert_array_equal(observation, episode.observations[0])
    for action, seen in zip(episode.actions[:10], episode.observations[1:], strict=False):
        np.testing.assert_array_equal(env.step(action)[0], seen)
    env.close()


def test_behaviour_cloning_reaches_half_of_its_expert(recorded):
    dataset = minari.load_dataset(recorded)
    seen = torch.tensor(np.concatenate([episode.observations[:-1] for episode in dataset]))
    done = torch.tensor(np.concatenate([episode.actions for episode in dataset]))
    mean, std = seen.mean(0), seen.std(0) + 1e-3
    torch.manual_seed(0)
    net = nn.Sequential(nn.Linear(seen.shape[1], 128), nn.Tanh(), nn.Linear(128, done.shape[1]), nn.Tanh())
    optimizer = torch.optim.Adam(net.parameters(), 1e-3)
    for _ in range(3000):
        rows = torch.randint(len(seen), (256,))
        loss = nn.functional.mse_loss(net((seen[rows] - mean) / std), done[rows])
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()

    @torch.no_grad()
    def clone(observation: np.ndarray) -> np.ndarray:
        return net((torch.as_tensor(observation) - mean) / std).numpy()

    env = dataset.recover_environment()
    fresh = range(1000, 1008)
    expert, cloned, still = (play(env, agent, fresh) for agent in (make_expert(env), clone, lambda o: 0 * clone(o)))
    env.close()
    assert still < 0.5 * expert <= cloned, (still, cloned, expert)
