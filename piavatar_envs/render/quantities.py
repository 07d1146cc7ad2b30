"""Quantities that colour bodies in pictures: measures of the deformation gradient, and contact impulses.

Each is a number of every particle, which skins and splats interpolate with the weights by which particles move them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from piavatar_envs.core.arrays import matrices_of

if TYPE_CHECKING:
    from piavatar_envs.sim.world import Simulation


@dataclass(frozen=True)
class Quantity:
    """Colour scale of a quantity: its title with the unit, and the value of the last colour; the first is zero."""

    label: str
    maximum: float


QUANTITIES = {
    "strain": Quantity("max |stretch - 1|", 0.3),
    "distortion": Quantity("|F - R|", 0.4),
    "impulse": Quantity("impulse on body part [N s]", 5.0),
}


def principal_stretches(deformation_gradient: ArrayLike) -> np.ndarray:
    """Return the singular values of ``F``, ascending; the smallest is negative where ``F`` is inverted.

    Args:
        deformation_gradient: ``F`` of each particle, shape ``(P, 3, 3)``.

    Returns:
        Shape ``(P, 3)``; infinity where ``F`` is not finite.
    """
    gradient = np.asarray(deformation_gradient, dtype=np.float64)
    finite = np.isfinite(gradient).all(axis=(-2, -1))
    safe = np.where(finite[..., None, None], gradient, np.eye(3))
    squared = np.linalg.eigvalsh(np.swapaxes(safe, -2, -1) @ safe)
    stretches = np.sqrt(np.maximum(squared, 0.0))
    stretches[..., 0] *= np.where(np.linalg.det(safe) < 0.0, -1.0, 1.0)
    return np.where(finite[..., None], stretches, np.inf)


def strain_magnitude(deformation_gradient: ArrayLike) -> np.ndarray:
    """Return the largest departure of a principal stretch from one: ``max_i |s_i - 1|``, zero for any rotation.

    Args:
        deformation_gradient: ``F`` of each particle, shape ``(P, 3, 3)``.

    Returns:
        Strain [1], shape ``(P,)``; infinity where ``F`` is not finite.
    """
    return np.abs(principal_stretches(deformation_gradient) - 1.0).max(axis=-1)


def distortion(deformation_gradient: ArrayLike) -> np.ndarray:
    """Return ``|F - R|``, the Frobenius norm, with the rotation ``R`` of the polar decomposition ``F = R S``.

    It is the root of the sum of ``(s_i - 1)^2`` over the principal stretches, and the strain in the energy of fixed
    corotated elasticity (Stomakhin et al., "Energetically consistent invertible elasticity", 2012, eq. 8).

    Args:
        deformation_gradient: ``F`` of each particle, shape ``(P, 3, 3)``.

    Returns:
        Distortion [1], shape ``(P,)``; infinity where ``F`` is not finite.
    """
    return np.linalg.norm(principal_stretches(deformation_gradient) - 1.0, axis=-1)


def of_particles(simulation: Simulation, env: int, own: slice, name: str) -> np.ndarray:
    """Return one of :data:`QUANTITIES` of some particles in environment ``env`` now, shape ``(P,)``.

    The impulse is that of all other bodies, in the last control step, on the body part that a particle is in. Only
    avatars have parts.
    """
    if name == "impulse":
        impulse = np.linalg.norm(simulation.sensors.part_impulse.numpy()[env].sum(axis=1), axis=-1)
        return impulse[simulation.model.particles.sensor.numpy()[own]]
    gradient = matrices_of(simulation.state.F.numpy()[env])[own]
    return {"strain": strain_magnitude, "distortion": distortion}[name](gradient)
