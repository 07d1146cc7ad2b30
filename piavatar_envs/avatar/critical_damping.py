"""Implicit, critically damped pulls: one formula for shape, tone, root and flesh."""

from __future__ import annotations

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.func
def pull_denominator(rate: float, dt: float):
    """Return ``1 + 2 w dt + w^2 dt^2``, the divisor of backward Euler at natural frequency ``w`` = ``rate`` [1/s]."""
    return 1.0 + 2.0 * rate * dt + rate * rate * dt * dt


@wp.func
def pull_gain(rate: float, dt: float):
    """Return the velocity change per displacement of one implicit step [1/s]."""
    return dt * rate * rate / pull_denominator(rate, dt)


@wp.func
def critical_pull(rate: float, dt: float, error: wp.vec3, v: wp.vec3):
    """Return the acceleration of an implicit critically damped spring of natural frequency ``rate`` [1/s]."""
    return (rate * rate * (error - dt * v) - 2.0 * rate * v) / pull_denominator(rate, dt)


@wp.func
def implicit_velocity(rate: float, dt: float, displacement: wp.vec3, v: wp.vec3):
    """Return the velocity after ``dt`` of an implicit critically damped pull of natural frequency ``rate`` [1/s]."""
    return (1.0 / pull_denominator(rate, dt)) * (v + dt * rate * rate * displacement)
