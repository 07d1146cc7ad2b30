"""Analytic colliders, fixed or moving, with Coulomb friction.

A collider acts on a node only if the mass-weighted position of the particles there is within ``COLLIDER_CONTACT_GATE``
of the surface: without this gate a foot is held while it is still a grid cell away, and sticks when it leaves.

Kinds, each in a local frame:

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

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import warp as wp

from piavatar_envs.mpm.types import Boundaries, row

wp.set_module_options({"enable_backward": False})

#: Leading components of ``size`` that must be positive, by kind.
_EXTENTS: dict[str, int] = {"plane": 0, "sphere": 1, "box": 3, "capsule": 2}

PLANE = wp.constant(0)
SPHERE = wp.constant(1)
BOX = wp.constant(2)
CAPSULE = wp.constant(3)
COLLIDER_KINDS: dict[str, int] = {"plane": 0, "sphere": 1, "box": 2, "capsule": 3}

#: Gap at which contact begins [grid spacings].
COLLIDER_CONTACT_GATE = wp.constant(0.5)
#: Particles closer than this [grid spacings] are contact candidates: the gate and two stencils, so that near a level
#: surface all particles are that have a node in contact.
NEAR_PARTICLE = wp.constant(3.5)
#: Blocks whose middle is closer [grid spacings] may be the base of such a particle: NEAR_PARTICLE and half a diagonal.
NEAR_BLOCK = wp.constant(7.0)
#: Slabs of nodes closer than this [grid spacings] may hold matter within the gate: COLLIDER_CONTACT_GATE, half a
#: stencil's and half a slab's diagonal.
GATED_SLAB = wp.constant(5.3)

#: Shorter directions [m] are round-off and replaced by another.
_NO_LENGTH = wp.constant(1.0e-9)


@dataclass(frozen=True)
class Collider:
    """An analytic solid, fixed or moving.

    Attributes:
        kind: ``"plane"``, ``"sphere"``, ``"box"`` or ``"capsule"``.
        size: sphere: radius; box: half extents; capsule: radius and half length of its axis, along local z [m].
        position: of its origin, for a plane of any of its points [m].
        rotation: local to world, quaternion ``wxyz``; a plane's outward normal is local z.
        velocity: of its origin [m/s].
        spin: angular velocity [rad/s].
        friction: Coulomb coefficient, one or one a velocity field.
        kinematic: may be given another velocity later.
    """

    kind: str
    size: Sequence[float] = ()
    position: Sequence[float] = (0.0, 0.0, 0.0)
    rotation: Sequence[float] = (1.0, 0.0, 0.0, 0.0)
    velocity: Sequence[float] = (0.0, 0.0, 0.0)
    spin: Sequence[float] = (0.0, 0.0, 0.0)
    friction: float | Sequence[float] = 0.0
    kinematic: bool = False

    @classmethod
    def plane(cls, normal: Sequence[float], offset: float, friction: float | Sequence[float] = 0.0) -> Collider:
        """Return the half-space ``dot(normal, x) < offset`` [m].

        Raises:
            ValueError: the normal is zero.
        """
        normal = np.asarray(normal, float)
        length = float(np.linalg.norm(normal))
        if not length > 0.0:
            raise ValueError(f"bad collider: the normal {normal.tolist()} of a plane must not be zero")
        n = normal / length
        # shortest turn from z to n; a half turn about x where n points down
        turn = np.array([1.0 + n[2], -n[1], n[0], 0.0]) if n[2] > -1.0 + 1e-9 else np.array([0.0, 1.0, 0.0, 0.0])
        rotation = turn / np.linalg.norm(turn)
        return cls("plane", (), tuple(n * offset / length), tuple(rotation), friction=friction)

    @property
    def moves(self) -> bool:
        """Whether it has a velocity or a spin."""
        return bool(np.any(self.velocity) or np.any(self.spin))

    def check(self) -> None:
        """Check kind, size, friction and rotation.

        Raises:
            ValueError: an unknown kind, a missing or non-positive size, a negative friction, or a zero rotation.
        """
        if self.kind not in COLLIDER_KINDS:
            raise ValueError(f"unknown collider {self.kind!r}; use one of {', '.join(COLLIDER_KINDS)}")
        extents = _EXTENTS[self.kind]
        if len(self.size) != extents or not all(np.isfinite(s) and s > 0.0 for s in self.size):
            raise ValueError(f"size={list(self.size)} of a {self.kind} must be {extents} positive numbers [m]")
        if not np.all(np.asarray(self.friction) >= 0.0):
            raise ValueError(f"friction={self.friction} of a {self.kind} must not be negative")
        if not np.linalg.norm(self.rotation) > 0.0:
            raise ValueError(f"rotation={list(self.rotation)} of a {self.kind} must be a quaternion wxyz, not zero")


def half_thickness(kind: str, size: Sequence[float]) -> float:
    """Return half the thickness of a collider across its thinnest part [m]; infinity for a plane."""
    return {"plane": math.inf, "box": min(size, default=0.0)}.get(kind, size[0] if size else 0.0)


def make_boundaries(colliders: Sequence[Collider], num_fields: int, rows: int, device: str) -> Boundaries:
    """Upload colliders, with ``rows`` (1 or ``num_envs``) copies of their poses.

    Raises:
        ValueError: an invalid collider, see :meth:`Collider.check`.
    """
    count = max(1, len(colliders))
    kind, size = np.zeros(count, np.int32), np.zeros((count, 3), np.float32)
    pose = {name: np.zeros((rows, count, 3), np.float32) for name in ("position", "velocity", "spin")}
    rotation = np.tile(np.array([0.0, 0.0, 0.0, 1.0], np.float32), (rows, count, 1))
    friction = np.zeros((1, num_fields, count), np.float32)
    for b, collider in enumerate(colliders):
        collider.check()
        kind[b] = COLLIDER_KINDS[collider.kind]
        size[b, : len(collider.size)] = collider.size
        for name, array in pose.items():
            array[:, b] = getattr(collider, name)
        wxyz = np.asarray(collider.rotation, float) / np.linalg.norm(collider.rotation)
        rotation[:, b] = np.roll(wxyz, -1)
        friction[0, :, b] = collider.friction
    boundaries = Boundaries()
    boundaries.count = len(colliders)
    boundaries.kind = wp.array(kind, dtype=int, device=device)
    boundaries.size = wp.array(size, dtype=wp.vec3, device=device)
    for name, array in pose.items():
        setattr(boundaries, name, wp.array(array, dtype=wp.vec3, device=device))
    boundaries.rotation = wp.array(rotation, dtype=wp.quat, device=device)
    boundaries.friction = wp.array(friction.reshape(1, -1), dtype=float, device=device)
    return boundaries


@wp.func
def _box_distance(half: wp.vec3, p: wp.vec3):
    """Return normal and signed distance of ``p`` from a box; inside, from its nearest face."""
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
    """Return normal and signed distance of ``p`` from a capsule; a sphere has no length."""
    away = p - wp.vec3(0.0, 0.0, wp.clamp(p[2], -half_length, half_length))
    distance = wp.length(away)
    n = wp.vec3(1.0, 0.0, 0.0)  # on the axis every direction across it is a normal
    if distance > _NO_LENGTH:
        n = away / distance
    return wp.vec4(n[0], n[1], n[2], distance - radius)


@wp.func
def solid_distance(kind: int, size: wp.vec3, p: wp.vec3):
    """Return outward unit normal and signed distance [m] of ``p`` from a solid, both in the solid's frame."""
    if kind == SPHERE:
        return _round_distance(size[0], 0.0, p)
    if kind == BOX:
        return _box_distance(size, p)
    if kind == CAPSULE:
        return _round_distance(size[0], size[1], p)
    return wp.vec4(0.0, 0.0, 1.0, p[2])


@wp.func
def signed_distance(boundaries: Boundaries, e: int, b: int, x: wp.vec3):
    """Return outward unit normal and signed distance [m] of ``x`` from a collider, positive outside."""
    r = row(e, boundaries.position.shape[0])
    q = boundaries.rotation[r, b]
    if boundaries.kind[b] == PLANE:  # the usual kind, evaluated for every particle
        up = q[0] * q[0] + q[1] * q[1]
        z = wp.vec3(2.0 * (q[0] * q[2] + q[3] * q[1]), 2.0 * (q[1] * q[2] - q[3] * q[0]), 1.0 - 2.0 * up)
        return wp.vec4(z[0], z[1], z[2], wp.dot(z, x - boundaries.position[r, b]))
    d = solid_distance(boundaries.kind[b], boundaries.size[b], wp.quat_rotate_inv(q, x - boundaries.position[r, b]))
    n = wp.quat_rotate(q, wp.vec3(d[0], d[1], d[2]))
    return wp.vec4(n[0], n[1], n[2], d[3])


@wp.func
def surface_velocity(boundaries: Boundaries, e: int, b: int, x: wp.vec3):
    """Return the velocity of the collider's material point at ``x`` [m/s]."""
    r = row(e, boundaries.position.shape[0])
    arm = x - boundaries.position[r, b]
    return boundaries.velocity[r, b] + wp.cross(boundaries.spin[r, b], arm)


@wp.func
def nearest_boundary(boundaries: Boundaries, e: int, x: wp.vec3):
    """Return the smallest signed distance of ``x`` from any collider [m], 1e6 if there is none."""
    distance = float(1.0e6)
    for b in range(boundaries.count):
        distance = wp.min(distance, signed_distance(boundaries, e, b, x)[3])
    return distance


@wp.func
def slide(v: wp.vec3, normal: wp.vec3, friction: float):
    """Return a velocity after contact with a fixed surface: no approach, Coulomb friction."""
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
    """Return the velocity of a field at ``x`` after contact with every collider closer than ``gate`` [m], in order.

    Coulomb's law holds for the motion relative to the surface.
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
    """Return ``v`` without its component into any collider closer than ``gate`` [m], without friction.

    ``v`` is the part of a particle's velocity that contact on the grid did not act on. Contact on the grid has already
    met the surface's own velocity, so none is subtracted here.
    """
    for b in range(boundaries.count):
        d = signed_distance(boundaries, e, b, x)
        if d[3] < gate:
            normal = wp.vec3(d[0], d[1], d[2])
            v = v - wp.min(wp.dot(v, normal), 0.0) * normal
    return v


@wp.func
def turned(rotation: wp.quat, spin: wp.vec3, dt: float):
    """Return a rotation after ``dt`` [s] of spin [rad/s]; without spin it keeps its bits."""
    rate = wp.length(spin)
    if rate > 0.0:
        return wp.normalize(wp.quat_from_axis_angle(spin / rate, rate * dt) * rotation)
    return rotation


@wp.kernel
def move_colliders(dt: float, boundaries: Boundaries):
    """Advance every collider by its velocity and spin for ``dt`` [s], over ``(rows, B)``.

    The pose of a fixed collider keeps its bits.
    """
    r, b = wp.tid()
    boundaries.position[r, b] = boundaries.position[r, b] + dt * boundaries.velocity[r, b]
    boundaries.rotation[r, b] = turned(boundaries.rotation[r, b], boundaries.spin[r, b], dt)


@wp.kernel
def place_colliders(
    mask: wp.array(dtype=wp.bool),
    start: Boundaries,
    # out
    boundaries: Boundaries,
):
    """Reset the colliders of the masked environments to their start, over ``(num_envs, B)``."""
    e, b = wp.tid()
    if mask[e]:
        boundaries.position[e, b] = start.position[e, b]
        boundaries.rotation[e, b] = start.rotation[e, b]
        boundaries.velocity[e, b] = start.velocity[e, b]
        boundaries.spin[e, b] = start.spin[e, b]
