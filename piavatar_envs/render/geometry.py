"""The triangles of one picture, as a single mesh (arrays of points are ``(3, N)`` here: NumPy is faster so)."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import numpy as np
from scipy import sparse

#: Farther than this from the origin nothing is drawn [m].
_FAR = 50.0


class Topology:
    """Connectivity of several meshes laid one after the other. Built when what is shown changes, not every frame."""

    def __init__(self, faces: Sequence[np.ndarray], counts: Sequence[int]) -> None:
        """Join meshes.

        Args:
            faces: triangles of each mesh, shapes ``(T_i, 3)``.
            counts: number of vertices ``V_i`` of each mesh.
        """
        offsets = np.concatenate([[0], np.cumsum(counts)])
        self.key = topology_key(faces, counts)
        self._kept = tuple(faces)  # an id is only unique while its owner lives
        self.num_vertices = int(offsets[-1])
        shifted = [np.asarray(part) + offset for part, offset in zip(faces, offsets, strict=False)]
        self.faces = np.concatenate(shifted).astype(np.int32) if shifted else np.zeros((0, 3), dtype=np.int32)
        self._corners = tuple(np.ascontiguousarray(self.faces[:, corner]) for corner in range(3))

    @cached_property
    def _scatter(self) -> sparse.csr_array:
        """Sums a quantity of the triangles at their corners, shape ``(V, T)``."""
        triangles = np.repeat(np.arange(len(self.faces)), 3)
        shape = (self.num_vertices, len(self.faces))
        return sparse.csr_array((np.ones(len(triangles), dtype=np.float32), (self.faces.ravel(), triangles)), shape)

    @cached_property
    def _neighbours(self) -> sparse.csr_array:
        """Averages a quantity of the vertices with their neighbours', shape ``(V, V)``, rows sum to one."""
        start, end = self.faces.ravel(), np.roll(self.faces, -1, axis=1).ravel()
        ones = np.ones(len(start), dtype=np.float32)
        edges = sparse.csr_array((ones, (start, end)), shape=(self.num_vertices, self.num_vertices))
        edges = edges + edges.T
        edges.data[:] = 1.0
        edges = edges + sparse.eye_array(self.num_vertices, dtype=np.float32, format="csr")
        return sparse.csr_array(sparse.diags_array(1.0 / edges.sum(axis=1)) @ edges, dtype=np.float32)

    def smooth(self, values: np.ndarray, passes: int) -> np.ndarray:
        """Average quantities of the vertices with their neighbours ``passes`` times, shape ``(V, n)``."""
        for _ in range(passes):
            values = self._neighbours @ values
        return values

    def triangles(self, vertices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return centres [m] and area vectors [m^2] (outward normal times area) of the triangles.

        Args:
            vertices: positions [m], shape ``(3, V)``.

        Returns:
            Both ``(3, T)`` float32.
        """
        a, b, c = (vertices[:, corner] for corner in self._corners)
        u, v = b - a, c - a
        area = np.empty_like(u)
        for axis in range(3):  # numpy.cross is several times slower
            j, k = (axis + 1) % 3, (axis + 2) % 3
            area[axis] = u[j] * v[k] - u[k] * v[j]
        area *= np.float32(0.5)
        return a + (u + v) * np.float32(1.0 / 3.0), area

    def vertex_areas(self, triangle_areas: np.ndarray) -> np.ndarray:
        """Return area vectors of the vertices [m^2], a third of each of their triangles': smooth normals times area.

        Args:
            triangle_areas: area vectors of the triangles [m^2], shape ``(3, T)``.

        Returns:
            Shape ``(3, V)`` float32.
        """
        return np.ascontiguousarray((self._scatter @ triangle_areas.T).T) * np.float32(1.0 / 3.0)


def topology_key(faces: Sequence[np.ndarray], counts: Sequence[int]) -> tuple:
    """Return a key that is equal for meshes of one :class:`Topology`: the same face arrays and numbers of vertices."""
    return tuple((id(part), int(count)) for part, count in zip(faces, counts, strict=True))


def drawable(vertices: np.ndarray) -> np.ndarray:
    """Return vertices as float32 that a graphics library accepts, also of a failed simulation."""
    vertices = np.asarray(vertices, dtype=np.float32)
    return np.clip(np.nan_to_num(vertices, nan=0.0, posinf=_FAR, neginf=-_FAR), -_FAR, _FAR)


def unit(vectors: np.ndarray) -> np.ndarray:
    """Return vectors of length one, along the first axis; a zero vector stays zero."""
    return vectors / np.maximum(length(vectors), np.float32(1e-20))


def length(vectors: np.ndarray) -> np.ndarray:
    """Return lengths of vectors along the first axis, shape ``(3, N)`` to ``(N,)``."""
    x, y, z = vectors
    return np.sqrt(x * x + y * y + z * z)
