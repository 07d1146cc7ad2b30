"""Clips of the live view, drawn by the package's renderer with the camera of the browser that records."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np

from piavatar_envs.render import Camera, Renderer, Scene, write_video

#: Size of the pictures [px], and the most of them in a clip: 10 s of control steps of 1/30 s.
WIDTH, HEIGHT, MOST_FRAMES = 480, 360, 300


class Recording:
    """A clip that is being recorded.

    Attributes:
        client: number of the browser that gets it, None for all.
        frames: pictures so far.
    """

    def __init__(self, camera: Camera, rate: float, kind: str, client: int | None) -> None:
        """Begin without pictures.

        Args:
            camera: of the browser.
            rate: scenes a second [1/s].
            kind: ``"mp4"`` or ``"gif"``.
            client: number of the browser.
        """
        self._renderer = Renderer(WIDTH, HEIGHT, camera)
        self._rate, self.kind, self.client = rate, kind, client
        self.frames: list[np.ndarray] = []

    @property
    def full(self) -> bool:
        """Whether no picture may follow."""
        return len(self.frames) >= MOST_FRAMES

    def add(self, scene: Scene) -> None:
        """Draw a scene."""
        elapsed = 1.0 / self._rate
        self.frames.append(self._renderer.render(scene.bodies, scene.markers, follow=scene.follow, elapsed=elapsed))

    def finish(self) -> bytes:
        """Return the content of the file.

        Raises:
            ImportError: the extra ``render`` is not installed.
            ValueError: there are no pictures.
        """
        self._renderer.close()
        with tempfile.TemporaryDirectory() as folder:
            path = write_video(Path(folder) / f"clip.{self.kind}", self.frames, self._rate)
            return path.read_bytes()
