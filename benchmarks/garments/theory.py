"""Textbook solutions for cloth: hanging, swinging, bending, sliding and falling."""

from __future__ import annotations

import numpy as np
from scipy.optimize import brentq
from scipy.special import j0, jn_zeros


def hanging_stretch(areal_density: float, stretch: float, length: float, gravity: float = 9.81) -> float:
    """Return how much longer a sheet is that hangs by its upper border, relative to its length.

    The tension at a distance ``s`` from the lower border is ``sigma g s``; the mean of ``sigma g s / (E h)``.

    Args:
        areal_density: sigma [kg/m^2].
        stretch: membrane stiffness E h [N/m].
        length: [m].
        gravity: [m/s^2].
    """
    return areal_density * gravity * length / (2.0 * stretch)


def swing_frequency(mode: int, length: float, gravity: float = 9.81) -> float:
    """Return the angular frequency [1/s] of small swings of a hanging sheet, or chain, in its n-th mode.

    D. Bernoulli, 1733: ``j / 2 sqrt(g / L)`` with the n-th zero ``j`` of the Bessel function ``J_0``.

    Args:
        mode: from 1 on.
        length: [m].
        gravity: [m/s^2].
    """
    return 0.5 * float(jn_zeros(0, mode)[-1]) * np.sqrt(gravity / length)


def swing_shape(mode: int, length: float, height: np.ndarray) -> np.ndarray:
    """Return the shape of a swing, 1 at the lower border.

    Args:
        mode: from 1 on.
        length: [m].
        height: above the lower border [m].
    """
    return j0(float(jn_zeros(0, mode)[-1]) * np.sqrt(np.clip(height / length, 0.0, 1.0)))


def bending_stiffness(areal_density: float, bending_length: float, gravity: float = 9.81) -> float:
    """Return the bending stiffness D [N m] of cloth of a bending length ``c`` [m]: ``sigma g c^3`` (Peirce, 1930)."""
    return areal_density * gravity * bending_length**3


def peirce_angle(overhang: float, bending_length: float) -> float:
    """Return the angle below the horizontal [rad] of the chord of a strip that overhangs an edge.

    ``c = L (cos(a / 2) / (8 tan a))^(1/3)`` (F. T. Peirce, "The 'handle' of cloth as a measurable quantity", J. Text.
    Inst. 21, 1930, T377-T416).

    Args:
        overhang: length L [m].
        bending_length: c [m].
    """

    def miss(angle: float) -> float:
        return np.cbrt(np.cos(0.5 * angle) / (8.0 * np.tan(angle))) - bending_length / overhang

    return float(brentq(miss, 1e-6, 0.5 * np.pi - 1e-6))


def implicit_spin(omega: float, time: float, step: float) -> float:
    """Return what implicit Euler steps have left of the angular velocity [1/s] of a stiff free body after a time [s].

    Constraints that hold at the end of a step turn it by ``tan b = sin a / (2 - cos a)`` after a step that turned it by
    ``a``, hence ``b = a - a^3`` for small angles, and ``d omega / dt = -step omega^3``.

    Args:
        omega: at first [1/s].
        time: [s].
        step: [s].
    """
    return float(omega / np.sqrt(1.0 + 2.0 * step * omega**2 * time))


def sliding_acceleration(angle: float, friction: float, gravity: float = 9.81) -> float:
    """Return the acceleration [m/s^2] of what slides down an incline of an angle [rad]; 0 below the friction angle."""
    return max(0.0, gravity * (np.sin(angle) - friction * np.cos(angle)))


def terminal_speed(areal_density: float, drag: float, gravity: float = 9.81) -> float:
    """Return the speed [m/s] at which drag ``drag v^2`` [N/m^2] bears the weight of a level sheet."""
    return float(np.sqrt(areal_density * gravity / drag))


def falling_speed(time: np.ndarray | float, areal_density: float, drag: float, gravity: float = 9.81) -> np.ndarray:
    """Return the speed [m/s] of a level sheet that has fallen from rest for a time [s] against ``drag v^2`` [N/m^2]."""
    most = terminal_speed(areal_density, drag, gravity)
    return most * np.tanh(gravity * np.asarray(time) / most)


def slowed_speed(speed: float, time: np.ndarray | float, areal_density: float, drag: float) -> np.ndarray:
    """Return the speed [m/s] that drag ``drag v^2`` [N/m^2] alone has left of ``speed`` after a time [s]."""
    return speed / (1.0 + drag / areal_density * speed * np.asarray(time))
