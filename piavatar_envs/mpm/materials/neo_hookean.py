"""Compressible Neo-Hookean solid: flesh, rubber.

Energy density ``psi = mu/2 (|F|^2 - 3) - mu l(J) + lam/2 l(J)^2`` with ``l = log J`` (Bonet & Wood, "Nonlinear
Continuum Mechanics for Finite Element Analysis", 2008, eq. 6.27), and the barrier of
:mod:`piavatar_envs.mpm.compression`, which continues the logarithm below ``J_MIN``.
"""

from __future__ import annotations

import numpy as np
import warp as wp

from piavatar_envs.mpm.compression import J_MIN, barrier_energy, barrier_stress, log_volume

wp.set_module_options({"enable_backward": False})

NAME = "neo_hookean"

_J_MIN = wp.constant(J_MIN)


def energy(F: np.ndarray, mu: float, lam: float) -> np.ndarray:
    """Return the energy density [Pa] of deformation gradients ``F``, shape ``(..., 3, 3)``."""
    J = np.linalg.det(F)
    log_j = log_volume(J)
    elastic = 0.5 * mu * ((F**2).sum((-1, -2)) - 3.0) - mu * log_j + 0.5 * lam * log_j**2
    return elastic + barrier_energy(J, mu, lam)


@wp.func
def kirchhoff_stress(F: wp.mat33, mu: float, lam: float):
    """Return the Kirchhoff stress ``tau = (d psi / d F) F^T`` [Pa]."""
    J = wp.determinant(F)
    Jc = wp.max(J, _J_MIN)
    ratio = J / Jc  # one where the logarithm holds
    log_j = wp.log(Jc) + ratio - 1.0
    pressure = (lam * log_j - mu) * ratio + barrier_stress(J, mu, lam)
    return mu * (F * wp.transpose(F)) + wp.diag(wp.vec3(pressure))
