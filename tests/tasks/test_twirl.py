"""Twirl: the hem hangs at rest, rises to the cone of its pattern when the body turns, and is judged by that."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest

import piavatar_envs  # noqa: F401
from piavatar_envs.config import ConfigError
from piavatar_envs.tasks.twirl import hem_of

SETTINGS = {"fidelity": "tiny", "pose_noise": 0.0}


@pytest.fixture(scope="module")
def env():
    env = gym.make("PIAvatar/Twirl-v0", **SETTINGS)
    yield env
    env.close()


def turn(env, steps: int, speed: float) -> list[dict]:
    action = np.zeros(env.action_space.shape, np.float32)
    action[-1] = speed
    return [env.step(action)[4] for _ in range(steps)]


def test_hem_hangs_rises_to_the_cone_of_its_pattern_and_falls(env):
    env.reset(seed=0)
    assert abs(turn(env, 10, 0.0)[-1]["lift"]) < 0.005
    spun = turn(env, 60, 1.0)[-20:]
    simulation = env.unwrapped.batch.simulation
    garment = simulation.garments.garments[0]
    rows = garment.draped[:, 2]
    # a sector of 3/4 of a circle is a cone of sine 3/4 when it is taut: the hem hangs L sqrt(1 - 9/16) below the belt
    hem, belt = rows[hem_of(garment)].mean(), rows[garment.held.vertices].mean()
    expected = (belt - hem) - 0.5 * np.sqrt(1.0 - 0.75**2)
    assert np.mean([info["lift"] for info in spun]) == pytest.approx(expected, rel=0.15)
    assert np.mean([info["hem_spin"] for info in spun]) == pytest.approx(8.0, rel=0.05)
    # it comes to rest in other folds
    assert abs(np.mean([info["lift"] for info in turn(env, 75, 0.0)[-15:]])) < 0.04


def test_wanted_height_changes_and_is_what_rewards_judge(env):
    observation, _ = env.reset(seed=3)
    place = env.unwrapped.observation_layout["wanted_lift"].slice
    wanted, lowest, highest = [], *env.unwrapped.config.lift
    for _ in range(80):
        before = observation[place][0]
        observation, _, _, _, info = env.step(np.zeros(env.action_space.shape, np.float32))
        assert info["off"] == pytest.approx(abs(info["lift"] - before), abs=1e-6)
        assert info["success"] == (info["off"] <= env.unwrapped.config.lift_radius)
        wanted.append(before)
    assert len(set(wanted)) == 2 and wanted[74] != wanted[75] and lowest <= min(wanted) <= max(wanted) <= highest


def test_without_a_garment_it_is_refused():
    with pytest.raises(ConfigError, match="skirt"):
        gym.make("PIAvatar/Twirl-v0", **SETTINGS, garments=())
