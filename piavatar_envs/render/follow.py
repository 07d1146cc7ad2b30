"""Camera that glides after a point on the ground."""

from __future__ import annotations

import numpy as np

from piavatar_envs.render.scene import Camera


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
