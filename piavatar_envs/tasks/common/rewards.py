"""Reward shaping in kernels, and the cost of acting."""

from __future__ import annotations

import warp as wp

from piavatar_envs.envs.task import Term

wp.set_module_options({"enable_backward": False})

_LOG_10 = wp.constant(2.302585093)
#: The term of :func:`mean_square_action`.
CONTROL = Term("control", "`-control_cost` times the mean of the squared action components")


@wp.func
def tolerance(value: float, bound: float, margin: float):
    """Return 1 for ``value <= bound``, then a Gaussian that has fallen to 0.1 at ``bound + margin``.

    The ``tolerance`` of dm_control (Tassa et al., "DeepMind Control Suite", 2018) for one-sided bounds.
    """
    excess = wp.max(value - bound, 0.0) / margin
    return wp.exp(-_LOG_10 * excess * excess)


@wp.func
def mean_square_action(action: wp.array3d(dtype=float), e: int, agent: int):
    """Return the mean of the squared, clipped action components, in [0, 1]."""
    total = float(0.0)
    size = action.shape[2]
    for n in range(size):
        a = wp.clamp(action[e, agent, n], -1.0, 1.0)
        if wp.isfinite(a):
            total += a * a
    return total / float(size)
