"""Pictures of an environment of a batch: skin, colours and markers handed to the renderer."""

from __future__ import annotations

import numpy as np

from piavatar_envs.envs.batch_env import BatchEnv
from piavatar_envs.envs.config import RenderConfig


class Picture:
    """Draws environments of a batch. Opened lazily: nothing of the renderer is imported without a picture."""

    def __init__(self, batch: BatchEnv, config: RenderConfig) -> None:
        """Open the renderer.

        Raises:
            ImportError: the extra ``render`` is not installed.
        """
        from piavatar_envs.render import Renderer

        self.batch, self.config = batch, config
        self.renderer = Renderer(config.width, config.height)
        self._skins: dict[bytes, object] = {}

    def cut(self) -> None:
        """A new episode has begun: the camera jumps instead of gliding."""
        self.renderer.reset_camera()

    def _skin(self, env: int):
        """Skin of the body that an environment has now; bodies that come back are not baked again."""
        from piavatar_envs.render import Skin

        simulation = self.batch.simulation
        key = simulation.shape_parameters[env].tobytes()
        if key not in self._skins:
            points, row = simulation.points, min(env, len(simulation.points.rest) - 1)
            shaped = simulation.asset.shape(simulation.shape_parameters[env])
            self._skins = {
                key: Skin(simulation.asset, shaped, points.rest[row], points.skin_joints, points.skin_weights)
            }
        return self._skins[key]

    def frame(self, env: int) -> np.ndarray:
        """The scene of environment ``env``, ``(height, width, 3)`` uint8."""
        from scipy.spatial.transform import Rotation

        from piavatar_envs.render import Body, Sphere, strain_magnitude

        simulation = self.batch.simulation
        tracked, skin = simulation.avatar.tracked, self._skin(env)
        rotations = Rotation.from_quat(tracked.rotation.numpy()[env]).as_matrix()
        positions = tracked.position.numpy()[env]
        vertices = skin.deform(rotations, positions, simulation.state.x.numpy()[env])
        scalars = None
        if self.config.color == "strain":
            scalars = skin.interpolate(strain_magnitude(simulation.state.F.numpy()[env]))
        markers = [Sphere(at, radius, color) for at, radius, color in self.batch.task.markers(self.batch, env)]
        body = Body(vertices, simulation.asset.faces, scalars=scalars)
        return self.renderer.render([body], markers, follow=positions[0])

    def close(self) -> None:
        """Close the renderer."""
        self.renderer.close()
