"""Joints that turn: flesh stays where bones have it, and light limbs can be turned."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.physics.wear import set_spinning, straight_growth, widths
from piavatar_envs.avatar.body.asset import dense_weights
from piavatar_envs.avatar.body.skeleton import JOINT_NAMES, PARENTS, joint_index
from piavatar_envs.avatar.torque_control.joint_torques import LOCK
from piavatar_envs.avatar.torque_control.mass_matrix import GRID_SHARES
from piavatar_envs.mpm.diagnostics import totals

REACH = "PIAvatar/Reach-v0"
EMPTY = {"gravity": 0.0, "scene": {"ground": False, "walls": False}}
HELD_BY_NOTHING = {"control": "pd", "pose_noise": 0.0, "root_assist": 0.0}


def test_limbs_that_turn_do_not_swell(make_batch):
    """In ``T`` seconds of straight ways they would grow by ``exp(omega^2 dt T / 2)``, about which no stress knows.

    Nor do those that no control step puts back.
    """
    rate, steps = 8.0, 45
    batch = make_batch(REACH, 1, firm_bones=False, **HELD_BY_NOTHING, **EMPTY)
    batch.reset(seeds=[0])
    model, state = batch.simulation.model, batch.simulation.state
    before = widths(batch)
    set_spinning(batch, rate)
    start = totals(model, state)
    for _ in range(steps):
        batch.step()
    now = totals(model, state)
    assert not batch.failure.numpy().any()
    assert np.linalg.norm(now.angular_momentum - start.angular_momentum) < 1e-5 * start.momentum_scale
    swelling = straight_growth(batch, rate, steps)
    assert swelling > 0.15
    assert np.abs(widths(batch) / before - 1.0).max() < 0.1 * swelling


def test_light_joints_take_over_with_a_share_of_the_inertia_of_the_grid(make_batch):
    """Of ``m dx^2/2``, with ``m`` of the limb that hangs on them; others have none. Toes are locked."""
    batch = make_batch(REACH, 1, control="torque")
    simulation = batch.simulation
    joints, sampled = simulation.controllers[0].joints, simulation.flesh[0].sampled
    besides = joints._workspace.diagonals.numpy()[0, 3:].reshape(-1, 3)
    mass = simulation.model.particles.mass.numpy()[0].astype(float) @ dense_weights(
        sampled.skin_joints, sampled.skin_weights
    )
    for bone, name in enumerate(JOINT_NAMES):
        known = GRID_SHARES.get(name.split("_")[-1], 0.0)
        expected = LOCK if name.endswith("foot") else known * 0.5 * simulation.dx**2 * mass[bone]
        np.testing.assert_allclose(besides[bone], expected, rtol=1e-5)


def weight_about_joints(batch) -> np.ndarray:
    """Moment of the weight that hangs on each joint about it, in the world's axes, ``(22, 3)`` [N m]."""
    simulation = batch.simulation
    sampled, at = simulation.flesh[0].sampled, simulation.controllers[0].state.position.numpy()[0].astype(float)
    mass, x = simulation.model.particles.mass.numpy()[0].astype(float), simulation.state.x.numpy()[0].astype(float)
    share = dense_weights(sampled.skin_joints, sampled.skin_weights)
    for bone in reversed(range(1, len(PARENTS))):
        share[:, PARENTS[bone]] += share[:, bone]
    force = np.array([0.0, 0.0, -9.81]) * mass[:, None]
    return np.stack([share[:, b] @ np.cross(x - at[b], force) for b in range(len(PARENTS))])


def spring_torques(batch) -> np.ndarray:
    """What the springs of the joints pull with, towards the rest pose, in the world's axes, ``(22, 3)`` [N m]."""
    controller = batch.simulation.controllers[0]
    world = Rotation.from_quat(controller.state.rotation.numpy()[0].astype(float))
    stiffness = controller.joints.springs.stiffness.numpy()[0, 1:]
    above = [world[max(PARENTS[b], 0)] for b in range(len(PARENTS))]
    return np.stack([-k * a.apply((a.inv() * w).as_rotvec()) for k, a, w in zip(stiffness, above, world, strict=True)])


def test_a_joint_at_rest_bears_the_weight_that_hangs_on_it(make_batch):
    """Springs give exactly its moment: what light joints know of the grid's inertia resists no load that stays."""
    batch = make_batch(REACH, 1, control="pd", pose_noise=0.0, root_assist=1.0, joints=None, scene=EMPTY["scene"])
    batch.reset(seeds=[0])
    for _ in range(150):
        batch.step()
    spring, weight = spring_torques(batch), weight_about_joints(batch)
    moving = [b for b in range(1, len(PARENTS)) if batch.simulation.controllers[0].joints.tissue.lock.numpy()[b] == 0.0]
    assert len(moving) == len(PARENTS) - 3  # toes are locked
    assert np.linalg.norm(weight[moving], axis=1).min() > 0.05
    np.testing.assert_allclose(spring[moving], -weight[moving], rtol=0.003, atol=0.01)


@pytest.mark.parametrize("name", ["ankle", "knee"])
def test_legs_bear_what_stands_on_them(make_batch, name):
    """Feet press the ground, and springs give the moment of all above a joint: its weight and what holds the pelvis."""
    batch = make_batch(REACH, 1, control="pd", pose_noise=0.0, root_assist=1.0, joints=None, episode_seconds=20.0)
    batch.reset(seeds=[0])
    for _ in range(100):
        batch.step()
    simulation, joints = batch.simulation, [joint_index(f"{side}_{name}") for side in ("left", "right")]
    pelvis, at = (
        simulation.controllers[0].joints.support,
        simulation.controllers[0].state.position.numpy()[0].astype(float),
    )
    axis = at[joints].mean(0)
    mass, x = simulation.model.particles.mass.numpy()[0].astype(float), simulation.state.x.numpy()[0].astype(float)
    weight = np.cross(x - axis, np.array([0.0, 0.0, -9.81]) * mass[:, None]).sum(0)
    held = pelvis.torque.numpy()[0] + np.cross(at[0] - axis, pelvis.force.numpy()[0])
    above = weight - weight_about_joints(batch)[joints].sum(0) + held
    assert above[0] > 15.0  # [N m]
    assert spring_torques(batch)[joints, 0].sum() == pytest.approx(above[0], rel=0.04)


@pytest.mark.parametrize("firm", [False, True])
def test_bodies_that_thrash_on_the_ground_do_not_fail(make_batch, firm):
    """Random torques of all that muscles have, where a hand is half as large as a cell."""
    batch = make_batch("PIAvatar/GetUp-v0", 8, firm_bones=firm)
    batch.reset(seeds=list(range(8)))
    rng, fastest = np.random.default_rng(0), 0.0
    for _ in range(100):
        batch.action.assign(rng.uniform(-1.0, 1.0, batch.action.shape).astype(np.float32))
        batch.step()
        fastest = max(fastest, np.abs(batch.simulation.controllers[0].state.velocity.numpy()).max())
    assert not batch.failure.numpy().any()
    assert fastest > 10.0  # [rad/s]
