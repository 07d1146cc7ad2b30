"""Compressible Neo-Hookean solid: flesh, rubber.

Energy density ``psi = mu/2 (|F|^2 - 3) - mu l(J) + lam/2 l(J)^2`` with ``l = log J`` (Bonet & Wood, "Nonlinear
Continuum Mechanics for Finite Element Analysis", 2008, eq. 6.27). Below a volume ratio of ``J_STIFF`` a barrier
``K/2 (l - log J_STIFF)^2`` joins, with ``K = STIFFENING (lam + 2 mu)``: without it, hard impacts squeeze matter to
nothing. Elastic waves stay slow enough for the time step. Below ``J_MIN`` the logarithm goes on along its tangent, so
that energy and stress stay finite and consistent for squashed and inverted matter.
"""

from __future__ import annotations

import math

import numpy as np
import warp as wp

wp.set_module_options({"enable_backward": False})

NAME = "neo_hookean"

#: Volume ratio below which the logarithm is continued linearly.
J_MIN = 0.05
#: Volume ratio below which the barrier acts, and its modulus in units of that of the elastic wave at rest.
J_STIFF, STIFFENING = 0.6, 1.5
_J_MIN = wp.constant(J_MIN)
_LOG_STIFF = wp.constant(math.log(J_STIFF))
_STIFFENING = wp.constant(STIFFENING)


def energy(F: np.ndarray, mu: float, lam: float) -> np.ndarray:
    """Return the energy density [Pa] of deformation gradients ``F``, shape ``(..., 3, 3)``."""
    J = np.linalg.det(F)
    log_j = np.where(J > J_MIN, np.log(np.maximum(J, J_MIN)), np.log(J_MIN) + J / J_MIN - 1.0)
    barrier = STIFFENING * (lam + 2.0 * mu) * np.minimum(log_j - np.log(J_STIFF), 0.0) ** 2
    return 0.5 * mu * ((F**2).sum((-1, -2)) - 3.0) - mu * log_j + 0.5 * lam * log_j**2 + 0.5 * barrier


@wp.func
def kirchhoff_stress(F: wp.mat33, mu: float, lam: float):
    """Return the Kirchhoff stress ``tau = (d psi / d F) F^T`` [Pa]."""
    J = wp.determinant(F)
    Jc = wp.max(J, _J_MIN)
    ratio = J / Jc  # one where the logarithm holds
    log_j = wp.log(Jc) + ratio - 1.0
    barrier = _STIFFENING * (lam + 2.0 * mu) * wp.min(log_j - _LOG_STIFF, 0.0)
    pressure = (lam * log_j - mu + barrier) * ratio
    return mu * (F * wp.transpose(F)) + wp.diag(wp.vec3(pressure))
