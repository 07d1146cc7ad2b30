"""The controller against pendulums whose answer is known: m l^2 x'' = tau - c x' -+ m g l sin x, finely integrated."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from agents.pid.controller import PID, Gains, PosePID, difference, follow, motion_poses, turned
from agents.pid.gains import gains_for, subtrees

M, L, G = 2.0, 0.5, 9.81
INERTIA, LOAD = M * L**2, M * G * L  # [kg m^2], [N m]
AXIS = np.array([0.36, 0.48, 0.8])  # a pendulum that turns about an axis that is no joint's own


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
    """Held fast while it pulls as strongly as it may, then let go: without anti-windup it overshoots the more, the
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


def test_the_error_is_the_shortest_turn_not_a_difference_of_vectors():
    near_pi = np.array([0.0, 0.0, 3.1]), np.array([0.0, 0.0, -3.1])
    np.testing.assert_allclose(difference(*near_pi), [0.0, 0.0, 2.0 * np.pi - 6.2], atol=1e-12)
    bent, turn = np.array([[0.8, -0.3, 0.5]]), np.array([[0.2, 0.1, -0.4]])
    moved = (Rotation.from_rotvec(bent) * Rotation.from_rotvec(turn)).as_rotvec()
    np.testing.assert_allclose(difference(bent, moved), turn, atol=1e-12)
    np.testing.assert_allclose(turned(turn, bent), Rotation.from_rotvec(turn).apply(bent), atol=1e-12)
    # a target's rate has the axes of the bone where it shall be, the torque those of the bone where it is
    damper = PosePID(PID(Gains(0.0, 2.0), 0.1, (1, 1, 3)))
    omega = np.array([0.5, -1.0, 0.2])
    torque = damper.step(bent[None], moved[None], np.zeros((1, 1, 3)), omega)[0, 0]
    in_parent = Rotation.from_rotvec(bent[0]).apply(torque), Rotation.from_rotvec(moved[0]).apply(2.0 * omega)
    np.testing.assert_allclose(*in_parent, atol=1e-12)


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


def test_a_jump_of_the_target_gives_no_kick_and_rates_can_be_found():
    gains, dt = Gains(50.0, 5.0), 0.01
    found, told = PosePID(PID(gains, dt, (2, 1, 3))), PosePID(PID(gains, dt, (2, 1, 3)))
    omega = np.array([0.3, -0.7, 0.2])
    path = [np.broadcast_to(step * dt * omega, (2, 1, 3)) for step in range(6)]
    for rotation in path:
        own = found.step(rotation, np.zeros(3))
        other = told.step(rotation, np.zeros(3), np.broadcast_to(omega, (2, 1, 3)))
    np.testing.assert_allclose(own, other, atol=1e-9)
    jumped = found.step(path[-1], np.array([0.5, 0.0, 0.0]))
    still = 50.0 * difference(path[-1], np.broadcast_to([0.5, 0.0, 0.0], (2, 1, 3)))
    np.testing.assert_allclose(jumped, still, atol=1e-9)  # at rest now: all of it is the error's
    # a new episode in one environment stands elsewhere, and that is no rate
    found.reset(np.array([True, False]))
    moved = found.step(np.stack([np.ones((1, 3)), path[-1][1] + dt * omega]), np.stack([np.ones((1, 3)), path[-1][1]]))
    np.testing.assert_allclose(moved[0], 0.0, atol=1e-9)
    np.testing.assert_allclose(moved[1], -(50.0 * dt + 5.0) * omega[None], rtol=0.05)
    slow = PosePID(PID(gains, dt, (1, 1, 3)), smoothing=0.04)
    for rotation in path:
        torque = slow.step(rotation[:1], rotation[:1])
    np.testing.assert_allclose(torque[0, 0], -5.0 * omega * (1.0 - (0.04 / 0.05) ** 5), rtol=1e-6)


def test_with_the_inertia_known_strong_gains_do_not_shake_at_thirty_steps_a_second():
    dt, hold = 1.0 / 30.0, 100
    for kp in (50.0, 5e3, 5e5):
        kd = 2.0 * np.sqrt(kp * INERTIA)
        ahead = PID(Gains(kp, kd, inertia=INERTIA), dt, (1, 1))
        angles = swing(ahead, 0.5, 0.0, 6.0, hold=hold)
        assert np.abs(angles[-500:]).max() < 1e-3 and np.abs(angles).max() <= 0.5
    blunt = swing(PID(Gains(5e3, 2.0 * np.sqrt(5e3 * INERTIA), limit=1e6), dt, (1, 1)), 0.5, 0.0, 2.0, hold=hold)
    assert np.abs(blunt).max() > 10.0


def test_environments_know_nothing_of_each_other_and_reset_alone():
    gains, shape = Gains(30.0, 2.0, 10.0, 20.0), (3, 4, 3)
    rng = np.random.default_rng(1)
    steps = rng.normal(size=(5, 2, *shape))
    together = PID(gains, 0.02, shape)
    alone = [PID(gains, 0.02, (1, 4, 3)) for _ in range(3)]
    for error, rate in steps:
        joint = together.step(error, rate)
        np.testing.assert_array_equal(joint, np.concatenate([
            pid.step(error[env : env + 1], rate[env : env + 1]) for env, pid in enumerate(alone)
        ]))  # fmt: skip
    kept = together.integral.copy()
    together.reset(np.array([False, True, False]))
    assert not together.integral[1].any()
    np.testing.assert_array_equal(together.integral[[0, 2]], kept[[0, 2]])
    together.reset()
    assert not together.integral.any()


def test_a_clip_is_followed_by_its_own_rates():
    from piavatar_envs.avatar.motion.library import load_motion

    motion, joints, dt = load_motion("step"), [1, 4, 7], 1.0 / 30.0
    poses = motion_poses(motion, joints)
    target, rate = follow(poses, np.array([0.1, 0.4]), dt)
    assert target.shape == rate.shape == (2, 3, 3) and np.abs(rate).max() > 0.1
    led = Rotation.from_rotvec(target.reshape(-1, 3)) * Rotation.from_rotvec(dt * rate.reshape(-1, 3))
    there = Rotation.from_rotvec(poses(np.array([0.1, 0.4]) + dt).reshape(-1, 3))
    np.testing.assert_allclose((led.inv() * there).magnitude(), 0.0, atol=1e-7)


def test_gains_follow_from_what_hangs_on_a_joint():
    """A bar of three bones a metre apart, each with its mass half a metre on: sums by hand."""
    masses, x = np.array([3.0, 2.0, 1.0]), np.arange(3.0)
    positions, centres = (np.stack([place, 0 * x, 0 * x], axis=1) for place in (x, x + 0.5))
    load = subtrees((-1, 0, 1), masses, centres, positions)
    np.testing.assert_allclose(load.mass, [6.0, 3.0, 1.0])
    np.testing.assert_allclose(load.arm, [(3 * 0.5 + 2 * 1.5 + 2.5) / 6, (2 * 0.5 + 1.5) / 3, 0.5])
    np.testing.assert_allclose(load.inertia, [3 * 0.25 + 2 * 2.25 + 6.25, 2 * 0.25 + 2.25, 0.25])
    gains = gains_for(load, stiffness=10.0, damping_ratio=0.7, limit=np.array([9.0, 9.0, 5.0]), integral_time=2.0)
    np.testing.assert_allclose(gains.kp[:, 0], 10.0 * G * load.mass * load.arm)
    np.testing.assert_allclose(gains.ki, gains.kp / 2.0)
    np.testing.assert_allclose(gains.kd**2, 4 * 0.7**2 * gains.kp * gains.inertia)
    # level, it sags by 1 / stiffness
    assert PID(gains, 0.01, (1, 3, 3)).step(np.full((1, 3, 3), 0.01), np.zeros((1, 3, 3))).shape == (1, 3, 3)
    # not on a line: about the axis across both arms
    flat = subtrees((-1, 0), np.array([2.0, 3.0]), np.array([[1.0, 0.0, 0.0], [0.0, 2.0, 0.0]]), np.zeros((2, 3)))
    np.testing.assert_allclose(flat.inertia, [2.0 + 3.0 * 4.0, 3.0 * 4.0])
    with pytest.raises(ValueError, match="joint 0 comes before its parent 1"):
        subtrees((1, -1), masses[:2], centres[:2], positions[:2])
