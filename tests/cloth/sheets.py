"""Rectangular sheets of cloth for tests of the solver."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from piavatar_envs.cloth.mesh import ClothMesh


def lattice(width: float, height: float, spacing: float) -> tuple[np.ndarray, np.ndarray]:
    """Return points ``(V, 2)`` in ``[0, width] x [0, height]`` and triangles of a triangular lattice of rows in x."""
    columns, rows = max(1, round(width / spacing)), max(1, round(height / (spacing * np.sqrt(0.75))))
    points, row = [], []
    for j in range(rows + 1):
        even = np.arange(columns + 1) / columns
        x = width * (even if j % 2 == 0 else np.concatenate([[0.0], even[:-1] + 0.5 / columns, [1.0]]))
        row.append(sum(len(r) for r in row) + np.arange(len(x)))
        points.append(np.stack([x, np.full(len(x), j * height / rows)], axis=1))
    points = np.concatenate(points)
    faces = []
    for a, b in pairwise(row):
        i = k = 0
        while i < len(a) - 1 or k < len(b) - 1:  # on in the row whose next point is further left
            if k == len(b) - 1 or (i < len(a) - 1 and points[a[i + 1], 0] <= points[b[k + 1], 0]):
                faces.append([a[i], a[i + 1], b[k]])
                i += 1
            else:
                faces.append([a[i], b[k + 1], b[k]])
                k += 1
    return points, np.array(faces, np.int32)


def mesh_of(points: np.ndarray, faces: np.ndarray) -> ClothMesh:
    """Return the mesh whose pattern is ``points``, in the plane or in space."""
    return ClothMesh.build(faces, lambda pairs: np.linalg.norm(points[pairs[:, 0]] - points[pairs[:, 1]], axis=1))
