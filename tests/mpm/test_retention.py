"""Substeps beyond the reference damp short waves as the reference does, and conserve momentum and energy."""

from __future__ import annotations

import numpy as np
import pytest

from piavatar_envs.mpm.retention import SHORTEST_KEPT, retained_share
from piavatar_envs.mpm.types import PATHS

#: Two bodies that tumble into each other.
CUBES = [
    {"box": ((-0.2, -0.1, -0.1), (0.0, 0.1, 0.1)), "velocity": (2.0, 0.2, 0.0)},
    {"box": ((0.0, -0.12, -0.07), (0.2, 0.08, 0.13)), "velocity": (-2.0, 0.0, 0.4), "density": 400.0},
]
REFERENCE = 5


def energy(totals):
    return totals.kinetic + totals.elastic


def tumbling(meet, finer=8, **kwargs):
    """Return the cubes with random velocities of every wavelength, with ``finer`` times the reference substeps."""
    settings = {"friction": 0.3, "control_dt": 1.0 / 120.0, "reference_substeps": REFERENCE} | kwargs
    sim = meet(CUBES, num_substeps=finer * REFERENCE, **settings)
    rng = np.random.default_rng(4)
    return sim.set(u=sim.get("u") + rng.normal(0.0, 0.3, sim.rest.shape), C=rng.normal(0.0, 3.0, (len(sim.rest), 3, 3)))


def wave_left(simulate, wavelength, finer, **kwargs):
    """Return the share of energy that is left of a wave along a free bar, of a length in grid spacings."""
    sim = simulate(
        (-0.1, -0.1, -0.3),
        (0.1, 0.1, 0.3),
        num_substeps=finer * REFERENCE,
        control_dt=0.02,
        poisson_ratio=0.0,
        **kwargs,
    )
    wave = np.cos(2.0 * np.pi / (wavelength * 0.05) * (sim.rest[:, 2] + 0.3))
    sim.set(u=0.05 * wave[:, None] * [0.0, 0.0, 1.0])
    before = energy(sim.totals())
    after = energy(sim.run(3).totals())
    assert sim.failures == [0]
    return after / before


@pytest.mark.parametrize("times", [1.0, 2.0, 31.5])
def test_share_damps_the_shortest_wave_alike(times):
    share = retained_share(times)
    assert (share + (1.0 - share) * SHORTEST_KEPT) ** times == pytest.approx(SHORTEST_KEPT)
    assert (share > 0.0) == (times > 1.0) and share < 1.0


@pytest.mark.parametrize("wavelength", [4.0, 6.0])
def test_waves_are_damped_by_time_not_by_substeps(simulate, wavelength):
    usual = wave_left(simulate, wavelength, 1)
    kept = wave_left(simulate, wavelength, 8, reference_substeps=REFERENCE)
    damped = wave_left(simulate, wavelength, 8)
    assert np.log(kept) == pytest.approx(np.log(usual), rel=0.6)
    assert np.log(damped) < 3.0 * np.log(usual)


def test_momentum_is_kept_and_energy_never_rises_in_contact(meet):
    sim = tumbling(meet)
    assert sim.model.retained_share is not None
    start, history = sim.totals(), [energy(sim.totals())]
    away = sim.totals(select=sim.of(0)).momentum
    for _ in range(20):
        history.append(energy(sim.run().totals()))
    end = sim.totals()
    assert sim.failures == [0]
    assert np.linalg.norm(sim.totals(select=sim.of(0)).momentum - away) > 0.3 * start.momentum_scale  # they did collide
    assert np.abs(end.momentum - start.momentum).max() < 1e-5 * start.momentum_scale
    assert np.abs(end.angular_momentum - start.angular_momentum).max() < 1e-5 * 0.2 * start.momentum_scale
    assert np.diff(history).max() < 1e-6 * history[0]


def test_matter_comes_to_rest(simulate):
    # What the nodes do not see must not live on: a shaken block on a floor is as still as with the reference.
    left = {}
    for finer in (1, 8):
        sim = simulate(
            num_substeps=finer * REFERENCE, reference_substeps=REFERENCE, control_dt=1.0 / 100.0, young_modulus=3e4,
            gravity=(0.0, 0.0, -9.81), planes=[((0.0, 0.0, 1.0), -0.11, 0.5)], retardation=5e-3,
        )  # fmt: skip
        rng = np.random.default_rng(1)
        sim.set(u=rng.normal(0.0, 0.2, sim.rest.shape), C=rng.normal(0.0, 2.0, (len(sim.rest), 3, 3)))
        start = sim.totals().kinetic
        left[finer] = sim.run(200).totals().kinetic / start
        assert sim.failures == [0]
        assert np.ptp(sim.get("x")[:, 2]) < 0.21
    assert left[8] < 2.0 * left[1] < 1e-6


@pytest.mark.parametrize("path", [name for name in PATHS if name != "plain"])
@pytest.mark.parametrize("several", [True, False])
def test_paths_agree_and_repeat_bit_for_bit(meet, device, path, several):
    if device == "cpu":
        pytest.skip("only the plain path is for a CPU")
    bodies = CUBES if several else CUBES[:1]
    settings = {"control_dt": 1.0 / 240.0, "reference_substeps": 2, "num_substeps": 6, "max_active_blocks": 250}
    settings |= {"gravity": (0.0, 0.0, -9.81), "planes": [((0.0, 0.0, 1.0), -0.11, 0.5)], "friction": 0.3}

    def run(path):
        sim = meet(bodies, path=path, **settings)
        rng = np.random.default_rng(4)
        shape = sim.rest.shape
        sim.set(u=sim.get("u") + rng.normal(0.0, 0.1, shape), C=rng.normal(0.0, 1.0, (*shape, 3)))
        return sim.run(2)

    other, again, plain = run(path), run(path), run("plain")
    assert other.accumulators_are_clear and plain.accumulators_are_clear
    for array, atol in zip(("x", "u", "C", "F"), (1e-5, 2e-3, 2e-1, 1e-3), strict=True):
        np.testing.assert_array_equal(getattr(other.state, array).numpy(), getattr(again.state, array).numpy())
        np.testing.assert_allclose(other.get(array), plain.get(array), atol=atol, err_msg=array)


def test_only_further_substeps_retain_anything(simulate):
    for given in ({}, {"reference_substeps": 20}, {"reference_substeps": 2, "decoupling": "paper"}):
        sim = simulate(num_substeps=20, **given)
        assert sim.model.retained_share is None and sim.scratch.retained is None
