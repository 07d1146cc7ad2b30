"""Random shapes of the avatars: drawn on the host, or from a pool of bodies on the device.

A shape takes the host some 0.1 s, so a pool of ``shape.pool`` bodies can be shaped when the world is built, from fixed
seeds; at a reset each masked environment then draws one of them, from its seed and episode, and copies its row of every
constant that depends on the shape.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import warp as wp

from piavatar_envs.avatar.avatar import Avatar
from piavatar_envs.avatar.body.device import bone_masses
from piavatar_envs.config import (
    ConfigError,
)
from piavatar_envs.core.launch_graph import LaunchGraph
from piavatar_envs.core.rng import STREAM_PARAMETERS, generator
from piavatar_envs.mpm.types import Model
from piavatar_envs.sim.bodies import Bodies, Flesh
from piavatar_envs.sim.randomize import Parameter, Randomization

wp.set_module_options({"enable_backward": False})


#: Arrays of :class:`~piavatar_envs.avatar.types.Body` that depend on the shape.
_OF_BODY = ("rest", "rest_joint", "rest_center", "bone_mass", "velocity_lag")


def check_shape_names(flesh: Sequence[Flesh]) -> None:
    """Refuse random shapes of bodies that have different shape parameters, or none.

    Raises:
        ConfigError: the parameters of one would be observed under the names of another, or no body would vary.
    """
    fixed = [body for body in flesh if body.shape.randomize and not body.asset.shape_names]
    if fixed:
        raise ConfigError(
            f"shape.randomize=True, but the body of {fixed[0].asset.name} has no shape parameters; leave it out, or "
            "use a source that has some, such as embedded"
        )
    names = {body.asset.shape_names for body in flesh}
    if len(names) > 1 and any(body.shape.randomize for body in flesh):
        raise ConfigError("shape.randomize=True needs avatars with the same shape parameters; use one avatar.source")


def shape_ranges(flesh: Sequence[Flesh]) -> dict[str, Parameter]:
    """Return the shape parameters that episodes draw, by the names of the asset; empty where no shape is random.

    Avatars of fixed shape have these parameters as well, so that all avatars are observed alike.
    """
    found: dict[str, Parameter] = {}
    random = [body for body in flesh if body.shape.randomize]
    for index, name in enumerate(flesh[0].asset.shape_names):
        drawn = [body for body in random if name not in body.shape.parameters]
        if drawn:
            fixed = [abs(float(body.base_parameters[index])) for body in flesh if body not in drawn]
            bound = max(*(body.shape.scale for body in drawn), *fixed, 0.0)
            found[name] = Parameter(f"shape_{name}", "-", -bound, bound, f"parameter {name} of the shape")
    return found


class BodyPool:
    """Bodies that one avatar of a world may have, one in each environment.

    Attributes:
        bodies: what they are.
        index: which of them each environment has, shape ``(num_envs,)`` int32.
    """

    def __init__(self, bodies: Bodies, avatar: int, num_envs: int, device: str) -> None:
        self.bodies, self.avatar, self.device = bodies, avatar, device
        self.index = wp.zeros(num_envs, dtype=int, device=device)
        self._targets: list[tuple[wp.array, wp.array]] = []

    def connect(self, **targets: wp.array) -> None:
        """Set the arrays ``(num_envs, ...)`` that a draw overwrites, by the names of the tables."""
        for name, target in targets.items():
            table = wp.array(self.bodies.tables[name], dtype=target.dtype, device=self.device)
            self._targets.append((table, target))

    def record_reset(self, graph: LaunchGraph, mask: wp.array, seed: wp.array, episode: wp.array) -> None:
        """Record the launches by which the masked environments draw a body and its constants."""
        drawn = [mask, seed, episode, self.avatar, len(self.bodies.parameters)]
        graph.launch(draw_body, len(mask), drawn, [self.index])
        for table, target in self._targets:
            kernel = copy_drawn_vectors if target.dtype is wp.vec3 else copy_drawn_numbers
            graph.launch(kernel, target.shape, [mask, self.index, table], [target])


@wp.kernel
def draw_body(
    mask: wp.array(dtype=wp.bool),
    seed: wp.array(dtype=int),
    episode: wp.array(dtype=int),
    avatar: int,
    count: int,
    # out
    index: wp.array(dtype=int),
):
    """Draw one of ``count`` bodies in each masked environment; over ``(num_envs,)``."""
    e = wp.tid()
    if mask[e]:
        # randomised factors use stream indices from 0; negative ones avoid a clash
        random = generator(seed[e], episode[e], STREAM_PARAMETERS, -1 - avatar)
        index[e] = wp.randi(random, 0, count)


@wp.kernel
def copy_drawn_numbers(
    mask: wp.array(dtype=wp.bool),
    index: wp.array(dtype=int),
    table: wp.array2d(dtype=float),
    # out
    target: wp.array2d(dtype=float),
):
    """Copy the drawn rows of a table in the masked environments; over ``(num_envs, K)``."""
    e, k = wp.tid()
    if mask[e]:
        target[e, k] = table[index[e], k]


@wp.kernel
def copy_drawn_vectors(
    mask: wp.array(dtype=wp.bool),
    index: wp.array(dtype=int),
    table: wp.array2d(dtype=wp.vec3),
    # out
    target: wp.array2d(dtype=wp.vec3),
):
    """Copy the drawn rows of a table of vectors in the masked environments; over ``(num_envs, K)``."""
    e, k = wp.tid()
    if mask[e]:
        target[e, k] = table[index[e], k]


class Shapes:
    """Shapes of the avatars in every environment, drawn on the host or from pools on the device.

    Attributes:
        flesh, avatars, model, randomization: those of the world.
        of_host: indices of the avatars whose bodies are drawn on the host.
        pools: pools that the bodies of the other random shapes are drawn from, by index of the avatar.
    """

    def __init__(
        self, flesh: Sequence[Flesh], avatars: Sequence[Avatar], model: Model, randomization: Randomization
    ) -> None:
        """Shape the bodies of pools; ``randomization`` must exist, as it gives each environment its own row."""
        self.flesh, self.avatars, self.model, self.randomization = flesh, avatars, model, randomization
        self._ranges, self._names = shape_ranges(flesh), flesh[0].asset.shape_names
        # (num_envs, S) for every avatar; none where no shape is random
        self._parameters = [
            wp.array(own.shape_parameters.astype(np.float32), dtype=float, device=model.device)
            for own in (flesh if self._ranges else ())
        ]
        self.of_host = [index for index, own in enumerate(flesh) if own.drawn_on_host]
        self.pools: dict[int, BodyPool] = {}
        self._connect_pools()

    def draw(self, mask: wp.array, seed: wp.array, episode: wp.array) -> None:
        """Draw bodies on the host for the masked environments, from seed and episode."""
        if not self.of_host:
            return
        seeds, episodes = seed.numpy().view(np.uint32), episode.numpy()
        for env in np.flatnonzero(mask.numpy()):
            key = [int(seeds[env]), int(episodes[env])]
            for avatar in self.of_host:
                rng = np.random.default_rng([*key, avatar] if avatar else key)
                self.give(int(env), self.flesh[avatar].draw_parameters(rng), avatar)

    def give(self, env: int, parameters: np.ndarray, avatar: int = 0) -> None:
        """Replace the body of an avatar in environment ``env``, with effect from its next placement on.

        Raises:
            ValueError: shapes are fixed or come from a pool, or a parameter is out of range.
        """
        flesh, drive = self.flesh[avatar], self.avatars[avatar]
        if not flesh.shape.randomize:
            raise ValueError("shape.randomize=False, so all environments share one body; set it to True")
        if flesh.drawn_from_pool:
            raise ValueError(f"shape.pool={flesh.shape.pool}, so bodies are drawn from a pool; set it to None")
        points, volume = flesh.shaped(parameters)
        mass, center = bone_masses(points)
        body, particles = drive.body, self.model.particles
        own = slice(body.first, body.first + body.count)
        rows = [
            (body.rest[env], points.rest),
            (body.rest_joint[env], points.joints),
            (body.rest_center[env], center),
            (body.velocity_lag[env], points.velocity_lag),
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
        """Update the host's copy of bodies whose arrays were restored on the device, with their shape parameters."""
        flesh, body = self.flesh[avatar], self.avatars[avatar].body
        own = slice(body.first, body.first + body.count)
        flesh.points.rest[:], flesh.points.joints[:] = body.rest.numpy(), body.rest_joint.numpy()
        flesh.points.mass[:] = flesh.masses(self.model.particles.volume.numpy()[:, own])
        flesh.shape_parameters[:] = parameters
        if self._parameters:
            self._parameters[avatar].assign(flesh.shape_parameters.astype(np.float32))

    def mark_stale(self) -> None:
        """Mark the host's copies as stale, since the device may have drawn other bodies from pools."""
        for flesh in self.flesh:
            flesh.mark_stale()

    def _connect_pools(self) -> None:
        """Shape the bodies of pools, and connect the arrays that a draw overwrites (nominal masses)."""
        particles, known = self.model.particles, {}
        for index, (flesh, avatar) in enumerate(zip(self.flesh, self.avatars, strict=True)):
            if not flesh.drawn_from_pool:
                continue
            if flesh.settings not in known:
                known[flesh.settings] = flesh.shaped_pool()
            pool = BodyPool(known[flesh.settings], index, self.model.num_envs, self.model.device)
            flesh.connect_pool(pool.bodies, pool.index)
            self.pools[index] = pool
            body = avatar.body
            own = slice(body.first, body.first + body.count)
            shape = {"shape": self._parameters[index]} if self._parameters else {}
            pool.connect(
                rest=body.rest,
                joints=body.rest_joint,
                rest_center=body.rest_center,
                velocity_lag=body.velocity_lag,
                volume=particles.volume[:, own],
                **self.randomization.nominal_mass(index),
                **shape,
            )

    def parameters(self, avatar: int) -> wp.array:
        """Return the shape parameters of an avatar in every environment, ``(num_envs, S)``, where shapes are random."""
        return self._parameters[avatar]

    def drawn(self, avatar: int) -> dict[str, tuple[Parameter, wp.array]]:
        """Return the drawn parameters of an avatar's shape by name, with their values in every environment."""
        names = self._names
        return {p.name: (p, self._parameters[avatar][:, names.index(name)]) for name, p in self._ranges.items()}

    def record_reset(self, graph: LaunchGraph, mask: wp.array, seed: wp.array, episode: wp.array) -> None:
        """Record the launches by which the masked environments draw bodies from pools."""
        for pool in self.pools.values():
            pool.record_reset(graph, mask, seed, episode)

    def arrays(self) -> dict[str, wp.array]:
        """Return the arrays of a checkpoint by name."""
        found: dict[str, wp.array] = {}
        for index, (avatar, flesh) in enumerate(zip(self.avatars, self.flesh, strict=True)):
            if flesh.shape.randomize:
                found |= {f"body_{index}.{name}": getattr(avatar.body, name) for name in _OF_BODY}
                found[f"body_{index}.body_mass"] = avatar.body_mass
            if index in self.pools:
                found[f"body_{index}.index"] = self.pools[index].index
            if index in self.pools and self._parameters:
                found[f"body_{index}.shape"] = self._parameters[index]
        if any(flesh.shape.randomize for flesh in self.flesh):
            found |= {f"matter.{name}": getattr(self.model.particles, name) for name in ("mass", "volume")}
        return found
