"""Validation as of an engine: textbook frequencies and deflections, closer the finer the grid."""

from __future__ import annotations

import numpy as np
import pytest

from piavatar_envs.mpm import build
from piavatar_envs.mpm.build import CFL_STABLE, MaterialPoints


def period(times, signal):
    """Mean period of an oscillation about zero, from its interpolated zero crossings."""
    n = np.flatnonzero(signal[:-1] * signal[1:] < 0.0)
    crossings = times[n] - signal[n] * (times[n + 1] - times[n]) / (signal[n + 1] - signal[n])
    assert len(crossings) >= 4
    return 2.0 * np.diff(crossings).mean()


def bar_frequency_error(simulate, cells, material="neo_hookean", poisson_ratio=0.0):
    """Relative error of the first longitudinal frequency of a free bar of ``cells`` cells a side, 6 sides long.

    Theory: ``c / (2 L)`` with ``c = sqrt(E / rho)``, Rayleigh's correction for the inertia of the sides' Poisson
    motion included: ``1 - (nu pi r / L)^2 / 2`` with the polar radius of gyration ``r^2 = side^2 / 6`` (Graff, "Wave
    Motion in Elastic Solids", 1975, sec. 2.5).
    """
    side, young_modulus, density = 0.1, 1.0e5, 1000.0
    length, dx = 6.0 * side, side / cells
    theory = np.sqrt(young_modulus / density) / (2.0 * length)
    theory *= 1.0 - 0.5 * (poisson_ratio * np.pi / length) ** 2 * side**2 / 6.0
    sim = simulate(
        (-length / 2, -side / 2, -side / 2),
        (length / 2, side / 2, side / 2),
        dx / 2,
        dx,
        margin=0.1,
        material=material,
        poisson_ratio=poisson_ratio,
        control_dt=1.0 / (24.0 * theory),
    )
    mode = np.sin(np.pi * sim.rest[:, 0] / length)
    sim.set(u=0.02 * mode[:, None] * [1.0, 0.0, 0.0])
    times = np.arange(80) * sim.model.control_dt
    signal = np.array([sim.get("u")[:, 0] @ mode if n == 0 else sim.run().get("u")[:, 0] @ mode for n in range(80)])
    return 1.0 / (period(times, signal) * theory) - 1.0


@pytest.mark.parametrize("material", ["neo_hookean", "fixed_corotated"])
def test_bar_rings_at_its_natural_frequency(simulate, material):
    """The error falls with the square of the grid spacing."""
    coarse, fine = (abs(bar_frequency_error(simulate, cells, material)) for cells in (2, 4))
    assert coarse < 0.01
    assert fine < 0.003
    assert fine < 0.4 * coarse


def test_bar_with_poisson_ratio(simulate):
    """The sides are free: it rings as a bar (E), not as a laterally held medium (lam + 2 mu, 16 % higher)."""
    assert abs(bar_frequency_error(simulate, 4, poisson_ratio=0.3)) < 0.005


def beam_deflection(x, acceleration, side, young_modulus, density):
    """Sag [m] of a free beam against its middle, from Timoshenko's equations integrated over half of it.

    ``V' = q``, ``M' = V``, ``y' = integral of M / EI - V / (k G A)`` with ``k = 5/6`` and no Poisson effect
    (Timoshenko & Gere, "Mechanics of Materials", 1972, ch. 6 and 12).
    """
    dx, area, inertia = x[1] - x[0], side**2, side**4 / 12.0
    load = density * area * acceleration
    shear = -np.cumsum(load[::-1])[::-1] * dx  # both vanish at the free end
    moment = -np.cumsum(shear[::-1])[::-1] * dx
    slope = np.cumsum(moment / (young_modulus * inertia)) * dx - shear / (5.0 / 6.0 * 0.5 * young_modulus * area)
    return np.cumsum(slope) * dx


def cantilever_error(simulate, cells):
    """Relative error of the tip deflection of a cantilever under a little weight, ``cells`` cells thick, 5 sides long.

    It is one half of a free beam that is pushed up in the middle as much as it weighs: symmetry is a perfect clamp.
    """
    side, length, young_modulus, density, g = 0.2, 1.0, 1.0e5, 1000.0, 0.02
    dx, spacing, band = side / cells, 0.5 * side / cells, 0.5 * side
    pulsation = 22.4 / (2 * length) ** 2 * np.sqrt(young_modulus / density * side**2 / 12.0)  # first mode [rad/s]

    def acceleration(x):
        return np.where(np.abs(x) < band, g * (length - band) / band, -g)

    sim = simulate(
        (-length, -side / 2, -side / 2),
        (length, side / 2, side / 2),
        spacing,
        dx,
        margin=0.2,
        poisson_ratio=0.0,
        control_dt=8.0 / pulsation,
        pushed=True,
    )
    x = sim.rest[:, 0]
    sim.push(damping=2.0 * pulsation, acceleration=acceleration(x)[:, None] * [0.0, 0.0, 1.0]).run()
    sag = sim.get("x")[:, 2] - sim.rest[:, 2]
    tip, middle = sag[np.abs(x) > length - spacing].mean(), sag[np.abs(x) < spacing].mean()
    line = np.linspace(0.0, length, 4001)[:-1] + 0.5 * length / 4000
    theory = beam_deflection(line, acceleration(line), side, young_modulus, density)
    theory = np.interp([0.5 * spacing, length - 0.5 * spacing], line, theory)
    return (tip - middle) / (theory[1] - theory[0]) - 1.0


def test_cantilever_bends_as_timoshenko_says(simulate):
    coarse, fine = cantilever_error(simulate, 2), cantilever_error(simulate, 4)
    assert abs(coarse) < 0.05
    assert abs(fine) < 0.01
    assert abs(fine) < 0.4 * abs(coarse)


def energy_history(simulate, courant, poisson_ratio, steps=12):
    """Total energy of a vibrating cube over time, at a time step of ``courant`` cells per substep."""
    points = MaterialPoints.uniform(np.full(512, 0.025**3), poisson_ratio=poisson_ratio)
    dt = courant * 0.05 / points.sound_speed()
    sim = simulate(points=points, control_dt=50 * dt, num_substeps=50)
    rng = np.random.default_rng(0)
    sim.set(u=0.1 * rng.normal(size=sim.rest.shape))
    history = [sim.totals()] + [sim.run().totals() for _ in range(steps)]
    return sim.failures, np.array([t.kinetic + t.elastic for t in history])


@pytest.mark.parametrize("poisson_ratio", [0.0, 0.3, 0.4])
def test_stable_up_to_the_limit(simulate, poisson_ratio):
    failures, energy = energy_history(simulate, 0.8, poisson_ratio)
    assert failures == [0]
    assert np.diff(energy).max() < 1e-4 * energy[0]


def test_unstable_far_above_the_limit(simulate, monkeypatch):
    """The limit is no idle caution: at twice its time step the same body blows up."""
    monkeypatch.setattr(build, "CFL_STABLE", 10.0)
    failures, energy = energy_history(simulate, 2.0 * CFL_STABLE, 0.3)
    assert failures != [0] or energy.max() > 2.0 * energy[0]
