"""Markers: what a task shows besides matter, such as a target or a gate.

A task declares them, :class:`MarkerSpec`, and where they move writes their rows of :class:`Markers` by a kernel, for
all environments. Pictures of any kind read these arrays, so that a marker is described once.

======== ==================================================== ==================== ====================
kind     solid                                                size [m]             ``scale`` multiplies
======== ==================================================== ==================== ====================
sphere   about the position                                   radius               the radius
box      about the position, along its axes                   half extents         all extents
capsule  about a segment of its z axis around the position    radius, half length  both
ring     of wire, about its z axis                            radius, of the wire  the radius
arrow    from the position along its z axis                   radius, length       the length
======== ==================================================== ==================== ====================

The part of a ring below the ground is left out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import warp as wp

from piavatar_envs.core.structs import fill

wp.set_module_options({"enable_backward": False})

#: Number of components of ``size``, by kind.
SIZES: dict[str, int] = {"sphere": 1, "box": 3, "capsule": 2, "ring": 2, "arrow": 2}
#: sRGB in [0, 1] of a target.
TARGET = (0.95, 0.36, 0.23)
#: Thickness of a ring [m].
WIRE = 0.02


@dataclass(frozen=True)
class MarkerSpec:
    """A marker, and where it is until a kernel moves it.

    Attributes:
        kind: ``"sphere"``, ``"box"``, ``"capsule"``, ``"ring"`` or ``"arrow"``.
        size: as in the table of :mod:`piavatar_envs.sim.markers` [m].
        color: sRGB in [0, 1].
        position: [m].
        rotation: local to world, quaternion ``wxyz``.
        visible: whether it is shown.
    """

    kind: str
    size: Sequence[float]
    color: tuple[float, float, float] = TARGET
    position: Sequence[float] = (0.0, 0.0, 0.0)
    rotation: Sequence[float] = (1.0, 0.0, 0.0, 0.0)
    visible: bool = True

    def __post_init__(self) -> None:
        if self.kind not in SIZES:
            raise ValueError(f"marker of kind {self.kind!r}; use one of {', '.join(SIZES)}")
        if len(self.size) != SIZES[self.kind]:
            raise ValueError(f"size={list(self.size)} of a {self.kind}; give {SIZES[self.kind]} numbers [m]")


@wp.struct
class Markers:
    """Markers of every environment, ``(num_envs, markers)``, in the order of their specifications."""

    position: wp.array2d(dtype=wp.vec3)  # [m]
    rotation: wp.array2d(dtype=wp.quat)  # local to world
    scale: wp.array2d(dtype=float)  # factor on the size
    visible: wp.array2d(dtype=wp.bool)


def allocate_markers(specs: Sequence[MarkerSpec], num_envs: int, device: str) -> Markers:
    """Allocate the markers of every environment where their specifications put them."""

    def rows(values: list, width: tuple[int, ...], kind: type) -> np.ndarray:
        return np.repeat(np.array(values, kind).reshape(1, len(specs), *width), num_envs, axis=0)

    def array(values: np.ndarray, dtype: type) -> wp.array:
        return wp.array(values, dtype=dtype, shape=(num_envs, len(specs)), device=device)

    turns = rows([np.roll(spec.rotation, -1) for spec in specs], (4,), np.float32)
    return fill(
        Markers(),
        position=array(rows([spec.position for spec in specs], (3,), np.float32), wp.vec3),
        rotation=array(turns, wp.quat),
        scale=wp.ones((num_envs, len(specs)), dtype=float, device=device),
        visible=array(rows([spec.visible for spec in specs], (), bool), wp.bool),
    )


@wp.func
def turn_to(direction: wp.vec3):
    """Return the rotation of a marker whose z axis shall point along a unit vector."""
    if direction[2] < -0.999999:
        return wp.quat(1.0, 0.0, 0.0, 0.0)
    return wp.normalize(wp.quat(-direction[1], direction[0], 0.0, 1.0 + direction[2]))
