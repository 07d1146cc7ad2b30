"""Textbook solutions for elastic bodies: bars, beams, and impacts of balls."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.integrate import solve_ivp


def bar_frequency(length: float, side: float, young_modulus: float, poisson_ratio: float, density: float) -> float:
    """Return the first longitudinal frequency of a free square bar [Hz].

    ``c / (2 L)`` with ``c = sqrt(E / rho)``, Rayleigh's correction for the inertia of the sides' Poisson motion
    included: ``1 - (nu pi r / L)^2 / 2`` with the polar radius of gyration ``r^2 = side^2 / 6`` (Graff, "Wave Motion in
    Elastic Solids", 1975, sec. 2.5).
    """
    plain = np.sqrt(young_modulus / density) / (2.0 * length)
    return plain * (1.0 - 0.5 * (poisson_ratio * np.pi / length) ** 2 * side**2 / 6.0)


def beam_deflection(
    x: np.ndarray, acceleration: np.ndarray, side: float, young_modulus: float, density: float
) -> np.ndarray:
    """Return the sag [m] of one half of a free square beam against its middle, at ``x`` [m] from there.

    From Timoshenko's equations, ``V' = q``, ``M' = V``, ``y' = integral of M / EI - V / (k G A)`` with ``k = 5/6`` and
    no Poisson effect (Timoshenko & Gere, "Mechanics of Materials", 1972, ch. 6 and 12).

    Args:
        x: evenly spaced, shape ``(n,)``.
        acceleration: of the load there [m/s^2], shape ``(n,)``; it holds itself in balance.
        side: of the section [m].
        young_modulus: [Pa].
        density: [kg/m^3].
    """
    dx, area, inertia = x[1] - x[0], side**2, side**4 / 12.0
    load = density * area * acceleration
    shear = -np.cumsum(load[::-1])[::-1] * dx  # both vanish at the free end
    moment = -np.cumsum(shear[::-1])[::-1] * dx
    slope = np.cumsum(moment / (young_modulus * inertia)) * dx - shear / (5.0 / 6.0 * 0.5 * young_modulus * area)
    return np.cumsum(slope) * dx


@dataclass(frozen=True)
class BarImpact:
    """A bar that meets a rigid wall, or its own mirror image, end on.

    A wave of stress ``rho c v`` runs to the free end and back; then the bar leaves as fast as it came (de Saint-Venant;
    Johnson, "Contact Mechanics", 1985, sec. 11.1). Exact for Poisson's ratio 0 and small speeds.

    Attributes:
        length: [m].
        area: of its section [m^2].
        density: [kg/m^3].
        young_modulus: [Pa].
        speed: before [m/s].
    """

    length: float
    area: float
    density: float
    young_modulus: float
    speed: float

    @property
    def wave_speed(self) -> float:
        """Return ``c`` [m/s]."""
        return float(np.sqrt(self.young_modulus / self.density))

    @property
    def mass(self) -> float:
        """Return the mass [kg]."""
        return self.density * self.area * self.length

    @property
    def force(self) -> float:
        """Return the force during contact [N]."""
        return self.density * self.wave_speed * self.speed * self.area

    @property
    def duration(self) -> float:
        """Return the duration of contact [s]."""
        return 2.0 * self.length / self.wave_speed

    @property
    def history(self) -> tuple[np.ndarray, np.ndarray]:
        """Return times from the first contact on [s], and the force of the wall [N]."""
        return np.array([0.0, 0.0, 1.0, 1.0]) * self.duration, np.array([0.0, 1.0, 1.0, 0.0]) * self.force

    @property
    def reversal_time(self) -> float:
        """Return the time of reversal, as for :class:`HertzImpact` [s]."""
        return 0.5 * self.duration


@dataclass(frozen=True)
class HertzImpact:
    """A ball that meets a rigid plane head-on and without friction, or its own mirror image.

    Hertz: ``m d'' = -k d^(3/2)`` with ``k = 4/3 E* sqrt(R)`` and ``E* = E / (1 - nu^2)``, for depths ``d`` that are
    small beside the radius and speeds that are small beside those of waves (Johnson, "Contact Mechanics", 1985, sec.
    4.2 and 11.4).

    Attributes:
        radius: [m].
        mass: [kg].
        young_modulus: [Pa].
        poisson_ratio: [-].
        speed: of the ball before [m/s].
    """

    radius: float
    mass: float
    young_modulus: float
    poisson_ratio: float
    speed: float

    @property
    def stiffness(self) -> float:
        """Return ``k`` [N/m^1.5]."""
        return 4.0 / 3.0 * self.young_modulus / (1.0 - self.poisson_ratio**2) * np.sqrt(self.radius)

    @property
    def depth(self) -> float:
        """Return the greatest depth [m], where ``2/5 k d^(5/2)`` is the kinetic energy."""
        return (1.25 * self.mass * self.speed**2 / self.stiffness) ** 0.4

    @property
    def contact_radius(self) -> float:
        """Return the radius of the disc of contact at the greatest depth [m]."""
        return np.sqrt(self.radius * self.depth)

    @property
    def force(self) -> float:
        """Return the greatest force [N]."""
        return self.stiffness * self.depth**1.5

    @property
    def duration(self) -> float:
        """Return the duration of contact [s]: ``2 d/v`` times 1.4716, the integral of ``(1 - s^(5/2))^(-1/2)``."""
        return 2.9432 * self.depth / self.speed

    @cached_property
    def history(self) -> tuple[np.ndarray, np.ndarray]:
        """Return times from the first contact on [s], and the force of the plane [N]."""
        times = np.linspace(0.0, self.duration, 1001)
        moved = solve_ivp(
            lambda _t, y: [y[1], -self.stiffness / self.mass * max(y[0], 0.0) ** 1.5],
            (0.0, self.duration),
            [0.0, self.speed],
            t_eval=times,
            rtol=1e-8,
            atol=1e-12,
        )
        return times, self.stiffness * np.maximum(moved.y[0], 0.0) ** 1.5

    @property
    def reversal_time(self) -> float:
        """Return the time from half of the initial velocity to half of it backwards [s]."""
        times, force = self.history
        velocity = np.concatenate([[0.0], np.cumsum(0.5 * (force[1:] + force[:-1]) * np.diff(times))]) / self.mass
        return float(np.diff(np.interp([0.5 * self.speed, 1.5 * self.speed], velocity, times))[0])
