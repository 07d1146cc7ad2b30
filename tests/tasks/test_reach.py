"""Reach: where the target goes, what counts as near, and that the numbers agree with each other."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from piavatar_envs.avatar.body.skeleton import joint_index
from tests.tasks.measured import markers_of, middle, pelvis, still, tolerance

REACH = "PIAvatar/Reach-v0"


def target(env) -> np.ndarray:
    """Position of the target in the world [m], as it is drawn."""
    (spec,) = env.batch.task.marker_specs()
    assert spec.kind == "sphere" and spec.size == (env.config.target_radius,)
    return markers_of(env.batch).position.numpy()[0, 0].astype(float)


def hands(env) -> np.ndarray:
    """Middles of the hands in the world ``(2, 3)`` [m]."""
    return np.array([middle(env, name) for name in ("left_wrist", "right_wrist")])


@pytest.mark.parametrize("fastest", [0.0, 0.5])
def test_target_stays_on_its_sphere_below_its_greatest_speed(make_env, fastest):
    env = make_env(REACH, target_speed=fastest, radius=0.5)
    speeds = []
    for seed in range(6):
        env.reset(seed=seed)
        center = env.batch.simulation.flesh[0].points.joints[0, joint_index("spine3")]
        path = [target(env)]
        for _ in range(30):
            env.step(still(env))
            path.append(target(env))
        path = np.array(path)
        assert np.linalg.norm(path - center, axis=1) == pytest.approx(np.full(len(path), 0.5), abs=1e-5)
        speeds.append(np.linalg.norm(np.diff(path, axis=0), axis=1) / env.config.physics.control_dt)
    speeds = np.array(speeds)
    assert speeds.max() <= fastest + 1e-4
    assert fastest == 0.0 or (speeds.max() > 0.2 and (speeds.max(1) > 0.02).all()), "it must move in every episode"


def test_targets_are_before_the_body_and_spread(make_env):
    """Azimuths to both sides, elevations above and below: no constant answer reaches them all."""
    env = make_env(REACH)
    center = env.batch.simulation.flesh[0].points.joints[0, joint_index("spine3")]
    ways = []
    for seed in range(60):
        env.reset(seed=seed)
        ways.append((target(env) - center) / env.config.radius)
    ways = np.array(ways)
    assert ways[:, 0].min() < -0.6 and ways[:, 0].max() > 0.6
    assert ways[:, 2].min() < -0.4 and ways[:, 2].max() > 0.4
    assert (ways[:, 1] < 0.4).all() and np.mean(ways[:, 1] < 0.0) > 0.8  # -y is forward
    assert abs(ways[:, 0].mean()) < 0.25


def test_distances_reward_and_success_are_those_of_numpy(make_env):
    env = make_env(REACH, target_radius=0.2)
    successes = set()
    for seed in range(6):
        env.reset(seed=seed)
        rng = np.random.default_rng(seed)
        for _ in range(12):
            action = rng.uniform(-1.0, 1.0, env.action_space.shape)
            info = env.step(action)[4]
            distances = np.linalg.norm(hands(env) - target(env), axis=1)
            assert (info["left_distance"], info["right_distance"]) == pytest.approx(tuple(distances), abs=2e-5)
            assert info["distance"] == pytest.approx(distances.min(), abs=2e-5)
            reach = tolerance(distances.min(), env.config.target_radius, env.config.margin)
            assert info["reward_reach"] == pytest.approx(reach, abs=2e-4)
            if abs(distances.min() - env.config.target_radius) > 1e-4:
                assert info["success"] == (distances.min() < env.config.target_radius)
            successes.add(info["success"])
    assert successes == {True, False}, "the case must see both"


def test_observed_target_is_the_one_that_is_drawn(make_env):
    """In the pelvis' frame, and relative to each hand; its velocity is the way to its next place."""
    env = make_env(REACH, target_speed=1.0)
    dt = env.config.physics.control_dt
    observation, _ = env.reset(seed=3)
    rng = np.random.default_rng(0)
    for _ in range(8):
        here, (at, turn), both = target(env), pelvis(env), hands(env)
        seen = env.observation_layout.split(observation)
        assert at + turn.apply(seen["target_position"]) == pytest.approx(here, abs=1e-5)
        for side, hand in zip(("left", "right"), both, strict=True):
            assert turn.apply(seen[f"target_from_{side}_hand"]) == pytest.approx(here - hand, abs=3e-5)
        velocity = turn.apply(seen["target_velocity"])
        observation, *_ = env.step(rng.uniform(-1.0, 1.0, env.action_space.shape))
        assert velocity == pytest.approx((target(env) - here) / dt, abs=1e-3)


def test_the_first_pose_is_noisy_within_its_bound(make_env):
    env, still = make_env(REACH, pose_noise=0.2), make_env(REACH, pose_noise=0.0)
    angles = []
    for seed in range(12):
        env.reset(seed=seed)
        quaternions = env.get_state()["avatar_0.state.command_rotation"][0].astype(float)
        angles.append(Rotation.from_quat(quaternions).as_rotvec())
    angles = np.array(angles)
    assert np.abs(angles).max() <= 0.2 + 1e-5 and np.abs(angles[:, 1:]).max(2).min() > 0.0
    assert not angles[:, 0].any(), "the root starts upright"
    assert angles[:, 1:].std(0).max() > 0.05
    still.reset(seed=0)
    assert np.abs(Rotation.from_quat(still.get_state()["avatar_0.state.command_rotation"][0]).as_rotvec()).max() < 1e-6


def test_a_hand_can_be_brought_to_the_target(make_env):
    """Greedy descent of the distance along the arm's own components: the task can be done."""
    env = make_env(REACH, target_speed=0.0, pose_noise=0.0)
    arm = [n for n, name in enumerate(env.action_names) if name.split(".")[0] in ("left_shoulder", "left_elbow")]
    env.reset(seed=2)
    distances = []
    for _ in range(10):
        state = env.get_state()
        gains = np.zeros(env.action_space.shape)
        here = np.linalg.norm(hands(env)[0] - target(env))
        for n in arm:
            action = np.zeros(env.action_space.shape)
            action[n] = 1.0
            env.set_state(state)
            gains[n] = here - env.step(action)[4]["left_distance"]
        env.set_state(state)
        info = env.step(np.clip(gains / max(np.abs(gains).max(), 1e-6), -1.0, 1.0))[4]
        distances.append(info["left_distance"])
    assert min(distances) < 0.5 * distances[0]
