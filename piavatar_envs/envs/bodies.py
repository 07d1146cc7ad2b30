"""A pool of bodies: random shapes that are worked out beforehand, so that episodes can draw them on the device.

To shape a body takes the host a good part of a second. A pool of ``shape.pool`` bodies is shaped when the world is
built, from seeds of its own, alike for every batch; at a reset each masked environment draws one of them from its seed
and episode, and its row of every constant that depends on the shape is copied from the pool's tables.
"""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from piavatar_envs.avatar.body import bone_masses
from piavatar_envs.envs.draws import STREAM_PARAMETERS, generator
from piavatar_envs.mpm.program import Program

if TYPE_CHECKING:
    from piavatar_envs.envs.flesh import Flesh

wp.set_module_options({"enable_backward": False})

#: First number of the seeds of a pool's shapes.
POOL_SEED = 20_260


@dataclass(frozen=True)
class Bodies:
    """Bodies of an avatar's settings, worked out on the host.

    Attributes:
        parameters: shape parameters of every body, shape ``(K, S)``.
        tables: constants of every body by name, the first dimension over bodies, float32: what
            :class:`~piavatar_envs.avatar.body.BodyPoints` holds of a shape, the particles' volumes [m^3], what follows
            for bones, the whole mass [kg], and the shape parameters again.
    """

    parameters: np.ndarray
    tables: dict[str, np.ndarray]

    @classmethod
    def shaped(cls, flesh: Flesh, count: int) -> Bodies:
        """``count`` bodies as the settings of ``flesh`` draw them."""
        found: dict[str, list[np.ndarray]] = defaultdict(list)
        for number in range(count):
            parameters = flesh.draw_parameters(np.random.default_rng([POOL_SEED, number]))
            points, volume = flesh.shaped(parameters)
            bone_mass, center = bone_masses(points)
            rows = {name: getattr(points, name) for name in ("rest", "mass", "joints", "inert")}
            rows |= {"volume": volume, "bone_mass": bone_mass, "rest_center": center}
            rows |= {"body_mass": points.mass.sum(1, keepdims=True), "shape": parameters[None]}
            for name, value in rows.items():
                found[name].append(value)
        parameters = np.concatenate(found["shape"])
        return cls(parameters, {name: np.concatenate(rows).astype(np.float32) for name, rows in found.items()})


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
        """Say which arrays ``(num_envs, ...)`` shall follow, by the names of the tables."""
        for name, target in targets.items():
            table = wp.array(self.bodies.tables[name], dtype=target.dtype, device=self.device)
            self._targets.append((table, target))

    def record_reset(self, program: Program, mask: wp.array, seed: wp.array, episode: wp.array) -> None:
        """Append: the masked environments draw a body, and their constants follow."""
        drawn = [mask, seed, episode, self.avatar, len(self.bodies.parameters)]
        program.launch(draw_body, len(mask), drawn, [self.index])
        for table, target in self._targets:
            kernel = take_vectors if target.dtype is wp.vec3 else take_numbers
            program.launch(kernel, target.shape, [mask, self.index, table], [target])


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
    """One of ``count`` bodies for each masked environment."""
    e = wp.tid()
    if mask[e]:
        # factors draw from the indices from zero on
        random = generator(seed[e], episode[e], STREAM_PARAMETERS, -1 - avatar)
        index[e] = wp.randi(random, 0, count)


@wp.kernel
def take_numbers(
    mask: wp.array(dtype=wp.bool),
    index: wp.array(dtype=int),
    table: wp.array2d(dtype=float),
    # out
    target: wp.array2d(dtype=float),
):
    """Rows of a table into those of the masked environments."""
    e, k = wp.tid()
    if mask[e]:
        target[e, k] = table[index[e], k]


@wp.kernel
def take_vectors(
    mask: wp.array(dtype=wp.bool),
    index: wp.array(dtype=int),
    table: wp.array2d(dtype=wp.vec3),
    # out
    target: wp.array2d(dtype=wp.vec3),
):
    """Rows of a table of vectors into those of the masked environments."""
    e, k = wp.tid()
    if mask[e]:
        target[e, k] = table[index[e], k]
