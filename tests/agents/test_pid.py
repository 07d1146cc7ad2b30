"""The controller against pendulums whose answer is known: m l^2 x'' = tau - c x' -+ m g l sin x, finely integrated."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from agents.pid.controller import PID, Gains, PosePID, difference

M, L, G = 2.0, 0.5, 9.81
INERTIA, LOAD = M * L**2, M * G * L  # [kg m^2], [N m]
AXIS = np.array([0.36, 0.48, 0.8])  # a pendulum that turns about an axis that is not a joint's own


def swing(controller, angle, target, seconds, damping=0.0, upright=False, blocked=0.0, hold=1):
    """Angles of a pendulum over time; a controller of ``(1, 1)``, or of poses about :data:`AXIS`.

    Args:
        controller: with a ``dt`` of its own, of which ``hold`` steps of the integration are made.
        angle: from which it is released.
        target: a number, or a function of time to angle and rate.
        seconds: how long.
        damping: c [N m s/rad].
        upright: whether gravity drives it away from 0.
        blocked: time in which it is held fast [s].
        hold: steps of the integration under one torque.
    """
    pid = controller.pid if isinstance(controller, PosePID) else controller
    dt, rate, torque, angles = pid.dt / hold, 0.0, 0.0, []
    sign = -1.0 if upright else 1.0
    for step in range(round(seconds / dt)):
        if step % hold == 0:
            goal, goal_rate = target(step * dt) if callable(target) else (target, 0.0)
            if isinstance(controller, PosePID):
                vectors = [np.reshape(value * AXIS, (1, 1, 3)) for value in (angle, goal, rate, goal_rate)]
                torque = float(controller.step(*vectors)[0, 0] @ AXIS)
            else:
                torque = float(pid.step(np.array([[goal - angle]]), np.array([[rate]]), goal_rate)[0, 0])
        if step * dt >= blocked:
            # semi-implicit, second order in the rate's damping
            rate += dt * (torque - damping * rate - sign * LOAD * np.sin(angle)) / INERTIA
            angle += dt * rate
        angles.append(angle)
    return np.array(angles)


@pytest.mark.parametrize("upright", [False, True], ids=["hanging", "upright"])
@pytest.mark.parametrize("pose", [False, True], ids=["angle", "rotation"])
def test_a_pd_controlled_pendulum_has_the_analytic_frequency_and_damping(upright, pose):
    kp, kd, damping, dt = 60.0, 0.8, 0.2, 1e-3
    gains = Gains(kp, kd)
    controller = PosePID(PID(gains, dt, (1, 1, 3))) if pose else PID(gains, dt, (1, 1))
    angles = swing(controller, 0.02, 0.0, 4.0, damping, upright)
    stiffness = kp - LOAD if upright else kp + LOAD
    frequency = np.sqrt(stiffness / INERTIA)
    ratio = (kd + damping) / (2.0 * np.sqrt(stiffness * INERTIA))
    # the peaks of a damped oscillation come every 2 pi / (w sqrt(1 - z^2)), each exp(-2 pi z / sqrt(1 - z^2)) as high
    peaks = np.flatnonzero((angles[1:-1] > angles[:-2]) & (angles[1:-1] >= angles[2:])) + 1
    peaks = peaks[:5]
    period = np.diff(peaks).mean() * dt
    assert period == pytest.approx(2.0 * np.pi / (frequency * np.sqrt(1.0 - ratio**2)), rel=3e-3)
    decrement = np.log(angles[peaks[0]] / angles[peaks[-1]]) / (len(peaks) - 1)
    assert decrement == pytest.approx(2.0 * np.pi * ratio / np.sqrt(1.0 - ratio**2), rel=0.02)


def test_the_integral_takes_away_the_sag_of_gravity():
    kp, kd, target = 40.0, 6.0, 1.0
    sagged = swing(PID(Gains(kp, kd), 1e-3, (1, 1)), 0.0, target, 6.0)[-1]
    assert target - sagged == pytest.approx(LOAD * np.sin(sagged) / kp, rel=1e-6) and target - sagged > 0.1
    integrating = PID(Gains(kp, kd, ki=60.0), 1e-3, (1, 1))
    held = swing(integrating, 0.0, target, 20.0)[-1]
    assert abs(target - held) < 1e-6
    assert integrating.integral[0, 0] == pytest.approx(LOAD * np.sin(target), rel=1e-6)


def test_an_integral_that_is_of_no_effect_gives_way():
    """Held fast while it pulls as strongly as it may, then released: without anti-windup it overshoots the more, the
    longer it was held; with back-calculation always the same, and little."""
    kp, kd, ki, limit = 40.0, 6.0, 40.0, 15.0

    def overshoot(tracking, blocked):
        gains = Gains(kp, kd, ki, limit, tracking)
        return swing(PID(gains, 2e-3, (1, 1)), 0.0, 1.0, blocked + 12.0, blocked=blocked).max() - 1.0

    short, long = (overshoot(None, blocked) for blocked in (2.0, 6.0))
    assert long == pytest.approx(short, abs=1e-6) and long < 0.1
    wound = [overshoot(np.inf, blocked) for blocked in (2.0, 6.0)]
    assert wound[0] > 4.0 * max(short, 0.05) and wound[1] > 1.3 * wound[0]
    # the integral rests where the law says: raw - limit = tracking ki e
    held = PID(Gains(kp, kd, ki, limit), 2e-3, (1, 1))
    for _ in range(5000):
        assert held.step(np.array([[1.0]]), np.zeros((1, 1)))[0, 0] == limit
    assert kp + held.integral[0, 0] - limit == pytest.approx(np.sqrt(kd / ki) * ki, rel=0.02)
    # and where a motor gives less in one direction, at what it gives
    weak = PID(Gains(10.0, kd, ki, limit), 2e-3, (1, 1))
    for sign, most in ((1.0, 4.0), (-1.0, limit)):
        for _ in range(5000):
            torque = weak.step(np.array([[sign]]), np.zeros((1, 1)), given=lambda asked: np.minimum(asked, 4.0))
        assert torque[0, 0] == sign * most
        left = 10.0 + sign * weak.integral[0, 0] - most
        assert left == pytest.approx(np.sqrt(kd / ki) * ki, rel=0.02)


def test_a_free_body_turns_about_one_axis_as_critical_damping_says():
    """Isotropic inertia and a turn of 170 degrees in three joints at once: angle = a (1 + w t) exp(-w t)."""
    inertia, frequency, dt = 0.3, 5.0, 1e-3
    rng = np.random.default_rng(0)
    start, target = (Rotation.random(6, rng=rng) for _ in range(2))
    turn = rng.normal(size=(6, 3))
    start = target * Rotation.from_rotvec(np.deg2rad(170.0) * turn / np.linalg.norm(turn, axis=1, keepdims=True))
    shape = (2, 3, 3)
    gains = Gains(inertia * frequency**2, 2.0 * inertia * frequency)
    controller = PosePID(PID(gains, dt, shape))
    rotation, rate = start, np.zeros((6, 3))
    goal = target.as_rotvec().reshape(shape)
    for step in range(1000):
        angle = np.linalg.norm(difference(rotation.as_rotvec().reshape(shape), goal), axis=-1)
        t = step * dt
        expected = np.deg2rad(170.0) * (1.0 + frequency * t) * np.exp(-frequency * t)
        np.testing.assert_allclose(angle, expected, rtol=0.01, atol=0.003)
        torque = controller.step(rotation.as_rotvec().reshape(shape), goal, rate.reshape(shape))
        rate = rate + dt * torque.reshape(6, 3) / inertia
        rotation = rotation * Rotation.from_rotvec(dt * rate)
    assert angle.max() < 0.2


@pytest.mark.parametrize("feed", [False, True], ids=["blind", "fed"])
def test_what_a_moving_target_leaves_as_error_is_the_transfer_function(feed):
    """E/R = (I s^2 + [c s]) / (I s^2 + kd s + kp), the bracket only without the target's rate; without gravity."""
    kp, kd, omega, amplitude, dt = 80.0, 8.0, 6.0, 0.3, 1e-3
    controller = PosePID(PID(Gains(kp, kd), dt, (1, 1, 3)))

    def target(time):
        return amplitude * np.sin(omega * time), amplitude * omega * np.cos(omega * time) if feed else 0.0

    angle, rate, errors = 0.0, 0.0, []
    for step in range(6000):
        goal, goal_rate = target(step * dt)
        vectors = [np.reshape(value * AXIS, (1, 1, 3)) for value in (angle, goal, rate, goal_rate)]
        errors.append(goal - angle)
        rate += dt * float(controller.step(*vectors)[0, 0] @ AXIS) / INERTIA
        angle += dt * rate
    s = 1j * omega
    left = INERTIA * s**2 + (0.0 if feed else kd * s)
    expected = amplitude * abs(left / (INERTIA * s**2 + kd * s + kp))
    assert np.abs(errors[-2000:]).max() == pytest.approx(expected, rel=0.02)


def test_with_the_inertia_known_strong_gains_do_not_shake_at_thirty_steps_a_second():
    dt, hold = 1.0 / 30.0, 100
    for kp in (50.0, 5e3, 5e5):
        kd = 2.0 * np.sqrt(kp * INERTIA)
        ahead = PID(Gains(kp, kd, inertia=INERTIA), dt, (1, 1))
        angles = swing(ahead, 0.5, 0.0, 6.0, hold=hold)
        assert np.abs(angles[-500:]).max() < 1e-3 and np.abs(angles).max() <= 0.5
    blunt = swing(PID(Gains(5e3, 2.0 * np.sqrt(5e3 * INERTIA), limit=1e6), dt, (1, 1)), 0.5, 0.0, 2.0, hold=hold)
    assert np.abs(blunt).max() > 10.0
