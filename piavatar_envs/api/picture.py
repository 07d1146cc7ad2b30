"""Pictures of environments of a batch."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from piavatar_envs.api.scenery import Progress, Scenery
from piavatar_envs.config import RenderConfig
from piavatar_envs.envs.batch_env import BatchEnv


class Picture:
    """Draws environments of a batch. Opened lazily: nothing of the renderer is imported without a picture."""

    def __init__(self, batch: BatchEnv, config: RenderConfig) -> None:
        """Open the renderer.

        Raises:
            ImportError: the extra ``render`` is not installed.
        """
        from piavatar_envs.render import Camera, Renderer

        self.config, task = config, batch.task
        self.renderer = Renderer(config.width, config.height, Camera(task.camera_position, task.camera_target))
        self._scenery = Scenery(batch)

    def cut(self) -> None:
        """A new episode has begun: the camera jumps instead of gliding."""
        self.renderer.reset_camera()

    def frame(self, env: int, elapsed: float) -> np.ndarray:
        """The scene of environment ``env``, ``(height, width, 3)`` uint8, a time [s] after the last picture."""
        scene = self._scenery.scene(env, self.config.color)
        return self.renderer.render(scene.bodies, scene.markers, follow=scene.follow, elapsed=elapsed)

    def close(self) -> None:
        """Close the renderer."""
        self.renderer.close()


class Pictures:
    """Pictures of any environments, each with a camera of its own, opened when it is first drawn."""

    def __init__(self, place: Callable[[int], tuple[BatchEnv, int]], config: RenderConfig) -> None:
        """Nothing is opened yet.

        Args:
            place: the batch in which an environment lives, and its number there.
            config: size and colours.
        """
        self._place, self._config = place, config
        self._opened: dict[int, Picture] = {}
        self._progress: dict[int, Progress] = {}

    def frame(self, env: int) -> np.ndarray:
        """The scene of environment ``env``, ``(height, width, 3)`` uint8.

        Raises:
            ImportError: the extra ``render`` is not installed.
        """
        batch, own = self._place(env)
        if env not in self._opened:
            self._opened[env], self._progress[env] = Picture(batch, self._config), Progress(batch, own)
        elapsed = self._progress[env].since_last()
        if elapsed is None:
            self._opened[env].cut()
        return self._opened[env].frame(own, elapsed or 0.0)

    def close(self) -> None:
        """Close what was opened."""
        for picture in self._opened.values():
            picture.close()
        self._opened.clear()
