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
