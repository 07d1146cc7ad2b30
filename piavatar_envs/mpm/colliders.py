"""Analytic boundaries with Coulomb friction.

A boundary acts on a node only if the mass-weighted position of the particles there is within ``CONTACT_GATE`` of the
surface: without this gate a foot is held while it is still a grid cell away, and sticks when it leaves.
"""

from __future__ import annotations

import warp as wp

from piavatar_envs.mpm.types import Boundaries

wp.set_module_options({"enable_backward": False})

#: Gap at which contact begins, in grid spacings.
CONTACT_GATE = wp.constant(0.5)
#: Particles closer than this [grid spacings] keep track of their position on the grid, for the gate.
NEAR_PARTICLE = wp.constant(2.5)
#: Slabs of nodes closer than this may hold such a position: NEAR_PARTICLE, a stencil and a slab's half diagonal.
NEAR_SLAB = wp.constant(7.5)


@wp.func
def plane_distance(plane: wp.vec4, x: wp.vec3):
    """Signed distance of ``x`` from a plane, positive outside the solid [m]."""
    return plane[0] * x[0] + plane[1] * x[1] + plane[2] * x[2] - plane[3]


@wp.func
def nearest_boundary(boundaries: Boundaries, x: wp.vec3):
    """Smallest signed distance of ``x`` from any boundary [m]; large if there is none."""
    distance = float(1.0e6)
    for b in range(boundaries.count):
        distance = wp.min(distance, plane_distance(boundaries.plane[b], x))
    return distance


@wp.func
def slide(v: wp.vec3, normal: wp.vec3, friction: float):
    """Velocity after contact with a resting surface: no approach, friction at most ``friction`` times the normal."""
    vn = wp.dot(v, normal)
    if vn >= 0.0:
        return v
    vt = v - vn * normal
    speed = wp.length(vt)
    if speed <= -friction * vn:
        return wp.vec3(0.0)
    return vt * (1.0 + friction * vn / speed)


@wp.func
def boundary_contact(boundaries: Boundaries, x: wp.vec3, v: wp.vec3, gate: float):
    """Velocity of a node whose matter is at ``x`` after contact with every boundary closer than ``gate`` [m]."""
    for b in range(boundaries.count):
        plane = boundaries.plane[b]
        if plane_distance(plane, x) < gate:
            v = slide(v, wp.vec3(plane[0], plane[1], plane[2]), boundaries.friction[b])
    return v


@wp.func
def remove_approach(boundaries: Boundaries, x: wp.vec3, v: wp.vec3, gate: float):
    """``v`` without its component into any boundary closer than ``gate`` [m], and without friction."""
    for b in range(boundaries.count):
        plane = boundaries.plane[b]
        if plane_distance(plane, x) < gate:
            normal = wp.vec3(plane[0], plane[1], plane[2])
            v = v - wp.min(wp.dot(v, normal), 0.0) * normal
    return v
