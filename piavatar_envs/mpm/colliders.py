"""Analytic boundaries, resting or moving as told, with Coulomb friction.

A boundary acts on a node only if the mass-weighted position of the particles there is within ``CONTACT_GATE`` of the
surface: without this gate a foot is held while it is still a grid cell away, and sticks when it leaves.

Kinds, each in a frame of its own:

======== =================================================== ===================================
kind     solid                                               size [m]
======== =================================================== ===================================
plane    all below the plane ``z = 0``                       unused
sphere   about the origin                                    radius
box      about the origin, along the axes                    half extents along x, y, z
capsule  about a segment of the z axis around the origin     radius, half length of the segment
======== =================================================== ===================================
"""

from __future__ import annotations

import warp as wp

from piavatar_envs.mpm.types import Boundaries, row

wp.set_module_options({"enable_backward": False})

PLANE = wp.constant(0)
SPHERE = wp.constant(1)
BOX = wp.constant(2)
CAPSULE = wp.constant(3)
COLLIDER_KINDS: dict[str, int] = {"plane": 0, "sphere": 1, "box": 2, "capsule": 3}

#: Gap at which contact begins, in grid spacings.
CONTACT_GATE = wp.constant(0.5)
#: Particles closer than this [grid spacings] tell the nodes where they are, for the gate, and how they are driven: the
#: gate and two stencils, so that of level surfaces all do whose nodes may be in contact.
NEAR_PARTICLE = wp.constant(3.5)
#: Blocks of nodes whose middle is closer may be the base of such a particle: NEAR_PARTICLE, and half a diagonal.
NEAR_BLOCK = wp.constant(7.0)
#: Slabs of nodes closer than this may hold matter within the gate: CONTACT_GATE, half a stencil's and half a slab's
#: diagonal.
GATED_SLAB = wp.constant(5.3)
#: Particles closer than this may have a node with matter within the gate: CONTACT_GATE, and a stencil's diagonal.
GATED_STENCIL = wp.constant(5.7)

#: A direction shorter than this [m] is round-off, and another is taken for it.
_NO_LENGTH = wp.constant(1.0e-9)


@wp.func
def _box_distance(half: wp.vec3, p: wp.vec3):
    """Normal and signed distance of ``p`` from a box: outside to its nearest point, inside to its nearest face."""
    beyond = wp.vec3(wp.abs(p[0]) - half[0], wp.abs(p[1]) - half[1], wp.abs(p[2]) - half[2])
    away = wp.max(beyond, wp.vec3(0.0))
    distance = wp.length(away)
    if distance > _NO_LENGTH:
        n = wp.cw_mul(away, wp.vec3(wp.sign(p[0]), wp.sign(p[1]), wp.sign(p[2]))) / distance
        return wp.vec4(n[0], n[1], n[2], distance)
    if beyond[0] >= wp.max(beyond[1], beyond[2]):
        return wp.vec4(wp.sign(p[0]), 0.0, 0.0, beyond[0])
    if beyond[1] >= beyond[2]:
        return wp.vec4(0.0, wp.sign(p[1]), 0.0, beyond[1])
    return wp.vec4(0.0, 0.0, wp.sign(p[2]), beyond[2])


@wp.func
def _round_distance(radius: float, half_length: float, p: wp.vec3):
    """Normal and signed distance of ``p`` from a capsule; a sphere is one without length."""
    away = p - wp.vec3(0.0, 0.0, wp.clamp(p[2], -half_length, half_length))
    distance = wp.length(away)
    n = wp.vec3(1.0, 0.0, 0.0)  # on the axis every direction across it leads out
    if distance > _NO_LENGTH:
        n = away / distance
    return wp.vec4(n[0], n[1], n[2], distance - radius)


@wp.func
def solid_distance(kind: int, size: wp.vec3, p: wp.vec3):
    """Outward unit normal and signed distance [m] of ``p`` from a solid, both in the solid's own frame."""
    if kind == SPHERE:
        return _round_distance(size[0], 0.0, p)
    if kind == BOX:
        return _box_distance(size, p)
    if kind == CAPSULE:
        return _round_distance(size[0], size[1], p)
    return wp.vec4(0.0, 0.0, 1.0, p[2])


@wp.func
def signed_distance(boundaries: Boundaries, e: int, b: int, x: wp.vec3):
    """Outward unit normal and signed distance [m] of ``x`` from a boundary, positive outside the solid."""
    r = row(e, boundaries.position.shape[0])
    q = boundaries.rotation[r, b]
    if boundaries.kind[b] == PLANE:  # the most frequent by far, and every particle asks
        up = q[0] * q[0] + q[1] * q[1]
        z = wp.vec3(2.0 * (q[0] * q[2] + q[3] * q[1]), 2.0 * (q[1] * q[2] - q[3] * q[0]), 1.0 - 2.0 * up)
        return wp.vec4(z[0], z[1], z[2], wp.dot(z, x - boundaries.position[r, b]))
    d = solid_distance(boundaries.kind[b], boundaries.size[b], wp.quat_rotate_inv(q, x - boundaries.position[r, b]))
    n = wp.quat_rotate(q, wp.vec3(d[0], d[1], d[2]))
    return wp.vec4(n[0], n[1], n[2], d[3])


@wp.func
def surface_velocity(boundaries: Boundaries, e: int, b: int, x: wp.vec3):
    """Velocity of the solid's matter at ``x`` [m/s]; zero if it rests."""
    r = row(e, boundaries.position.shape[0])
    arm = x - boundaries.position[r, b]
    return boundaries.velocity[r, b] + wp.cross(boundaries.spin[r, b], arm)


@wp.func
def nearest_boundary(boundaries: Boundaries, e: int, x: wp.vec3):
    """Smallest signed distance of ``x`` from any boundary [m]; large if there is none."""
    distance = float(1.0e6)
    for b in range(boundaries.count):
        distance = wp.min(distance, signed_distance(boundaries, e, b, x)[3])
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
def boundary_contact(boundaries: Boundaries, e: int, field: int, x: wp.vec3, v: wp.vec3, gate: float):
    """Velocity of a field's matter at ``x`` after contact with every boundary closer than ``gate`` [m].

    Coulomb's law holds for the motion relative to the surface, in the order of the boundaries.
    """
    r = row(e, boundaries.friction.shape[0])
    for b in range(boundaries.count):
        d = signed_distance(boundaries, e, b, x)
        if d[3] < gate:
            surface = surface_velocity(boundaries, e, b, x)
            normal = wp.vec3(d[0], d[1], d[2])
            if wp.dot(v - surface, normal) < 0.0:  # else v keeps its bits: no impulse out of round-off
                v = surface + slide(v - surface, normal, boundaries.friction[r, field * boundaries.count + b])
    return v


@wp.func
def remove_approach(boundaries: Boundaries, e: int, x: wp.vec3, v: wp.vec3, gate: float):
    """``v`` without its component into any boundary closer than ``gate`` [m], and without friction.

    ``v`` is the part of a particle's velocity that the grid did not see. Contact on the grid has already met the
    surface's own velocity, so none is taken off here.
    """
    for b in range(boundaries.count):
        d = signed_distance(boundaries, e, b, x)
        if d[3] < gate:
            normal = wp.vec3(d[0], d[1], d[2])
            v = v - wp.min(wp.dot(v, normal), 0.0) * normal
    return v


@wp.kernel
def move_colliders(dt: float, boundaries: Boundaries):
    """Carry every collider on by its velocity and spin for ``dt`` [s]: writes ``boundaries.position, rotation``.

    Launched over ``(rows, B)``. What rests keeps its bits.
    """
    r, b = wp.tid()
    boundaries.position[r, b] = boundaries.position[r, b] + dt * boundaries.velocity[r, b]
    spin = boundaries.spin[r, b]
    rate = wp.length(spin)
    if rate > 0.0:
        turn = wp.quat_from_axis_angle(spin / rate, rate * dt)
        boundaries.rotation[r, b] = wp.normalize(turn * boundaries.rotation[r, b])
