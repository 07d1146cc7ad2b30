"""Walk: distance, speed and ends along its way; a gait's clock, arms that swing with it, and the cost of postures."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from agents.rsl_rl.ppo import Mirror
from piavatar_envs.avatar.body.skeleton import joint_index
from piavatar_envs.avatar.motion import load_motion
from piavatar_envs.config import ConfigError, load_config
from piavatar_envs.envs.batch_env import BatchEnv
from piavatar_envs.tasks import load_task
from piavatar_envs.tasks.common.gait import GAIT_POSTURE
from tests.conftest import reward_terms
from tests.tasks.measured import joints, pelvis, seen, still, tolerance

WALK = "PIAvatar/Walk-v0"
HEAD, CHEST = joint_index("head"), joint_index("spine3")
ANKLES, SHOULDERS, ELBOWS, WRISTS = (
    [joint_index(f"{side}_{name}") for side in ("left", "right")] for name in ("ankle", "shoulder", "elbow", "wrist")
)


def gait_terms(env, steps: int, action=None) -> list[dict]:
    """Return the reward terms of an episode's first steps."""
    env.reset(seed=0)
    return [reward_terms(env.step(still(env) if action is None else action)[4]) for _ in range(steps)]


def drift(env, velocity) -> None:
    """Give a body a velocity [m/s]."""
    state, joint_state = env.batch.simulation.state, env.batch.simulation.controllers[0].state
    of_joints = joint_state.velocity.numpy()
    of_joints[0, :3] = velocity
    joint_state.velocity.assign(of_joints)
    state.vk.assign(state.vk.numpy() + np.float32(velocity))


@pytest.mark.parametrize("avatar", [None, {"position": [0.4, -0.2], "yaw": 2.0}])
def test_walking_is_measured_along_the_way(make_env, avatar):
    """A body that is moved at the target's speed earns the speed's reward and succeeds, along its own way."""
    env = make_env(WALK, **({} if avatar is None else {"scene.avatars": [avatar]}), gravity=0.0, pose_noise=0.0)
    yaw, place = (0.0, np.zeros(2)) if avatar is None else (2.0, np.array([0.4, -0.2]))
    ahead = np.array([np.sin(yaw), -np.cos(yaw), 0.0])
    observation, _ = env.reset(seed=0)
    assert pelvis(env)[1].apply(seen(env, observation, "path_direction")) == pytest.approx(ahead, abs=1e-5)
    assert seen(env, observation, "path_offset") == pytest.approx(0.0, abs=1e-4)
    drift(env, ahead)
    for step in range(36):
        _, _, terminated, _, info = env.step(still(env))
        rest = Rotation.from_rotvec([0, 0, yaw]).apply(env.batch.simulation.flesh[0].points.joints[0, 0])
        gone = float((pelvis(env)[0] - rest - [*place, 0.0]) @ ahead)
        assert info["distance"] == pytest.approx(gone, abs=1e-4)
        assert info["mean_speed"] == pytest.approx(gone / ((step + 1) / 30.0), abs=1e-3)
        assert not terminated and info["speed"] == pytest.approx(1.0, abs=0.1)
        assert info["reward_speed"] == pytest.approx(0.35, abs=0.015)
        assert info["success"] == (gone >= 1.0)
    assert info["success"]


def test_the_reward_of_walking_is_what_the_joints_say(make_env):
    """Of a body that is left to itself: it stands, tips over and turns as it falls."""
    env = make_env(
        WALK, pose_noise=0.3, **{"upright.height_margin": 0.4, "upright.tilt_margin": 0.7, "heading_margin": 0.5}
    )
    rule, seen_heads, turned = env.config.upright, [], []
    env.reset(seed=2)
    for _ in range(60):
        _, reward, _, _, info = env.step(still(env))
        tracked, terms = env.batch.simulation.avatar.tracked, reward_terms(info)
        head = joints(env)[HEAD, 2] / env.batch.simulation.flesh[0].points.joints[0, HEAD, 2]
        chest = Rotation.from_quat(tracked.rotation.numpy()[0, CHEST].astype(float))
        tilt = np.arccos(min(chest.apply([0.0, 0.0, 1.0])[2], 1.0))
        facing = pelvis(env)[1].apply([0.0, -1.0, 0.0])
        off_way = np.arccos(np.clip(-facing[1] / np.hypot(*facing[:2]), -1.0, 1.0))
        off_speed = abs(-float(tracked.velocity.numpy()[0, 0, 1]) - env.config.target_speed)
        high = tolerance(1.0 - head, 0.05, rule.height_margin)
        assert terms["speed"] == pytest.approx(0.35 * high * tolerance(off_speed, 0.1, 1.0), abs=1e-3)
        heading = tolerance(off_way, 0.1, env.config.heading_margin)
        assert terms["heading"] == pytest.approx(0.1 * high * heading, abs=1e-3)
        assert terms["height"] == pytest.approx(0.1 * high, abs=1e-4)
        assert terms["upright"] == pytest.approx(0.1 * tolerance(tilt, 0.1, rule.tilt_margin), abs=1e-3)
        assert terms["control"] == 0.0 and reward == pytest.approx(sum(terms.values()), abs=1e-6)
        seen_heads.append(head)
        turned.append(off_way)
    assert max(seen_heads) > 0.95 and min(seen_heads) < 0.6 and max(turned) > 0.2


@pytest.mark.parametrize("velocity", [(1.0, 0.0, 0.0), (-1.0, 0.0, 0.0), (0.0, -4.0, 0.0)], ids=str)
def test_leaving_the_way_is_the_end(make_env, velocity):
    """To either side of the lane, or beyond its end: one and a half times as far as its speed goes in an episode."""
    env = make_env(WALK, lane=0.3, gravity=0.0, pose_noise=0.0, episode_seconds=0.6)
    env.reset(seed=0)
    drift(env, velocity)
    steps, terminated = 0, False
    while not terminated and steps < 18:
        observation, _, terminated, _, info = env.step(still(env))
        aside = abs(seen(env, observation, "path_offset")[0])
        assert terminated == (aside > np.float32(0.3) or info["distance"] > 0.9)
        steps += 1
    assert terminated and 5 < steps < 14


@pytest.mark.parametrize("max_lag", [0.2, None])
def test_falling_behind_the_pace_is_the_end(make_env, max_lag):
    """Of a body that stands: by 0.9 of the target's speed it is 0.2 m behind after 0.22 s, and not out without."""
    env = make_env(WALK, root_assist=1.0, pose_noise=0.0, max_lag=max_lag)
    env.reset(seed=0)
    ends = []
    for step in range(12):
        _, _, terminated, _, info = env.step(still(env))
        behind = 0.9 * (step + 1) * env.config.physics.control_dt - info["distance"]
        assert terminated == (max_lag is not None and behind > max_lag)
        ends.append(terminated)
        if terminated:
            break
    assert len(ends) == (12 if max_lag is None else 7)


def due(time: float, stride: float) -> float:
    """All in the first half of a stride, none in the second, a tenth of it to go over: a sine that is cut off."""
    return float(np.clip(0.5 + 0.5 * np.sin(2.0 * np.pi * time / stride) / np.sin(0.1 * np.pi), 0.0, 1.0))


def stepped(lead: float, time: float, stride: float, length: float) -> float:
    """A foot comes down a step's length in front, in turn: what it is worth that the left one is ahead by so much."""
    return tolerance(abs(lead - length * np.cos(2.0 * np.pi * time / stride)) / length, 0.2, 0.6)


@pytest.mark.parametrize(("stride", "speed", "yaw"), [(1.0, 1.0, 0.0), (0.7, 1.6, 2.0)])
def test_the_clock_is_seen_and_feet_are_paid_by_it(make_env, stride, speed, yaw):
    """A body that leans on one foot and then on the other: the reward is that of its load, its step and of the time."""
    settings = {"gait.weight": 0.3, "gait.stride_seconds": stride, "scene.avatars": [{"yaw": yaw}]}
    env = make_env(WALK, root_assist=0.3, pose_noise=0.0, target_speed=speed, **settings)
    observation, _ = env.reset(seed=0)
    assert seen(env, observation, "gait_phase") == pytest.approx([0.0, 1.0])
    ahead = np.array([np.sin(yaw), -np.cos(yaw), 0.0])
    paid, dt, sim = [], env.config.physics.control_dt, env.batch.simulation
    rest, soles = sim.flesh[0].points.rest[0], env.batch.task.path.gait.soles.numpy()
    for step in range(60):
        action = still(env)
        for name in ("spine1.y", "spine2.y", "spine3.y"):
            action[env.action_names.index(name)] = np.sign(np.sin(2.0 * np.pi * step / 40.0))
        for name, side in (("left_hip.x", -1.0), ("right_hip.x", 1.0)):
            action[env.action_names.index(name)] = 0.4 * side * np.cos(2.0 * np.pi * step * dt / stride)
        observation, *_, info = env.step(action)
        phase = 2.0 * np.pi * (step + 1) * dt / stride
        assert seen(env, observation, "gait_phase") == pytest.approx([np.sin(phase), np.cos(phase)], abs=1e-4)
        left, right = seen(env, observation, "foot_impulses")
        share = left / (left + right) if left + right > 0.0 else np.inf
        lifts = [(sim.state.x.numpy()[0, sole, 2] - rest[sole, 2]).min() for sole in soles]
        if (lifts[0] > 0.03) != (lifts[1] > 0.03) and left + right > 0.0:
            share = float(lifts[1] > 0.03)
        off = abs(share - due((step + 0.5) * dt, stride))
        up, ankles = pelvis(env)[1].apply([0.0, 0.0, 1.0])[2], joints(env)[ANKLES]
        lead = float((ankles[0] - ankles[1]) @ ahead)
        passing = stepped(lead, (step + 1) * dt, stride, 0.5 * speed * stride)
        in_turn = tolerance(off, 0.2, 0.4) * (0.5 + 0.5 * passing)
        worth = in_turn * tolerance(np.arccos(min(up, 1.0)), 0.1, 0.6)
        terms = reward_terms(info)
        assert terms["gait"] / 0.3 == pytest.approx(terms["height"] / 0.1 * worth, abs=2e-3)
        paid.append(worth)
    assert min(paid) < 0.05 and max(paid) > 0.9


def test_feet_in_the_air_are_not_in_turn(make_env):
    env = make_env(WALK, gravity=0.0, pose_noise=0.0, ground=False, **{"gait.weight": 0.3})
    for terms in gait_terms(env, 5):
        assert terms["gait"] == 0.0 and terms["speed"] == pytest.approx(0.4 * tolerance(1.0, 0.1, 1.0), abs=5e-3)


@pytest.mark.parametrize("swing", [0.3, 0.0])
def test_arms_hang_and_swing_against_the_legs(make_env, swing):
    """Held joints follow the reference: the left hand is in front when the clock has the right foot there."""
    env = make_env(WALK, root_assist=1.0, pose_noise=0.0, **{"gait.weight": 0.3, "gait.arm_swing": swing})
    env.reset(seed=0)
    ahead = []
    for _ in range(60):
        env.step(still(env))
        arms = joints(env)[WRISTS] - joints(env)[SHOULDERS]
        ahead.append(-arms[:, 1])
        assert (np.abs(arms[:, 0]) < 0.25).all() and (arms[:, 2] < -0.25).all()
    ahead = np.array(ahead)[30:]
    amplitude = np.ptp(ahead, axis=0) / 2.0
    if swing == 0.0:
        assert (amplitude < 0.01).all()
        return
    apart = ahead[:, 0] - ahead[:, 1]
    # by springs that are a little late: the left hand is foremost near half a stride
    assert (amplitude > 0.05).all() and 14 <= np.argmax(apart) <= 20 and np.argmin(apart) in (*range(6), 29)


@pytest.mark.parametrize(
    "settings", [{"root_assist": 1.0, "gait.weight": 0.0}, {"control": "pose"}], ids=["no gait", "commanded"]
)
def test_arms_do_not_swing_without_a_gait_or_under_commands(make_env, settings):
    """A commanded body is paid by the clock as others are, and stays in the pose that it is in."""
    env = make_env(WALK, pose_noise=0.0, **settings)
    terms = gait_terms(env, 30)
    local = env.batch.simulation.avatar.tracked.local.numpy()[0, SHOULDERS]
    assert (Rotation.from_quat(local.astype(float)).magnitude() < 0.1).all()
    assert ("gait_phase" in env.observation_layout) == ("control" in settings)
    for step, term in enumerate(terms):  # side by side, and the load on both: what remains of that at any time
        shared = tolerance(abs(0.5 - due((step + 0.5) / 30.0, 1.0)), 0.2, 0.4)
        passing = stepped(0.0, (step + 1) / 30.0, 1.0, 0.5)
        expected = 0.35 * shared * (0.5 + 0.5 * passing) if "control" in settings else 0.0
        assert term["gait"] == pytest.approx(expected, abs=5e-3)


def test_every_environment_has_a_clock_of_its_own(device):
    """Goals of held arms follow the clock of each environment, which a partial reset sets back."""
    legs = ["left_hip", "right_hip", "left_knee", "right_knee"]
    settings = {"control": "torque", "fidelity": "tiny", "joints": legs, "root_assist": 1.0, "gait.weight": 0.2}
    task = load_task(WALK)
    batch = BatchEnv(task(load_config(task.Config, settings)), 3, device)
    batch.reset(seeds=[0, 1, 2])
    dt, clocks = batch.config.physics.control_dt, np.zeros(3)
    for step in range(14):
        if step in (4, 9):
            mask = np.array([step == 4, False, True])
            batch.reset(env_mask=mask)
            clocks[mask] = 0
        batch.step()
        clocks += 1
        goal = batch.simulation.avatar.state.goal_rotation.numpy()
        for env in range(3):
            ahead = 0.3 * np.cos(2.0 * np.pi * clocks[env] * dt) * np.array([-1.0, 1.0])
            for b, side, swing in zip(SHOULDERS, (1.0, -1.0), ahead, strict=True):
                expected = Rotation.from_rotvec([-swing, 0, 0]) * Rotation.from_rotvec([0, 0.6 * side, 0])
                off = expected.inv() * Rotation.from_quat(goal[env, b].astype(float))
                assert off.magnitude() < 1e-3
            for b in ELBOWS:
                assert goal[env, b] == pytest.approx(Rotation.from_rotvec([0.5, 0, 0]).as_quat(), abs=1e-5)


@pytest.mark.parametrize(
    ("settings", "refused"),
    [
        ({"gait.stride_seconds": 0.2, "physics.control_dt": 0.2}, "stride_seconds"),
        ({"gait.stride_seconds": 0.19}, "stride_seconds"),
        ({"gait.stride_seconds": 2.0, "target_speed": 1.2}, None),
        ({"gait.stride_seconds": 2.0, "target_speed": 1.3}, r"1\.3 m.* 1\.85 s"),
        ({"gait.stride_seconds": 2.0, "target_speed": 1.3, "gait.weight": 0.0}, None),
        ({"gait.stride_seconds": 0.4, "target_speed": 5.0}, None),
    ],
)
def test_strides_of_hardly_any_steps_and_steps_that_no_leg_makes_are_refused(settings, refused):
    """Legs reach 1.2 m; without a gait there is no limit."""
    task = load_task(WALK)
    if refused is None:
        task(load_config(task.Config, {}, settings))
        return
    with pytest.raises(ConfigError, match=refused):
        task(load_config(task.Config, {}, settings))


def test_the_mirror_is_half_a_stride_on(make_env):
    """The reward of the left foot's load is, mirrored, that of the right one's at the same moment."""
    env = make_env(WALK, **{"gait.weight": 0.3})
    terms = [env.observation_layout["gait_phase"], env.observation_layout["foot_impulses"]]
    mirror = Mirror(terms, ("left_hip", "right_hip"), "cpu")
    time = 0.13
    clock = [np.sin(2.0 * np.pi * time), np.cos(2.0 * np.pi * time)]
    changed = mirror.observations(torch.tensor([*clock, 3.0, 1.0])).numpy()
    later = 2.0 * np.pi * (time + 0.5)
    assert changed == pytest.approx([np.sin(later), np.cos(later), 1.0, 3.0], abs=1e-6)


def beyond(bent: dict[str, np.ndarray]) -> np.ndarray:
    """By how much rotation vectors [rad] are out of their ranges, by joint and axis."""
    ends = {name: np.radians(np.array(GAIT_POSTURE[name]).T) for name in bent}
    return np.array([v - np.clip(v, *ends[name]) for name, v in bent.items()])


def test_bent_joints_cost_what_they_are_beyond_their_ranges(make_env):
    env = make_env(WALK, root_assist=1.0, pose_noise=0.0, posture_cost=2.0)
    assert min(terms["posture"] for terms in gait_terms(env, 10)) > -1e-4, "standing costs nothing"
    env.reset(seed=0)
    action = still(env)
    for name, value in {"left_hip.x": -0.7, "spine1.x": 0.8, "right_ankle.y": 0.9, "left_knee.x": -1.0}.items():
        action[env.action_names.index(name)] = value
    tracked, found = env.batch.simulation.avatar.tracked, []
    for _ in range(20):
        *_, info = env.step(action)
        local = tracked.local.numpy()[0].astype(float)
        off = beyond({name: Rotation.from_quat(local[joint_index(name)]).as_rotvec() for name in GAIT_POSTURE})
        assert info["reward_posture"] == pytest.approx(-2.0 * np.mean(off**2), rel=1e-3, abs=1e-6)
        found.append(np.abs(off).max(1))
    names, most = list(GAIT_POSTURE), np.max(found, axis=0)
    assert all(most[names.index(name)] > 0.05 for name in ("left_hip", "spine1", "right_ankle"))


def test_a_captured_walk_is_within_the_ranges():
    """Of a motion that was captured, DeepMimic's."""
    pytest.importorskip("pybullet_data", reason="the extra `motions` is not installed")
    turns = load_motion("deepmimic:walk").local_rotations
    for name in GAIT_POSTURE:
        bent = Rotation.from_quat(turns[:, joint_index(name)], scalar_first=True).as_rotvec()
        assert np.abs(beyond({name: bent})).max() < np.radians(0.5), name
