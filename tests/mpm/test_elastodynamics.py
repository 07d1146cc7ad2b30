"""Validation as of an engine: textbook frequencies, deflections and impacts, closer the finer the grid."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.physics import elastodynamics, impacts
from benchmarks.physics.textbook import HertzImpact
from piavatar_envs.mpm import model as build
from piavatar_envs.mpm.model import CFL_STABLE, MaterialPoints


@pytest.mark.parametrize("material", ["neo_hookean", "fixed_corotated"])
def test_bar_rings_at_its_natural_frequency(device, material):
    # The error falls with the square of the grid spacing.
    coarse, fine = (abs(elastodynamics.bar(cells, material, device=device)["error"]) for cells in (2, 4))
    assert coarse < 0.01
    assert fine < 0.003
    assert fine < 0.4 * coarse


def test_bar_with_poisson_ratio(device):
    # The sides are free: it rings as a bar (E), not as a laterally held medium (lam + 2 mu, 16 % higher).
    assert abs(elastodynamics.bar(4, poisson_ratio=0.3, device=device)["error"]) < 0.005


def test_cantilever_bends_as_timoshenko_says(device):
    coarse, fine = (abs(elastodynamics.cantilever(cells, device)["error"]) for cells in (2, 4))
    assert coarse < 0.056
    assert fine < 0.026  # of second order at last: 0.0114 at 6 cells
    assert fine < 0.47 * coarse


def test_hertz_by_textbook():
    # Against the closed forms of the contact's duration and of what a collision exchanges.
    theory = HertzImpact(radius=0.2, mass=30.0, young_modulus=1e5, poisson_ratio=0.3, speed=0.1)
    times, force = theory.history
    assert np.trapezoid(force, times) == pytest.approx(2.0 * theory.mass * theory.speed, rel=1e-5)
    assert force.max() == pytest.approx(theory.force, rel=1e-5) and force[-1] < 1e-4 * theory.force
    effective = 1e5 / (1.0 - 0.3**2)
    # Johnson, eq. 11.24, for a ball and a plane
    assert theory.duration == pytest.approx(2.87 * (30.0**2 / (0.2 * effective**2 * 0.1)) ** 0.2, rel=2e-3)
    assert 0.0 < theory.reversal_time < 0.5 * theory.duration


@pytest.mark.parametrize(("mirrored", "cells"), [(False, 4), (True, 5)], ids=["wall", "bar"])
def test_a_bar_bounces_as_saint_venant_says(device, mirrored, cells):
    # Contact with a boundary and with another body passes a wave of stress ``rho c v`` on, no more and no less.
    coarse, fine = (impacts.bar_impact(n, mirrored, (0.0, 0.25), device) for n in (2, cells))
    assert np.abs(fine["time_error_range"]).max() < 0.02 and np.abs(fine["force_error_range"]).max() < 0.01
    assert np.abs(fine["time_error_range"]).max() < np.abs(coarse["time_error_range"]).max()
    assert 0.95 < fine["speed_after"] < 1.0 and coarse["speed_after"] < fine["speed_after"]
    assert fine["energy_left"] < 1.0


@pytest.mark.parametrize(("mirrored", "cells"), [(False, 6), (True, 5)], ids=["plane", "ball"])
def test_a_ball_bounces_as_hertz_says(device, mirrored, cells):
    # The contact is a quarter of a grid spacing deep here: what can be hoped for is its size, not Poisson's ratio.
    row = impacts.ball_impact(cells, mirrored, shifts=(0.5,), device=device)
    assert abs(row["time_error"]) < 0.25 and abs(row["force_error"]) < 0.25
    assert 0.8 < row["speed_after"] < 1.0 and row["energy_left"] < 1.0


def energy_history(simulate, courant, poisson_ratio, steps=12):
    """Return the total energy of a vibrating cube over time, at a time step of ``courant`` cells per substep."""
    points = MaterialPoints.uniform(np.full(512, 0.025**3), poisson_ratio=poisson_ratio)
    dt = courant * 0.05 / points.sound_speed()
    sim = simulate(points=points, control_dt=50 * dt, num_substeps=50)
    rng = np.random.default_rng(0)
    sim.set(u=0.1 * rng.normal(size=sim.rest.shape))
    history = [sim.totals()] + [sim.run().totals() for _ in range(steps)]
    return sim.failures, np.array([t.kinetic + t.elastic for t in history])


@pytest.mark.parametrize("poisson_ratio", [0.0, 0.4])
def test_stable_up_to_the_limit(simulate, poisson_ratio):
    failures, energy = energy_history(simulate, 0.8, poisson_ratio)
    assert failures == [0]
    assert np.diff(energy).max() < 1e-4 * energy[0]


def test_unstable_far_above_the_limit(simulate, monkeypatch):
    # At twice the time step of the limit the same body blows up.
    monkeypatch.setattr(build, "CFL_STABLE", 10.0)
    failures, energy = energy_history(simulate, 2.0 * CFL_STABLE, 0.3)
    assert failures != [0] or energy.max() > 2.0 * energy[0]
