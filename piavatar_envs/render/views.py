"""Cameras of pictures: a shot on the host, and the view of it that kernels read."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.struct
class View:
    """A perspective camera: the eye [m], its axes (right, up, forward; unit), focal length [px], picture size [px]."""

    eye: wp.vec3
    right: wp.vec3
    up: wp.vec3
    forward: wp.vec3
    focal: float
    width: int
    height: int


@wp.func
def to_camera(view: View, point: wp.vec3) -> wp.vec3:
    """Return a world point [m] along the camera's axes: to its right, up and into the picture."""
    offset = point - view.eye
    return wp.vec3(wp.dot(offset, view.right), wp.dot(offset, view.up), wp.dot(offset, view.forward))


@wp.struct
class Rays:
    """Rays of a picture: through its upper left corner, and their change for a pixel to the right and down."""

    corner: wp.vec3
    right: wp.vec3
    down: wp.vec3


@wp.func
def rays_of(view: View) -> Rays:
    """Return the rays of a view, of depth one along its axis."""
    rays = Rays()
    rays.right = view.right / view.focal
    rays.down = -view.up / view.focal
    rays.corner = view.forward - 0.5 * (float(view.width) * rays.right + float(view.height) * rays.down)
    return rays


@wp.func
def ray_at(rays: Rays, x: float, y: float) -> wp.vec3:
    """Return the ray through a pixel position, x to the right and y down [px]."""
    return rays.corner + x * rays.right + y * rays.down


def focal_length(field_of_view: float, height: int) -> float:
    """Return the focal length of a picture [px].

    Args:
        field_of_view: vertical angle [deg].
        height: of the picture [px].
    """
    return 0.5 * height / math.tan(math.radians(0.5 * field_of_view))


@dataclass(frozen=True, eq=False)
class Shot:
    """Camera of one picture.

    Attributes:
        eye: the camera's position [m], shape ``(3,)``.
        target: the point looked at [m], shape ``(3,)``.
        field_of_view: vertical angle [deg].
        center: the point of the ground about which it fades [m], shape ``(2,)``.
    """

    eye: np.ndarray
    target: np.ndarray
    field_of_view: float
    center: np.ndarray

    @property
    def up(self) -> tuple[float, float, float]:
        """Direction that points up in the picture: z, or y where the camera looks straight down or up."""
        way = np.asarray(self.target, np.float64) - self.eye
        steep = np.hypot(way[0], way[1]) < 1e-3 * abs(way[2])
        return (0.0, 1.0, 0.0) if steep else (0.0, 0.0, 1.0)

    @property
    def axes(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Unit vectors that point into the picture, to its right and up in it."""
        forward = np.asarray(self.target, dtype=np.float64) - self.eye
        forward /= np.linalg.norm(forward)
        right = np.cross(forward, self.up)
        right /= np.linalg.norm(right)
        return forward, right, np.cross(right, forward)

    def focal(self, height: int) -> float:
        """Return the focal length of a picture ``height`` pixels high [px]."""
        return focal_length(self.field_of_view, height)

    def project(self, points: np.ndarray, height: int, width: int) -> np.ndarray:
        """Return the pixels ``(n, 2)``, x to the right and y down, of points ``(V, 3)`` [m] before the camera."""
        forward, right, up = self.axes
        relative = np.asarray(points, np.float64) - self.eye
        depth = relative @ forward
        relative, depth = relative[depth > 1e-6], depth[depth > 1e-6]
        scale = self.focal(height) / depth
        return np.stack([0.5 * width + scale * (relative @ right), 0.5 * height - scale * (relative @ up)], axis=1)


def view_rows(shots: Sequence[Shot], height: int, width: int) -> np.ndarray:
    """Return the views of shots as a structured array ``(N,)``, to assign to a ``wp.array`` of :class:`View`.

    Args:
        shots: the cameras.
        height: of the pictures [px].
        width: of the pictures [px].
    """
    rows = np.zeros(len(shots), dtype=View.numpy_dtype())
    for row, shot in zip(rows, shots, strict=True):
        row["forward"], row["right"], row["up"] = shot.axes
        row["eye"], row["focal"] = shot.eye, shot.focal(height)
        row["width"], row["height"] = width, height
    return rows
