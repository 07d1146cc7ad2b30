"""The solver of cloth against theory: stretch, swings, bending, friction, air, momentum and energy."""

from __future__ import annotations

import pytest

from benchmarks.garments import free
from benchmarks.garments.rows import CHECKS, Options
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
