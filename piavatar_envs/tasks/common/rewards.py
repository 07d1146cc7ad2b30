"""Reward shaping in kernels."""

from __future__ import annotations

import warp as wp

wp.set_module_options({"enable_backward": False})

_LOG_10 = wp.constant(2.302585093)


@wp.func
def tolerance(value: float, bound: float, margin: float):
    """1 for ``value <= bound``, then falling as a Gaussian to 0.1 at ``bound + margin``.

    The ``tolerance`` of dm_control (Tassa et al., "DeepMind Control Suite", 2018) for one-sided bounds.
    """
    excess = wp.max(value - bound, 0.0) / margin
    return wp.exp(-_LOG_10 * excess * excess)


@wp.func
def mean_square_action(action: wp.array3d(dtype=float), e: int, agent: int):
    """Mean of the squared, clipped action components: the control cost, in [0, 1]."""
    total = float(0.0)
    size = action.shape[2]
    for n in range(size):
        a = wp.clamp(action[e, agent, n], -1.0, 1.0)
        if wp.isfinite(a):
            total += a * a
    return total / float(size)
