"""Analytic solids in NumPy terms, and their upload."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import warp as wp

from piavatar_envs.mpm.colliders import COLLIDER_KINDS
from piavatar_envs.mpm.types import Boundaries

wp.set_module_options({"enable_backward": False})

#: Components of ``size`` that must be positive, by kind.
_EXTENTS: dict[str, int] = {"plane": 0, "sphere": 1, "box": 3, "capsule": 2}


@dataclass(frozen=True)
class Collider:
    """An analytic solid, at rest or moving as told.

    Attributes:
        kind: ``"plane"``, ``"sphere"``, ``"box"`` or ``"capsule"``.
        size: sphere: radius; box: half extents; capsule: radius and half length of its axis, along local z [m].
        position: of its origin, for a plane of any of its points [m].
        rotation: local to world, quaternion ``wxyz``; a plane's outward normal is local z.
        velocity: of its origin [m/s].
        spin: angular velocity [rad/s].
        friction: Coulomb coefficient, one or one a velocity field.
        kinematic: may be given another velocity later.
    """

    kind: str
    size: Sequence[float] = ()
    position: Sequence[float] = (0.0, 0.0, 0.0)
    rotation: Sequence[float] = (1.0, 0.0, 0.0, 0.0)
    velocity: Sequence[float] = (0.0, 0.0, 0.0)
    spin: Sequence[float] = (0.0, 0.0, 0.0)
    friction: float | Sequence[float] = 0.0
    kinematic: bool = False

    @classmethod
    def plane(cls, normal: Sequence[float], offset: float, friction: float | Sequence[float] = 0.0) -> Collider:
        """The half-space ``dot(normal, x) < offset`` [m].

        Raises:
            ValueError: the normal is zero.
        """
        normal = np.asarray(normal, float)
        length = float(np.linalg.norm(normal))
        if not length > 0.0:
            raise ValueError(f"bad collider: the normal {normal.tolist()} of a plane must not be zero")
        n = normal / length
        # shortest turn from z to n; a half turn about x where n points down
        turn = np.array([1.0 + n[2], -n[1], n[0], 0.0]) if n[2] > -1.0 + 1e-9 else np.array([0.0, 1.0, 0.0, 0.0])
        rotation = turn / np.linalg.norm(turn)
        return cls("plane", (), tuple(n * offset / length), tuple(rotation), friction=friction)

    @property
    def moves(self) -> bool:
        """Whether it has a velocity or a spin."""
        return bool(np.any(self.velocity) or np.any(self.spin))

    def check(self) -> None:
        """Refuse what is no solid.

        Raises:
            ValueError: an unknown kind, a size that is missing or not positive, or negative friction.
        """
        if self.kind not in COLLIDER_KINDS:
            raise ValueError(f"unknown collider {self.kind!r}; use one of {', '.join(COLLIDER_KINDS)}")
        extents = _EXTENTS[self.kind]
        if len(self.size) != extents or not all(np.isfinite(s) and s > 0.0 for s in self.size):
            raise ValueError(f"size={list(self.size)} of a {self.kind} must be {extents} positive numbers [m]")
        if not np.all(np.asarray(self.friction) >= 0.0):
            raise ValueError(f"friction={self.friction} of a {self.kind} must not be negative")
        if not np.linalg.norm(self.rotation) > 0.0:
            raise ValueError(f"rotation={list(self.rotation)} of a {self.kind} must be a quaternion wxyz, not zero")


def make_boundaries(colliders: Sequence[Collider], num_fields: int, rows: int, device: str) -> Boundaries:
    """Colliders on the device, with ``rows`` (1 or ``num_envs``) copies of their poses.

    Raises:
        ValueError: a collider is none, see :meth:`Collider.check`.
    """
    count = max(1, len(colliders))
    kind, size = np.zeros(count, np.int32), np.zeros((count, 3), np.float32)
    pose = {name: np.zeros((rows, count, 3), np.float32) for name in ("position", "velocity", "spin")}
    rotation = np.tile(np.array([0.0, 0.0, 0.0, 1.0], np.float32), (rows, count, 1))
    friction = np.zeros((1, num_fields, count), np.float32)
    for b, collider in enumerate(colliders):
        collider.check()
        kind[b] = COLLIDER_KINDS[collider.kind]
        size[b, : len(collider.size)] = collider.size
        for name, array in pose.items():
            array[:, b] = getattr(collider, name)
        wxyz = np.asarray(collider.rotation, float) / np.linalg.norm(collider.rotation)
        rotation[:, b] = np.roll(wxyz, -1)
        friction[0, :, b] = collider.friction
    boundaries = Boundaries()
    boundaries.count = len(colliders)
    boundaries.kind = wp.array(kind, dtype=int, device=device)
    boundaries.size = wp.array(size, dtype=wp.vec3, device=device)
    for name, array in pose.items():
        setattr(boundaries, name, wp.array(array, dtype=wp.vec3, device=device))
    boundaries.rotation = wp.array(rotation, dtype=wp.quat, device=device)
    boundaries.friction = wp.array(friction.reshape(1, -1), dtype=float, device=device)
    return boundaries


@wp.kernel
def place_colliders(
    mask: wp.array(dtype=wp.bool),
    start: Boundaries,
    # out
    boundaries: Boundaries,
):
    """Put the colliders of the masked environments where they started, over ``(num_envs, B)``."""
    e, b = wp.tid()
    if mask[e]:
        boundaries.position[e, b] = start.position[e, b]
        boundaries.rotation[e, b] = start.rotation[e, b]
        boundaries.velocity[e, b] = start.velocity[e, b]
        boundaries.spin[e, b] = start.spin[e, b]
