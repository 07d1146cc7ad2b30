"""The PID agent in the simulation: it asks for what joints get, goes where it is told, and stands where others fall."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import agents.pid.agent
from agents.pid.agent import Design, PIDAgent, make_pid_agent, rest_poses
from agents.pid.controller import motion_poses
from piavatar_envs.avatar.body.skeleton import JOINT_NAMES, NUM_JOINTS, joint_limits
from piavatar_envs.avatar.body.sources import load_asset
from piavatar_envs.avatar.motion import deepmimic, load_motion
from piavatar_envs.config import load_config
from piavatar_envs.envs.batch_env import BatchEnv
from piavatar_envs.tasks import load_task

#: Seeds of Stand whose first pose has the centre of mass 16 and 13 mm behind the ankles, and one 32 mm ahead of them.
SEEDS = np.array([9, 1, 0])
ABOVE = [name for name in JOINT_NAMES[1:] if not name.endswith(("hip", "knee", "ankle", "foot"))]


def make(num_envs: int, device: str, task: str = "Stand-v0", **settings) -> BatchEnv:
    """A batch of a task under torques."""
    kind = load_task(task)
    return BatchEnv(kind(load_config(kind.Config, None, {"control": "torque", **settings})), num_envs, device)


def play(env: BatchEnv, agent, seconds: float, seeds: np.ndarray) -> np.ndarray:
    """Times at which environments ended [s]; ``seconds`` for those that did not."""
    env.reset(seeds=seeds)
    if isinstance(agent, PIDAgent):
        agent.begin(env.num_envs)
    dt = env.config.physics.control_dt
    ended = np.full(env.num_envs, seconds)
    for step in range(round(seconds / dt)):
        env.action.assign(agent(env.observation.numpy()[:, 0]).astype(np.float32)[:, None])
        env.step()
        ended = np.where(env.terminated.numpy()[:, 0], np.minimum(ended, (step + 1) * dt), ended)
        if (ended < seconds).all():
            break
    assert not env.failure.numpy().any()
    return ended


@pytest.fixture(scope="module")
def standing(device):
    """Stand at the resolution that the agent is designed for."""
    return make(len(SEEDS), device)


@pytest.fixture(scope="module")
def held(device):
    """A body whose pelvis is held."""
    return make(1, device, fidelity="tiny", root_assist=1.0, pose_noise=0.0)


def missing(env: BatchEnv, target: np.ndarray) -> np.ndarray:
    """Angles of the first environment's joints from a pose ``(21, 3)`` [rad], ``(21,)``."""
    local = Rotation.from_quat(env.simulation.avatar.tracked.local.numpy()[0, 1:])
    return (local.inv() * Rotation.from_rotvec(target)).magnitude()


def alone(matrix: np.ndarray, torque: np.ndarray, stiffness: np.ndarray) -> np.ndarray:
    """Every joint by its own inertia."""
    own = np.diagonal(matrix, axis1=1, axis2=2)[:, 6:].reshape(torque.shape)
    return torque / (1.0 + stiffness / own)


def test_it_stands_where_no_torque_and_joints_for_themselves_fall(standing, monkeypatch):
    agent = PIDAgent(standing)
    assert play(standing, agent, 2.0, SEEDS).min() == 2.0
    assert (standing.metrics.numpy()[:, 0, 0] > 0.9).all()  # the head's height over that in the rest pose
    assert (agent.effort.margin > 0.0).all()  # caught: within the feet
    limp = np.zeros((len(SEEDS), standing.action_spec.size))
    assert play(standing, lambda _: limp, 1.0, SEEDS).max() < 0.7
    monkeypatch.setattr(agents.pid.agent, "answered", alone)
    assert play(standing, agent, 2.0, SEEDS).max() < 1.8


def test_it_knows_where_the_centre_of_mass_is_from_what_it_observes(standing):
    agent = PIDAgent(standing)
    play(standing, agent, 0.3, SEEDS)
    observation = standing.observation.numpy()[:, 0].astype(float)
    now = agent.posture(observation)
    sim = standing.simulation
    mass, x = sim.model.particles.mass.numpy(), sim.state.x.numpy()
    true = (mass[..., None] * x).sum(1) / mass.sum(1)[:, None] - sim.avatar.tracked.position.numpy()[:, 0]
    np.testing.assert_allclose(agent.bones.mean(now.centres), true, atol=0.01)
    assert agent.bones.mass.sum() == pytest.approx(mass[0].sum(), rel=1e-5)


def test_joints_get_the_torques_that_it_asks_for(standing):
    """Of this body, in the parents' axes, and no more than they have."""
    agent, rng = PIDAgent(standing), np.random.default_rng(0)
    wanted = rng.uniform(1.5 * agent.lower[1:], 1.5 * agent.upper[1:], (len(SEEDS), NUM_JOINTS - 1, 3))
    standing.reset(seeds=SEEDS)
    standing.action.assign(agent.actions(wanted).astype(np.float32)[:, None])
    standing.step()
    controller = standing.simulation.controllers[0]
    given = controller.state.torque.numpy()[:, 1:] * controller.joints.strength.factor.numpy()[:, None, None]
    np.testing.assert_allclose(given, np.clip(wanted, agent.lower[1:], agent.upper[1:]), rtol=1e-3, atol=1e-2)


def test_joints_go_to_the_pose_that_is_asked_for_and_follow_one_that_moves(held):
    """Every joint about all its axes at once, under gravity: the frames of rotations, rates and torques are right."""
    places = [JOINT_NAMES.index(name) - 1 for name in ABOVE]
    lower, upper = (bound[1:] for bound in joint_limits())
    goal = np.zeros((NUM_JOINTS - 1, 3))
    goal[places] = np.random.default_rng(0).uniform(0.5 * lower, 0.5 * upper)[places]

    def errors(target: np.ndarray) -> np.ndarray:
        return missing(held, target)[places]

    def share(times: np.ndarray) -> np.ndarray:
        return 1.0 - np.cos(np.minimum(times, 1.5) * np.pi / 1.5)  # there and back is one second and a half each

    def hold(times: np.ndarray) -> np.ndarray:
        return np.broadcast_to(goal, (len(times), *goal.shape))

    play(held, PIDAgent(held, poses=hold), 2.0, np.array([0]))
    assert errors(0.0 * goal).mean() > 0.4
    assert errors(goal).mean() < 0.1 and errors(goal).max() < 0.25
    steady = errors(goal).mean()
    play(held, PIDAgent(held, Design(integral_time=np.inf), hold), 2.0, np.array([0]))
    assert errors(goal).mean() > 1.2 * steady
    moving = PIDAgent(held, poses=lambda times: 0.5 * share(times)[:, None, None] * goal)
    play(held, moving, 0.9, np.array([0]))
    now = 0.5 * share(np.array([0.9]))[0] * goal
    assert errors(now).mean() < 0.15 < 0.3 < errors(0.0 * goal).mean()


def test_bodies_know_nothing_of_each_other_and_rounds_begin_anew(standing):
    many = PIDAgent(standing)
    ones = [PIDAgent(standing) for _ in SEEDS]
    standing.reset(seeds=SEEDS)
    seen = []
    for _ in range(4):
        seen.append(standing.observation.numpy()[:, 0].copy())
        action = many(seen[-1])
        for row, one in enumerate(ones):
            np.testing.assert_allclose(one(seen[-1][row : row + 1])[0], action[row], atol=1e-9)
        standing.action.assign(action.astype(np.float32)[:, None])
        standing.step()
    first = PIDAgent(standing)(seen[0])
    assert np.abs(many(seen[0]) - first).max() > 1e-3  # it remembers
    many.begin(len(SEEDS))
    np.testing.assert_array_equal(many(seen[0]), first)


def test_it_knows_what_muscles_give_of_what_it_asks_for(standing):
    """In any posture, also in the weak direction of joints whose muscles are not the same in both."""
    agent, rng = PIDAgent(standing), np.random.default_rng(0)
    agent.begin(2)
    local = Rotation.random(2 * (NUM_JOINTS - 1), random_state=1).as_matrix().reshape(2, NUM_JOINTS - 1, 3, 3)
    asked = rng.uniform(-400.0, 400.0, (2, NUM_JOINTS - 1, 3))
    given = np.einsum("nbij,nbj->nbi", local, agent.given(local, asked))
    shares = agent.actions(np.einsum("nbij,nbj->nbi", local, asked)).reshape(2, -1, 3)
    lower, upper = agent.lower[agent.acting], agent.upper[agent.acting]
    np.testing.assert_allclose(
        given[:, [joint - 1 for joint in agent.acting]], shares * np.where(shares > 0, upper, -lower)
    )
    neck = JOINT_NAMES.index("neck")
    assert -agent.lower[neck, 0] > 1.5 * agent.upper[neck, 0], "else nothing is tested"
    held, error = agent.pid.pid, np.zeros((2, NUM_JOINTS - 1, 3))
    error[:, neck - 1, 0] = 0.3
    straight = np.broadcast_to(np.eye(3), local.shape)
    for _ in range(3000):  # a neck that something holds back: the integral does not grow beyond what there is
        torque = held.step(error, np.zeros_like(error), given=lambda asked: agent.given(straight, asked))
    assert torque[0, neck - 1, 0] == pytest.approx(agent.upper[neck, 0])
    assert held.integral[0, neck - 1, 0] < 0.5 * agent.upper[neck, 0]


def test_only_joints_above_the_legs_have_an_integral(standing):
    agent = PIDAgent(standing)
    agent.begin(1)
    ki = np.broadcast_to(agent.pid.pid.gains.ki, (NUM_JOINTS - 1, 1))[:, 0]
    assert [name for name, gain in zip(JOINT_NAMES[1:], ki, strict=True) if gain > 0.0] == ABOVE
    play(standing, agent, 0.2, SEEDS)
    moved = np.abs(agent.pid.pid.integral).max(axis=(0, 2)) > 0.0
    assert [name for name, integral in zip(JOINT_NAMES[1:], moved, strict=True) if integral] == ABOVE


def test_the_gains_of_a_leg_go_with_its_load(standing, monkeypatch):
    """Of one that is about to fall to a side, of one that stands, and of one that is in the air."""
    agent, factors = PIDAgent(standing, Design(unloaded=0.25)), []
    agent.begin(4)
    step = agent.pid.step

    def watched(*args, factor, **kwargs):
        factors.append(np.broadcast_to(factor, (4, NUM_JOINTS - 1, 3)))
        return step(*args, factor=factor, **kwargs)

    monkeypatch.setattr(agent.pid, "step", watched)
    standing.reset(seeds=SEEDS)
    rows = np.repeat(standing.observation.numpy()[:1, 0].astype(float), 4, axis=0)
    weight = agent.bones.mass.sum() * 9.81
    root = Rotation.from_matrix(agent.posture(rows).rotation[0, 0])
    for row, (speed, load) in enumerate([(1.0, 1.0), (-1.0, 1.0), (0.0, 1.0), (0.0, 0.0)]):  # left is +x
        velocity = root.apply([speed, 0.0, 0.0], inverse=True)
        rows[row, agent.layout["bone_velocities"].slice] = np.tile(velocity, NUM_JOINTS)
        impulse = root.apply([0.0, 0.0, load * weight * agent.dt], inverse=True)
        rows[row, agent.layout["ground_impulse"].slice] = impulse
    agent(rows)
    knees = [JOINT_NAMES.index(f"{side}_knee") - 1 for side in ("left", "right")]
    to_left, to_right, still, in_air = factors[0][:, knees, 0]
    np.testing.assert_allclose(to_left, [1.0, 0.25])
    np.testing.assert_allclose(to_right, [0.25, 1.0])
    assert still.max() == 1.0 and still.min() > 0.6
    np.testing.assert_allclose(in_air, 0.25)
    np.testing.assert_array_equal(factors[0][:, [JOINT_NAMES.index(name) - 1 for name in ABOVE]], 1.0)


def test_it_follows_the_clip_that_the_task_shows(device):
    """The pose and the rate that the motion itself has at every time, and the body with them."""
    settings = {"fidelity": "tiny", "motion": "arm_wave", "root_assist": 1.0, "impulse": 0.0, "random_start": False}
    env = make(1, device, "TrackMotion-v0", **settings)
    motion = load_motion("arm_wave", load_asset())
    poses = motion_poses(motion, list(range(1, NUM_JOINTS)))
    play(env, PIDAgent(env), 0.9, np.array([0]))
    now = poses(np.array([0.9]))[0]
    arm = JOINT_NAMES.index("left_shoulder") - 1
    followed = missing(env, now)
    play(env, PIDAgent(env, poses=rest_poses), 0.9, np.array([0]))
    held = missing(env, now)
    assert held[arm] > 0.6 > 0.2 > followed[arm]
    assert followed.mean() < 0.5 * held.mean()
    without = tuple(name for name in JOINT_NAMES[1:] if name != "left_shoulder")
    play(env, PIDAgent(env, Design(followed=without)), 0.9, np.array([0]))
    assert missing(env, now)[arm] > 0.6


@pytest.mark.skipif(deepmimic.clip_folder() is None, reason="needs the extra motions: DeepMimic's clips")
def test_after_a_walk_it_falls_later_than_no_torques_and_latest_without_the_hip_strategy(device):
    clip = {"motion": "deepmimic:walk", "impulse": 0.0, "root_action": False, "fail_distance": 0.3}
    env, seeds = make(4, device, "TrackMotion-v0", **clip), np.arange(4)
    limp = np.zeros((4, env.action_spec.size))
    without = play(env, PIDAgent(env, Design(hip_share=0.0)), 1.0, seeds)
    for other in (lambda _: limp, PIDAgent(env)):
        assert without.mean() > play(env, other, 1.0, seeds).mean() + 0.1
    assert without.max() < 0.9  # and falls


@pytest.mark.parametrize("task", ["PushRecovery-v0", "GetUp-v0", "Walk-v0", "TrackMotion-v0"])
def test_it_plays_every_task_of_torques(task, device):
    settings = {"control": "torque", "fidelity": "tiny"}
    agent = make_pid_agent(task, settings)
    env = make(2, device, task, fidelity="tiny")
    play(env, agent, 0.2, np.array([3, 4]))
    action = agent(env.observation.numpy()[:, 0])
    assert action.shape == (2, env.action_spec.size)
    assert np.isfinite(action).all() and 0.0 < np.abs(action).max() <= 1.0


def test_what_moves_by_poses_is_refused():
    with pytest.raises(ValueError, match="control='pd'; the PID agent gives torques"):
        make_pid_agent("Stand-v0", {"fidelity": "tiny"})
