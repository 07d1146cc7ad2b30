"""GetUp: bodies lie on the ground face down or up as the seed has it, and standing must last to be a success."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from piavatar_envs.avatar.body.skeleton import joint_index
from tests.conftest import reward_terms
from tests.tasks.measured import joints, pelvis, still, tolerance

GET_UP = "PIAvatar/GetUp-v0"
HEAD, CHEST, ANKLES = (
    joint_index("head"),
    joint_index("spine3"),
    [joint_index("left_ankle"), joint_index("right_ankle")],
)
TRUNK = [joint_index(name) for name in ("spine1", "spine2", "spine3")]


def worth_of(env, turns: np.ndarray) -> float:
    """Reward of a step that begins in a pose, by the joints' rotation vectors ``(22, 3)`` [rad], with limp joints."""
    poses = env.batch.task.poses
    before = poses.numpy().copy()
    poses.assign(np.broadcast_to(turns, before.shape).astype(np.float32))
    env.reset(seed=0)
    poses.assign(before)
    return env.step(still(env))[1]


def faces(env) -> np.ndarray:
    """Direction that the pelvis faces, a unit vector."""
    return pelvis(env)[1].apply([0.0, -1.0, 0.0])


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


def test_some_begin_on_the_way_up(make_env):
    """On the ground, higher than lying bodies, and different for each side from which they come."""
    env, seen = make_env(GET_UP, halfway=1.0, pose_noise=0.0, observe_parameters=True), {}
    rest = env.batch.simulation.flesh[0].points
    for seed in range(24):
        observation, _ = env.reset(seed=seed)
        assert env.batch.simulation.state.x.numpy()[0, :, 2].min() == pytest.approx(rest.rest[0, :, 2].min(), abs=1e-5)
        at = env.batch.simulation.avatar.tracked.position.numpy()[0]
        side = env.observation_layout.split(observation)["parameters"][-2]
        assert side in (-1.0, 1.0) and at[HEAD, 2] / rest.joints[0, HEAD, 2] > 0.3
        seen.setdefault(side, set()).add(round(float(at[0, 2]), 2))
    assert len(seen[-1.0]) == len(seen[1.0]) == 3 and len(seen[-1.0] & seen[1.0]) == 1


def test_the_reward_is_what_the_joints_say(make_env):
    """From lying, over being lifted, to standing."""
    margins = {
        "upright.height_margin": 0.4,
        "upright.tilt_margin": 0.7,
        "still.speed_margin": 0.6,
        "still.pose_margin": 0.3,
    }
    env = make_env(GET_UP, root_assist=1.0, control_cost=0.1, **margins)
    rule, rest, at_rest = env.config.upright, env.config.still, env.batch.simulation.flesh[0].points.joints[0]
    action, worth = 0.1 * env.action_space.high, []
    env.reset(seed=1)
    for _ in range(75):
        _, reward, _, _, info = env.step(action)
        tracked = env.batch.simulation.avatar.tracked
        at, terms = joints(env), reward_terms(info)
        head, pelvis = np.clip([at[HEAD, 2] / at_rest[HEAD, 2], at[0, 2] / at_rest[0, 2]], 0.0, 1.0)
        feet = np.linalg.norm(at[ANKLES, :2] - at[0, :2], axis=1).mean() / at_rest[0, 2]
        turn = Rotation.from_quat(tracked.rotation.numpy()[0, CHEST].astype(float))
        tilt = np.arccos(np.clip(turn.apply([0.0, 0.0, 1.0])[2], -1.0, 1.0))
        stands = tolerance(1.0 - head, 0.05, rule.height_margin) * tolerance(tilt, 0.1, rule.tilt_margin)
        speed = float(np.linalg.norm(tracked.velocity.numpy()[0, 0]))
        angles = Rotation.from_quat(tracked.local.numpy()[0].astype(float)).magnitude()
        angle = max(angles[1:].mean(), angles[TRUNK].mean())
        assert terms["height"] == pytest.approx(0.5 * np.sqrt(head * pelvis), abs=1e-4)
        assert terms["feet"] == pytest.approx(0.2 * tolerance(feet, 0.25, env.config.feet_margin), abs=1e-4)
        assert terms["still"] == pytest.approx(0.15 * stands * tolerance(speed, 0.05, rest.speed_margin), abs=1e-3)
        assert terms["pose"] == pytest.approx(0.15 * stands * tolerance(angle, 0.05, rest.pose_margin), abs=1e-3)
        assert terms["control"] == pytest.approx(-0.1 * 0.01, abs=1e-6)
        worth.append(reward)
    assert worth[0] < 0.1 and worth[-1] > 0.7


@pytest.mark.parametrize("side", [0, 1])
def test_every_pose_on_the_way_is_worth_more_than_the_one_before(make_env, side):
    """And the splits, from where no way leads up, less than a squat, or a knee on the ground."""
    env = make_env(GET_UP, control="torque", pose_noise=0.0)
    way = list(env.batch.task.poses.numpy()[side].copy())
    worth = [worth_of(env, pose) for pose in [*way, np.zeros_like(way[0])]]
    assert np.diff(worth).min() > 0.02 and worth[0] < 0.1 and worth[-1] > 0.95
    splits = np.zeros_like(way[0])
    splits[[joint_index("left_hip"), joint_index("right_hip")]] = [[-1.0, 0.8, 0.0], [-1.0, -0.8, 0.0]]
    assert worth[0] < worth_of(env, splits) < worth[2] - 0.05


@pytest.mark.parametrize(("share", "up"), [(0.0, False), (1.0, True)])
def test_a_lying_body_comes_to_rest_on_its_side_and_the_episode_goes_on(make_env, share, up):
    """The ground bears the whole weight; nothing but the clock ends the episode."""
    env = make_env(GET_UP, face_up=share)
    env.reset(seed=0)
    impulses = []
    for _ in range(60):
        _, _, terminated, _, info = env.step(still(env))
        assert not terminated and not info["success"] and info["failure"] == 0
        impulses.append(env.batch.simulation.sensors.boundary_impulse.numpy()[0, 0, 2])
    assert (faces(env)[2] > 0.9) if up else (faces(env)[2] < -0.9)
    weight = 9.81 * env.batch.simulation.flesh[0].points.mass.sum()
    assert np.mean(impulses[-20:]) / env.config.physics.control_dt == pytest.approx(weight, rel=0.05)
    assert (
        max(info["head_height"], info["pelvis_height"]) < 0.25 and info["held_seconds"] == 0.0 and info["speed"] < 0.1
    )


def test_standing_must_last(make_env):
    """The first pose is replaced by a standing one that is helped to stay; a second later it is a success."""
    env = make_env(GET_UP, root_assist=1.0, hold_seconds=0.5, pose_noise=0.0)
    env.reset(seed=0)
    stand = make_env("PIAvatar/Stand-v0", root_assist=1.0, pose_noise=0.0)
    stand.reset(seed=0)
    lying, standing = env.get_state(), stand.get_state()
    env.set_state({name: standing[name] if name.startswith(("particles", "avatar", "controller")) else value
                   for name, value in lying.items()})  # fmt: skip
    held = 0
    for _ in range(25):
        info = env.step(still(env))[4]
        held = held + 1 if info["head_height"] >= env.config.upright.stand_head else 0
        assert info["held_seconds"] == pytest.approx(held / 30.0, abs=1e-5)
        assert info["success"] == (held >= 15)
    assert info["success"]


def test_assistance_lifts_a_lying_body(make_env):
    """Without, the pelvis stays where it lies (tested above)."""
    env = make_env(GET_UP, root_assist=1.0, pose_noise=0.0)
    env.reset(seed=0)
    assert max(env.step(still(env))[4]["pelvis_height"] for _ in range(40)) > 0.5


def test_there_is_room_to_wander(make_env):
    """A body 4 m from where it began goes on as it would there; policies that had got up left the domain."""
    env = make_env(GET_UP, pose_noise=0.0)
    env.reset(seed=0)
    state = env.get_state()
    placed = {"particles.x", "controller_0.position", "avatar_0.tracked.position"}
    placed |= {"avatar_0.state.goal_root", "avatar_0.state.command_root"}
    away = np.array([4.0, -4.0, 0.0], np.float32)
    env.set_state({name: value + away if name in placed else value for name, value in state.items()})
    for _ in range(3):
        _, _, terminated, _, info = env.step(still(env))
        assert not terminated and info["failure"] == 0
    np.testing.assert_allclose(env.get_state()["particles.x"].mean(axis=(0, 1))[:2], away[:2], atol=0.3)


def test_a_body_that_crawls_away_comes_to_a_wall(make_env):
    """Dragged for six metres it is still in the episode; policies that crawl as far had failed."""
    env = make_env(GET_UP, pose_noise=0.0)
    env.reset(seed=0)
    env.unwrapped.apply_force("pelvis", [900.0, 0.0, 0.0], steps=90)
    places = []
    for _ in range(90):
        _, _, terminated, _, info = env.step(still(env))
        assert not terminated and info["failure"] == 0
        places.append(pelvis(env)[0][0])
    assert 5.0 < places[-1] < 6.0 and max(places[-5:]) - min(places[-5:]) < 0.05
