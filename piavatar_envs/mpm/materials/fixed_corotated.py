"""Fixed-corotated solid: garment, hair, soft props.

Energy density ``psi = mu |F - R|^2 + lam/2 (J - 1)^2`` with the rotation ``R`` of the polar decomposition ``F = R S``
(Stomakhin et al., "Energetically Consistent Invertible Elasticity", 2012). ``R`` comes from Newton's iteration
(Higham, "Computing the Polar Decomposition", 1986), several times cheaper than a singular value decomposition. The
barrier of :mod:`piavatar_envs.mpm.compression` joins: the energy alone is finite for matter without volume.
"""

from __future__ import annotations

import numpy as np
import warp as wp

from piavatar_envs.mpm.compression import barrier_energy, barrier_stress

wp.set_module_options({"enable_backward": False})

NAME = "fixed_corotated"

#: Most Newton steps. Convergence is quadratic: 3 suffice for stretches near one, 6 for stretches of 1/20 to 20.
_NEWTON_STEPS = wp.constant(8)
#: Squared distance of ``R`` and ``R^-T`` from which one more step reaches single precision.
_CONVERGED = wp.constant(1.0e-6)
_SINGULAR = wp.constant(1.0e-6)


def energy(F: np.ndarray, mu: float, lam: float) -> np.ndarray:
    """Return the energy density [Pa] of deformation gradients ``F``, shape ``(..., 3, 3)``, ``det F > 0``."""
    stretches = np.linalg.svd(F, compute_uv=False)
    J = np.linalg.det(F)
    return mu * ((stretches - 1.0) ** 2).sum(-1) + 0.5 * lam * (J - 1.0) ** 2 + barrier_energy(J, mu, lam)


@wp.func
def polar_rotation(F: wp.mat33):
    """Return the orthogonal factor of ``F = R S`` by scaled Newton iteration; the identity if ``F`` is singular."""
    R = F
    steps = int(_NEWTON_STEPS)  # a variable, to keep the loop: unrolled, it would be most of P2G's code
    for _n in range(steps):
        # the rows of R^-T are cross products of those of R, over the determinant
        yz = wp.cross(R[1], R[2])
        J = wp.dot(R[0], yz)
        if wp.abs(J) < _SINGULAR:
            return wp.mat33(1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
        inverse_transpose = wp.matrix_from_rows(yz, wp.cross(R[2], R[0]), wp.cross(R[0], R[1])) / J
        change = inverse_transpose - R
        if wp.ddot(change, change) < _CONVERGED:
            return R + 0.5 * change
        # Higham's scaling brings the singular values around one before the quadratic phase
        scale = wp.sqrt(wp.sqrt(wp.ddot(inverse_transpose, inverse_transpose) / wp.ddot(R, R)))
        R = 0.5 * (scale * R + inverse_transpose / scale)
    return R


@wp.func
def kirchhoff_stress(F: wp.mat33, mu: float, lam: float):
    """Return the Kirchhoff stress ``tau = (d psi / d F) F^T`` [Pa]."""
    R = polar_rotation(F)
    J = wp.determinant(F)
    pressure = lam * (J - 1.0) * J + barrier_stress(J, mu, lam)
    return 2.0 * mu * ((F - R) * wp.transpose(F)) + wp.diag(wp.vec3(pressure))
