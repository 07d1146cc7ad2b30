"""The PID agent in the simulation: joints go where they are commanded, and it stands where others fall."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import agents.pid.agent
from agents.pid.agent import Design, PIDAgent, make_pid_agent, rest_poses
from agents.pid.controller import motion_poses
from piavatar_envs.avatar.body.skeleton import JOINT_NAMES, NUM_JOINTS, joint_limits
from piavatar_envs.avatar.body.sources import load_asset
from piavatar_envs.avatar.motion import load_motion
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
    assert (standing.metrics.numpy()[:, 0, 0] > 0.85).all()  # the head's height over that in the rest pose
    assert (agent.effort.margin > 0.0).all(axis=1).any()  # caught: within the feet
    limp = np.zeros((len(SEEDS), standing.action_spec.size))
    assert play(standing, lambda _: limp, 1.0, SEEDS).max() < 0.7
    monkeypatch.setattr(agents.pid.agent, "answered", alone)
    assert play(standing, agent, 2.0, SEEDS).min() < 1.8


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


def test_joints_go_to_the_pose_that_is_asked_for_and_follow_one_that_moves(held):
    """Every joint about all its axes at once, under gravity: the frames of rotations, rates and torques are right."""
    places = [JOINT_NAMES.index(name) - 1 for name in ABOVE]
    lower, upper = (bound[1:] for bound in joint_limits())
    goal = np.zeros((NUM_JOINTS - 1, 3))
    goal[places] = np.random.default_rng(0).uniform(0.35 * lower, 0.35 * upper)[places]

    def errors(target: np.ndarray) -> np.ndarray:
        return missing(held, target)[places]

    def share(times: np.ndarray) -> np.ndarray:
        return 1.0 - np.cos(np.minimum(times, 1.5) * np.pi / 1.5)  # there and back is one second and a half each

    def hold(times: np.ndarray) -> np.ndarray:
        return np.broadcast_to(goal, (len(times), *goal.shape))

    play(held, PIDAgent(held, poses=hold), 3.0, np.array([0]))
    assert errors(0.0 * goal).mean() > 0.25
    assert errors(goal).mean() < 0.12 and errors(goal).max() < 0.25
    steady = errors(goal).mean()
    play(held, PIDAgent(held, Design(integral_time=np.inf), hold), 3.0, np.array([0]))
    assert errors(goal).mean() > 1.1 * steady
    moving = PIDAgent(held, poses=lambda times: 0.7 * share(times)[:, None, None] * goal)
    play(held, moving, 0.9, np.array([0]))
    now = 0.7 * share(np.array([0.9]))[0] * goal
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
    assert np.abs(many(seen[0]) - first).max() > 1e-3  # it is stateful
    many.begin(len(SEEDS))
    np.testing.assert_array_equal(many(seen[0]), first)


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
    assert followed.mean() < 0.6 * held.mean()
    without = tuple(name for name in JOINT_NAMES[1:] if name != "left_shoulder")
    play(env, PIDAgent(env, Design(followed=without)), 0.9, np.array([0]))
    assert missing(env, now)[arm] > 0.6


@pytest.mark.parametrize("task", ["PushRecovery-v0", "GetUp-v0", "Walk-v0", "TrackMotion-v0"])
def test_it_plays_every_task_of_torques(task, device):
    settings = {"control": "torque", "fidelity": "tiny"}
    agent = make_pid_agent(task, settings)
    env = make(2, device, task, fidelity="tiny")
    play(env, agent, 0.2, np.array([3, 4]))
    action = agent(env.observation.numpy()[:, 0])
    assert action.shape == (2, env.action_spec.size)
    assert np.isfinite(action).all() and 0.0 < np.abs(action).max() <= 1.0
