"""Environments under torque control: targets and torques as actions, and the contracts of every task."""

from __future__ import annotations

import warnings

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from scipy.spatial.transform import Rotation

from piavatar_envs.avatar.body.muscles import LOCKED_JOINTS, joint_torques
from piavatar_envs.avatar.body.skeleton import JOINT_NAMES, PARENTS, joint_index, joint_limits
from piavatar_envs.config import ConfigError
from piavatar_envs.mpm.types import FAILURE_CFL

CONTROLS = ("pd", "torque")
REACH = "PIAvatar/Reach-v0"


@pytest.fixture(params=CONTROLS)
def control(request) -> str:
    return request.param


def actions(env, count: int, seed: int = 0) -> np.ndarray:
    return 0.3 * np.random.default_rng(seed).uniform(-1.0, 1.0, (count, *env.action_space.shape)).astype(np.float32)


def run(env, rows) -> list:
    return [env.step(action)[:4] for action in rows]


def alike(equal, first, second) -> bool:
    return all(equal(a[0], b[0]) and equal(a[1], b[1]) and a[2:] == b[2:] for a, b in zip(first, second, strict=True))


def test_every_task_steps_under_torques(make_env, env_id):
    env = make_env(env_id, control="torque")
    env.reset(seed=3)
    for action in actions(env, 3):
        observation, reward, *_, info = env.step(action)
        assert np.isfinite(observation).all() and np.isfinite(reward) and info["failure"] == 0


def test_torques_pass_the_checker_and_repeat_and_restore_a_run(make_env, sample_id, equal):
    env = make_env(sample_id, control="torque")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of unbounded spaces
        check_env(env, skip_render_check=True)
    rows = actions(env, 10)
    env.reset(seed=3)
    first = run(env, rows[:6])
    state = env.get_state()
    last = run(env, rows[6:])
    env.reset(seed=3)
    assert alike(equal, first, run(env, rows[:6]))
    env.reset(seed=4)
    run(env, rows[:2])
    env.set_state(state)
    assert alike(equal, last, run(env, rows[6:]))


def test_a_failure_freezes_the_environment(make_env, control):
    env = make_env(REACH, control=control)
    env.reset(seed=0)
    state = env.get_state()
    state["particles.u"][0, 0] = 1e6
    env.set_state(state)
    assert env.step(np.zeros(env.action_space.shape))[4]["failure"] == FAILURE_CFL
    frozen = env.get_state()
    env.step(np.ones(env.action_space.shape))
    after = env.get_state()
    names = [name for name in frozen if name.startswith(("controller_0", "particles"))]
    assert all(frozen[name].tobytes() == after[name].tobytes() for name in names if name != "controller_0.torque")
    env.reset(seed=0)
    assert env.step(np.zeros(env.action_space.shape))[4]["failure"] == 0


def angles(env) -> np.ndarray:
    """Return the rotation vectors of the joints [rad], ``(22, 3)``."""
    world = Rotation.from_quat(env.batch.simulation.controllers[0].state.rotation.numpy()[0].astype(float))
    return np.stack([(world[max(PARENTS[b], 0)].inv() * world[b]).as_rotvec() for b in range(len(JOINT_NAMES))])


@pytest.mark.parametrize(("component", "share"), [("left_shoulder.x", -0.4), ("right_elbow.z", 0.3), ("neck.z", 0.6)])
def test_a_target_is_absolute(make_env, component, share):
    """Hold an action: the joint ends at that share of its axis' range, but for what its tissue resists."""
    env = make_env(REACH, control="pd", root_assist=1.0, gravity=0.0, pose_noise=0.0, joints=None)
    env.reset(seed=0)
    action = np.zeros(env.action_space.shape, np.float32)
    action[env.action_names.index(component)] = share
    for _ in range(60):
        env.step(action)
    joint, axis = component.split(".")
    lower, upper = joint_limits()
    expected = np.zeros(3)
    bound = upper if share > 0.0 else -lower
    expected["xyz".index(axis)] = share * bound[joint_index(joint), "xyz".index(axis)]
    assert np.abs(angles(env)[joint_index(joint)] - expected).max() < 0.03


def test_torques_are_shares_of_the_joints_strength(make_env):
    """Compare with the table of the mean body, scaled by weight times height."""
    env = make_env(REACH, control="torque", joints=None)
    env.reset(seed=0)
    controller = env.batch.simulation.controllers[0]
    lower, upper = joint_torques()
    for share in (1.0, -0.5):
        env.step(np.full(env.action_space.shape, share, np.float32))
        expected = share * (upper if share > 0.0 else -lower)
        np.testing.assert_allclose(controller.state.torque.numpy()[0], expected, rtol=1e-5)
    size = controller.joints.strength.factor.numpy()[0]
    mass = env.batch.simulation.avatar.body_mass.numpy()[0]
    rest = env.batch.simulation.flesh[0].points.rest[0]
    assert size == pytest.approx(mass * np.ptp(rest[:, 2]) / (75.0 * 1.75), rel=1e-4)


def test_toes_do_not_act_and_do_not_move(make_env, control):
    env = make_env(REACH, control=control, joints=None, pose_noise=0.0)
    assert not any(name.startswith(LOCKED_JOINTS) for name in env.action_names)
    env.reset(seed=1)
    run(env, actions(env, 5))
    toes = [joint_index(name) for name in LOCKED_JOINTS]
    assert np.abs(angles(env)[toes]).max() < 1e-3


def test_the_root_is_held_by_assistance_only(make_env, make_batch):
    heights = {}
    for assist in (0.0, 1.0):
        env = make_env(REACH, control="torque", root_assist=assist, pose_noise=0.0)
        env.reset(seed=0)
        rows = [env.step(np.zeros(env.action_space.shape)) for _ in range(40)]
        assert all(np.any(row[4]["root_force"]) == (assist > 0.0) for row in rows)
        assert not any(row[2] for row in rows)
        heights[assist] = env.batch.simulation.avatar.tracked.position.numpy()[0, 0, 2]
    assert heights[0.0] < 0.5 < 0.75 < heights[1.0]
    batch = make_batch(REACH, 2, control="torque", pose_noise=0.0)
    batch.reset(seeds=[0, 0])
    batch.assist_root(np.array([0.0, 1.0]))
    for _ in range(40):
        batch.step()
    fallen, held = batch.simulation.avatar.tracked.position.numpy()[:, 0, 2]
    assert (fallen, held) == pytest.approx((heights[0.0], heights[1.0]), abs=1e-6)
    batch.assist_root(0.0)


def test_an_assisted_avatar_stands_still(make_env):
    env = make_env(REACH, control="pd", root_assist=1.0, pose_noise=0.0, episode_seconds=20.0)
    env.reset(seed=0)
    for _ in range(150):
        *_, info = env.step(np.zeros(env.action_space.shape))
    state = env.batch.simulation.state
    speed = np.linalg.norm(state.u.numpy()[0] + state.vk.numpy()[0], axis=1)
    assert info["failure"] == 0
    assert speed.max() < 0.02
    assert np.degrees(np.linalg.norm(angles(env)[1:], axis=1)).max() < 6.0


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"control": "pd", "decoupling": "paper"}, "two velocities.*split"),
        ({"decoupling": "paper"}, r"root='wrench'.*two velocities.*paper.*control\.root=free"),
        ({"decoupling": "none"}, r"root='wrench'.*two velocities.*none.*control\.root=free"),
        ({"scene": {"avatars": [{"control": {"mode": "pd"}}]}}, r"control\.mode='pd' cannot differ"),
        ({"control": "pd", "num_substeps": 5}, r"num_substeps=5.*at least 9"),
        ({"control": "pd", "flesh_rate": (30.0, -1.0)}, "flesh_rate"),
        ({"control": "pd", "flesh_rate": (0.0, 100.0)}, "flesh_rate"),
        ({"control": "pd", "flesh_rate": (200.0, 100.0)}, "flesh_rate"),
    ],
)
def test_impossible_combinations_are_refused(device, settings, words):
    with pytest.raises(ConfigError, match=words):
        gymnasium.make(REACH, device=device, fidelity="tiny", **settings)


def test_a_stop_does_not_let_a_joint_turn_round(make_env):
    """Push an elbow into the corner of its range, over half a turn from its middle, where rotation vectors jump."""
    env = make_env(REACH, control="torque", gravity=0.0, root_assist=1.0)
    env.reset(seed=0)
    action, names = np.zeros(env.action_space.shape, np.float32), env.unwrapped.action_names
    for component in ("left_elbow.x", "left_elbow.z"):
        action[names.index(component)] = -1.0
    elbow, above = joint_index("left_elbow"), joint_index("left_shoulder")
    for step in range(60):
        *_, info = env.step(action)
        assert info["failure"] == 0
        world = Rotation.from_quat(
            env.unwrapped.batch.simulation.controllers[0].state.rotation.numpy()[0].astype(float)
        )
        turn = (world[above].inv() * world[elbow]).magnitude()
        assert turn < 3.0, f"step {step}: {turn:.2f} rad"


def test_random_corners_do_not_break_a_body(make_env):
    """Set every target of every joint to an end of its range, another one every step."""
    env, rng = make_env(REACH, control="pd", pose_noise=0.0), np.random.default_rng(0)
    env.reset(seed=0)
    for _ in range(150):
        *_, terminated, truncated, info = env.step(rng.choice([-1.0, 1.0], env.action_space.shape).astype(np.float32))
        assert info["failure"] == 0
        if terminated or truncated:
            env.reset()


def test_joints_are_observed(make_env, control):
    """Compare velocities with differences of angles in the parent's frame, and the ground's impulse with the weight."""
    env = make_env(REACH, control=control, joints=None, root_assist=0.5, pose_noise=0.0)
    layout, elbow = env.observation_layout, joint_index("left_elbow")
    env.reset(seed=0)
    action = np.zeros(env.action_space.shape, np.float32)
    action[env.action_names.index("left_elbow.x")] = -0.2
    turned, seen, weight = [angles(env)[elbow]], [np.zeros(3)], []
    for _ in range(10):
        observation, *_ = env.step(action)
        turned.append(angles(env)[elbow])
        seen.append(observation[layout["joint_velocities"].slice].reshape(-1, 3)[elbow - 1])
        weight.append(observation[layout["ground_impulse"].slice])
    rates = 30.0 * np.diff(turned, axis=0)
    means = 0.5 * (np.array(seen[1:]) + np.array(seen[:-1]))  # of both ends of a step
    assert np.abs(rates).max() > 0.5
    assert np.abs(rates - means)[2:].max() < 0.2 * np.abs(rates).max()
    mass = env.batch.simulation.avatar.body_mass.numpy()[0]
    assert 0.3 < np.mean(weight[4:], axis=0)[2] / (mass * 9.81 / 30.0) < 1.3
