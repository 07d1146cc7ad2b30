"""Maximum over threads, raised once a warp on a GPU."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp

from piavatar_envs.envs.observer import raise_peak

wp.set_module_options({"enable_backward": False})

ENVS, AGENTS, PARTS, VALUES = 2, 2, 5, 300


@wp.kernel
def raise_peaks(
    part: wp.array(dtype=int), value: wp.array2d(dtype=float), least: float, peaks: wp.array3d(dtype=float)
):
    e, p = wp.tid()
    if value[e, p] >= least:  # not all threads of a warp take part
        raise_peak(peaks, e, 1, part[p], value[e, p])


@pytest.mark.parametrize("least", [0.0, 0.4])
@pytest.mark.parametrize("mixed", [False, True])
def test_a_peak_is_the_greatest_of_its_part(device, least, mixed):
    """Give parts in runs, so that most warps have one, or mixed, so that none has."""
    rng = np.random.default_rng(3)
    part = np.sort(rng.integers(0, PARTS - 1, VALUES))  # none has the last one
    part = (rng.permutation(part) if mixed else part).astype(np.int32)
    value = rng.uniform(0.0, 1.0, (ENVS, VALUES)).astype(np.float32)
    value[:, ::7] = -0.0  # whose bits are more than any other's
    peaks = np.zeros((ENVS, AGENTS, PARTS), np.float32)
    peaks[1, 1, 0] = 2.0  # more than any
    expected = peaks.copy()
    for env in range(ENVS):
        for of in range(PARTS):
            own = value[env, (part == of) & (value[env] >= least)]
            expected[env, 1, of] = max(expected[env, 1, of], *own, 0.0)
    raised = wp.array(peaks, dtype=float, device=device)
    inputs = [wp.array(part, dtype=int, device=device), wp.array(value, dtype=float, device=device), least]
    wp.launch(raise_peaks, (ENVS, VALUES), inputs=[*inputs, raised], device=device)
    np.testing.assert_array_equal(raised.numpy(), expected)
