"""Interface of the two back ends: a shot in, a picture out."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from piavatar_envs.render.geometry import Topology
from piavatar_envs.render.ground import GroundShadow


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
        return float(0.5 * height / np.tan(np.deg2rad(0.5 * self.field_of_view)))

    def project(self, points: np.ndarray, height: int, width: int) -> np.ndarray:
        """Return the pixels ``(n, 2)``, x to the right and y down, of points ``(V, 3)`` [m] before the camera."""
        forward, right, up = self.axes
        relative = np.asarray(points, np.float64) - self.eye
        depth = relative @ forward
        relative, depth = relative[depth > 1e-6], depth[depth > 1e-6]
        scale = self.focal(height) / depth
        return np.stack([0.5 * width + scale * (relative @ right), 0.5 * height - scale * (relative @ up)], axis=1)


class Backend(Protocol):
    """Turns lit vertices into pictures of one size."""

    def draw(
        self, topology: Topology, vertices: np.ndarray, colors: np.ndarray, shadow: GroundShadow, shot: Shot
    ) -> np.ndarray:
        """Draw one picture.

        Args:
            topology: the triangles; a new object where they changed.
            vertices: positions [m], shape ``(V, 3)`` float32.
            colors: lit sRGB colours, shape ``(V, 3)`` uint8.
            shadow: the shadow on the ground.
            shot: where the picture is taken from.

        Returns:
            The picture, shape ``(height, width, 3)`` uint8, a copy.
        """
        ...

    def close(self) -> None:
        """Free the window and the buffers."""
        ...
