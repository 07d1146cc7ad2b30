"""What there is to see of an environment of a batch: skins, props, colliders and the task's markers."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

import numpy as np

from piavatar_envs.core.arrays import matrices_of
from piavatar_envs.envs.batch_env import BatchEnv
from piavatar_envs.sim.bodies import Flesh

if TYPE_CHECKING:
    from piavatar_envs.render import Body, Marker, Scene, Skin


class Scenery:
    """Collects scenes, whoever shows them. Nothing of the renderer is imported before there is one of these."""

    def __init__(self, batch: BatchEnv) -> None:
        """Bake the surfaces of the props; skins follow when they are first seen."""
        from piavatar_envs.render import SolidSurface

        self.batch = batch
        self._skins: dict[tuple[int, bytes], Skin] = {}
        self._solids = [SolidSurface(p.rest, p.vertices, p.faces) for p in batch.simulation.props.points]

    def scene(self, env: int, color: Literal["skin", "strain"] = "skin") -> Scene:
        """All that is to be seen of environment ``env`` now, the bodies in their colours or by their strain."""
        from piavatar_envs.render import Scene, Sphere

        task, x = self.batch.task, self.batch.simulation.state.x.numpy()[env]
        bodies = self._avatars(env, x, color) + self._props(env, x)
        markers = [Sphere(*m) if isinstance(m, tuple) else m for m in task.markers(self.batch, env)]
        roots = [avatar.tracked.position.numpy()[env, 0] for avatar in self.batch.simulation.avatars]
        follow = np.mean(roots, axis=0) if task.camera_follows else None
        return Scene(bodies, markers + self._colliders(env), follow)

    def _skin(self, env: int, avatar: int, flesh: Flesh) -> Skin:
        """Skin of the body that an avatar has now; bodies that come back are not baked again."""
        from piavatar_envs.render import Skin

        key = (avatar, flesh.shape_parameters[env].tobytes())
        if key not in self._skins:
            points, row = flesh.points, min(env, len(flesh.points.rest) - 1)
            shaped = flesh.asset.shape(flesh.shape_parameters[env])
            self._skins = {other: skin for other, skin in self._skins.items() if other[0] != avatar}
            self._skins[key] = Skin(flesh.asset, shaped, points.rest[row], points.skin_joints, points.skin_weights)
        return self._skins[key]

    def _avatars(self, env: int, x: np.ndarray, color: str) -> list[Body]:
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
            if color == "strain":
                F = matrices_of(self.batch.simulation.state.F.numpy()[env])
                scalars = skin.interpolate(strain_magnitude(F[own]))
            bodies.append(Body(vertices, flesh.asset.faces, color=PALETTE[index % len(PALETTE)], scalars=scalars))
        return bodies

    def _props(self, env: int, x: np.ndarray) -> list[Body]:
        from scipy.spatial.transform import Rotation

        from piavatar_envs.render import PROP, Body

        props, bodies = self.batch.simulation.props, []
        for index, (prop, solid) in enumerate(zip(props.props, self._solids, strict=True)):
            rotation = Rotation.from_quat(props.state.rotation.numpy()[env, index]).as_matrix()
            particles = x[prop.first : prop.first + prop.count]
            vertices = solid.deform(rotation, props.state.position.numpy()[env, index], particles)
            bodies.append(Body(vertices, solid.faces, color=PROP))
        return bodies

    def _colliders(self, env: int) -> list[Marker]:
        """The scene's boxes, spheres and capsules; planes are not drawn."""
        from scipy.spatial.transform import Rotation

        from piavatar_envs.render import PROP, Box, Capsule, Sphere

        boundaries, shapes = self.batch.simulation.model.boundaries, []
        for index, collider in enumerate(self.batch.simulation.subjects.colliders):
            at = boundaries.position.numpy()[env, index]
            turn = Rotation.from_quat(boundaries.rotation.numpy()[env, index]).as_matrix()
            if collider.kind == "box":
                shapes.append(Box(at, np.array(collider.size), rotation=turn))
            elif collider.kind == "sphere":
                shapes.append(Sphere(at, collider.size[0], color=PROP))
            elif collider.kind == "capsule":
                shapes.append(Capsule(at, *collider.size, rotation=turn))
        return shapes


class Progress:
    """How far an environment of a batch has come since somebody looked at it last."""

    def __init__(self, batch: BatchEnv, env: int) -> None:
        """Nobody has looked yet."""
        self._batch, self._env = batch, env
        self._seen: tuple[int, ...] | None = None

    def since_last(self) -> float | None:
        """Simulated time since the last call [s]; None if the one does not lead to the other.

        That is so at first, where another episode has begun, and where the same one was taken up at another moment.
        """
        batch = self._batch
        counters = (batch.seed, batch.episode, batch.step_count)
        now = (batch.restarts, *(int(array.numpy()[self._env]) for array in counters))
        before, self._seen = self._seen, now
        if before is None or now[:3] != before[:3] or now[3] < before[3]:
            return None
        return (now[3] - before[3]) * batch.config.physics.control_dt
