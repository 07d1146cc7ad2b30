"""Materials: constitutive models, one file each, found by the registry here.

A file of this folder is a material. It defines ``NAME``, ``kirchhoff_stress(F, mu, lam)``, a ``wp.func`` that returns
the Kirchhoff stress [Pa], and ``energy(F, mu, lam)``, the energy density [Pa] in NumPy, of which the stress must be the
derivative, ``tau = (d psi / d F) F^T``. :func:`register_material` adds a material from elsewhere.
"""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

wp.set_module_options({"enable_backward": False})


@dataclass(frozen=True)
class Material:
    """A constitutive model.

    Attributes:
        name: its name in settings.
        kirchhoff_stress: ``wp.func`` of deformation gradient, shear modulus and first Lame parameter [Pa].
        energy: NumPy function of the same arguments, ``F`` of shape ``(..., 3, 3)``, to energy density [Pa].
    """

    name: str
    kirchhoff_stress: Callable[..., Any]
    energy: Callable[[np.ndarray, float, float], np.ndarray]


#: Frequency for which damping ratios are stated [Hz], the lowest at which Klatt et al., "Viscoelasticity-based MR
#: elastography of skeletal muscle", 2010, measured relaxed muscle. A vibration of another frequency is damped in
#: proportion to it.
DAMPING_FREQUENCY = 25.0
#: The usual material, which the dispatch evaluates last.
DEFAULT = "neo_hookean"


def _own_materials() -> dict[str, Material]:
    """Return the materials of this folder by name."""
    modules = [importlib.import_module(f"{__name__}.{found.name}") for found in pkgutil.iter_modules(__path__)]
    return {module.NAME: Material(module.NAME, module.kirchhoff_stress, module.energy) for module in modules}


#: Every material by name; particles carry its position.
MATERIALS: dict[str, Material] = _own_materials()
_OWN = frozenset(MATERIALS)


def _otherwise(stress: Callable[..., wp.mat33]) -> Callable[..., wp.mat33]:
    """Return a dispatch function that evaluates one material for any index."""

    @wp.func(name="kirchhoff_stress_otherwise")
    def otherwise(material: int, F: wp.mat33, mu: float, lam: float):
        return stress(F, mu, lam)

    return otherwise


def _choice(index: int, stress: Callable[..., wp.mat33], others: Callable[..., wp.mat33]) -> Callable[..., wp.mat33]:
    """Return a dispatch function that evaluates the material ``index``, and ``others`` for the rest."""

    @wp.func(name=f"kirchhoff_stress_{index}")
    def choice(material: int, F: wp.mat33, mu: float, lam: float):
        if material == index:
            return stress(F, mu, lam)
        return others(material, F, mu, lam)

    return choice


def _dispatch() -> Callable[..., wp.mat33]:
    """Return the dispatch over all materials."""
    stress = _otherwise(MATERIALS[DEFAULT].kirchhoff_stress)
    for index, (name, material) in enumerate(MATERIALS.items()):
        if name != DEFAULT:
            stress = _choice(index, material.kirchhoff_stress, stress)
    return stress


_chain = _dispatch()


@wp.func
def kirchhoff_stress(material: int, F: wp.mat33, mu: float, lam: float):
    """Return the Kirchhoff stress of a particle of any registered material [Pa]."""
    return _chain(material, F, mu, lam)


def register_material(
    name: str, kirchhoff_stress: Callable[..., Any], energy: Callable[[np.ndarray, float, float], np.ndarray]
) -> None:
    """Make a material available to settings and to :class:`piavatar_envs.mpm.model.MaterialPoints`.

    Worlds that exist already are not affected. Registering a name again replaces the material.

    Args:
        name: its name in settings, a Python identifier.
        kirchhoff_stress: a ``wp.func`` of deformation gradient (``wp.mat33``), shear modulus and first Lame parameter
            [Pa] to the Kirchhoff stress [Pa], ``wp.mat33``.
        energy: the energy density [Pa] in NumPy, of ``F`` of shape ``(..., 3, 3)`` and the same moduli.

    Raises:
        TypeError: the stress is not a ``wp.func``, or the energy not callable.
        ValueError: the name is no identifier, or belongs to a material of this package.
    """
    if not isinstance(kirchhoff_stress, wp.Function) or not callable(energy):
        raise TypeError(f"material {name!r}: kirchhoff_stress must be a wp.func, and energy a function")
    if not name.isidentifier() or name in _OWN:
        raise ValueError(f"material name {name!r}: use an identifier other than {', '.join(sorted(_OWN))}")
    MATERIALS[name] = Material(name, kirchhoff_stress, energy)
    _rebuild()


def _rebuild() -> None:
    """Build the dispatch anew, and have Warp compile the kernels that use it anew."""
    global _chain
    _chain = _dispatch()
    modules, stack = set(), [wp.get_module(__name__)]
    while stack:
        module = stack.pop()
        if module not in modules:
            modules.add(module)
            module.mark_modified()
            stack += module.dependents


def material_index(name: str) -> int:
    """Return the position of a material in :data:`MATERIALS`.

    Raises:
        ValueError: there is no such material.
    """
    return list(MATERIALS).index(check_material(name))


def check_material(name: str) -> str:
    """Return the name of a registered material.

    Raises:
        ValueError: there is no such material.
    """
    if name not in MATERIALS:
        raise ValueError(f"unknown material {name!r}; use one of {', '.join(MATERIALS)}, or register_material")
    return name


def lame_parameters(young_modulus: ArrayLike, poisson_ratio: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
    """Return shear modulus and first Lame parameter [Pa] from Young's modulus [Pa] and Poisson's ratio.

    Raises:
        ValueError: Poisson's ratio is not in [0, 0.5), or the modulus is negative.
    """
    E, nu = np.asarray(young_modulus, float), np.asarray(poisson_ratio, float)
    bad = nu[~((nu >= 0.0) & (nu < 0.5))]
    if bad.size:
        raise ValueError(f"poisson_ratio={bad[0]:g} must be in [0, 0.5): at 0.5 the solid is incompressible")
    bad = E[~(E >= 0.0)]
    if bad.size:
        raise ValueError(f"young_modulus={bad[0]:g} Pa must not be negative")
    mu = E / (2.0 * (1.0 + nu))
    lam = E * nu / ((1.0 + nu) * (1.0 - 2.0 * nu))
    return mu, lam


def retardation_time(
    viscosity: float | np.ndarray, damping_ratio: float | np.ndarray, mu: float | np.ndarray
) -> np.ndarray:
    """Return the retardation time of a Kelvin-Voigt solid [s], the sum of what two settings give it.

    Args:
        viscosity: of shear [Pa s].
        damping_ratio: damping over critical damping of a vibration at :data:`DAMPING_FREQUENCY`.
        mu: shear modulus [Pa].
    """
    return np.asarray(viscosity / mu + damping_ratio / (np.pi * DAMPING_FREQUENCY))


@wp.func
def viscous_stress(C: wp.mat33, J: float, mu: float, lam: float, retardation: float):
    """Return the viscous Kirchhoff stress of a Kelvin-Voigt solid [Pa].

    It is ``J t (2 mu D + lam tr(D) I)`` with the rate of strain ``D``, the symmetric part of the velocity gradient
    ``C``, and the retardation time ``t`` [s] (Landau & Lifshitz, "Theory of Elasticity", 1986, section 34). A rotation
    has no rate of strain, so it is not damped.
    """
    D = 0.5 * (C + wp.transpose(C))
    return (J * retardation) * (2.0 * mu * D + wp.diag(wp.vec3(lam * wp.trace(D))))


@wp.func
def von_mises_stress(tau: wp.mat33, J: float):
    """Return the von Mises equivalent of the Cauchy stress ``tau / J`` [Pa]: ``sqrt(3/2) |deviator|``."""
    mean = (tau[0, 0] + tau[1, 1] + tau[2, 2]) / 3.0
    deviator = tau - wp.diag(wp.vec3(mean))
    return wp.sqrt(1.5 * wp.ddot(deviator, deviator)) / wp.max(J, 1.0e-3)
