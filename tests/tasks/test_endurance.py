"""Random full-scale actions: a few hundred steps here, the ten thousand of a release in benchmarks/robustness.py."""

from __future__ import annotations

import numpy as np
import pytest

SEEDS, STEPS = 20, 10


@pytest.mark.parametrize("kind", ["uniform", "corners", "held corners"])
def test_no_failure_and_nothing_that_is_not_finite(make_batch, env_id, kind):
    """Twenty seeds at once: environment ``i`` is the single environment of seed ``i`` (see test_batch_env)."""
    batch = make_batch(env_id, SEEDS)
    batch.reset(seeds=range(SEEDS))
    rng = np.random.default_rng(0)
    steps = STEPS if kind == "uniform" else STEPS // 2
    action = rng.choice([-1.0, 1.0], batch.action.shape)
    for step in range(steps):
        if kind == "uniform":
            action = rng.uniform(-1.0, 1.0, batch.action.shape)
        elif kind == "corners":
            action = rng.choice([-1.0, 1.0], batch.action.shape)
        batch.action.assign(action.astype(np.float32))
        batch.step()
        assert not batch.failure.numpy().any(), f"step {step}: {batch.failure.numpy()}"
        for name in ("observation", "reward", "terms", "metrics"):
            assert np.isfinite(getattr(batch, name).numpy()).all(), f"step {step}: {name}"
        state = batch.simulation.state.numpy()
        assert all(np.isfinite(value).all() for value in state.values())
        assert np.linalg.det(state["F"].astype(float)).min() > 0.0, "flesh has been turned inside out"
    batch.action.zero_()
