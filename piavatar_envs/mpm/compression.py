"""Resistance of matter to compression beyond elasticity: a barrier at small volumes, and viscosity in shocks.

The barrier ``K/2 (l(J) - log J_STIFF)^2`` joins the energy density below a volume ratio of ``J_STIFF``, with ``l = log
J`` and ``K = STIFFENING (lam + 2 mu)``: without it, hard impacts squeeze matter to nothing. Elastic waves stay slow
enough for the time step. Below ``J_MIN`` the logarithm goes on along its tangent, so that energy and stress stay finite
and consistent for squashed and inverted matter.

An impact faster than elastic waves makes a shock, behind which a scheme without viscosity oscillates and squeezes
matter far beyond the state that the shock's jump conditions give. The artificial viscosity of von Neumann & Richtmyer,
"A Method for the Numerical Calculation of Hydrodynamic Shocks" (1950), spreads a shock over some grid spacings. It is a
pressure that acts in compression only, of rate ``r = -tr(D)``, quadratic in the jump of velocity over a grid spacing
(coefficient as in Wilkins, "Use of Artificial Viscosity in Multidimensional Fluid Dynamic Calculations", 1980)::

    q = rho min(SHOCK dx^2 r, nu) max(r - SMOOTH c / dx, 0)

A plane wave that squeezes matter to ``J_STIFF`` moves it at ``(1 - J_STIFF) c``. ``SMOOTH c`` is its jump where it
rises over two grid spacings, so waves that the grid resolves and that stay clear of the barrier are not damped. ``nu``
is the kinematic viscosity at which the fastest mode of the grid, that of ``CFL_STABLE``, is still stable
(:meth:`~piavatar_envs.mpm.model.MaterialPoints.limiting_speed`), less that of the material. A stress keeps momentum,
and this one only takes energy.
"""

from __future__ import annotations

import math

import numpy as np
import warp as wp

from piavatar_envs.mpm.types import CFL_STABLE

wp.set_module_options({"enable_backward": False})

#: Volume ratio below which logarithms are continued linearly.
J_MIN = 0.05
#: Volume ratio below which the barrier acts, and its modulus in units of that of the elastic wave at rest.
J_STIFF, STIFFENING = 0.6, 1.5
_J_MIN, _J_STIFF, _STIFFENING = wp.constant(J_MIN), wp.constant(J_STIFF), wp.constant(STIFFENING)
_LOG_STIFF = wp.constant(math.log(J_STIFF))
#: Coefficient of the viscosity in shocks, and the least jump of velocity over a grid spacing, over the wave speed.
SHOCK, SMOOTH = wp.constant(4.0), wp.constant((1.0 - J_STIFF) / 2.0)
_CFL_STABLE = wp.constant(CFL_STABLE)


def log_volume(J: np.ndarray) -> np.ndarray:
    """Return the logarithm of volume ratios, continued linearly below :data:`J_MIN`."""
    return np.where(J > J_MIN, np.log(np.maximum(J, J_MIN)), np.log(J_MIN) + J / J_MIN - 1.0)


def barrier_energy(J: np.ndarray, mu: float, lam: float) -> np.ndarray:
    """Return the energy density of the barrier [Pa] at volume ratios ``J``."""
    return 0.5 * STIFFENING * (lam + 2.0 * mu) * np.minimum(log_volume(J) - np.log(J_STIFF), 0.0) ** 2


@wp.func
def barrier_stress(J: float, mu: float, lam: float):
    """Return the Kirchhoff stress of the barrier [Pa], times the identity; never positive."""
    if J >= _J_STIFF:
        return float(0.0)
    Jc = wp.max(J, _J_MIN)
    ratio = J / Jc  # one where the logarithm holds
    return _STIFFENING * (lam + 2.0 * mu) * (wp.log(Jc) + ratio - 1.0 - _LOG_STIFF) * ratio


@wp.func
def shock_pressure(rate: float, density: float, modulus: float, retardation: float, dx: float, dt: float):
    """Return the Kirchhoff pressure of the artificial viscosity [Pa].

    Args:
        rate: of compression, less the trace of the velocity gradient [1/s].
        density: of the matter at rest [kg/m^3]; the volume ratio cancels in a Kirchhoff stress.
        modulus: of the fastest elastic wave at rest, ``lam + 2 mu`` [Pa].
        retardation: time of the material's own viscosity [s].
        dx: grid spacing [m].
        dt: time step [s].
    """
    c_squared = modulus / density
    jump = dx * rate
    if jump <= 0.0 or jump * jump <= SMOOTH * SMOOTH * c_squared:
        return float(0.0)
    stable = 0.5 * (_CFL_STABLE * _CFL_STABLE * dx / dt - c_squared * dt / dx) - c_squared * retardation / dx
    return density * wp.min(SHOCK * jump, wp.max(stable, 0.0)) * (jump - SMOOTH * wp.sqrt(c_squared))
