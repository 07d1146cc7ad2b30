"""A gait's clock: whose turn it is to bear the body, what that is worth, and arms that swing with it."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from agents.rsl_rl.ppo import Mirror
from piavatar_envs.avatar.body.skeleton import joint_index
from piavatar_envs.config import ConfigError, load_config
from piavatar_envs.envs.batch_env import BatchEnv
from piavatar_envs.tasks import load_task

WALK = "PIAvatar/Walk-v0"
ANKLES = [joint_index("left_ankle"), joint_index("right_ankle")]
SHOULDERS = [joint_index("left_shoulder"), joint_index("right_shoulder")]
ELBOWS = [joint_index("left_elbow"), joint_index("right_elbow")]
WRISTS = [joint_index("left_wrist"), joint_index("right_wrist")]


def still(env) -> np.ndarray:
    return np.zeros(env.action_space.shape, np.float32)


def seen(env, observation, name: str) -> np.ndarray:
    return env.observation_layout.split(observation)[name]


def tolerance(value: float, bound: float, margin: float) -> float:
    return 10.0 ** -((max(value - bound, 0.0) / margin) ** 2)


def due(time: float, stride: float) -> float:
    """All in the first half of a stride, none in the second, a tenth of it to go over: a sine that is cut off."""
    return float(np.clip(0.5 + 0.5 * np.sin(2.0 * np.pi * time / stride) / np.sin(0.1 * np.pi), 0.0, 1.0))


def stepped(lead: float, time: float, stride: float, length: float) -> float:
    """A foot comes down a step's length in front, in turn: what it is worth that the left one is ahead by so much."""
    return tolerance(abs(lead - length * np.cos(2.0 * np.pi * time / stride)) / length, 0.2, 0.6)


@pytest.mark.parametrize(("stride", "speed", "yaw"), [(1.0, 1.0, 0.0), (0.7, 1.6, 2.0)])
def test_the_clock_is_seen_and_feet_are_paid_by_it(make_env, stride, speed, yaw):
    """A body that leans on one foot and then on the other: the reward is that of its load, its step and of the time."""
    settings = {"gait.worth": 0.3, "gait.stride_seconds": stride, "scene.avatars": [{"yaw": yaw}]}
    env = make_env(WALK, root_assist=0.3, pose_noise=0.0, target_speed=speed, **settings)
    observation, _ = env.reset(seed=0)
    assert seen(env, observation, "gait_phase") == pytest.approx([0.0, 1.0])
    ahead = np.array([np.sin(yaw), -np.cos(yaw), 0.0])
    paid, dt, sim = [], env.config.physics.control_dt, env.batch.simulation
    tracked, rest, soles = sim.avatar.tracked, sim.flesh[0].points.rest[0], env.batch.task.way.gait.soles.numpy()
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
        pelvis = Rotation.from_quat(tracked.rotation.numpy()[0, 0].astype(float)).apply([0.0, 0.0, 1.0])
        ankles = tracked.position.numpy()[0, ANKLES]
        lead = float((ankles[0] - ankles[1]) @ ahead)
        passing = stepped(lead, (step + 1) * dt, stride, 0.5 * speed * stride)
        in_turn = tolerance(off, 0.2, 0.4) * (0.5 + 0.5 * passing)
        worth = in_turn * tolerance(np.arccos(min(pelvis[2], 1.0)), 0.1, 0.6)
        terms = info["reward_terms"]
        assert terms["gait"] / 0.3 == pytest.approx(terms["height"] / 0.1 * worth, abs=2e-3)
        paid.append(worth)
    assert min(paid) < 0.05 and max(paid) > 0.9


def test_who_does_not_stand_on_anything_is_not_in_turn(make_env):
    env = make_env(WALK, gravity=0.0, pose_noise=0.0, ground=False, **{"gait.worth": 0.3})
    env.reset(seed=0)
    for _ in range(5):
        terms = env.step(still(env))[4]["reward_terms"]
        assert terms["gait"] == 0.0 and terms["speed"] == pytest.approx(0.4 * tolerance(1.0, 0.1, 1.0), abs=5e-3)


@pytest.mark.parametrize("swing", [0.3, 0.0])
def test_arms_hang_and_swing_against_the_legs(make_env, swing):
    """Held joints follow the reference: the left hand is in front when the clock has the right foot there."""
    env = make_env(WALK, root_assist=1.0, pose_noise=0.0, **{"gait.worth": 0.3, "gait.arm_swing": swing})
    env.reset(seed=0)
    tracked, ahead = env.batch.simulation.avatar.tracked, []
    for _ in range(60):
        env.step(still(env))
        at = tracked.position.numpy()[0]
        arms = at[WRISTS] - at[SHOULDERS]
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


def test_without_a_gait_there_is_no_clock_and_arms_are_at_rest(make_env):
    env = make_env(WALK, root_assist=1.0, pose_noise=0.0, **{"gait.worth": 0.0})
    assert "gait_phase" not in env.observation_layout
    env.reset(seed=0)
    for _ in range(15):
        assert env.step(still(env))[4]["reward_terms"]["gait"] == 0.0
    local = env.batch.simulation.avatar.tracked.local.numpy()[0, SHOULDERS]
    assert (Rotation.from_quat(local.astype(float)).magnitude() < 0.1).all()


def test_arms_of_a_commanded_body_do_not_swing_by_themselves(make_env):
    """It is paid by the clock as others are, and stays in the pose that it is in."""
    env = make_env(WALK, control="pose", pose_noise=0.0)
    env.reset(seed=0)
    paid = [env.step(still(env))[4]["reward_terms"]["gait"] for _ in range(30)]
    local = env.batch.simulation.avatar.tracked.local.numpy()[0, SHOULDERS]
    assert (Rotation.from_quat(local.astype(float)).magnitude() < 0.1).all()
    for step, gait in enumerate(paid):  # side by side, and the load on both: what remains of that at any time
        shared = tolerance(abs(0.5 - due((step + 0.5) / 30.0, 1.0)), 0.2, 0.4)
        passing = stepped(0.0, (step + 1) / 30.0, 1.0, 0.5)
        assert gait == pytest.approx(0.35 * shared * (0.5 + 0.5 * passing), abs=5e-3)


def test_a_foot_in_the_air_bears_nothing(make_env):
    """On the toes of the left foot, the right one ahead and high: levers between the ankles give it a third."""
    settings = {"gait.worth": 0.7, "gait.stride_seconds": 5.0, "fidelity": "coarse"}
    env = make_env(WALK, root_assist=1.0, pose_noise=0.0, target_speed=0.2, **settings)
    env.reset(seed=0)
    action = still(env)
    lifted = {"right_hip.y": -0.6, "right_hip.x": -0.25, "right_knee.x": 0.12, "left_hip.x": 0.2, "left_ankle.x": 0.5}
    for step in range(45):
        for name, value in lifted.items():
            action[env.action_names.index(name)] = value * min(1.0, step / 20.0)
        observation, *_, info = env.step(action)
    at, gait = env.batch.simulation.state.x.numpy()[0], env.batch.task.way.gait
    lowest = [at[sole, 2].min() for sole in gait.soles.numpy()]
    assert lowest[0] < 0.02 and lowest[1] > 0.05
    left, right = seen(env, observation, "foot_impulses")
    assert right > 0.15 * (left + right), "by the levers"
    terms = info["reward_terms"]  # a quarter of the stride: the left foot's turn
    straight = tolerance(np.radians(info["tilt_deg"]), 0.1, 0.6)
    ankles = env.batch.simulation.avatar.tracked.position.numpy()[0, ANKLES, 1]
    passing = stepped(float(ankles[1] - ankles[0]), 45.0 / 30.0, 5.0, 0.5)
    assert terms["gait"] > 0.9 * 0.7 * straight * (0.5 + 0.5 * passing) and terms["speed"] == pytest.approx(
        0.0, abs=1e-6
    )


@pytest.mark.parametrize("control", ["pd", "torque"])
def test_every_environment_has_a_clock_of_its_own(control, device):
    """Goals of held arms follow the clock of each environment, which a partial reset sets back."""
    legs = ["left_hip", "right_hip", "left_knee", "right_knee"]
    settings = {"control": control, "fidelity": "tiny", "joints": legs, "root_assist": 1.0, "gait.worth": 0.2}
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


def test_arms_hang(make_env):
    """At mid-swing forearms are nearer to the vertical than in the rest pose, and ahead of it."""
    env = make_env(WALK, root_assist=1.0, pose_noise=0.0, **{"gait.worth": 0.3, "fidelity": "coarse"})
    env.reset(seed=0)
    for _ in range(30 + 8):  # from a quarter of a stride on
        env.step(still(env))
    at, rest = env.batch.simulation.avatar.tracked.position.numpy()[0], env.batch.simulation.flesh[0].points.joints[0]
    for elbow, wrist, shoulder in zip(ELBOWS, WRISTS, SHOULDERS, strict=True):
        arm, forearm, before = at[elbow] - at[shoulder], at[wrist] - at[elbow], rest[wrist] - rest[elbow]
        assert arm[2] < -0.9 * np.linalg.norm(arm)
        assert before[2] > -0.7 * np.linalg.norm(before) and forearm[2] < -0.85 * np.linalg.norm(forearm)
        assert forearm[1] < 0.0


@pytest.mark.parametrize(("stride", "dt"), [(0.2, 0.2), (0.5, 0.1), (0.19, 1.0 / 30.0)])
def test_a_stride_of_hardly_any_steps_is_refused(stride, dt):
    task = load_task(WALK)
    with pytest.raises(ConfigError, match=r"stride_seconds"):
        task(load_config(task.Config, {}, {"gait.worth": 0.2, "gait.stride_seconds": stride, "physics.control_dt": dt}))


@pytest.mark.parametrize(("speed", "stride", "refused"), [(1.2, 2.0, False), (1.3, 2.0, True), (5.0, 0.4, False)])
def test_steps_that_no_leg_makes_are_refused(speed, stride, refused):
    """Of up to 1.2 m; without a gait there is no limit."""
    task = load_task(WALK)
    settings = {"target_speed": speed, "gait.stride_seconds": stride}
    if refused:
        with pytest.raises(
            ConfigError, match=r"steps of 1\.3 m, and legs reach 1\.2 m; use a stride of at most 1\.85 s"
        ):
            task(load_config(task.Config, {}, settings))
        settings["gait.worth"] = 0.0
    task(load_config(task.Config, {}, settings))


def test_the_mirror_is_half_a_stride_on(make_env):
    """The reward of the left foot's load is, mirrored, that of the right one's at the same moment."""
    env = make_env(WALK, **{"gait.worth": 0.3})
    terms = [env.observation_layout["gait_phase"], env.observation_layout["foot_impulses"]]
    mirror = Mirror(terms, ("left_hip", "right_hip"), "cpu")
    time = 0.13
    clock = [np.sin(2.0 * np.pi * time), np.cos(2.0 * np.pi * time)]
    changed = mirror.observations(torch.tensor([*clock, 3.0, 1.0])).numpy()
    later = 2.0 * np.pi * (time + 0.5)
    assert changed == pytest.approx([np.sin(later), np.cos(later), 1.0, 3.0], abs=1e-6)
