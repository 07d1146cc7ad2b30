"""Reward shaping in kernels against the formulas they cite."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp

from piavatar_envs.tasks.common.rewards import mean_square_action, tolerance


@wp.kernel
def shape(value: wp.array(dtype=float), bound: float, margin: float, out: wp.array(dtype=float)):
    n = wp.tid()
    out[n] = tolerance(value[n], bound, margin)


@wp.kernel
def cost(action: wp.array3d(dtype=float), out: wp.array(dtype=float)):
    e = wp.tid()
    out[e] = mean_square_action(action, e, 0)


@pytest.mark.parametrize(("bound", "margin"), [(0.0, 1.0), (0.1, 0.5), (2.0, 0.01)])
def test_tolerance_is_dm_controls(device, bound, margin):
    """One within the bound, beyond it ``exp(-(x sqrt(-2 ln 0.1))^2 / 2)`` of the excess over the margin."""
    values = np.array([-5.0, 0.0, bound, bound + 0.3 * margin, bound + margin, bound + 3 * margin], np.float32)
    out = wp.zeros(len(values), dtype=float, device=device)
    wp.launch(shape, len(values), [wp.array(values, device=device), bound, margin, out], device=device)
    excess = np.maximum(values.astype(float) - bound, 0.0) / margin
    expected = np.exp(-0.5 * (excess * np.sqrt(-2.0 * np.log(0.1))) ** 2)
    assert out.numpy() == pytest.approx(expected, rel=1e-3, abs=1e-6)
    assert out.numpy()[4] == pytest.approx(0.1, rel=1e-3)


def test_actions_cost_their_clipped_mean_square(device):
    actions = np.array([[0.0, 0.0, 0.0], [1.0, -1.0, 1.0], [0.5, 9.0, 0.0], [np.nan, 1.0, -np.inf]], np.float32)
    out = wp.zeros(4, dtype=float, device=device)
    wp.launch(cost, 4, [wp.array(actions[:, None], dtype=float, device=device), out], device=device)
    assert out.numpy()[:3] == pytest.approx([0.0, 1.0, 1.25 / 3.0])
    assert np.isfinite(out.numpy()[3]) and 0.0 <= out.numpy()[3] <= 1.0
