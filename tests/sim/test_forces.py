"""External forces: momentum and statics against theory, in every mode of control; what checkpoints and resets keep."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from piavatar_envs.avatar.body.skeleton import PARENTS, joint_index
from piavatar_envs.mpm.diagnostics import totals
from piavatar_envs.mpm.types import FAILURE_CFL, FAILURE_FORCE
from piavatar_envs.sim.forces import SLOTS
from tests.sim.tissue import tissue_torques

STAND = "PIAvatar/Stand-v0"
EMPTY = {"gravity": 0.0, "scene": {"ground": False, "walls": False}}
BALL = {"name": "ball", "mass": 1.5, "position": [0.0, -1.2, 1.3]}
FREE = {
    "pose": {"control": "pose", "root": "free"},
    "one velocity": {"control": "pose", "root": "free", "decoupling": "paper"},
    "pd": {"control": "pd"},
    "torque": {"control": "torque"},
}
#: A substep per control step, in which the arm of a force is known exactly.
FINE = 1.0 / 600.0


def hold(env, steps: int) -> list[dict]:
    """Step with zero actions; return the infos."""
    still = np.zeros(env.action_space.shape, np.float32)
    return [env.step(still)[4] for _ in range(steps)]


def pose_of(env, target: str) -> tuple[np.ndarray, Rotation]:
    """Return position and rotation of the frame in which a target's forces are stored."""
    found = env.batch.simulation.receivers.find(target)
    position, rotation = (getattr(found.frame, name).numpy()[0, found.column] for name in ("position", "rotation"))
    return position.astype(float), Rotation.from_quat(rotation.astype(float))


def moment(env, target: str, local: np.ndarray, force: np.ndarray, steps: int, dt: float) -> np.ndarray:
    """Step, and return the sum of ``r x F dt`` about the origin with the arm at the start of each step."""
    total = np.zeros(3)
    for _ in range(steps):
        at, turn = pose_of(env, target)
        total += dt * np.cross(at + turn.apply(local), force)
        hold(env, 1)
    return total


@pytest.mark.parametrize("mode", FREE)
def test_a_force_gives_its_momentum_and_its_angular_momentum(make_env, mode):
    force, local = np.array([20.0, 40.0, 10.0]), np.array([0.02, 0.0, -0.3])
    env = make_env(STAND, control_dt=FINE, pose_noise=0.0, **FREE[mode], **EMPTY)
    env.reset(seed=0)
    hold(env, 1)
    simulation = env.batch.simulation
    assert simulation.model.num_substeps == 1
    before = totals(simulation.model, simulation.state)
    at, turn = pose_of(env, "left_knee")
    env.apply_force("left_knee", force, at + turn.apply(local), steps=30)
    expected = moment(env, "left_knee", local, force, 30, FINE)
    after = totals(simulation.model, simulation.state)
    impulse = 30 * FINE * force
    assert after.momentum - before.momentum == pytest.approx(impulse, abs=1e-5 * np.linalg.norm(impulse))
    change = after.angular_momentum - before.angular_momentum
    assert change == pytest.approx(expected, abs=1e-5 * np.linalg.norm(expected))
    hold(env, 5)  # it has ended
    last = totals(simulation.model, simulation.state)
    assert last.momentum == pytest.approx(after.momentum, abs=1e-5 * np.linalg.norm(impulse))


def test_a_prop_falls_by_newtons_law(make_env):
    # F = m a at its centre of mass, without spin.
    env = make_env("PIAvatar/Reach-v0", gravity=0.0, scene={"ground": False, "props": [BALL]}, fidelity="coarse")
    env.reset(seed=0)
    props, force = env.batch.simulation.props, np.array([0.0, 0.0, 3.0])
    dt = env.config.physics.control_dt
    env.apply_force("ball", force, steps=10)
    hold(env, 10)
    state = props.state.numpy()
    mass = props.mass[0]
    assert state["velocity"][0, 0] == pytest.approx(force * 10 * dt / mass, abs=1e-5 * 10 * dt * 3.0 / mass)
    assert np.linalg.norm(state["spin"][0, 0]) < 1e-4
    rise = state["position"][0, 0] - BALL["position"]
    assert rise == pytest.approx(0.5 * force / mass * (10 * dt) ** 2, rel=0.02, abs=1e-4)  # substeps are explicit
    env.reset(seed=0)  # off it, it spins with the moment of the force
    model, state = env.batch.simulation.model, env.batch.simulation.state
    arm = np.array([0.05, 0.0, 0.02])
    env.apply_force("ball", force, np.array(BALL["position"]) + arm, steps=1)
    before = totals(model, state, about=BALL["position"])
    hold(env, 1)
    change = totals(model, state, about=BALL["position"]).angular_momentum - before.angular_momentum
    assert change == pytest.approx(np.cross(arm, force) * dt, abs=2e-3 * 0.15 * dt)  # the arm turns


def spring_moment(env, bone: int) -> np.ndarray:
    """Return the moment of a joint's spring on the bone in the world [N m]."""
    simulation = env.batch.simulation
    joints = simulation.controllers[0].joints
    world = Rotation.from_quat(joints.pose.rotation.numpy()[0].astype(float))
    goal = Rotation.from_quat(simulation.avatar.state.goal_rotation.numpy()[0, bone].astype(float))
    error = goal * (world[PARENTS[bone]].inv() * world[bone]).inv()
    return world[PARENTS[bone]].apply(joints.springs.stiffness.numpy()[0, 1 + bone] * error.as_rotvec())


def test_springs_carry_the_moment_of_a_force_on_a_foot(make_env):
    # 20 N up on a foot, at rest: each joint of the leg has the moment r x F with the opposite sign, the pelvis -F.
    env = make_env(STAND, control="pd", root_assist=1.0, pose_noise=0.0, fidelity="coarse", **EMPTY)
    env.reset(seed=0)
    force, simulation = np.array([0.0, 0.0, 20.0]), env.batch.simulation
    mass, x = simulation.model.particles.mass.numpy()[0], simulation.state.x.numpy()[0]
    foot = np.isin(simulation.flesh[0].sampled.skin_joints[:, 0], [joint_index("left_ankle"), joint_index("left_foot")])
    center = (mass[: len(foot)][foot] @ x[: len(foot)][foot]) / mass[: len(foot)][foot].sum()
    at, turn = pose_of(env, "left_ankle")
    local = turn.inv().apply(center - at)
    env.apply_force("left_ankle", force, center, steps=1000)
    info = hold(env, 60)[-1]
    at, turn = pose_of(env, "left_ankle")
    assert np.cross(turn.apply(local), force)[0] == pytest.approx(-1.07, abs=0.06)  # it turns the toes up
    for name in ("left_ankle", "left_knee", "left_hip"):
        load = np.cross(at + turn.apply(local) - pose_of(env, name)[0], force)
        bone = joint_index(name)
        assert spring_moment(env, bone) + tissue_torques(env.batch)[bone] == pytest.approx(-load, abs=0.005)
    assert info["root_force"] == pytest.approx(-force, abs=0.01)


def test_a_blocked_limb_passes_a_force_on(make_env):
    # A standing body at rest: weight, push, ground and the pelvis' springs are in balance; the push reaches the ground.
    env = make_env(STAND, control="pd", root_assist=1.0, pose_noise=0.0, episode_seconds=100.0)
    found = []
    for push in (0.0, -60.0):
        env.reset(seed=0)
        if push:
            env.apply_force("left_ankle", [0.0, 0.0, push], steps=1000)
        info = hold(env, 60)[-1]
        simulation = env.batch.simulation
        ground = simulation.sensors.boundary_impulse.numpy()[0, 0, 2] / env.config.physics.control_dt
        weight = 9.81 * simulation.model.particles.mass.numpy()[0].sum()
        assert ground + info["root_force"][2] + push == pytest.approx(weight, abs=0.05)
        found.append(ground)
    assert found[1] - found[0] == pytest.approx(60.0, rel=0.15)  # the pelvis' springs hold the rest


def test_forces_add_up_and_last_for_their_steps(make_env):
    env = make_env(STAND, pose_noise=0.0, **FREE["pose"], **EMPTY)
    env.reset(seed=0)
    simulation, dt, force = env.batch.simulation, env.config.physics.control_dt, np.array([0.0, 6.0, 0.0])
    start = totals(simulation.model, simulation.state).momentum
    given = 0.0
    for steps, bone in ((1, "head"), (3, "left_elbow"), (2, "head")):
        env.apply_force(bone, force, steps=steps)
    for acting in (3, 2, 1, 0):
        hold(env, 1)
        given += acting * dt
        momentum = totals(simulation.model, simulation.state).momentum - start
        assert momentum == pytest.approx(given * force, abs=1e-5 * np.linalg.norm(given * force))


def test_a_force_strains_nothing_by_itself(make_env):
    # Under torque control the bones move as joints let them, in free space as under a field.
    env = make_env(STAND, pose_noise=0.0, **FREE["pd"], **EMPTY)
    env.reset(seed=0)
    env.apply_force("pelvis", [0.0, 60.0, 0.0], steps=5)
    hold(env, 5)
    F = env.batch.simulation.state.numpy()["F"][0]
    assert np.abs(F - np.eye(3)).max() < 0.02


@pytest.mark.parametrize("mode", ["pose", "pd"])
def test_environments_of_a_batch_are_pushed_as_single_ones(make_batch, equal, mode):
    settings = {"pose_noise": 0.0, **FREE[mode], **EMPTY}
    several, single = make_batch(STAND, 3, **settings), make_batch(STAND, 1, **settings)
    push = np.float32([[0.0, 30.0, 5.0], [1.0, 2.0, 3.0], [-20.0, 0.0, 0.0]])
    several.reset(seeds=[4, 5, 6])
    for batch in (several, single):
        batch.enable_forces()
    call = several.simulation.forces.call
    call.mask.assign(np.array([True, False, True]))
    call.force.assign(push)
    several.apply_force(several.simulation.receivers.find("right_wrist"), 2, at_point=False)
    for _ in range(3):
        several.step()
    for env, seed in ((0, 4), (1, 5), (2, 6)):
        single.reset(seeds=[seed])
        call = single.simulation.forces.call
        call.mask.fill_(env != 1)
        call.force.assign(push[env : env + 1])
        single.apply_force(single.simulation.receivers.find("right_wrist"), 2, at_point=False)
        for _ in range(3):
            single.step()
        for name, value in single.get_state().items():
            if name != "env.settings" and not name.startswith("task."):
                alive = np.ones(SLOTS, bool)
                if name.startswith("forces."):  # what a free slot holds has no meaning
                    alive = several.get_state()["forces.remaining"][env] > 0
                    assert equal(several.get_state()[name][env][alive], value[0][alive]), name
                else:
                    assert equal(several.get_state()[name][env], value[0]), name


def test_resets_end_the_forces_of_their_environments_alone(make_batch):
    batch = make_batch(STAND, 3, **FREE["pose"], **EMPTY)
    batch.reset(seeds=[0, 1, 2])
    batch.enable_forces()
    forces = batch.simulation.forces
    forces.call.mask.fill_(True)
    forces.call.force.fill_(np.float32([0.0, 1.0, 0.0]))
    batch.apply_force(batch.simulation.receivers.find("head"), 5, at_point=False)
    batch.step()
    batch.reset(np.array([False, True, False]))
    assert forces.slots.remaining.numpy()[:, 0].tolist() == [4, 0, 4]


def test_failed_environments_keep_theirs(make_batch):
    batch = make_batch(STAND, 2, **FREE["pose"], **EMPTY)
    batch.reset(seeds=[0, 1])
    batch.enable_forces()
    forces = batch.simulation.forces
    forces.call.mask.fill_(True)
    forces.call.force.fill_(np.float32([0.0, 1.0, 0.0]))
    batch.apply_force(batch.simulation.receivers.find("head"), 5, at_point=False)
    batch.failure.assign(np.array([0, FAILURE_CFL], np.int32))
    before = batch.simulation.state.u.numpy()[1].copy()
    batch.step()
    assert forces.slots.remaining.numpy()[:, 0].tolist() == [4, 5]
    np.testing.assert_array_equal(batch.simulation.state.u.numpy()[1], before)


@pytest.mark.parametrize("wrong", ["force", "point", "slots"])
def test_what_a_device_cannot_refuse_ends_its_environment(make_batch, wrong):
    batch = make_batch(STAND, 2, **FREE["pose"], **EMPTY)
    batch.reset(seeds=[0, 1])
    batch.enable_forces()
    forces, head = batch.simulation.forces, batch.simulation.receivers.find("head")
    forces.call.mask.assign(np.array([False, True]))
    forces.call.force.fill_(np.float32([0.0, 1.0, 0.0]))
    forces.call.point.zero_()
    for _ in range(SLOTS if wrong == "slots" else 0):
        batch.apply_force(head, 9, at_point=True)
    assert batch.failure.numpy().tolist() == [0, 0]
    if wrong != "slots":
        getattr(forces.call, wrong).fill_(np.float32([0.0, np.nan, 0.0]))
    batch.apply_force(head, 1, at_point=True)
    assert batch.failure.numpy().tolist() == [0, FAILURE_FORCE]


def test_steps_without_forces_have_no_launches_for_them(make_batch):
    batch = make_batch(STAND, 1, episode_seconds=3.0, **FREE["pd"])
    before = batch.step_graph.names
    assert not any(name in before for name in ("find_used_slots", "push_joints", "count_step"))
    assert not any(name.startswith("forces.") for name in batch.get_state())
    batch.enable_forces()
    after = batch.step_graph.names
    assert [name for name in after if name not in ("find_used_slots", "push_joints", "count_step")] == before
    assert any(name.startswith("forces.") for name in batch.get_state())


def test_enabling_changes_nothing(make_batch, equal):
    # The same run, with forces enabled half-way and none given.
    settings = {"episode_seconds": 4.0, "control": "pd"}
    states = []
    for enable in (False, True):
        batch = make_batch(STAND, 1, **settings)
        batch.reset(seeds=[3])
        batch.action.fill_(0.3)
        batch.step()
        if enable:
            batch.enable_forces()
        for _ in range(3):
            batch.step()
        states.append(batch.get_state())
    assert all(equal(states[1][name], value) for name, value in states[0].items())
