"""The solver of cloth against theory: stretch, swings, bending, friction, air, momentum and energy."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.garments import free
from benchmarks.garments.rows import CHECKS, Options
from benchmarks.garments.sheets import LINEN, Run, flat_sheet, garment
from benchmarks.physics.checks import HOLDS

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
