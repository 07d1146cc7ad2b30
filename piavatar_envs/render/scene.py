"""Scene description: bodies, markers and the camera, as plain data without a graphics library."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

Color = tuple[float, float, float]

#: sRGB in [0, 1].
CLAY: Color = (0.86, 0.76, 0.69)
PALETTE: tuple[Color, ...] = (CLAY, (0.49, 0.67, 0.82), (0.62, 0.76, 0.55), (0.80, 0.62, 0.80))
TARGET: Color = (0.95, 0.36, 0.23)
IMPULSE: Color = (0.93, 0.68, 0.16)
PROP: Color = (0.55, 0.60, 0.66)

_SPHERE_RINGS, _SPHERE_SEGMENTS = 20, 32
_ARROW_SEGMENTS = 24
_BOX_CELLS = 6
_RING_SEGMENTS, _WIRE_SEGMENTS = 48, 12


@dataclass(frozen=True, eq=False)
class Body:
    """One triangle mesh, in world coordinates.

    Attributes:
        vertices: positions [m], shape ``(V, 3)``.
        faces: outward oriented triangles, shape ``(T, 3)`` int. Pass the same array every frame.
        color: sRGB in [0, 1].
        colors: sRGB of the vertices instead, shape ``(V, 3)`` uint8. Pass the same array every frame.
        scalars: what to colour by instead, shape ``(V,)``, for example the strain.
        scalar_max: the value of the last colour; the range is ``[0, scalar_max]``, the same in every frame.
        scalar_label: title of the colour scale.
    """

    vertices: np.ndarray
    faces: np.ndarray
    color: Color = CLAY
    colors: np.ndarray | None = None
    scalars: np.ndarray | None = None
    scalar_max: float = 0.3
    scalar_label: str = "max |stretch - 1|"


@dataclass(frozen=True, eq=False)
class Sphere:
    """A ball: a target, a prop, a thrown ball. Centre and radius [m]."""

    position: np.ndarray
    radius: float
    color: Color = TARGET

    def mesh(self) -> tuple[np.ndarray, np.ndarray]:
        """Return world vertices ``(V, 3)`` [m] and triangles ``(T, 3)``."""
        vertices, faces = _UNIT_SPHERE
        return np.asarray(self.position, dtype=np.float64) + self.radius * vertices, faces


@dataclass(frozen=True, eq=False)
class Arrow:
    """An arrow from ``start`` along ``vector`` [m]: an impulse, a velocity, a force to scale."""

    start: np.ndarray
    vector: np.ndarray
    color: Color = IMPULSE
    radius: float = 0.018

    def mesh(self) -> tuple[np.ndarray, np.ndarray]:
        """Return world vertices ``(V, 3)`` [m] and triangles ``(T, 3)``."""
        vector = np.asarray(self.vector, dtype=np.float64)
        length = float(np.linalg.norm(vector))
        axis = vector / length if length > 1e-9 else np.array([0.0, 0.0, 1.0])
        side = np.cross(axis, [0.0, 0.0, 1.0] if abs(axis[2]) < 0.9 else [1.0, 0.0, 0.0])
        side /= np.linalg.norm(side)
        head = min(5.0 * self.radius, 0.5 * length)
        # Radius and height of the rings, from the tail to the tip; doubled where an edge shall stay sharp.
        neck = length - head
        radii = np.array([0.0, 0.0, 1.0, 1.0, 1.0, 1.0, 2.4, 2.4, 0.0, 0.0]) * self.radius
        heights = np.array([0.0, 0.0, 0.0, 0.0, neck, neck, neck, neck, length, length])
        local = _revolve(np.stack([radii, heights], axis=-1))
        frame = np.stack([side, np.cross(axis, side), axis])
        return np.asarray(self.start, dtype=np.float64) + local @ frame, _ARROW_FACES


@dataclass(frozen=True, eq=False)
class Box:
    """A box: a wall, a step, a prop. Centre and half extents [m]; ``rotation`` its world rotation ``(3, 3)``."""

    position: np.ndarray
    half_size: np.ndarray
    color: Color = PROP
    rotation: np.ndarray = field(default_factory=lambda: np.eye(3))

    def mesh(self) -> tuple[np.ndarray, np.ndarray]:
        """Return world vertices ``(V, 3)`` [m] and triangles ``(T, 3)``."""
        vertices, faces = _UNIT_BOX
        local = vertices * np.asarray(self.half_size, dtype=np.float64)
        return np.asarray(self.position, dtype=np.float64) + local @ np.asarray(self.rotation).T, faces


@dataclass(frozen=True, eq=False)
class Capsule:
    """A capsule about its local z axis: radius and half length of the axis [m]; ``rotation`` its world rotation."""

    position: np.ndarray
    radius: float
    half_length: float
    color: Color = PROP
    rotation: np.ndarray = field(default_factory=lambda: np.eye(3))

    def mesh(self) -> tuple[np.ndarray, np.ndarray]:
        """Return world vertices ``(V, 3)`` [m] and triangles ``(T, 3)``."""
        vertices, faces = _UNIT_SPHERE
        local = self.radius * vertices
        local[:, 2] += np.where(vertices[:, 2] >= 0.0, self.half_length, -self.half_length)
        return np.asarray(self.position, dtype=np.float64) + local @ np.asarray(self.rotation).T, faces


@dataclass(frozen=True, eq=False)
class Ring:
    """A ring of wire: a gate, a hoop. Centre, unit normal of its plane, radius and that of the wire [m].

    Attributes:
        lowest: height below which the ring is left out [m]: where it stands in the ground.
    """

    position: np.ndarray
    normal: np.ndarray
    radius: float
    wire: float = 0.02
    color: Color = TARGET
    lowest: float = 0.0

    def mesh(self) -> tuple[np.ndarray, np.ndarray]:
        """Return world vertices ``(V, 3)`` [m] and triangles ``(T, 3)``."""
        position, normal = np.asarray(self.position, dtype=np.float64), np.asarray(self.normal, dtype=np.float64)
        up = np.array([0.0, 0.0, 1.0]) if abs(normal[2]) < 0.9 else np.array([0.0, 1.0, 0.0])
        up -= (up @ normal) * normal
        up /= np.linalg.norm(up)
        sine = np.clip((self.lowest - position[2]) / max(self.radius * up[2], 1e-9), -1.0, 1.0)
        # from where the ring leaves the ground on one side, over its top, to the other
        angle = np.linspace(np.arcsin(sine), np.pi - np.arcsin(sine), _RING_SEGMENTS + 1)[:, None, None]
        around = np.linspace(0.0, 2.0 * np.pi, _WIRE_SEGMENTS, endpoint=False)[None, :, None]
        out = np.cos(angle) * np.cross(up, normal) + np.sin(angle) * up
        surface = (self.radius + self.wire * np.cos(around)) * out - self.wire * np.sin(around) * normal
        return position + surface.reshape(-1, 3), _RING_FACES


Marker = Sphere | Arrow | Box | Capsule | Ring


@dataclass(frozen=True, eq=False)
class Scene:
    """All that there is to see at one moment, in world coordinates.

    Attributes:
        bodies: avatars and soft props, always in the same order.
        markers: what the task shows, and rigid obstacles.
        follow: the point that the camera follows [m], shape ``(3,)``, or None where it stays.
    """

    bodies: Sequence[Body]
    markers: Sequence[Marker]
    follow: np.ndarray | None = None


@dataclass(frozen=True)
class Camera:
    """A perspective camera; the default looks at a standing person three-quarters from the front.

    Attributes:
        position: the eye [m], relative to the ground point below what it follows.
        target: the point looked at [m], relative to the same point.
        field_of_view: vertical angle [deg].
        follow: share of the distance to the followed point made up in each 1/30 s: 0 stays put, 1 sticks to it.
    """

    position: tuple[float, float, float] = (1.75, -3.75, 1.62)
    target: tuple[float, float, float] = (0.0, -0.04, 0.86)
    field_of_view: float = 29.0
    follow: float = 0.15

    def glide(self, center: np.ndarray, before: np.ndarray, now: np.ndarray, seconds: float) -> np.ndarray:
        """Return the centre after a time [s] in which the followed point has moved straight from one place to another.

        The solution of ``dc/dt = k (p - c)``, which does not depend on the number of calls on the way.

        Args:
            center: of the camera, before [m].
            before: the followed point, before [m].
            now: the followed point, now [m].
            seconds: the time, not negative.
        """
        if self.follow == 0.0 or seconds == 0.0:
            return center
        if self.follow == 1.0:
            return now
        lag = -30.0 * seconds * math.log(1.0 - self.follow)  # k times the time
        share = 1.0 - math.exp(-lag)
        return center + share * (before - center) + (1.0 - share / lag) * (now - before)

    def __post_init__(self) -> None:
        if not 1.0 <= self.field_of_view <= 120.0:
            raise ValueError(f"field_of_view={self.field_of_view} deg is outside [1, 120]")
        if not 0.0 <= self.follow <= 1.0:
            raise ValueError(f"follow={self.follow} is outside [0, 1]: it is a share of the way in 1/30 s")


def _revolve(profile: np.ndarray) -> np.ndarray:
    """Return vertices of the rings ``(radius, height)`` about the z axis, shape ``(rings * segments, 3)``."""
    angle = np.linspace(0.0, 2.0 * np.pi, _ARROW_SEGMENTS, endpoint=False)
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    rings = np.concatenate(
        [profile[:, None, :1] * circle, np.broadcast_to(profile[:, None, 1:], (len(profile), _ARROW_SEGMENTS, 1))],
        axis=-1,
    )
    return rings.reshape(-1, 3)


def _ring_faces(num_rings: int, num_segments: int) -> np.ndarray:
    """Return outward triangles between consecutive rings that rise along z."""
    ring, segment = np.meshgrid(np.arange(num_rings - 1), np.arange(num_segments), indexing="ij")
    following = (segment + 1) % num_segments
    a, b = ring * num_segments + segment, ring * num_segments + following
    c, d = a + num_segments, b + num_segments
    return np.concatenate([np.stack([a, b, d], -1).reshape(-1, 3), np.stack([a, d, c], -1).reshape(-1, 3)]).astype(
        np.int32
    )


def _unit_sphere() -> tuple[np.ndarray, np.ndarray]:
    polar = np.linspace(np.pi, 0.0, _SPHERE_RINGS)
    angle = np.linspace(0.0, 2.0 * np.pi, _SPHERE_SEGMENTS, endpoint=False)
    radius, shape = np.sin(polar)[:, None], (_SPHERE_RINGS, _SPHERE_SEGMENTS)
    vertices = np.stack(
        [radius * np.cos(angle), radius * np.sin(angle), np.broadcast_to(np.cos(polar)[:, None], shape)], axis=-1
    )
    return vertices.reshape(-1, 3), _ring_faces(_SPHERE_RINGS, _SPHERE_SEGMENTS)


def _unit_box() -> tuple[np.ndarray, np.ndarray]:
    """Return six gridded sides that share no vertices, so that edges are sharp and shadows are filled."""
    line = np.linspace(-1.0, 1.0, _BOX_CELLS + 1)
    u, v = (grid.ravel() for grid in np.meshgrid(line, line, indexing="ij"))
    i, j = (grid.ravel() for grid in np.meshgrid(np.arange(_BOX_CELLS), np.arange(_BOX_CELLS), indexing="ij"))
    corner = i * (_BOX_CELLS + 1) + j
    quad = np.stack([corner, corner + _BOX_CELLS + 1, corner + _BOX_CELLS + 2, corner + 1], axis=-1)
    vertices, faces = [], []
    for axis in range(3):
        for sign in (-1.0, 1.0):
            side = np.empty((len(u), 3))
            side[:, axis], side[:, (axis + 1) % 3], side[:, (axis + 2) % 3] = sign, u, v
            order = quad if sign > 0.0 else quad[:, ::-1]
            offset = len(vertices) * len(u)
            vertices.append(side)
            faces.append(np.concatenate([order[:, [0, 1, 2]], order[:, [0, 2, 3]]]) + offset)
    return np.concatenate(vertices), np.concatenate(faces).astype(np.int32)


_UNIT_SPHERE = _unit_sphere()
_UNIT_BOX = _unit_box()
_ARROW_FACES = _ring_faces(10, _ARROW_SEGMENTS)
_RING_FACES = _ring_faces(_RING_SEGMENTS + 1, _WIRE_SEGMENTS)


class Follower:
    """Glides after a point on the ground, as a :class:`Camera` says.

    Attributes:
        camera: how closely.
        center: where it is [m], shape ``(2,)``, or None where it will begin at the next point.
    """

    def __init__(self, camera: Camera) -> None:
        """Start without a point to follow."""
        self.camera = camera
        self.center: np.ndarray | None = None
        self._wanted = np.zeros(2)  # what it followed last [m]

    def cut(self) -> None:
        """Begin at the next point, without a glide from where it was."""
        self.center = None

    def move(self, point: np.ndarray | None, elapsed: float) -> np.ndarray:
        """Follow for a while.

        Args:
            point: where what it follows is now [m], shape ``(3,)``; the origin if None. It stays where that is not
                finite.
            elapsed: time since the last call [s].

        Returns:
            The ground point below [m], shape ``(2,)``.
        """
        wanted = np.zeros(2) if point is None else np.asarray(point, dtype=np.float64)[:2]
        if not np.isfinite(wanted).all():
            wanted = np.zeros(2) if self.center is None else self.center
        if self.center is None:
            self.center = self._wanted = wanted
        self.center = self.camera.glide(self.center, self._wanted, wanted, elapsed)
        self._wanted = wanted
        return self.center
