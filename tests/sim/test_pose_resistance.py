"""Pose control in which joints resist contact: against statics, momentum and the commanded motion itself."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp
from scipy.spatial.transform import Rotation

from benchmarks.physics.checks import Options
from benchmarks.physics.loads import LIFTS, stiffness
from benchmarks.physics.probe import JOINTS, Measurements
from piavatar_envs.avatar.body.muscles import FULL_TORQUE_ANGLE
from piavatar_envs.avatar.body.skeleton import joint_index
from piavatar_envs.avatar.pose_control.resistance import bound_command
from piavatar_envs.config import ConfigError

REACH, KICK = "PIAvatar/Reach-v0", "PIAvatar/KickBall-v0"
EMPTY = {"gravity": 0.0, "scene": {"ground": False, "walls": False}}


def control(**settings) -> dict:
    """Return the settings of a body whose joints resist."""
    return {"control": {"mode": "pose", "resistance": "joints", **settings}}


def run(batch, steps: int, seed: int = 0, hold: int = 4):
    """Take full-scale actions of random signs, held for some steps; yield after each step."""
    rng = np.random.default_rng(seed)
    for step in range(steps):
        if step % hold == 0:
            batch.action.assign(rng.choice([-1.0, 1.0], batch.action.shape).astype(np.float32))
        batch.step()
        yield Measurements(batch)


def deviation(batch) -> np.ndarray:
    """Return the velocity by which the joints deviate from commanded motion, ``(69,)``."""
    return batch.simulation.controllers[0].joints.state.velocity.numpy()[0]


@pytest.mark.parametrize("gravity", [0.0, 9.81])
def test_commanded_motion_loads_no_spring_and_strains_nothing(make_batch, gravity):
    batch = make_batch(REACH, 1, **control(), **EMPTY | {"gravity": gravity}, fidelity="coarse")
    batch.reset(seeds=[0])
    for now in run(batch, 16):
        assert now.displacement().max() < 2e-5  # [m], single precision of places a metre from the origin
        assert np.degrees(np.abs(now.errors).max()) < 0.005
        assert np.abs(deviation(batch)).max() < 2e-3
    assert now.strain().mean() < 1e-4
    assert np.abs(now.errors).max() < 1e-4 < np.abs(now.local).max()


@pytest.mark.parametrize("lift", ["ankle", "wrist"])
def test_a_box_meets_the_stiffness_of_the_table(lift):
    quantity = next(iter(stiffness(Options(), JOINTS, LIFTS[lift])))
    assert quantity.verdict == "holds", quantity


@pytest.mark.parametrize("tone", [1.0, 0.3])
def test_a_steady_force_bends_each_joint_by_moment_over_stiffness(make_env, tone):
    env = make_env(REACH, **control(tone=tone), **EMPTY, fidelity="coarse", pose_noise=0.0)
    env.reset(seed=0)
    now, force, wrist = Measurements(env.batch), np.array([0.0, 0.0, -4.0]), joint_index("left_wrist")
    at = now.pose[1][wrist] + [0.05, 0.0, -0.05]
    env.apply_force("left_wrist", force, point=at, steps=60)
    for _ in range(60):
        env.step(np.zeros(env.action_space.shape, np.float32))
    for name in ("left_elbow", "left_shoulder"):
        joint = joint_index(name)
        moment = np.linalg.norm(np.cross(at - now.pose[1][joint], force))
        expected = moment / (tone * now.spring(name))
        assert np.linalg.norm(now.errors[joint]) == pytest.approx(expected, rel=0.15)


def momentum_errors(batch, steps: int) -> tuple[float, float]:
    """Return the largest momentum of unknown origin in a step [N s], and the greatest root force [N]."""
    now = Measurements(batch)
    weight = batch.config.physics.gravity * now.mass[now.body].sum()
    before, worst, most = now.momentum(now.body), 0.0, 0.0
    for now in run(batch, steps):
        root = batch.simulation.avatar.state.wrench_force.numpy()[0].astype(float)
        after = now.momentum(now.body)
        known = now.dt * (root - [0.0, 0.0, weight]) + now.sensor("boundary_impulse")[0]
        worst, most = max(worst, np.abs(after - before - known).max()), max(most, np.linalg.norm(root))
        before = after
    return worst, most


@pytest.mark.parametrize(
    "settings",
    [{}, {"bound_motion": True}, {"root": "weight"}, {"root": "free"}, {"free_motion": True}],
    ids=["wrench", "bounded", "weight", "free", "free_motion"],
)
def test_every_momentum_has_an_origin(make_batch, settings):
    batch = make_batch(REACH, 1, **control(**settings), scene={"walls": False})
    batch.reset(seeds=[0])
    worst, most = momentum_errors(batch, 12)
    weight = 9.81 * batch.simulation.avatar.body_mass.numpy()[0]
    assert worst < 1e-3
    if settings.get("bound_motion"):
        assert most < 2.001 * weight
    if settings.get("root") == "free":
        assert most == 0.0


def test_a_body_that_nothing_holds_keeps_both_momenta_while_it_moves(make_batch):
    batch = make_batch(REACH, 1, **control(root="free"), **EMPTY)
    batch.reset(seeds=[0])
    for now in run(batch, 12):
        mass, v, x = now.mass[now.body], now.velocity[now.body], now.x[now.body]
        arm = x - now.center(now.body)
        assert np.abs(now.momentum(now.body)).max() < 1e-4 * (mass @ np.linalg.norm(v, axis=1))
        turning = np.linalg.norm(np.cross(arm, v), axis=1)
        # 3 % is what the affine velocities of so coarse particles hold
        assert np.abs(mass @ np.cross(arm, v)).max() < 0.03 * (mass @ turning)


def test_light_limbs_stay_with_a_fast_command_for_ten_seconds(make_batch):
    batch = make_batch(KICK, 1, **control())
    batch.reset(seeds=[0])
    for now in run(batch, 300):
        assert not batch.failure.numpy().any()
        assert np.isfinite(now.x).all()
        assert np.abs(deviation(batch)).max() < 100.0


def test_a_blow_only_loses_energy(make_batch):
    batch = make_batch(REACH, 1, **control(root="free"), **EMPTY, pose_noise=0.0)
    batch.reset(seeds=[0])
    batch.action.zero_()
    now = Measurements(batch)
    now.give(now.particles_of("left_wrist"), np.array([0.0, 3.0, 0.0]))
    energies = []
    for _ in range(20):
        energies.append(0.5 * now.mass[now.body] @ (now.velocity[now.body] ** 2).sum(1))
        batch.step()
    # beyond what springs take and give back
    assert energies[0] > max(energies[1:]) and energies[-1] < 0.25 * energies[0]


@pytest.mark.parametrize(
    ("last", "goal", "kept"),
    [(0.1, 0.2, 0.2), (0.1, 0.5, 0.3), (0.8, 0.8, 0.8), (0.8, 0.9, 0.8), (0.8, 0.7, 0.7), (-0.1, -0.5, -0.3)],
)
def test_an_obstacle_winds_no_spring_up_and_drags_no_command_along(make_batch, last, goal, kept):
    """Give angles of a knee's commands from the pose in which an obstacle holds it [rad]."""
    batch, knee = make_batch(REACH, 1, **control(), pose_noise=0.0), joint_index("left_knee")
    batch.reset(seeds=[0])
    state, joints = batch.simulation.avatar.state, batch.simulation.controllers[0].joints
    for array, angle in ((state.command_rotation, last), (state.goal_rotation, goal)):
        values = array.numpy()
        values[0, knee] = Rotation.from_rotvec([angle, 0.0, 0.0]).as_quat()
        array.assign(values)
    inputs = [batch.simulation.avatar.body, joints.pose, state.goal_rotation, state.goal_root, batch.failure]
    bones = batch.simulation.avatar.state.command_rotation.shape
    outputs = [state.command_rotation, state.command_root]
    wp.launch(bound_command, bones, inputs, outputs, device=batch.device)
    found = Rotation.from_quat(state.command_rotation.numpy()[0]).as_rotvec()
    np.testing.assert_allclose(found[knee], [kept, 0.0, 0.0], atol=2e-6)
    assert FULL_TORQUE_ANGLE == 0.3 and np.abs(np.delete(found, knee, 0)).max() < 1e-6


def test_a_run_repeats_and_resumes_bit_for_bit(make_env, env_id, equal):
    env = make_env(env_id, **control())
    rng = np.random.default_rng(0)
    rows = rng.uniform(-1.0, 1.0, (8, *env.action_space.shape)).astype(np.float32)

    def steps(some) -> list:
        return [env.step(action)[:4] for action in some]

    def alike(first, second) -> bool:
        return all(equal(a[0], b[0]) and a[1:] == b[1:] for a, b in zip(first, second, strict=True))

    env.reset(seed=3)
    first = steps(rows[:5])
    state = env.get_state()
    last = steps(rows[5:])
    env.reset(seed=3)
    assert alike(first, steps(rows[:5]))
    env.reset(seed=4)
    steps(rows[:2])
    env.set_state(state)
    assert alike(last, steps(rows[5:]))


def test_environments_of_a_batch_equal_single_ones(make_batch, equal):
    settings = {**control(), "shape": {"randomize": True, "pool": 2}}
    many = make_batch(REACH, 3, **settings)
    many.reset(seeds=[5, 6, 7])
    action = np.random.default_rng(1).uniform(-1.0, 1.0, many.action.shape).astype(np.float32)
    many.action.assign(action)
    for _ in range(3):
        many.step()
    one = make_batch(REACH, 1, **settings)
    for env in range(3):
        one.reset(seeds=[5 + env])
        one.action.assign(action[env : env + 1])
        for _ in range(3):
            one.step()
        assert equal(one.simulation.state.x.numpy()[0], many.simulation.state.x.numpy()[env])


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        (control(command="target"), "control.command='target'"),
        (control(shape_preservation="kinematic"), "control.shape_preservation='kinematic'"),
        (control(soft_tissue=0.5), "control.soft_tissue"),
        (control() | {"physics": {"decoupling": "paper"}}, "resistance='joints' needs two velocities"),
    ],
)
def test_what_joints_cannot_do_is_refused(make_env, settings, words):
    with pytest.raises(ConfigError, match="joints") as refused:
        make_env(REACH, **settings)
    assert words in str(refused.value)
