"""Constitutive models: one file a material (energy in NumPy for its test, Kirchhoff stress for the kernels).

To add one: write ``materials/name.py`` with ``energy`` and ``kirchhoff_stress``, add it to :data:`MATERIALS` and to
the dispatch in :func:`kirchhoff_stress`. The tests run over :data:`MATERIALS`.
"""

from __future__ import annotations

from types import ModuleType

import numpy as np
import warp as wp

from piavatar_envs.mpm.materials import fixed_corotated, neo_hookean

wp.set_module_options({"enable_backward": False})

#: Material name -> its module; the position is the integer that particles carry.
MATERIALS: dict[str, ModuleType] = {"neo_hookean": neo_hookean, "fixed_corotated": fixed_corotated}
_FIXED_COROTATED = wp.constant(1)


def material_index(name: str) -> int:
    """Integer of a material.

    Raises:
        ValueError: there is no such material.
    """
    if name not in MATERIALS:
        raise ValueError(f"unknown material {name!r}; use one of {', '.join(MATERIALS)}")
    return list(MATERIALS).index(name)


def lame_parameters(young_modulus, poisson_ratio):
    """Shear modulus and first Lame parameter [Pa] from Young's modulus [Pa] and Poisson's ratio.

    Raises:
        ValueError: Poisson's ratio is not in [0, 0.5), or the modulus is negative.
    """
    young_modulus, poisson_ratio = np.asarray(young_modulus, float), np.asarray(poisson_ratio, float)
    bad = poisson_ratio[~((poisson_ratio >= 0.0) & (poisson_ratio < 0.5))]
    if bad.size:
        raise ValueError(f"poisson_ratio={bad[0]:g} must be in [0, 0.5): at 0.5 the solid is incompressible")
    bad = young_modulus[~(young_modulus >= 0.0)]
    if bad.size:
        raise ValueError(f"young_modulus={bad[0]:g} Pa must not be negative")
    mu = young_modulus / (2.0 * (1.0 + poisson_ratio))
    lam = young_modulus * poisson_ratio / ((1.0 + poisson_ratio) * (1.0 - 2.0 * poisson_ratio))
    return mu, lam


@wp.func
def kirchhoff_stress(material: int, F: wp.mat33, mu: float, lam: float):
    """Kirchhoff stress of a particle of any material [Pa]."""
    if material == _FIXED_COROTATED:
        return fixed_corotated.kirchhoff_stress(F, mu, lam)
    return neo_hookean.kirchhoff_stress(F, mu, lam)


@wp.func
def von_mises_stress(tau: wp.mat33, J: float):
    """Von Mises equivalent of the Cauchy stress ``tau / J`` [Pa]: ``sqrt(3/2) |deviator|``."""
    mean = (tau[0, 0] + tau[1, 1] + tau[2, 2]) / 3.0
    deviator = tau - wp.diag(wp.vec3(mean))
    return wp.sqrt(1.5 * wp.ddot(deviator, deviator)) / wp.max(J, 1.0e-3)
