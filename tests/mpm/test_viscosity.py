"""Viscosity of matter: vibrations decay as a Kelvin-Voigt solid says, at any time step, and nothing else is damped."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.physics.textbook import bar_frequency
from piavatar_envs.mpm.materials import DAMPING_FREQUENCY, retardation_time
from piavatar_envs.mpm.model import CFL_STABLE, MaterialPoints, choose_num_substeps

LENGTH, SIDE, CELLS = 0.6, 0.2, 4
YOUNG_MODULUS, DENSITY = 1.0e5, 1000.0


def damping_of_bar(simulate, poisson_ratio, retardation, num_substeps=None):
    """Return the damping ratio of the first longitudinal mode of a free bar, from the decay of its amplitude."""
    frequency = bar_frequency(LENGTH, SIDE, YOUNG_MODULUS, poisson_ratio, DENSITY)
    corner, dx = np.array([LENGTH, SIDE, SIDE]) / 2.0, SIDE / CELLS
    matter = {"poisson_ratio": poisson_ratio, "retardation": retardation}
    period = {"control_dt": 0.5 / frequency, "num_substeps": num_substeps}
    sim = simulate(-corner, corner, dx / 2, dx, margin=0.15, **matter, **period)
    mode = np.sin(np.pi * sim.rest[:, 0] / LENGTH)
    sim.set(u=0.02 * mode[:, None] * [1.0, 0.0, 0.0])
    # every half period, when displacement is nearly zero, an error of the period shows in second order
    amplitude = np.array([abs(sim.run().get("u")[:, 0] @ mode) for _ in range(6)])
    decay = -np.polyfit(np.arange(6), np.log(amplitude), 1)[0] / np.pi
    return decay / np.sqrt(1.0 + decay**2), 2.0 * np.pi * frequency, sim.model.num_substeps


@pytest.mark.parametrize("poisson_ratio", [0.0, 0.3])
def test_a_bar_is_damped_as_kelvin_voigt_says(simulate, poisson_ratio):
    # The ratio is w t / 2; the grid alone gives a tenth of it.
    without, frequency, _ = damping_of_bar(simulate, poisson_ratio, 0.0)
    retardation = 0.1 / frequency
    with_viscosity, _, count = damping_of_bar(simulate, poisson_ratio, retardation)
    finer, _, _ = damping_of_bar(simulate, poisson_ratio, retardation, 2 * count)
    assert without < 0.005
    assert with_viscosity - without == pytest.approx(0.05, rel=0.05)
    assert finer == pytest.approx(with_viscosity, rel=0.05)


def test_viscosity_keeps_momentum_and_takes_energy(simulate):
    # At the limit of the time step, from random velocities, of which most modes are the fastest of the grid.
    retardation = 5e-3
    sim = simulate(retardation=retardation, control_dt=0.02)
    rng = np.random.default_rng(0)
    sim.set(u=0.1 * rng.normal(size=sim.rest.shape))
    history = [sim.totals()] + [sim.run().totals() for _ in range(10)]
    energy = np.array([total.kinetic + total.elastic for total in history])
    assert np.diff(energy).max() <= 1e-6 * energy[0] and sim.failures == [0]
    scale = np.abs(sim.model.particles.mass.numpy()).sum() * 0.1
    assert np.abs(history[-1].momentum - history[0].momentum).max() < 1e-5 * scale
    assert np.abs(history[-1].angular_momentum - history[0].angular_momentum).max() < 1e-5 * scale


def test_a_rotation_is_not_damped(simulate):
    sim = simulate(retardation=5e-3, control_dt=0.02)
    spin = np.array([0.0, 0.0, 1.0])
    skew = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    sim.set(u=np.cross(spin, sim.rest), C=skew)
    before = sim.totals()
    after = sim.run(10).totals()
    assert after.angular_momentum[2] == pytest.approx(before.angular_momentum[2], rel=1e-5)
    assert after.kinetic + after.elastic == pytest.approx(before.kinetic, rel=2e-3)


def test_the_time_step_follows_the_viscosity(simulate):
    # The remedy in the message is the fewest substeps that are accepted; without viscosity there is no other limit.
    volume = np.full(8, 1e-3)
    assert MaterialPoints.uniform(volume).limiting_speed(0.05) == 0.0
    points = MaterialPoints.uniform(volume, retardation=0.01)
    speed = points.limiting_speed(0.05)
    fewest = choose_num_substeps(0.02, 0.05, speed, CFL_STABLE)
    assert simulate(retardation=0.01, control_dt=0.02).model.num_substeps == fewest
    with pytest.raises(ValueError, match=f"num_substeps >= {fewest}, or less viscosity"):
        simulate(retardation=0.01, control_dt=0.02, num_substeps=fewest - 1)
    with pytest.raises(ValueError, match="retardation=-1 s must not be negative"):
        simulate(retardation=-1.0)


def kept_by_transfer(k, places):
    """Return the share of a wave ``k`` [1/cell] that P2G and G2P keep; ``places`` of particles in a cell, in cells."""

    def weight(d):
        return np.where(abs(d) < 0.5, 0.75 - d**2, np.where(abs(d) < 1.5, 0.5 * (1.5 - abs(d)) ** 2, 0.0))

    # the affine part after a transfer is that of the node's wave, which the velocity is, too
    way = np.add.outer(np.arange(-3, 4), places)
    both = weight(way) * np.exp(1j * k * way), weight(way) * way * np.exp(1j * k * way)
    return float((abs(both[0].sum(0)) ** 2 + 4.0 * abs(both[1].sum(0)) ** 2).sum() / weight(way).sum())


@pytest.mark.parametrize("cells", [4, 8])
def test_transfers_damp_short_waves_alone(simulate, cells):
    # Without stress, each substep damps a wave of ``cells`` grid spacings as the splines say, by less than k^4 / 40.
    dx, substeps, k = 0.05, 8, 2.0 * np.pi / cells
    sim = simulate((-0.6, -0.3, -0.3), (0.6, 0.3, 0.3), decoupling="no_stress", control_dt=1e-4, num_substeps=substeps)
    wave = np.sin(k * sim.rest[:, 0] / dx)
    sim.set(u=wave[:, None] * [0.0, 1.0, 0.0]).run()  # the affine part settles within a transfer
    inside = (np.abs(sim.rest) < [0.2, 0.1, 0.1]).all(1)
    before = sim.get("u")[inside, 1] @ wave[inside]
    kept = (sim.run(2).get("u")[inside, 1] @ wave[inside] / before) ** (0.5 / substeps)
    assert kept == pytest.approx(kept_by_transfer(k, (0.25, 0.75)), abs=0.01 * (1.0 - kept))
    assert 1.0 - k**4 / 40.0 < kept < 1.0


def test_settings_give_a_retardation_time():
    # A damping ratio is stated for one frequency, w t / 2, and adds to a viscosity.
    ratio = np.pi * DAMPING_FREQUENCY * retardation_time(0.0, 0.2, 4e4)
    assert ratio == pytest.approx(0.2)
    assert retardation_time(40.0, 0.0, 4e4) == pytest.approx(1e-3)
    assert retardation_time(40.0, 0.2, 4e4) == pytest.approx(1e-3 + retardation_time(0.0, 0.2, 4e4))
