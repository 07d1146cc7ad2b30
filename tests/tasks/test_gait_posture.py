"""The cost of joints beyond the ranges of human gait."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from piavatar_envs.avatar.body.skeleton import joint_index
from piavatar_envs.avatar.motion import load_motion
from piavatar_envs.tasks.common.gait import GAIT_POSTURE

WALK = "PIAvatar/Walk-v0"


def beyond(bent: dict[str, np.ndarray]) -> np.ndarray:
    """By how much rotation vectors [rad] are out of their ranges, by joint and axis."""
    ends = {name: np.radians(np.array(GAIT_POSTURE[name]).T) for name in bent}
    return np.array([v - np.clip(v, *ends[name]) for name, v in bent.items()])


def test_bent_joints_cost_what_they_are_beyond_their_ranges(make_env):
    env = make_env(WALK, root_assist=1.0, pose_noise=0.0, posture_cost=2.0)
    env.reset(seed=0)
    action = np.zeros(env.action_space.shape, np.float32)
    for name, value in {"left_hip.x": -0.7, "spine1.x": 0.8, "right_ankle.y": 0.9, "left_knee.x": -1.0}.items():
        action[env.action_names.index(name)] = value
    tracked, seen = env.batch.simulation.avatar.tracked, []
    for _ in range(20):
        *_, info = env.step(action)
        local = tracked.local.numpy()[0].astype(float)
        off = beyond({name: Rotation.from_quat(local[joint_index(name)]).as_rotvec() for name in GAIT_POSTURE})
        assert info["reward_terms"]["posture"] == pytest.approx(-2.0 * np.mean(off**2), rel=1e-3, abs=1e-6)
        seen.append(np.abs(off).max(1))
    names, most = list(GAIT_POSTURE), np.max(seen, axis=0)
    assert all(most[names.index(name)] > 0.05 for name in ("left_hip", "spine1", "right_ankle"))


def test_standing_costs_nothing(make_env):
    env = make_env(WALK, root_assist=1.0, pose_noise=0.0, posture_cost=2.0)
    env.reset(seed=0)
    for _ in range(10):
        assert env.step(np.zeros(env.action_space.shape))[4]["reward_terms"]["posture"] > -1e-4


def test_a_captured_walk_is_within_the_ranges():
    """Of a motion that was captured, DeepMimic's."""
    pytest.importorskip("pybullet_data", reason="the extra `motions` is not installed")
    turns = load_motion("deepmimic:walk").local_rotations
    for name in GAIT_POSTURE:
        bent = Rotation.from_quat(turns[:, joint_index(name)], scalar_first=True).as_rotvec()
        assert np.abs(beyond({name: bent})).max() < np.radians(0.5), name
