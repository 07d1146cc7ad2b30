"""Models of the PID agent: balance against the linear inverted pendulum, and bones against rigid-body mechanics."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from agents.pid.balance import FRONTAL, GRAVITY, SAGITTAL, Balance, Effort, Stance
from agents.pid.bones import NUM_DOF, Bones, Posture, force_moments, in_bones
from agents.pid.gains import gains_for, subtrees
from piavatar_envs.avatar.body.skeleton import NUM_JOINTS, joint_index

STANCE = Stance(mass=70.0, height=0.9, behind=0.06, ahead=0.18, beside=0.14, foot_width=0.08)
W = np.sqrt(GRAVITY / 0.9)


def fall(balance: Balance, offset, velocity, seconds=4.0, dt=1e-3):
    """Motion of x'' = w^2 (x - p) - torque / (m h) in both planes, held for a step: exact in between."""
    x, v = (np.array(np.broadcast_to(part, (len(np.atleast_2d(offset)), 2)), float) for part in (offset, velocity))
    path = [x.copy()]
    for _ in range(round(seconds / dt)):
        effort = balance.step(x, v)
        rest = effort.pressure + effort.hip / (STANCE.mass * GRAVITY)  # about which the pendulum falls
        away = x - rest
        x, v = (
            rest + away * np.cosh(W * dt) + v / W * np.sinh(W * dt),
            W * away * np.sinh(W * dt) + v * np.cosh(W * dt),
        )
        path.append(x.copy())
        if np.abs(x).max() > 5.0:
            break
    return np.array(path)


@pytest.mark.parametrize("plane", [SAGITTAL, FRONTAL], ids=["sagittal", "frontal"])
@pytest.mark.parametrize("sign", [-1.0, 1.0])
@pytest.mark.parametrize("pushed", [False, True], ids=["leaning", "pushed"])
def test_the_ankles_hold_what_the_feet_allow_and_nothing_else(plane, sign, pushed):
    """Caught if and only if x + x'/w is within the feet (Hof et al., 2005)."""
    low, high = STANCE.edges
    balance = Balance(STANCE)
    edge = high[plane] if sign > 0 else low[plane]
    for share, caught in ((0.97, True), (1.03, False)):
        start = np.zeros((1, 2)) + balance.goal
        speed = np.zeros((1, 2))
        if pushed:
            speed[0, plane] = W * (balance.goal[plane] + share * (edge - balance.goal[plane]) - start[0, plane])
        else:
            start[0, plane] = balance.goal[plane] + share * (edge - balance.goal[plane])
        margin = balance.step(start, speed).margin[0, plane]
        assert (margin > 0.0) == caught
        path = fall(balance, start, speed, seconds=8.0)
        assert (np.abs(path[-1, 0, plane] - balance.goal[plane]) < 1e-3) == caught
        assert (sign * path[-1, 0, plane] > 1.0) == (not caught)


def test_what_is_left_of_a_push_decays_as_the_gain_says():
    balance = Balance(STANCE, gain=0.5)
    dt, seconds = 1e-3, 0.8
    x = balance.goal + np.array([[0.01, -0.01]])
    path = fall(balance, x, np.zeros(2), seconds, dt)
    velocity = np.gradient(path[:, 0], dt, axis=0)
    xi = path[:, 0] + velocity / W - balance.goal
    times = dt * np.arange(len(path))
    expected = xi[1] * np.exp(-0.5 * W * (times[1:-1] - dt))[:, None]
    np.testing.assert_allclose(xi[1:-1], expected, rtol=0.01)


def test_the_hips_reach_further_by_their_torque_and_only_beyond_the_threshold():
    """With the largest torque xi' = 0 at edge + torque / (m g)."""
    limit, weight = np.array([60.0, 40.0]), STANCE.mass * GRAVITY
    balance = Balance(STANCE, hip_threshold=0.8, hip_gain=10.0, hip_limit=tuple(limit))
    low, high = STANCE.edges
    for share, caught in ((0.95, True), (1.05, False)):
        start = high + share * limit / weight
        for plane in (SAGITTAL, FRONTAL):
            lean = balance.goal.copy()
            lean[plane] = start[plane]
            assert balance.step(lean[None], np.zeros((1, 2))).margin[0, plane] < 0.0  # the ankles alone cannot
            path = fall(balance, lean[None], np.zeros((1, 2)), seconds=8.0)
            assert (abs(path[-1, 0, plane] - balance.goal[plane]) < 1e-3) == caught
    for share, helps in ((0.79, False), (0.81, True)):
        lean = balance.goal + share * (low - balance.goal)
        hip = balance.step(lean[None], np.zeros((1, 2))).hip
        assert (hip < 0.0).all() if helps else not hip.any()
    assert (np.abs(balance.step(np.array([[9.0, -9.0]]), np.zeros((1, 2))).hip) == limit).all()


def test_torques_of_the_ankles_press_where_the_centre_of_pressure_is_wanted():
    """A foot that is turned by r x F presses the ground with F at r: forward is -y, left is +x."""
    pressure = np.array([[0.1, 0.02]])
    weight = STANCE.mass * GRAVITY
    effort = Effort(pressure, weight * pressure, np.zeros((1, 2)), np.zeros((1, 2)))
    torques = Balance(STANCE).joint_torques(effort)
    assert torques.shape == (1, 21, 3)
    lever = np.array([pressure[0, 1], -pressure[0, 0], 0.0])
    wanted = np.cross(lever, [0.0, 0.0, -weight])
    ankles = [torques[0, joint_index(f"{side}_ankle") - 1] for side in ("left", "right")]
    np.testing.assert_allclose(sum(ankles), wanted, atol=1e-9)
    assert np.count_nonzero(torques) == 4


GRAVITY = 9.81
STEP = 1e-6


@pytest.fixture(scope="module")
def bones() -> Bones:
    """A body of random bones."""
    rng = np.random.default_rng(0)
    joints = rng.normal(scale=0.3, size=(NUM_JOINTS, 3))
    spread = rng.normal(scale=0.1, size=(NUM_JOINTS, 3, 3))
    mass = rng.uniform(0.5, 8.0, NUM_JOINTS)
    inertia = mass[:, None, None] * (spread @ np.swapaxes(spread, 1, 2) + 1e-3 * np.eye(3))
    return Bones(mass, joints, joints + rng.normal(scale=0.1, size=(NUM_JOINTS, 3)), inertia)


@pytest.fixture(scope="module")
def local() -> np.ndarray:
    """Two random poses."""
    rng = np.random.default_rng(1)
    turns = Rotation.from_rotvec(rng.normal(scale=0.5, size=(2 * NUM_JOINTS, 3)))
    return turns.as_matrix().reshape(2, NUM_JOINTS, 3, 3)


def moved(bones: Bones, local: np.ndarray, velocity: np.ndarray, time: float) -> Posture:
    """The posture after ``time`` of a generalised velocity, about the bones' own axes."""
    turns = Rotation.from_rotvec(time * velocity[3:].reshape(-1, 3)).as_matrix()
    now = bones.posture(local @ turns)
    shift = time * velocity[:3]
    return Posture(now.rotation, now.joints + shift, now.centres + shift)


def rates(bones: Bones, local: np.ndarray, velocity: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Velocities of the centres and spins of all bones, by differences."""
    before, after = (moved(bones, local, velocity, sign * STEP) for sign in (-0.5, 0.5))
    turn = after.rotation @ np.swapaxes(before.rotation, -1, -2)
    spin = Rotation.from_matrix(turn.reshape(-1, 3, 3)).as_rotvec().reshape(turn.shape[:2] + (3,))
    return (after.centres - before.centres) / STEP, spin / STEP


def test_the_mass_matrix_gives_the_kinetic_energy(bones, local):
    velocity = np.random.default_rng(2).normal(size=NUM_DOF)
    linear, spin = rates(bones, local, velocity)
    rotation = bones.posture(local).rotation
    inertia = rotation @ bones.inertia @ np.swapaxes(rotation, -1, -2)
    wanted = 0.5 * np.einsum("b,nbi,nbi->n", bones.mass, linear, linear)
    wanted += 0.5 * np.einsum("nbi,nbij,nbj->n", spin, inertia, spin)
    matrix = bones.mass_matrix(bones.posture(local))
    np.testing.assert_allclose(0.5 * np.einsum("i,nij,j->n", velocity, matrix, velocity), wanted, rtol=1e-6)
    np.testing.assert_allclose(matrix, np.swapaxes(matrix, 1, 2), atol=1e-12)


def test_moments_of_weight_and_of_forces_do_the_work_that_they_do(bones, local):
    """Power of a moment about the bone's own axes is that of the force at what moves: virtual work."""
    velocity = np.random.default_rng(3).normal(size=NUM_DOF)
    velocity[:6] = 0.0  # the pelvis is held
    linear, spin = rates(bones, local, velocity)
    now = bones.posture(local)
    own = velocity[6:].reshape(-1, 3)

    weight = in_bones(now, bones.weight_moments(now, GRAVITY))[:, 1:]
    power = -GRAVITY * np.einsum("b,nb->n", bones.mass, linear[..., 2])
    np.testing.assert_allclose(np.einsum("nbi,bi->n", weight, own), power, rtol=1e-6)

    foot, force = joint_index("left_ankle"), np.array([[30.0, -20.0, 400.0], [-3.0, 5.0, 7.0]])
    place = now.centres[:, foot] + [0.02, -0.1, -0.03]
    speed = linear[:, foot] + np.cross(spin[:, foot], place - now.centres[:, foot])
    moments = in_bones(now, force_moments(now, foot, place, force))[:, 1:]
    np.testing.assert_allclose(np.einsum("nbi,bi->n", moments, own), (force * speed).sum(1), rtol=1e-6)


def test_gains_by_inertia_make_all_joints_respond_alike():
    """Check two bones on a line: what each joint carries, its sag when held level, and its damping."""
    line = np.array([[1.0, 0.0, 0.0]])
    masses, centres, positions = np.array([1.0, 2.0]), line * [[0.1], [0.3]], line * [[0.0], [0.2]]
    load = subtrees([-1, 0], masses, centres, positions)
    np.testing.assert_allclose(load.mass, [3.0, 2.0])
    np.testing.assert_allclose(load.arm, [0.7 / 3.0, 0.1])
    np.testing.assert_allclose(load.inertia, [1.0 * 0.1**2 + 2.0 * 0.3**2, 2.0 * 0.1**2], atol=1e-12)
    gains = gains_for(load, 10.0, 0.7, np.full(2, 50.0), integral_time=2.0)
    np.testing.assert_allclose(GRAVITY * load.mass * load.arm / gains.kp[:, 0], 0.1, rtol=1e-3)
    rate = np.sqrt(gains.kp / gains.inertia)
    np.testing.assert_allclose(gains.kd / (2.0 * gains.inertia * rate), 0.7)
    np.testing.assert_allclose(gains.kp / gains.ki, 2.0)
    with pytest.raises(ValueError, match="joint 0 comes before its parent 1"):
        subtrees([1, -1], masses, centres, positions)
