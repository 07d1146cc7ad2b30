"""GetUp: bodies lie on the ground face down or up as the seed has it, and standing must last to be a success."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

GET_UP = "PIAvatar/GetUp-v0"


def still(env) -> np.ndarray:
    return np.zeros(env.action_space.shape, np.float32)


def faces(env) -> np.ndarray:
    """Where the pelvis faces, a unit vector."""
    turn = Rotation.from_quat(env.batch.simulation.avatar.tracked.rotation.numpy()[0, 0].astype(float))
    return turn.apply([0.0, -1.0, 0.0])


def test_bodies_lie_on_the_ground_on_either_side(make_env):
    env = make_env(GET_UP, observe_parameters=True)
    sim, ups, headings = env.batch.simulation, [], []
    rest = sim.flesh[0].points.rest[0, :, 2].min()
    for seed in range(8):
        observation, _ = env.reset(seed=seed)
        x = sim.state.x.numpy()[0]
        assert x[:, 2].min() == pytest.approx(rest, abs=1e-5) and np.ptp(x[:, 2]) < 0.6
        up = faces(env)[2]
        assert abs(up) > 0.99
        ups.append(up > 0.0)
        assert env.observation_layout.split(observation)["parameters"][-2] == (1.0 if up > 0.0 else -1.0)
        head = sim.avatar.tracked.position.numpy()[0, 15]
        headings.append(np.arctan2(*head[:2]))
        assert np.linalg.norm(head[:2]) == pytest.approx(0.55, abs=0.1)
    assert 0 < sum(ups) < 8 and np.ptp(headings) > 1.0


@pytest.mark.parametrize(("share", "up"), [(0.0, False), (1.0, True)])
def test_who_lies_down_comes_to_rest_on_that_side_and_the_episode_goes_on(make_env, share, up):
    """The ground bears the whole weight; nothing but the clock ends the episode."""
    env = make_env(GET_UP, face_up=share)
    env.reset(seed=0)
    impulses = []
    for _ in range(60):
        _, _, terminated, _, info = env.step(still(env))
        assert not terminated and not info["success"] and info["failure"] is None
        impulses.append(env.batch.simulation.sensors.boundary_impulse.numpy()[0, 0, 2])
    assert (faces(env)[2] > 0.9) if up else (faces(env)[2] < -0.9)
    weight = 9.81 * env.batch.simulation.flesh[0].points.mass.sum()
    assert np.mean(impulses[-20:]) / env.config.physics.control_dt == pytest.approx(weight, rel=0.05)
    assert info["head_height"] < 0.2 and info["held_seconds"] == 0.0 and info["speed"] < 0.1


def test_standing_must_last(make_env):
    """The first pose is replaced by a standing one that is helped to stay; a second later it is a success."""
    env = make_env(GET_UP, root_assist=1.0, hold_seconds=0.5, pose_noise=0.0)
    env.reset(seed=0)
    stand = make_env("PIAvatar/Stand-v0", root_assist=1.0, pose_noise=0.0)
    stand.reset(seed=0)
    lying, standing = env.get_state(), stand.get_state()
    env.set_state({name: standing[name] if name.startswith(("particles", "joints", "tracked", "drive")) else value
                   for name, value in lying.items()})  # fmt: skip
    held = 0
    for _ in range(25):
        info = env.step(still(env))[4]
        held = held + 1 if info["head_height"] >= env.config.upright.stand_head else 0
        assert info["held_seconds"] == pytest.approx(held / 30.0, abs=1e-5)
        assert info["success"] == (held >= 15)
    assert info["success"]


def test_assistance_lifts_a_lying_body(make_env):
    """Led upwards and upright, the pelvis ends higher than where it lay; without assistance it stays."""
    heights = {}
    for share in (0.0, 1.0):
        env = make_env(GET_UP, root_assist=share, pose_noise=0.0)
        env.reset(seed=0)
        heights[share] = [env.step(still(env))[4]["pelvis_height"] for _ in range(60)]
    assert max(heights[0.0][20:]) < 0.25 and max(heights[1.0]) > 0.5
