"""Rotations in kernels: exponential, logarithm, heading. Quaternions are Warp's ``xyzw`` here, ``wxyz`` elsewhere."""

from __future__ import annotations

import warp as wp

wp.set_module_options({"enable_backward": False})

#: Largest rotation of a joint from its rest pose [rad]. Rotation vectors jump at pi, which a joint must not reach.
MAX_ANGLE = wp.constant(2.6)


@wp.func
def quat_exp(v: wp.vec3):
    """Return the quaternion of the rotation vector ``v`` [rad]."""
    half = 0.5 * wp.length(v)
    # sin(h)/h by its series where the quotient loses digits
    s = 0.5 * (1.0 - half * half / 6.0)
    if half > 1.0e-2:
        s = 0.5 * wp.sin(half) / half
    return wp.normalize(wp.quat(v[0] * s, v[1] * s, v[2] * s, wp.cos(half)))


@wp.func
def quat_log(q: wp.quat):
    """Return the rotation vector along the shorter arc, of length at most pi [rad]."""
    v = wp.vec3(q[0], q[1], q[2])
    w = q[3]
    if w < 0.0:
        v = -v
        w = -w
    n = wp.length(v)
    if n < 1.0e-6:
        return 2.0 * v
    return (2.0 * wp.atan2(n, w) / n) * v


@wp.func
def finite_turn(w: wp.vec3, dt: float):
    """Return ``(R - I) / dt`` of the rotation ``R = exp(dt w)``, without cancellation [1/s]."""
    half = 0.5 * dt * wp.length(w)
    s = 1.0 - half * half / 6.0
    if half > 1.0e-2:
        s = wp.sin(half) / half
    c = wp.cos(half)
    X = wp.skew(w)
    return (s * c) * X + (0.5 * dt * s * s) * (X * X)


@wp.func
def short_of_pi(v: wp.vec3):
    """Return the rotation vector ``v``, its angle limited to ``MAX_ANGLE`` [rad]."""
    return v * wp.min(1.0, MAX_ANGLE / wp.max(wp.length(v), 1.0e-6))


@wp.func
def torques_of_vector(v: wp.vec3):
    """Return ``J_l(v)^-T``: its columns are the torques that do the work of unit pulls on a rotation vector ``v``.

    A rotation by ``dt w``, after that of ``v``, changes ``v`` by ``dt J_l(v)^-1 w``, with the left Jacobian of SO(3)
    (Barfoot, "State Estimation for Robotics", 2017, section 7.1). Along ``v`` both are the same.
    """
    half = 0.5 * wp.length(v)
    c = 1.0 / 12.0 + half * half / 180.0
    if half > 0.05:
        c = (1.0 - half * wp.cos(half) / wp.sin(half)) / (4.0 * half * half)
    X = wp.skew(v)
    return wp.identity(n=3, dtype=float) + 0.5 * X + c * (X * X)


@wp.func
def turn_about_z(q: wp.quat):
    """Return the part of ``q`` that turns about the vertical (its twist); the identity where that is undefined."""
    n = wp.sqrt(q[2] * q[2] + q[3] * q[3])
    if n < 1.0e-4:
        return wp.quat(0.0, 0.0, 0.0, 1.0)
    return wp.quat(0.0, 0.0, q[2] / n, q[3] / n)


@wp.func
def rigid_matrix(q: wp.quat, pivot: wp.vec3, image: wp.vec3):
    """Return the homogeneous matrix of ``x -> q (x - pivot) + image``."""
    R = wp.quat_to_matrix(q)
    t = image - R * pivot
    # fmt: off
    return wp.mat44(
        R[0, 0], R[0, 1], R[0, 2], t[0],
        R[1, 0], R[1, 1], R[1, 2], t[1],
        R[2, 0], R[2, 1], R[2, 2], t[2],
        0.0, 0.0, 0.0, 1.0,
    )
