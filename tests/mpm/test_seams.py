"""Fields of one subject: they grow together where both have seam particles, and only there."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from piavatar_envs.mpm.model import Fields, MaterialPoints

DX, SPACING = 0.05, 0.025
BAR = {"lower": (-0.3, -0.05, -0.05), "upper": (0.3, 0.05, 0.05), "dx": DX, "spacing": SPACING, "margin": 0.4}


def bar(simulate, cut=None, seam=0.5 * DX, subjects=1, **kwargs):
    """Return a bar along x, of one field, or cut at ``cut`` [m] in two; ``seam`` is half the width of the seam [m]."""
    x = simulate(**BAR).rest[:, 0]
    points = MaterialPoints.uniform(np.full(len(x), SPACING**3))
    if cut is None:
        return simulate(**BAR, points=points, pushed=True, fields=Fields(), **kwargs)
    field = (x > cut).astype(int)
    points = replace(points, field=field, seam=(np.abs(x - cut) < seam).astype(np.float32), sensor=field)
    fields = Fields((0, 0) if subjects == 1 else (0, 1), num_sensors=2)
    return simulate(**BAR, points=points, pushed=True, fields=fields, **kwargs)


def load(sim, how):
    """Return accelerations [m/s^2] that sum to nothing."""
    x, zero = sim.rest[:, 0], np.zeros(len(sim.rest))
    if how == "tension":
        return np.stack([30.0 * np.sign(x), zero, zero], 1)
    if how == "bending":
        return np.stack([zero, zero, 20.0 * (np.abs(x) / 0.15 - 1.0)], 1)
    return np.stack([zero, -200.0 * np.sign(x) * sim.rest[:, 2], 200.0 * np.sign(x) * sim.rest[:, 1]], 1)  # torsion


@pytest.mark.parametrize(("how", "cut"), [("tension", 0.0), ("bending", 0.025), ("torsion", 0.0)])
def test_halves_with_a_seam_are_one_bar(simulate, how, cut):
    # Wherever the cut lies on the grid, to round-off; the seam needs no more particles than those next to it.
    check_halves(simulate, how, cut)


@pytest.mark.parametrize("path", ["tiled", "block"])
def test_halves_are_one_bar_on_every_path(simulate, device, path):
    if device == "cpu":
        pytest.skip("of a GPU")
    check_halves(simulate, "bending", 0.025, path=path)


def check_halves(simulate, how, cut, **way):
    one, two = bar(simulate, **way), bar(simulate, cut, **way)
    for sim in (one, two):
        sim.push(damping=5.0, acceleration=load(sim, how)).run(5)
    assert two.failures == [0]
    assert np.abs(one.get("x") - one.rest).max() > 0.1 * DX  # they are loaded
    assert np.abs(two.get("x") - one.get("x")).max() < 1e-3 * DX
    assert np.abs(two.get("u") - one.get("u")).max() < 2e-3
    assert not two.scratch.sensors.pair_impulse.numpy().any()
    assert not two.scratch.sensors.part_impulse.numpy().any()


@pytest.mark.parametrize(("seam", "subjects"), [(0.0, 1), (0.5 * DX, 2)])
def test_halves_part_without_a_seam_and_between_subjects(simulate, seam, subjects):
    sim = bar(simulate, 0.0, seam, subjects)
    sim.push(acceleration=load(sim, "tension")).run(5)
    x = sim.get("x")[:, 0]
    assert x[sim.of(1)].min() - x[sim.of(0)].max() > 2.0 * DX


def test_halves_without_a_seam_push_each_other(simulate):
    # Limbs of one subject touch like bodies, on the sensors of their parts, but not as a pair of subjects.
    sim = bar(simulate, 0.0, 0.0)
    velocity = np.where(sim.of(1)[:, None], [-1.0, 0.0, 0.0], [1.0, 0.0, 0.0])
    sim.set(u=velocity).run()
    parts = sim.scratch.sensors.part_impulse.numpy()[0]
    half = 0.5 * sim.totals().mass
    assert parts[1, 0, 0] > 0.5 * half and parts[0, 0, 0] == pytest.approx(-parts[1, 0, 0], rel=1e-4)
    assert not sim.scratch.sensors.pair_impulse.numpy().any()
    x = sim.get("x")[:, 0]
    assert x[sim.of(1)].min() - x[sim.of(0)].max() > 0.2 * SPACING  # neither in the other


def test_prescribed_motion_grows_together_too(simulate):
    # Kinematic momentum is summed like the physical one: a strained bar with prescribed rotation does not tear.
    runs = []
    for sim in (bar(simulate), bar(simulate, 0.0)):
        turning = np.cross([0.0, 3.0, 0.0], sim.rest)
        sim.set(vk=turning, F=np.diag([1.1, 0.95, 1.0])).run(3)
        runs.append({name: sim.get(name) for name in ("x", "u", "F")})
    assert np.abs(runs[1]["x"] - runs[0]["x"]).max() < 1e-3 * DX
    assert np.abs(runs[1]["u"] - runs[0]["u"]).max() < 1e-3
    assert np.abs(runs[1]["F"] - runs[0]["F"]).max() < 1e-3


@pytest.mark.parametrize("side", [0, 1])
def test_a_seam_needs_both_sides(simulate, side):
    # Flesh of the shoulder does not grow to whatever of the belly comes near it.
    sim = bar(simulate, 0.0)
    seam = sim.model.particles.seam.numpy()
    assert 0.0 < seam[sim.of(side)].mean() < 0.2
    sim.model.particles.seam.assign(np.where(sim.of(side), seam, 0.0).astype(np.float32))
    sim.push(acceleration=load(sim, "tension")).run(5)
    x = sim.get("x")[:, 0]
    assert x[sim.of(1)].min() - x[sim.of(0)].max() > 2.0 * DX


def test_impulse_on_a_seam_is_sensed_by_the_parts(simulate):
    # A second bar falls on the seam of the first: what its halves sense adds up to what they gain.
    lower = simulate(**BAR)
    rest = np.concatenate([lower.rest, lower.rest @ np.diag([0.3, 1.0, 1.0]) + [0.0, 0.0, 0.1]])
    field = np.concatenate([(lower.rest[:, 0] > 0.0).astype(int), np.full(len(lower.rest), 2)])
    points = MaterialPoints.uniform(np.full(len(rest), SPACING**3))
    seam = ((np.abs(rest[:, 0]) < 0.5 * DX) & (field < 2)).astype(np.float32)
    points = replace(points, field=field, seam=seam, sensor=field)
    sim = simulate(**BAR, rest=rest, points=points, fields=Fields((0, 0, 1), 0.3, num_sensors=3))
    sim.set(u=(field == 2)[:, None] * [0.3, 0.0, -2.0]).run()
    gained = sim.totals(select=field < 2).momentum
    parts = sim.scratch.sensors.part_impulse.numpy()[0]
    assert -gained[2] > 1.0 and sim.failures == [0]
    np.testing.assert_allclose(parts[0, 1] + parts[1, 1], gained, atol=1e-4 * sim.totals().momentum_scale)
    assert not parts[:2, 0].any() and not parts[2, 1].any()
    np.testing.assert_allclose(sim.scratch.sensors.pair_impulse.numpy()[0, 1], gained, rtol=1e-4, atol=1e-3)
