"""Pictures of an environment of a batch: skins, props, colours and markers handed to the renderer."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from piavatar_envs.envs.batch_env import BatchEnv
from piavatar_envs.envs.config import RenderConfig
from piavatar_envs.envs.flesh import Flesh
from piavatar_envs.mpm.matrices import matrices_of


class Picture:
    """Draws environments of a batch. Opened lazily: nothing of the renderer is imported without a picture."""

    def __init__(self, batch: BatchEnv, config: RenderConfig) -> None:
        """Open the renderer.

        Raises:
            ImportError: the extra ``render`` is not installed.
        """
        from piavatar_envs.render import Camera, Renderer, SolidSurface

        self.batch, self.config = batch, config
        task = batch.task
        self.renderer = Renderer(config.width, config.height, Camera(task.camera_position, task.camera_target))
        self._skins: dict[tuple[int, bytes], object] = {}
        self._solids = [SolidSurface(p.rest, p.vertices, p.faces) for p in batch.simulation.props.points]

    def cut(self) -> None:
        """A new episode has begun: the camera jumps instead of gliding."""
        self.renderer.reset_camera()

    def _skin(self, env: int, avatar: int, flesh: Flesh):
        """Skin of the body that an avatar has now; bodies that come back are not baked again."""
        from piavatar_envs.render import Skin

        key = (avatar, flesh.shape_parameters[env].tobytes())
        if key not in self._skins:
            points, row = flesh.points, min(env, len(flesh.points.rest) - 1)
            shaped = flesh.asset.shape(flesh.shape_parameters[env])
            self._skins = {other: skin for other, skin in self._skins.items() if other[0] != avatar}
            self._skins[key] = Skin(flesh.asset, shaped, points.rest[row], points.skin_joints, points.skin_weights)
        return self._skins[key]

    def frame(self, env: int, elapsed: float) -> np.ndarray:
        """The scene of environment ``env``, ``(height, width, 3)`` uint8, a time [s] after the last picture."""
        from piavatar_envs.render import Sphere

        state = self.batch.simulation.state
        x, F = state.x.numpy()[env], matrices_of(state.F)[env]
        bodies = self._avatars(env, x, F) + self._props(env, x)
        markers = self.batch.task.markers(self.batch, env)
        markers = [Sphere(*marker) if isinstance(marker, tuple) else marker for marker in markers]
        roots = [avatar.tracked.position.numpy()[env, 0] for avatar in self.batch.simulation.avatars]
        follow = np.mean(roots, axis=0) if self.batch.task.camera_follows else None
        return self.renderer.render(bodies, markers + self._colliders(env), follow=follow, elapsed=elapsed)

    def _avatars(self, env: int, x: np.ndarray, F: np.ndarray) -> list:
        from scipy.spatial.transform import Rotation

        from piavatar_envs.render import PALETTE, Body, strain_magnitude

        bodies = []
        for index, (flesh, avatar) in enumerate(
            zip(self.batch.simulation.flesh, self.batch.simulation.avatars, strict=True)
        ):
            own, skin = slice(avatar.body.first, avatar.body.first + avatar.body.count), self._skin(env, index, flesh)
            rotations = Rotation.from_quat(avatar.tracked.rotation.numpy()[env]).as_matrix()
            vertices = skin.deform(rotations, avatar.tracked.position.numpy()[env], x[own])
            scalars = None
            if self.config.color == "strain":
                scalars = skin.interpolate(strain_magnitude(F[own]))
            bodies.append(Body(vertices, flesh.asset.faces, color=PALETTE[index % len(PALETTE)], scalars=scalars))
        return bodies

    def _props(self, env: int, x: np.ndarray) -> list:
        from scipy.spatial.transform import Rotation

        from piavatar_envs.render import PROP, Body

        props, bodies = self.batch.simulation.props, []
        for index, (prop, solid) in enumerate(zip(props.props, self._solids, strict=True)):
            rotation = Rotation.from_quat(props.state.rotation.numpy()[env, index]).as_matrix()
            particles = x[prop.first : prop.first + prop.count]
            vertices = solid.deform(rotation, props.state.position.numpy()[env, index], particles)
            bodies.append(Body(vertices, solid.faces, color=PROP))
        return bodies

    def _colliders(self, env: int) -> list:
        """The scene's boxes, spheres and capsules; planes are not drawn."""
        from scipy.spatial.transform import Rotation

        from piavatar_envs.render import Box, Capsule, Sphere

        boundaries, shapes = self.batch.simulation.model.boundaries, []
        for index, collider in enumerate(self.batch.simulation.subjects.colliders):
            at = boundaries.position.numpy()[env, index]
            turn = Rotation.from_quat(boundaries.rotation.numpy()[env, index]).as_matrix()
            if collider.kind == "box":
                shapes.append(Box(at, np.array(collider.size), rotation=turn))
            elif collider.kind == "sphere":
                shapes.append(Sphere(at, collider.size[0], color=(0.55, 0.60, 0.66)))
            elif collider.kind == "capsule":
                shapes.append(Capsule(at, *collider.size, rotation=turn))
        return shapes

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
        self._seen: dict[int, tuple[int, ...]] = {}

    def frame(self, env: int) -> np.ndarray:
        """The scene of environment ``env``, ``(height, width, 3)`` uint8.

        Raises:
            ImportError: the extra ``render`` is not installed.
        """
        batch, own = self._place(env)
        if env not in self._opened:
            self._opened[env] = Picture(batch, self._config)
        counters = (batch.seed, batch.episode, batch.step_count)
        now = (batch.restarts, *(int(array.numpy()[own]) for array in counters))
        before = self._seen.get(env, now)
        if now[:3] != before[:3] or now[3] < before[3]:
            # another episode, or the same one from another moment on: the camera jumps instead of gliding
            self._opened[env].cut()
        self._seen[env] = now
        return self._opened[env].frame(own, max(0, now[3] - before[3]) * batch.config.physics.control_dt)

    def close(self) -> None:
        """Close what was opened."""
        for picture in self._opened.values():
            picture.close()
        self._opened.clear()
