"""Bodies of random shape: what follows from a shape on the device, given by the host or drawn from a pool."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import warp as wp

from piavatar_envs.avatar.body import bone_masses
from piavatar_envs.avatar.drive import AvatarDrive
from piavatar_envs.envs.bodies import Bodies, BodyPool
from piavatar_envs.envs.flesh import Flesh, shape_ranges
from piavatar_envs.envs.observations import Parameter
from piavatar_envs.envs.randomize import Randomization
from piavatar_envs.mpm.program import Program
from piavatar_envs.mpm.types import Model

#: What follows from a shape, of :class:`~piavatar_envs.avatar.types.Body`.
_OF_BODY = ("rest", "rest_joint", "rest_center", "bone_mass", "inert")


class Shapes:
    """Shapes of the avatars in every environment.

    Attributes:
        flesh, avatars, model, randomization: of the world.
        of_host: avatars whose bodies are drawn on the host.
    """

    def __init__(
        self, flesh: Sequence[Flesh], avatars: Sequence[AvatarDrive], model: Model, randomization: Randomization
    ) -> None:
        """Shape the bodies of pools, when the factors have given what varies rows of its own."""
        self.flesh, self.avatars, self.model, self.randomization = flesh, avatars, model, randomization
        self._ranges, self._names = shape_ranges(flesh), flesh[0].asset.shape_names
        #: of every avatar, (num_envs, S); none where no shape is random
        self._parameters = [
            wp.array(own.shape_parameters.astype(np.float32), dtype=float, device=model.device)
            for own in (flesh if self._ranges else ())
        ]
        self.of_host = [index for index, own in enumerate(flesh) if own.drawn_on_host]
        self._connect_pools()

    def draw(self, mask: wp.array, seed: wp.array, episode: wp.array) -> None:
        """Bodies for the masked environments, from seed and episode, for avatars whose bodies are drawn on the host."""
        if not self.of_host:
            return
        seeds, episodes = seed.numpy().view(np.uint32), episode.numpy()
        for env in np.flatnonzero(mask.numpy()):
            key = [int(seeds[env]), int(episodes[env])]
            for avatar in self.of_host:
                rng = np.random.default_rng([*key, avatar] if avatar else key)
                self.give(int(env), self.flesh[avatar].draw_parameters(rng), avatar)

    def give(self, env: int, parameters: np.ndarray, avatar: int = 0) -> None:
        """Give an avatar of environment ``env`` another body; takes effect when it is placed again.

        Raises:
            ValueError: the configuration has one shape for all environments, or a pool of them, or a parameter is out
                of range.
        """
        flesh, drive = self.flesh[avatar], self.avatars[avatar]
        if not flesh.shape.randomize:
            raise ValueError("all environments share one body; set shape.randomize=True to give each its own")
        if flesh.pool:
            raise ValueError(f"bodies are drawn from a pool of {flesh.shape.pool}; set shape.pool=None to give others")
        points, volume = flesh.shaped(parameters)
        mass, center = bone_masses(points)
        body, particles = drive.body, self.model.particles
        own = slice(body.first, body.first + body.count)
        rows = [
            (body.rest[env], points.rest),
            (body.rest_joint[env], points.joints),
            (body.rest_center[env], center),
            (body.inert[env], points.inert),
            (body.bone_mass[env], mass),
            (particles.mass[env][own], points.mass),
            (particles.volume[env][own], volume),
        ]
        for array, value in rows:
            array.assign(np.ascontiguousarray(value[0], np.float32))
        drive.body_mass[env : env + 1].assign(points.mass.sum(1).astype(np.float32))
        self.randomization.set_nominal_mass(avatar, env, points.mass[0], mass[0])
        for name in ("rest", "mass", "joints"):
            getattr(flesh.points, name)[env] = getattr(points, name)[0]
        flesh.shape_parameters[env] = parameters
        if self._parameters:
            self._parameters[avatar][env].assign(flesh.shape_parameters[env].astype(np.float32))

    def adopt(self, avatar: int, parameters: np.ndarray) -> None:
        """Make the host's copy follow bodies whose arrays were restored on the device, with their shape parameters."""
        flesh, body = self.flesh[avatar], self.avatars[avatar].body
        own = slice(body.first, body.first + body.count)
        flesh.points.rest[:], flesh.points.joints[:] = body.rest.numpy(), body.rest_joint.numpy()
        flesh.points.mass[:] = flesh.masses(self.model.particles.volume.numpy()[:, own])
        flesh.shape_parameters[:] = parameters
        if self._parameters:
            self._parameters[avatar].assign(flesh.shape_parameters.astype(np.float32))

    def fall_behind(self) -> None:
        """The device may have drawn other bodies from pools: the host looks there when it wants to know."""
        for flesh in self.flesh:
            flesh.fall_behind()

    def _connect_pools(self) -> None:
        """Shape the bodies of pools, and say what follows them; masses that a factor scales follow nominally."""
        particles, known = self.model.particles, {}
        for index, (flesh, avatar) in enumerate(zip(self.flesh, self.avatars, strict=True)):
            if not flesh.shape.randomize or flesh.drawn_on_host:
                continue
            if flesh.settings not in known:
                known[flesh.settings] = Bodies.shaped(flesh, flesh.shape.pool)
            flesh.pool = BodyPool(known[flesh.settings], index, self.model.num_envs, self.model.device)
            body = avatar.body
            own = slice(body.first, body.first + body.count)
            shape = {"shape": self._parameters[index]} if self._parameters else {}
            flesh.pool.connect(
                rest=body.rest,
                joints=body.rest_joint,
                rest_center=body.rest_center,
                inert=body.inert,
                volume=particles.volume[:, own],
                **self.randomization.nominal_mass(index),
                **shape,
            )

    def drawn(self, avatar: int) -> dict[str, tuple[Parameter, wp.array]]:
        """Parameters of an avatar's shape by name, with their values in every environment; those that may differ."""
        names = self._names
        return {p.name: (p, self._parameters[avatar][:, names.index(name)]) for name, p in self._ranges.items()}

    def record_draws(self, program: Program, mask: wp.array, seed: wp.array, episode: wp.array) -> None:
        """Append: the masked environments draw bodies from pools."""
        for flesh in self.flesh:
            if flesh.pool:
                flesh.pool.record_reset(program, mask, seed, episode)

    def arrays(self) -> dict[str, wp.array]:
        """Arrays of a checkpoint, by name."""
        found: dict[str, wp.array] = {}
        for index, (avatar, flesh) in enumerate(zip(self.avatars, self.flesh, strict=True)):
            if flesh.shape.randomize:
                found |= {f"body_{index}.{name}": getattr(avatar.body, name) for name in _OF_BODY}
                found[f"body_{index}.body_mass"] = avatar.body_mass
            if flesh.pool:
                found[f"body_{index}.index"] = flesh.pool.index
            if flesh.pool and self._parameters:
                found[f"body_{index}.shape"] = self._parameters[index]
        if any(flesh.shape.randomize for flesh in self.flesh):
            found |= {f"matter.{name}": getattr(self.model.particles, name) for name in ("mass", "volume")}
        return found
