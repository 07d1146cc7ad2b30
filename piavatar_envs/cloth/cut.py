"""A cut garment, before it is worn: its mesh, the lengths of its pattern, and its place on the body."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from piavatar_envs.cloth.wearer import Wearer

#: Distance of cloth from skin, with its thickness and that of air beneath it [m].
THICKNESS = 0.004


@dataclass(frozen=True, eq=False)
class Cut:
    """The result of a kind of garment.

    Attributes:
        positions: of the vertices on the wearer, before the drape [m], shape ``(V, 3)`` float64.
        faces: triangles, their outsides away from the wearer, shape ``(T, 3)`` int32.
        sees: bits of the parts of the wearer that each vertex touches, see :mod:`piavatar_envs.cloth.proxy`, ``(V,)``.
        held: vertices that the wearer holds, such as those of a waistband, shape ``(H,)``.
        lengths: rest lengths of pairs of vertices ``(K, 2)`` in the flat pattern [m]; None takes those of
            ``positions``.
        fit: positions of the same vertices on another shape of the same body; None binds them to the nearest skin.
        thickness: distance at which it lies on the skin [m].
        colors: sRGB of the vertices, shape ``(V, 3)`` uint8; None for those of the fabric.
        source: places of the vertices on the surface of a file that this is, shape ``(V, 3)`` [m]; None for a kind that
            is cut.
        replaces: name of the surface of the wearer's file that is no longer drawn, empty for none.
    """

    positions: np.ndarray
    faces: np.ndarray
    sees: np.ndarray
    held: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int32))
    lengths: Callable[[np.ndarray], np.ndarray] | None = None
    fit: Callable[[Wearer], np.ndarray] | None = None
    thickness: float = THICKNESS
    colors: np.ndarray | None = None
    source: np.ndarray | None = None
    replaces: str = ""

    def measure(self, pairs: np.ndarray) -> np.ndarray:
        """Return rest lengths of pairs of vertices ``(K, 2)`` [m]."""
        if self.lengths is not None:
            return self.lengths(pairs)
        return np.linalg.norm(self.positions[pairs[:, 0]] - self.positions[pairs[:, 1]], axis=1)
