"""Dodge: costs of hits agree with the sensors; the reward is for standing still in the place."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from piavatar_envs.avatar.body.skeleton import BODY_PARTS
from piavatar_envs.config import ConfigError, load_config
from piavatar_envs.tasks.dodge import DodgeConfig, DodgeTask

DODGE = "PIAvatar/Dodge-v0"


def still(env) -> np.ndarray:
    return np.zeros(env.action_space.shape)


def seen(env, observation, name: str) -> np.ndarray:
    return env.observation_layout.split(observation)[name]


def joints(env) -> np.ndarray:
    return env.batch.simulation.avatar.tracked.position.numpy()[0].astype(float)


def test_waiting_balls_do_not_disturb(make_env):
    env = make_env(DODGE, throw_interval=60.0, pose_noise=0.0)
    env.reset(seed=0)
    for _ in range(20):
        info = env.step(still(env))[4]
        assert info["impulse"] == 0.0 and info["hits"] == 0.0 and info["success"] and info["cost"] == 0.0
        assert info["rotation_error_deg"] < 1e-3 and info["root_error"] < 1e-4


def test_costs_hits_and_success_are_what_the_sensors_felt(make_env):
    env = make_env(DODGE, stress_limit=0.02, throw_interval=0.4)
    sensors, outcomes = env.batch.simulation.sensors, set()
    for seed in range(3):
        observation, _ = env.reset(seed=seed)
        struck, hits = np.zeros(2, bool), 0
        rng = np.random.default_rng(seed)
        for _ in range(50):
            struck[seen(env, observation, "time_to_throw") == 0.0] = False
            observation, _, _, _, info = env.step(0.3 * rng.uniform(-1.0, 1.0, env.action_space.shape))
            impulses = np.linalg.norm(sensors.pair_impulse.numpy()[0, 1:3].astype(float), axis=1)
            parts = sensors.part_impulse.numpy()[0].astype(float)
            assert np.linalg.norm(parts[:, 1:3].sum(0), axis=1) == pytest.approx(impulses, abs=2e-3)
            assert info["impulse"] == pytest.approx(impulses.sum(), rel=1e-5, abs=1e-7)
            assert info["cost_terms"]["impulse"] == pytest.approx(impulses.sum() / env.config.impulse_scale, abs=1e-5)
            above = [name not in ("left_leg", "right_leg") for name in BODY_PARTS]
            peak = float(seen(env, observation, "stress")[above].max())
            assert info["stress"] == pytest.approx(peak, rel=1e-5)
            assert info["cost_terms"]["stress"] == pytest.approx(max(peak / 0.02 - 1.0, 0.0), rel=1e-4, abs=1e-5)
            assert info["cost"] == pytest.approx(sum(info["cost_terms"].values()), rel=1e-5)
            new = (impulses > env.config.hit_impulse) & ~struck
            struck |= new
            hits += new.sum()
            assert info["hits"] == hits and info["success"] == (not struck.any())
            outcomes.add((info["success"], info["cost_terms"]["stress"] > 0.0))
        assert hits >= 2
    assert {success for success, _ in outcomes} == {True, False} == {costs for _, costs in outcomes}


@pytest.mark.parametrize("avatar", [None, {"position": [0.4, -0.2], "yaw": 2.0}])
def test_reward_is_for_the_rest_pose_in_its_place(make_env, avatar):
    env = make_env(DODGE, **({} if avatar is None else {"scene.avatars": [avatar]}))
    place, upright = np.zeros(2), Rotation.identity()
    if avatar is not None:
        place, upright = np.array(avatar["position"]), Rotation.from_rotvec([0.0, 0.0, avatar["yaw"]])
    env.reset(seed=1)
    rng = np.random.default_rng(0)
    direction = rng.uniform(-1.0, 1.0, env.action_space.shape)
    for _ in range(15):
        observation, _, _, _, info = env.step(0.5 * direction)
        state = env.batch.simulation.avatar.tracked
        local = Rotation.from_quat(state.local.numpy()[0])
        angles = [(upright.inv() * local[0]).magnitude(), *local[1:].magnitude()]
        rest = upright.apply(env.batch.simulation.flesh[0].points.joints[0, 0]) + [*place, 0.0]
        off = joints(env)[0] - rest
        assert info["rotation_error_deg"] == pytest.approx(np.degrees(np.mean(angles)), abs=2e-3)
        assert info["root_error"] == pytest.approx(np.hypot(*off[:2]), abs=1e-5)
        for name, weight, value, bound, margin in (
            ("pose", 0.6, np.mean(angles), 0.05, env.config.pose_margin),
            ("place", 0.4, np.hypot(*off[:2]), 0.02, env.config.place_margin),
        ):
            expected = weight * 10.0 ** -((max(value - bound, 0.0) / margin) ** 2)
            assert info["reward_terms"][name] == pytest.approx(expected, abs=2e-4)
        turn = Rotation.from_quat(state.rotation.numpy()[0, 0])
        assert turn.apply(seen(env, observation, "place_position")) == pytest.approx(-off, abs=1e-5)
    assert info["reward_terms"]["pose"] < 0.5 and info["reward_terms"]["place"] < 0.39


def test_the_root_is_steered_to_its_range_and_no_farther(make_env):
    env = make_env(DODGE, throw_interval=60.0, pose_noise=0.0)
    for way in np.array([[1.0, 0.0], [0.0, -1.0], [-1.0, 1.0]]):
        env.reset(seed=0)
        action = still(env)
        at = env.action_names.index("root.x")
        action[at : at + 2] = way
        errors, commanded = [], []
        for _ in range(20):
            errors.append(env.step(action)[4]["root_error"])
            goal = env.batch.simulation.avatar.state.goal_root.numpy()[0]
            commanded.append(np.hypot(*(goal[:2] - env.batch.task.place[:2])))
        assert errors[-1] == pytest.approx(env.config.root_range, abs=0.03) and max(errors) < errors[-1] + 0.01
        assert max(commanded) <= env.config.root_range + 1e-6
        if abs(way).sum() == 2.0:  # a step along both axes is the longest
            assert max(commanded) == pytest.approx(env.config.root_range, abs=1e-4)


@pytest.mark.parametrize("name", ["ball_mass", "throw_speed", "throw_distance"])
def test_falling_ranges_are_refused(name):
    with pytest.raises(ConfigError, match=rf"{name}=\[3.0, 2.0\]"):
        DodgeTask(load_config(DodgeConfig, None, {name: [3.0, 2.0]}))
