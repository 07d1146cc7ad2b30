"""The root wrench: it holds a standing body, within its limits, and releases one that is knocked down."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from piavatar_envs.avatar.body.skeleton import joint_index

G = 9.81


def tilt(rig, env: int = 0) -> float:
    """Return the angle between the pelvis' axis and the vertical [deg]."""
    return float(np.degrees(np.arccos(np.clip(rig.tracked_world(env)[0][0][2, 2], -1.0, 1.0))))


def displacement(rig, env: int = 0) -> np.ndarray:
    """Return the place of the pelvis relative to standing [m]."""
    return rig.tracked_world(env)[1][0] - rig.points.joints[0, 0]


def push(rig, force, steps: int = 15, after: int = 30) -> dict[str, np.ndarray]:
    """Push the upper chest for ``steps`` control steps, and return a log of these and of the steps after."""
    log = {"tilt": [], "released": [], "force": [], "torque": [], "shift": []}
    for k in range(steps + after):
        if k < steps:
            rig.push(force)
        rig.step()
        log["tilt"].append(tilt(rig))
        log["released"].append(int(rig.avatar.state.released.numpy()[0]))
        log["force"].append(np.linalg.norm(rig.avatar.state.wrench_force.numpy()[0]))
        log["torque"].append(np.linalg.norm(rig.avatar.state.wrench_torque.numpy()[0]))
        log["shift"].append(displacement(rig))
    return {name: np.array(values) for name, values in log.items()}


def test_standing_does_not_sag_and_costs_the_weight(make_rig):
    rig = make_rig(gravity=G, floor=True)
    rig.step(30)
    assert np.abs(displacement(rig)).max() < 1e-4
    assert np.abs(rig.read("x") - rig.target()).max() < 1e-3
    weight = rig.mass.sum() * G
    np.testing.assert_allclose(rig.avatar.state.wrench_force.numpy()[0], (0.0, 0.0, weight), atol=1e-3 * weight)
    np.testing.assert_allclose(rig.avatar.state.wrench_torque.numpy()[0], 0.0, atol=1e-3 * weight)


def test_the_weight_of_every_body_is_its_own(make_rig):
    rig = make_rig(gravity=G, num_envs=2, shapes=[{"weight": -0.8}, {"weight": 0.8}])
    rig.step(5)
    weights = rig.points.mass.astype(float).sum(1) * G
    assert weights[1] > 1.1 * weights[0]
    np.testing.assert_allclose(rig.avatar.state.wrench_force.numpy()[:, 2], weights, rtol=1e-3)


def test_a_push_within_the_limits_is_survived(make_rig):
    rig = make_rig(gravity=G, floor=True, half_width=1.6)
    log = push(rig, (0.0, 1000.0, 0.0))
    assert 5.0 < log["tilt"].max() < 45.0
    assert not log["released"].any()
    assert log["tilt"][-1] < 2.0
    assert np.linalg.norm(log["shift"][-1]) < 0.02
    # the limits of the wrench, in units of the weight and of a metre
    weight = rig.mass.sum() * G
    assert 1.5 * weight < log["force"].max() < 2.001 * weight
    assert log["torque"].max() < 0.7001 * weight


def test_a_push_beyond_the_limits_knocks_down_for_good(make_rig):
    rig = make_rig(gravity=G, floor=True, half_width=2.0)
    log = push(rig, (0.0, 1500.0, 0.0), steps=15, after=10)
    assert log["released"].any()
    first = log["released"].argmax()
    assert log["released"][first:].all()  # latched
    assert np.all(log["force"][first + 1 :] == 0.0) and np.all(log["torque"][first + 1 :] == 0.0)
    assert log["torque"].max() == pytest.approx(0.7 * rig.mass.sum() * G, rel=1e-3)  # it did what it could
    assert log["tilt"][-1] > 45.0
    rig.reset()
    assert rig.avatar.state.released.numpy()[0] == 0
    rig.step(10)
    assert rig.avatar.state.released.numpy()[0] == 0 and tilt(rig) < 0.1


@pytest.mark.parametrize(
    ("turn", "offset", "limited"),
    [
        ((0.6 * np.pi / 4, 0.8 * np.pi / 4, 0.0), (0.0, 0.0, 0.0), True),
        ((0.0, 0.0, 2.0), (0.0, 0.0, 0.0), False),  # turning in place is not a tilt
        ((0.0, 0.0, 0.0), (0.3, 0.4, 0.0), True),
        ((0.0, 0.0, 0.0), (0.0, 0.0, 0.4), True),
        ((0.0, 0.0, 0.0), (0.0, 0.0, -0.4), True),
    ],
)
def test_the_root_is_released_beyond_each_limit(make_rig, turn, offset, limited):
    # The command is moved off the body at once; only its size decides.
    rig = make_rig(gravity=0.0, half_width=1.6)
    for share in (0.9, 1.1):
        rotvec, root = np.zeros((22, 3)), rig.points.joints[0, 0] + share * np.array(offset)
        rotvec[0] = share * np.array(turn)
        rig.reset()
        rig.avatar.state.command_rotation.assign(rig.quaternions(rotvec))
        rig.avatar.state.command_root.assign(root.astype(np.float32)[None])
        rig.command(rotvec, root)
        rig.step()
        assert rig.avatar.state.released.numpy()[0] == (limited and share > 1.0)


def test_flesh_hangs_on_the_bones_by_its_weight(make_rig):
    # Statics of linear elasticity: sag goes with 1 / E, and the elastic energy is half of what the load has done
    # (Clapeyron). The root still carries the weight, and no more.
    sags = []
    for young in (1e4, 2e4):
        rig = make_rig(gravity=G, root="weight", alpha=0.0, young_modulus=young)
        rig.step(60)
        weight, load = rig.mass * G, rig.controller.workspace.load.numpy()
        down = rig.skinned(rig.tracked_local(), rig.tracked_world()[1][0])[:, 2] - rig.read("x")[:, 2]
        flesh = load == 1.0
        assert flesh.mean() > 0.5 and abs(load @ weight) < 1e-3 * weight.sum()
        sags.append((down[flesh].mean() - down[~flesh].mean(), down[flesh].max()))
        assert rig.totals().elastic == pytest.approx(0.5 * (load * weight) @ down, rel=0.06)
        force = rig.avatar.state.wrench_force.numpy()[0]
        np.testing.assert_allclose(force, (0.0, 0.0, weight.sum()), atol=1e-3 * weight.sum())
        assert rig.joint_errors().max() < 0.15 and np.abs(displacement(rig)).max() < 0.01
    np.testing.assert_allclose(sags[0], 2.0 * np.array(sags[1]), rtol=0.1)
    # the order of rho g L^2 / 2 E, with 0.2 m of belly before the spine
    assert sags[0][1] == pytest.approx(1000.0 * G * 0.2**2 / 2e4, rel=0.3)


@pytest.mark.parametrize("commanded", [False, True])
def test_a_released_body_falls_freely(make_rig, commanded):
    # Not even by moving its limbs, or by a commanded root, can it push itself off the air.
    rig = make_rig(gravity=G, half_width=1.8)
    rig.avatar.state.released.fill_(1)
    swing = np.zeros((22, 3))
    for k in range(6):
        if commanded:
            swing[16, 1] = swing[1, 0] = 0.15 * (k + 1)
            rig.command(swing, rig.points.joints[0, 0] + [0.0, -0.05 * (k + 1), 0.1 * (k + 1)])
        rig.step()
    _, velocity, spin = rig.rigid_motion()
    np.testing.assert_allclose(velocity, (0.0, 0.0, -G * 0.2), atol=1e-4)
    np.testing.assert_allclose(spin, 0.0, atol=5e-3)
    assert not rig.avatar.state.wrench_force.numpy().any()
    if commanded:
        assert np.degrees(rig.joint_errors().max()) < 0.1  # the limbs did move as commanded


def test_a_small_error_decays_critically_damped(make_rig):
    # Root rate 10/s: ``e(t) = e0 (1 + w t) exp(-w t)`` in translation and rotation.
    rig = make_rig(gravity=G, tone=1.0)
    root, rotvec = rig.points.joints[0, 0] + np.array([0.03, -0.04, 0.02]), np.zeros((22, 3))
    rotvec[0] = (0.02, -0.05, 0.04)
    rig.avatar.state.command_rotation.assign(rig.quaternions(rotvec))
    rig.avatar.state.command_root.assign(root.astype(np.float32)[None])
    rig.command(rotvec, root)
    goal = Rotation.from_rotvec(rotvec[0])
    turn0 = goal.magnitude()
    # the wrench turns the body about its centre of mass, which carries the pelvis a little
    for k in range(1, 11):
        rig.step()
        wt = 10.0 * k / 30.0
        expected = (1.0 + wt) * np.exp(-wt)
        world, position = rig.tracked_world()
        turn = (goal.inv() * Rotation.from_matrix(world[0])).magnitude()
        assert turn / turn0 == pytest.approx(expected, abs=0.05)
        assert np.linalg.norm(root - position[0]) / 0.0539 == pytest.approx(expected, abs=0.15)


def test_a_commanded_walk_is_followed_without_lag(make_rig):
    # Root commands move through the kinematic velocity: the wrench carries the weight and, at the start, accelerates.
    rig = make_rig(gravity=G, half_width=1.8, bound_motion=True)
    weight, walked = rig.mass.sum() * G, 0.0
    for k in range(1, 17):
        before, walked = walked, walked + min(k / 8.0, 1.0)
        rotvec = np.zeros((22, 3))
        rotvec[0, 2] = 0.1 * walked
        root = rig.points.joints[0, 0] + [0.0, -0.04 * walked, 0.0]
        rig.command(rotvec, root)
        rig.step()
        world, position = rig.tracked_world()
        np.testing.assert_allclose(position[0], root, atol=5e-4)
        assert (Rotation.from_rotvec(rotvec[0]).inv() * Rotation.from_matrix(world[0])).magnitude() < 1e-4
        # 0.005 m per step faster in every step of 1/30 s, then as fast as before
        pushed = -rig.mass.sum() * 0.005 * 30.0**2 if walked - before < 1.0 or k == 8 else 0.0
        expected = (0.0, pushed, weight)
        np.testing.assert_allclose(rig.avatar.state.wrench_force.numpy()[0], expected, atol=0.05 * weight)


def kick(k: int) -> np.ndarray:
    """Return a pose after ``k`` steps in which a leg and an arm swing, at full speed from the first."""
    pose = np.zeros((22, 3))
    pose[joint_index("left_hip"), 0] = -0.13 * k
    pose[joint_index("right_shoulder"), 1] = 0.13 * k
    return pose


@pytest.mark.parametrize("bound", [False, True])
def test_the_root_force_is_all_that_changes_the_momentum(make_rig, bound):
    # Commanded motion is given by the root, too: its force is the whole of what acts, and can keep within the bounds.
    rig = make_rig(gravity=G, half_width=1.6, bound_motion=bound)
    mass, dt, turned = rig.mass.sum(), rig.model.control_dt, []
    for k in range(1, 13):
        before = rig.totals().momentum
        rig.command(kick(min(k, 8)), rig.points.joints[0, 0] + [0.03 * min(k, 8), 0.0, 0.0])
        rig.step()
        force, torque = (a.numpy()[0] for a in (rig.avatar.state.wrench_force, rig.avatar.state.wrench_torque))
        change = rig.totals().momentum - before
        np.testing.assert_allclose(change, dt * (force - [0.0, 0.0, mass * G]), atol=1e-3)
        if bound:
            assert np.linalg.norm(force) < 2.001 * mass * G and np.linalg.norm(torque) < 0.7001 * mass * G
        turned.append(np.linalg.norm(torque))
        if k == 1:  # from rest at once to 0.9 m/s, more than the bound can give in a step
            assert (20.0 < np.linalg.norm(change) < 0.7 * 0.9 * mass) == bound
            assert np.linalg.norm(force) > 1.9 * mass * G
    assert max(turned) > 30.0
    assert np.linalg.norm(displacement(rig) - [0.24, 0.0, 0.0]) < 0.02


def test_the_root_torque_is_all_that_changes_the_angular_momentum(make_rig):
    # Without gravity and root motion the centre of mass rests, and angular momentum about it is that about the origin.
    rig = make_rig(half_width=1.6, bound_motion=True)
    dt, largest = rig.model.control_dt, 0.0
    for k in range(1, 9):
        before = rig.totals(about=rig.rigid_motion()[0]).angular_momentum
        rig.command(kick(k))
        rig.step()
        torque = rig.avatar.state.wrench_torque.numpy()[0]
        change = rig.totals(about=rig.rigid_motion()[0]).angular_momentum - before
        largest = max(largest, np.linalg.norm(change))
        np.testing.assert_allclose(change, dt * torque, atol=0.02)
    assert largest > 1.0


def test_a_body_keeps_its_momenta_when_its_root_is_released(make_rig):
    # It runs and turns; released, it flies and spins on, whatever is commanded.
    rig = make_rig(half_width=1.6)

    def run(k: int) -> None:
        pose = kick(k)
        pose[0, 2] = 0.06 * k
        rig.command(pose, rig.points.joints[0, 0] + [0.02 * k, 0.0, 0.005 * k])
        rig.step()

    for k in range(1, 6):
        run(k)
    before = rig.totals(about=rig.rigid_motion()[0])
    assert np.linalg.norm(before.momentum) > 0.5 * rig.mass.sum()
    assert np.linalg.norm(before.angular_momentum) > 1.0
    rig.avatar.state.released.fill_(1)
    for k in range(6, 10):
        run(k)
        after = rig.totals(about=rig.rigid_motion()[0])
        np.testing.assert_allclose(after.momentum, before.momentum, atol=1e-3)
        np.testing.assert_allclose(after.angular_momentum, before.angular_momentum, atol=0.02)
