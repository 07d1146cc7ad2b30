"""Ends of ranges: no joint leaves its range, stops neither pull nor rebound, and momentum is kept."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from piavatar_envs.avatar.body.muscles import LOCKED_JOINTS
from piavatar_envs.avatar.body.skeleton import NUM_JOINTS, PARENTS, joint_index, joint_limits
from piavatar_envs.avatar.torque_control.joint_tissue import JointTissue
from piavatar_envs.mpm.diagnostics import totals
from tests.avatar.test_flesh_coupling import EVERYWHERE, TOES, Held

ELBOWS = [joint_index("left_elbow"), joint_index("right_elbow")]
MOVING = [b for b in range(1, NUM_JOINTS) if b not in [joint_index(name) for name in LOCKED_JOINTS]]
CHEST = (0.0, -0.12, 1.28)


@pytest.fixture
def elbows(make_rig) -> Held:
    """Return elbows that turn about x, up to 0.3 rad."""
    return hinged(make_rig, 0.3)


def hinged(make_rig, end: float, damper: float = 0.5, tissue: float = 0.0) -> Held:
    """Return elbows that turn about x, up to an ``end`` [rad], damped by a muscle and by tissue [N m s/rad]."""
    held = Held(make_rig(cells=16), ELBOWS, 0.0, damper)
    lower, upper, damping = -EVERYWHERE.copy(), EVERYWHERE.copy(), np.zeros(NUM_JOINTS)
    lower[ELBOWS], upper[ELBOWS], damping[ELBOWS] = (-3.0, -1e-3, -1e-3), (end, 1e-3, 1e-3), tissue
    held.body.set_tissue(JointTissue(damping, lower, upper, TOES))
    return held.start()


def push(held: Held, torque: float) -> None:
    """Turn the elbows by a torque about x [N m]."""
    torques = np.zeros((1, NUM_JOINTS, 3), np.float32)
    torques[0, ELBOWS, 0] = torque
    held.body.state.torque.assign(torques)


def test_a_joint_stops_at_the_end_of_its_range(elbows):
    # 10 N m turn it to its end and no further, it does not rebound, and the stop gives the moment back.
    push(elbows, 10.0)
    angles = []
    for _ in range(40):
        elbows.graph.run()
        angles.append(elbows.local()[:, 0])
    reached = np.argmax(np.array(angles)[:, 0] > 0.29)
    assert reached < 20
    np.testing.assert_allclose(angles[reached + 1 :], 0.3, atol=2e-3)
    np.testing.assert_allclose(elbows.torque()[:, 0], 0.0, atol=0.3)


def test_a_stop_does_not_hold_back(elbows, make_rig):
    # Turned back from its end, a joint moves as one without an end.
    push(elbows, 10.0)
    for _ in range(40):
        elbows.graph.run()
    free = hinged(make_rig, 3.0)
    bend = np.zeros((NUM_JOINTS, 3))
    bend[ELBOWS] = elbows.local()
    for held in (elbows, free):
        held.pose(bend)
        for array in (held.state.u, held.state.vk, held.state.C, held.body.state.velocity, held.body.state.outside):
            array.zero_()
        push(held, -5.0)
        held.graph.run()
    way = free.local() - bend[ELBOWS]
    assert np.abs(way).max() > 0.05
    np.testing.assert_allclose(elbows.local(), free.local(), atol=0.01 * np.abs(way).max())


def test_tissue_damps_in_proportion_to_the_body(make_rig):
    # Torques scale with the body's size, and so does damping: muscles turn the joints of a larger body as fast.
    speeds = []
    for size in (1.0, 2.0):
        held = hinged(make_rig, 3.0, damper=0.0, tissue=0.5)
        held.body.target.factor.fill_(size)
        push(held, 1.0)
        for _ in range(12):
            held.graph.run()
        before = held.local()[:, 0]
        held.graph.run()
        speeds.append(held.local()[:, 0] - before)
    assert np.abs(speeds[0]).min() > 0.01
    np.testing.assert_allclose(speeds[1], speeds[0], rtol=0.1)


def beyond(simulation) -> np.ndarray:
    """Return how far joints are beyond their ranges in the first environment, ``(22,)`` [rad]."""
    world = Rotation.from_quat(simulation.controllers[0].state.rotation.numpy()[0].astype(float))
    local = np.zeros((NUM_JOINTS, 3))
    local[1:] = [(world[PARENTS[b]].inv() * world[b]).as_rotvec() for b in range(1, NUM_JOINTS)]
    excess = local - np.clip(local, *joint_limits())
    return np.linalg.norm(excess, axis=1)[MOVING]


def strike(simulation, momentum, at, radius: float = 0.16) -> None:
    """Hit flesh near a place [m] with a momentum [N s]."""
    x, u = simulation.state.x.numpy()[0], simulation.state.u.numpy()
    mass = simulation.model.particles.mass.numpy()[0]
    spread = np.exp(-2.0 * ((x - np.asarray(at)) ** 2).sum(1) / radius**2)
    u[0] += (spread / (mass @ spread))[:, None] * np.asarray(momentum, np.float32)
    simulation.state.u.assign(u)


LIMP = {"control": "torque", "pose_noise": 0.0, "fidelity": "coarse"}


def test_full_torques_leave_no_range(make_batch):
    # Of random signs, held for four steps, on the floor too: 22 degrees beyond, were ends springs.
    batch = make_batch("PIAvatar/GetUp-v0", 1, **LIMP)
    batch.reset(seeds=[0])
    rng, worst = np.random.default_rng(0), 0.0
    for step in range(40):
        if step % 4 == 0:
            batch.action.assign(np.sign(rng.uniform(-1.0, 1.0, batch.action.shape)).astype(np.float32))
        batch.step()
        worst = max(worst, beyond(batch.simulation).max())
    assert not batch.failure.numpy().any()
    assert worst < np.radians(1.0)


@pytest.mark.parametrize(("momentum", "at"), [((0.0, 100.0, 0.0), CHEST), ((100.0, 0.0, 0.0), (0.0, 0.0, 0.95))])
def test_a_blow_on_a_limp_body_leaves_no_range(make_batch, momentum, at):
    # 100 N s: 12 and 17 degrees beyond, were ends springs.
    batch = make_batch("PIAvatar/Stand-v0", 1, **LIMP)
    batch.reset(seeds=[0])
    strike(batch.simulation, momentum, at)
    worst, turned = 0.0, 0.0
    for _ in range(25):
        batch.step()
        worst = max(worst, beyond(batch.simulation).max())
        world = Rotation.from_quat(batch.simulation.controllers[0].state.rotation.numpy()[0].astype(float))
        turned = max(turned, (world[0].inv() * world[joint_index("head")]).magnitude())
    assert not batch.failure.numpy().any()
    assert worst < np.radians(1.0)
    assert np.radians(30.0) < turned < np.radians(130.0)


def test_stops_keep_momentum(make_batch):
    settings = {"control": "torque", "pose_noise": 0.0, "gravity": 0.0, "scene": {"ground": False, "walls": False}}
    batch = make_batch("PIAvatar/Reach-v0", 1, **settings)
    batch.reset(seeds=[0])
    rng, held = np.random.default_rng(1), 0
    model, state = batch.simulation.model, batch.simulation.state
    start, scale, drift = totals(model, state), 0.0, np.zeros(2)
    for step in range(20):
        if step % 4 == 0:
            batch.action.assign(np.sign(rng.uniform(-1.0, 1.0, batch.action.shape)).astype(np.float32))
        batch.step()
        now = totals(model, state)
        scale = max(scale, now.momentum_scale)
        changes = now.momentum - start.momentum, now.angular_momentum - start.angular_momentum
        drift = np.maximum(drift, [np.linalg.norm(change) for change in changes])
        held += np.count_nonzero(batch.simulation.controllers[0].joints._workspace.stops.held.numpy())
    assert held > 10
    assert (drift < 1e-5 * scale).all(), drift / scale
