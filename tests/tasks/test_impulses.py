"""Impulses: what they add is exactly what was drawn, and when they come is decided by seed and episode alone."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp

from piavatar_envs.avatar.body.skeleton import NUM_JOINTS, joint_index
from piavatar_envs.envs.episodes import Episodes
from piavatar_envs.tasks.track_motion import STRUCK, apply_impulse, draw_impulse

TRACK = "PIAvatar/TrackMotion-v0"


def schedule(device, seed: int, episode: int, steps: int, interval: int, magnitude: float, bones=(3, 9, 15)):
    """Impulses ``(steps, 3)`` [N s] and struck bones ``(steps,)`` of an episode."""
    out, struck = wp.zeros(steps, dtype=wp.vec3, device=device), wp.zeros(steps, dtype=int, device=device)

    def constant(value):
        return wp.array(np.full(steps, value, np.int32), dtype=int, device=device)

    count = wp.array(np.arange(steps, dtype=np.int32), dtype=int, device=device)
    targets = wp.array(list(bones), dtype=int, device=device)
    episodes = Episodes()
    episodes.seed, episodes.episode, episodes.step_count = constant(seed), constant(episode), count
    wp.launch(draw_impulse, steps, [episodes, interval, magnitude, targets], [out, struck], device=device)
    return out.numpy(), struck.numpy()


@pytest.mark.parametrize("interval", [1, 7, 30])
def test_one_impulse_an_interval_at_a_moment_of_the_episodes_own(device, interval):
    firsts = []
    for episode in range(20):
        impulses, _ = schedule(device, 5, episode, 4 * interval, interval, 20.0)
        strikes = np.flatnonzero(np.linalg.norm(impulses, axis=1))
        assert len(strikes) == 4 and (np.diff(strikes) == interval).all()
        firsts.append(strikes[0])
    assert interval == 1 or len(set(firsts)) > 2


def test_impulses_are_bounded_spread_and_reproducible(device):
    impulses, struck = schedule(device, 1, 0, 4000, 1, 20.0)
    sizes = np.linalg.norm(impulses, axis=1)
    assert 0.3 * 20.0 <= sizes.min() < 7.0 and 19.0 < sizes.max() <= 20.0 + 1e-4
    directions = impulses / sizes[:, None]
    # uniform on the sphere: mean 0 and second moments 1/3, within four standard errors of 4000 draws
    assert np.abs(directions.mean(0)).max() < 4.0 * np.sqrt(1.0 / 3.0 / 4000)
    assert np.abs(directions.T @ directions / 4000 - np.eye(3) / 3.0).max() < 4.0 * 0.3 / np.sqrt(4000)
    assert set(struck) == {3, 9, 15} and np.bincount(struck)[[3, 9, 15]].min() > 1100
    again, _ = schedule(device, 1, 0, 4000, 1, 20.0)
    assert np.array_equal(impulses, again)
    for seed, episode in ((2, 0), (1, 1)):
        other, _ = schedule(device, seed, episode, 4000, 1, 20.0)
        assert np.abs(np.corrcoef(other[:, 0], impulses[:, 0])[0, 1]) < 4.0 / np.sqrt(4000)


def test_no_magnitude_no_impulse(device):
    assert not schedule(device, 1, 0, 100, 3, 0.0)[0].any()


@pytest.mark.parametrize("name", STRUCK)
def test_the_momentum_that_arrives_is_the_impulse(make_batch, name):
    """Sum of ``m du`` over the body, per body, also where shapes differ; only the struck bone's flesh moves."""
    batch = make_batch(TRACK, 2, **{"shape.randomize": True})
    batch.reset(seeds=[0, 1])
    simulation = batch.simulation
    J = np.array([[3.0, -4.0, 12.0], [-20.0, 0.5, 1.0]], np.float32)
    velocity = wp.zeros_like(simulation.state.u)
    wp.launch(
        apply_impulse,
        (2, simulation.avatar.num_points),
        [
            simulation.avatar.body,
            wp.array(J, dtype=wp.vec3, device=batch.device),
            wp.array([joint_index(name)] * 2, dtype=int, device=batch.device),
            batch.episodes,
        ],
        [velocity],
        device=batch.device,
    )
    du, mass = velocity.numpy().astype(float), simulation.model.particles.mass.numpy().astype(float)
    assert np.einsum("ep,epi->ei", mass, du) == pytest.approx(J, rel=2e-6)
    weight = (
        simulation.flesh[0].points.skin_weights * (simulation.flesh[0].points.skin_joints == joint_index(name))
    ).sum(1)
    assert np.array_equal(np.abs(du).max((0, 2)) > 0.0, weight > 0.0)
    # heavy enough that the flesh is not torn
    assert np.linalg.norm(du, axis=2).max() / np.linalg.norm(J, axis=1).max() < 1.0


def test_a_failed_environment_is_not_struck(make_batch):
    batch = make_batch(TRACK, 2)
    velocity = wp.zeros_like(batch.simulation.state.u)
    batch.failure.assign([0, 1])
    inputs = [
        batch.simulation.avatar.body,
        wp.array(np.ones((2, 3), np.float32), dtype=wp.vec3, device=batch.device),
        wp.zeros(2, dtype=int, device=batch.device),
        batch.episodes,
    ]
    wp.launch(apply_impulse, (2, batch.simulation.avatar.num_points), inputs, [velocity], device=batch.device)
    assert velocity.numpy()[0].any() and not velocity.numpy()[1].any()


def test_struck_bones_exist_and_are_not_the_lightest(make_batch):
    mass = make_batch(TRACK, 2).simulation.avatar.body.bone_mass.numpy()[0]
    indices = [joint_index(name) for name in STRUCK]
    assert len(set(indices)) == len(STRUCK) <= NUM_JOINTS and mass[indices].min() > 1.0
