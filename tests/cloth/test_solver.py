"""The solver of cloth against theory: stretch, swings, bending, friction, air, momentum and energy."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.garments import free
from benchmarks.garments.rows import CHECKS, Options
from benchmarks.garments.sheets import LINEN, Run, flat_sheet, garment
from benchmarks.physics.checks import HOLDS
from piavatar_envs.cloth.solver import fastest_bending, longest_substep

#: Quantities that the usual number of steps does not reach.
MISSED = (free.UNCONVERGED,)


@pytest.mark.parametrize("name", ["hanging", "swings", "cantilever", "incline", "air", "free"])
def test_cloth_is_as_theory_has_it(name):
    """Run the rows of the benchmark, whose formulae are in :mod:`benchmarks.garments.theory`."""
    rows = list(CHECKS[name].measure(Options()))
    missed = [f"{row.name}: {row.value:.4g} {row.unit}, {row.limit}" for row in rows if row.verdict != HOLDS]
    assert [text for text in missed if not text.startswith(MISSED)] == []
    assert rows


def test_bending_of_small_triangles_feeds_no_waves():
    """Check that a flat sheet stays flat though its fastest waves turn by a radian until the forces are renewed."""
    points, faces = flat_sheet(0.2, 0.2, 0.02)
    start = points + 1e-6 * np.random.default_rng(0).standard_normal(points.shape)
    run = Run(garment(points, faces, replace(LINEN, bending=1e-5), start=start), gravity=(0.0, 0.0, 0.0)).steps(60)
    assert np.abs(run.get()[:, 2]).max() < 1e-4 and run.speed() < 1e-3


def test_forces_are_renewed_as_often_as_stiff_bending_needs():
    """Check that a flat sheet stays flat up to the limit of theory, and that more bending is refused with a remedy."""
    points, faces = flat_sheet(0.2, 0.2, 0.02)
    start = points + 1e-6 * np.random.default_rng(0).standard_normal(points.shape)
    unit = fastest_bending(garment(points, faces, replace(LINEN, bending=1.0)))

    def runs(frequency: float, **settings) -> bool:
        sheet = garment(points, faces, replace(LINEN, bending=(frequency / unit) ** 2), start=start)
        run = Run(sheet, gravity=(0.0, 0.0, 0.0), **settings).steps(60)
        return np.abs(run.get()[:, 2]).max() < 1e-4 and run.speed() < 1e-3

    dt = 1.0 / 600.0
    shared, own = np.sqrt(4.0 / 6.0) / dt, np.sqrt(4.0 / 2.0) / dt  # of two substeps, and of each
    assert runs(0.95 * shared) and runs(1.05 * shared) and runs(0.95 * own)
    with pytest.raises(ValueError, match=r"substeps=20 are too few for the bending .* at least 22; set it"):
        runs(1.05 * own)
    assert runs(1.05 * own, substeps=22)


@pytest.mark.parametrize("every", [1, 2, 3])
def test_the_longest_substep_is_that_in_which_a_wave_keeps_its_size(every):
    for share in (0.99, 1.01):
        dt = share * longest_substep(every, 1.0)
        step = np.eye(2)  # of place and velocity
        force = -(step[0] + 0.5 * every * dt * step[1])
        for _ in range(every):
            velocity = step[1] + dt * force
            step = np.stack([step[0] + dt * velocity, velocity])
        assert (np.abs(np.linalg.eigvals(step)).max() > 1.0 + 1e-9) == (share > 1.0)
