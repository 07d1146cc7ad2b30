"""Scene description: bodies, markers and the camera, as plain data without a graphics library."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import ClassVar

import numpy as np
from scipy.spatial.transform import Rotation

from piavatar_envs.avatar.body.splats import SplatCloud, constant_colors
from piavatar_envs.avatar.body.textures import Textures
from piavatar_envs.config.schema import STANDING_VIEW
from piavatar_envs.render.markers import placed_mesh, turn_to_direction
from piavatar_envs.sim.markers import TARGET, WIRE

Color = tuple[float, float, float]

#: sRGB in [0, 1].
CLAY: Color = (0.86, 0.76, 0.69)
PALETTE: tuple[Color, ...] = (CLAY, (0.49, 0.67, 0.82), (0.62, 0.76, 0.55), (0.80, 0.62, 0.80))
IMPULSE: Color = (0.93, 0.68, 0.16)
PROP: Color = (0.55, 0.60, 0.66)
_UPRIGHT = (0.0, 0.0, 0.0, 1.0)


@dataclass(frozen=True, eq=False)
class MovedSplats:
    """Gaussian splats where they are now, in world coordinates.

    Attributes:
        cloud: opacities, and colours as at rest. Pass the same object every frame.
        means: centres [m], shape ``(S, 3)``.
        covariances: xx, xy, xz, yy, yz, zz [m^2], shape ``(S, 6)``.
        turns: rotations from the rest pose, quaternions xyzw, shape ``(S, 4)``.
        colors: sRGB in [0, 1] instead of the cloud's, the same from all sides, shape ``(S, 3)``.
    """

    cloud: SplatCloud
    means: np.ndarray
    covariances: np.ndarray
    turns: np.ndarray
    colors: np.ndarray | None = None

    @property
    def sh(self) -> np.ndarray:
        """Coefficients of the colours in the frame of the rest pose, shape ``(S, K, 3)`` float32."""
        return self.cloud.sh if self.colors is None else constant_colors(self.colors)

    @staticmethod
    def resting(cloud: SplatCloud, shift: np.ndarray) -> MovedSplats:
        """Return a cloud in its rest pose, shifted by ``(3,)`` [m]."""
        turns = np.tile(np.array(_UPRIGHT, np.float32), (len(cloud), 1))
        return MovedSplats(cloud, (cloud.means + shift).astype(np.float32), cloud.packed_covariances(), turns)

    def as_cloud(self) -> SplatCloud:
        """Return a cloud of these splats, whose colours have turned with them."""
        covariances = self.covariances[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3)
        colored = replace(self.cloud, sh=self.sh)
        return SplatCloud.deformed(colored, self.means, covariances, Rotation.from_quat(self.turns).as_matrix())


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
        splats: what is drawn instead of the mesh, which then casts shadows only; they have their own colours.
        textures: of the base colour, drawn in place of ``colors``, which the live view has, where there are no scalars.
            Pass the same object every frame.
    """

    vertices: np.ndarray
    faces: np.ndarray
    color: Color = CLAY
    colors: np.ndarray | None = None
    scalars: np.ndarray | None = None
    scalar_max: float = 0.3
    scalar_label: str = "max |stretch - 1|"
    splats: MovedSplats | None = None
    textures: Textures | None = None


@dataclass(frozen=True, eq=False)
class Sphere:
    """A ball: a target, a prop, a thrown ball. Centre and radius [m]."""

    position: np.ndarray
    radius: float
    color: Color = TARGET

    kind: ClassVar[str] = "sphere"

    def mesh(self) -> tuple[np.ndarray, np.ndarray]:
        """Return world vertices ``(V, 3)`` [m] and triangles ``(T, 3)``."""
        return placed_mesh("sphere", (self.radius,), self.position, _UPRIGHT)


@dataclass(frozen=True, eq=False)
class Arrow:
    """An arrow from ``start`` along ``vector`` [m]: an impulse, a velocity, a force to scale."""

    start: np.ndarray
    vector: np.ndarray
    color: Color = IMPULSE
    radius: float = 0.018

    kind: ClassVar[str] = "arrow"

    def mesh(self) -> tuple[np.ndarray, np.ndarray]:
        """Return world vertices ``(V, 3)`` [m] and triangles ``(T, 3)``."""
        length = float(np.linalg.norm(self.vector))
        return placed_mesh("arrow", (self.radius, length), self.start, turn_to_direction(self.vector))


@dataclass(frozen=True, eq=False)
class Box:
    """A box: a wall, a step, a prop. Centre and half extents [m]; ``rotation`` its world rotation ``(3, 3)``."""

    position: np.ndarray
    half_size: np.ndarray
    color: Color = PROP
    rotation: np.ndarray = field(default_factory=lambda: np.eye(3))

    kind: ClassVar[str] = "box"

    def mesh(self) -> tuple[np.ndarray, np.ndarray]:
        """Return world vertices ``(V, 3)`` [m] and triangles ``(T, 3)``."""
        return placed_mesh("box", self.half_size, self.position, _quaternion(self.rotation))


@dataclass(frozen=True, eq=False)
class Capsule:
    """A capsule about its local z axis: radius and half length of the axis [m]; ``rotation`` its world rotation."""

    position: np.ndarray
    radius: float
    half_length: float
    color: Color = PROP
    rotation: np.ndarray = field(default_factory=lambda: np.eye(3))

    kind: ClassVar[str] = "capsule"

    def mesh(self) -> tuple[np.ndarray, np.ndarray]:
        """Return world vertices ``(V, 3)`` [m] and triangles ``(T, 3)``."""
        return placed_mesh("capsule", (self.radius, self.half_length), self.position, _quaternion(self.rotation))


@dataclass(frozen=True, eq=False)
class Ring:
    """A ring of wire: a gate, a hoop. Centre, unit normal of its plane, radius and that of the wire [m].

    Attributes:
        lowest: height below which the ring is left out [m]: where it stands in the ground.
    """

    position: np.ndarray
    normal: np.ndarray
    radius: float
    wire: float = WIRE
    color: Color = TARGET
    lowest: float = 0.0

    kind: ClassVar[str] = "ring"

    def mesh(self) -> tuple[np.ndarray, np.ndarray]:
        """Return world vertices ``(V, 3)`` [m] and triangles ``(T, 3)``."""
        size = (self.radius, self.wire, self.lowest)
        return placed_mesh("ring", size, self.position, turn_to_direction(self.normal))


@dataclass(frozen=True, eq=False)
class Solid:
    """A marker or collider as a simulation has placed it.

    Attributes:
        kind: ``"sphere"``, ``"box"``, ``"capsule"``, ``"ring"`` or ``"arrow"``.
        vertices: in the world [m], shape ``(V, 3)``.
        faces: triangles, shape ``(T, 3)``.
        color: sRGB in [0, 1].
        number: its own among those of the scene, which stays when others are hidden.
    """

    kind: str
    vertices: np.ndarray
    faces: np.ndarray
    color: Color
    number: int

    def mesh(self) -> tuple[np.ndarray, np.ndarray]:
        """Return world vertices ``(V, 3)`` [m] and triangles ``(T, 3)``."""
        return self.vertices, self.faces


Marker = Sphere | Arrow | Box | Capsule | Ring | Solid


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

    position: tuple[float, float, float] = STANDING_VIEW[0]
    target: tuple[float, float, float] = STANDING_VIEW[1]
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


def _quaternion(rotation: np.ndarray) -> np.ndarray:
    """Return the quaternion ``xyzw`` of a matrix ``(3, 3)``."""
    return Rotation.from_matrix(np.asarray(rotation, np.float64)).as_quat()


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
