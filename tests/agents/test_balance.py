"""Balance against the linear inverted pendulum: what is analytically within reach is held, and nothing else."""

from __future__ import annotations

import numpy as np
import pytest

from agents.pid.balance import FRONTAL, GRAVITY, SAGITTAL, Balance, Effort, Stance
from piavatar_envs.avatar.body.skeleton import joint_index

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
