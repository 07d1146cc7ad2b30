"""The surface of a soft prop: its rest shape carried by the rigid fit, dented as its particles are."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

_NEIGHBOURS = 6


class SolidSurface:
    """Deforms the surface mesh of one prop with its particles."""

    def __init__(self, rest: np.ndarray, vertices: np.ndarray, faces: np.ndarray) -> None:
        """Bake the weights: a vertex moves with its nearest particles, the nearer the more.

        Args:
            rest: particles in the rest frame [m], shape ``(P, 3)``.
            vertices: surface in the same frame [m], shape ``(V, 3)``.
            faces: its triangles, shape ``(T, 3)``.
        """
        self.vertices, self.faces = np.asarray(vertices, np.float64), np.ascontiguousarray(faces, np.int32)
        self._rest = np.asarray(rest, np.float64)
        distance, self._near = cKDTree(self._rest).query(self.vertices, k=min(_NEIGHBOURS, len(rest)))
        weight = 1.0 / np.maximum(distance, 1e-6) ** 2
        self._weight = weight / weight.sum(axis=1, keepdims=True)

    def deform(self, rotation: np.ndarray, position: np.ndarray, x: np.ndarray) -> np.ndarray:
        """Return world vertices [m], shape ``(V, 3)``.

        Args:
            rotation: rest frame to world, shape ``(3, 3)``.
            position: centre of mass [m].
            x: particles in the world [m], shape ``(P, 3)``.
        """
        dent = x - (self._rest @ rotation.T + position)
        return self.vertices @ rotation.T + position + (self._weight[..., None] * dent[self._near]).sum(1)
