"""Joints that turn: flesh stays where bones have it, and light limbs can be turned."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.wear import set_spinning, straight_growth, widths
from piavatar_envs.avatar.joint_mass import GRID_SHARE, TRUNK
from piavatar_envs.avatar.joint_torques import LOCK
from piavatar_envs.avatar.skeleton import joint_index
from piavatar_envs.mpm.diagnostics import totals

REACH = "PIAvatar/Reach-v0"
EMPTY = {"gravity": 0.0, "scene": {"ground": False, "walls": False}}
HELD_BY_NOTHING = {"control": "pd", "pose_noise": 0.0, "root_assist": 0.0}


def test_limbs_that_turn_do_not_swell(make_batch):
    """In ``T`` seconds of straight ways they would grow by ``exp(omega^2 dt T / 2)``, about which no stress knows."""
    rate, steps = 8.0, 45
    batch = make_batch(REACH, 1, **HELD_BY_NOTHING, **EMPTY)
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


def test_light_joints_have_a_share_of_the_inertia_of_the_grid(make_batch):
    """Of ``m dx^2/2``, whatever limb hangs on them; toes are locked, and the trunk has none."""
    batch = make_batch(REACH, 1, control="torque")
    simulation = batch.simulation
    inertia, sampled = simulation.avatar.joints.body.tissue.inertia.numpy(), simulation.flesh[0].sampled
    mass, wrist = simulation.model.particles.mass.numpy()[0].astype(float), joint_index("left_wrist")
    share = np.where(sampled.skin_joints == wrist, sampled.skin_weights, 0.0).sum(1) / sampled.skin_weights.sum(1)
    assert inertia[wrist] == pytest.approx(GRID_SHARE * 0.5 * simulation.dx**2 * (share @ mass[: len(share)]), rel=1e-5)
    assert all(inertia[joint_index(name)] == 0.0 for name in TRUNK)
    assert inertia[joint_index("left_foot")] == pytest.approx(LOCK)


@pytest.mark.parametrize("firm", [False, True])
def test_bodies_that_thrash_on_the_ground_do_not_fail(make_batch, firm):
    """Random torques of all that muscles have, where a hand is half as large as a cell."""
    batch = make_batch("PIAvatar/GetUp-v0", 8, firm_bones=firm)
    batch.reset(seeds=list(range(8)))
    rng, fastest = np.random.default_rng(0), 0.0
    for _ in range(100):
        batch.action.assign(rng.uniform(-1.0, 1.0, batch.action.shape).astype(np.float32))
        batch.step()
        fastest = max(fastest, np.abs(batch.simulation.avatar.joints.state.velocity.numpy()).max())
    assert not batch.failure.numpy().any()
    assert fastest > 10.0  # [rad/s]
