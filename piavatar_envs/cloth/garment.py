"""A garment: its mesh, its fabric, and how it is worn."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from piavatar_envs.cloth.mesh import ClothMesh

if TYPE_CHECKING:
    from piavatar_envs.cloth.fabric import Fabric

#: Index of the wearer of cloth that is worn by none, such as a blanket.
NO_WEARER = -1


@dataclass(frozen=True, eq=False)
class Held:
    """Vertices that are held at places of the wearer's proxy skin, such as a waistband.

    A place is the point of the curved patch of a triangle and an offset along its normal
    (:func:`piavatar_envs.cloth.contact.curved_patch`).

    Attributes:
        vertices: of the garment, shape ``(H,)`` int32.
        face: triangles of the wearer's proxy, counted from its first, shape ``(H,)`` int32.
        weights: of the corners, shape ``(H, 3)``.
        offset: along the normal [m], shape ``(H,)``.
    """

    vertices: np.ndarray
    face: np.ndarray
    weights: np.ndarray
    offset: np.ndarray

    @classmethod
    def none(cls) -> Held:
        """Return no vertices."""
        return cls(np.zeros(0, np.int32), np.zeros(0, np.int32), np.zeros((0, 3)), np.zeros(0))


@dataclass(frozen=True, eq=False)
class Garment:
    """A garment of ``V`` vertices, cut and draped.

    Attributes:
        kind: name in the registry of kinds.
        wearer: piece of the obstacles that wears it, :data:`NO_WEARER` for none.
        mesh: topology and pattern.
        draped: positions at rest on the wearer in its rest pose [m], shape ``(V, 3)``.
        held: vertices that move with the skin; they count as the wearer's and have no mass.
        sees: bits of the wearer's parts that a vertex touches, shape ``(V,)`` int32; -1 for all.
        thickness: distance that it keeps from skin, floor and colliders [m].
        fabric: weight, stiffness and friction.
        skin_joints: bones that place it at a reset, shape ``(V, 4)`` int32.
        skin_weights: their weights, shape ``(V, 4)``.
        shape_deltas: change of ``draped`` by the shape parameters [m], shape ``(2 S, V, 3)``; None without grading.
        colors: sRGB of the vertices, shape ``(V, 3)`` uint8; None for those of the fabric.
        source: places of the vertices on the surface of the wearer's file that it replaces, in the mean shape [m],
            shape ``(V, 3)``; None where that surface's textures are not drawn.
        replaces: name of the surface of the wearer's file that is not drawn, because this is it; empty for none.
    """

    kind: str
    wearer: int
    mesh: ClothMesh
    draped: np.ndarray
    held: Held
    sees: np.ndarray
    thickness: float
    fabric: Fabric
    skin_joints: np.ndarray | None = None
    skin_weights: np.ndarray | None = None
    shape_deltas: np.ndarray | None = None
    colors: np.ndarray | None = None
    source: np.ndarray | None = None
    replaces: str = ""
