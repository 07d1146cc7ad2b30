"""Smooth surfaces of coarse meshes, as one constant sparse matrix from their vertices to those that are drawn.

Loop subdivision (C. Loop, "Smooth subdivision surfaces based on triangles", M.S. thesis, University of Utah, 1987)
splits every triangle in four and averages. Borders are creases, whose curves depend on themselves alone (H. Hoppe et
al., "Piecewise smooth surface reconstruction", SIGGRAPH 1994), so that hems are cubic splines and garments keep their
size there.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import sparse


@dataclass(frozen=True, eq=False)
class Subdivision:
    """A finer mesh.

    Attributes:
        matrix: shares of the ``V`` coarse vertices in the finer ones, rows sum to one, shape ``(W, V)``.
        faces: its triangles, oriented as those that they divide, shape ``(T, 3)`` int.
    """

    matrix: sparse.csr_array
    faces: np.ndarray


def subdivided(faces: np.ndarray, num_vertices: int, levels: int, smooth: bool = True) -> Subdivision:
    """Return a mesh divided ``levels`` times.

    Args:
        faces: triangles, shape ``(T, 3)``.
        num_vertices: number of coarse vertices ``V``.
        levels: each makes four triangles of one.
        smooth: whether to average; else new vertices are in the middles of edges, and old ones stay.
    """
    matrix = sparse.eye_array(num_vertices, format="csr")
    faces = np.asarray(faces, np.int64).reshape(-1, 3)
    for _ in range(levels):
        step, faces = _divide(faces, matrix.shape[0], smooth)
        matrix = (step @ matrix).tocsr()
    matrix.sort_indices()
    return Subdivision(matrix, faces)


def levels_for(faces: np.ndarray, points: np.ndarray, edge: float, most: int = 2) -> int:
    """Return how often to divide a mesh until its edges are at most so long on average.

    Args:
        faces: triangles, shape ``(T, 3)``.
        points: its vertices [m], shape ``(V, 3)``.
        edge: the length [m].
        most: greatest number of divisions.
    """
    corners = points[faces]
    length = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=-1).mean() if len(faces) else 0.0
    return int(np.clip(np.ceil(np.log2(max(length, 1e-12) / edge)), 0, most))


def _divide(faces: np.ndarray, count: int, smooth: bool) -> tuple[sparse.csr_array, np.ndarray]:
    """Divide once: return the matrix ``(count + edges, count)`` and four triangles for each."""
    start, end, opposite = faces.ravel(), np.roll(faces, -1, axis=1).ravel(), np.roll(faces, -2, axis=1).ravel()
    sides = np.sort(np.stack([start, end], axis=1), axis=1)
    edges, index, sharers = np.unique(sides, axis=0, return_inverse=True, return_counts=True)
    index = index.ravel()
    inner = (sharers == 2) & smooth
    low, high = edges.T
    middles = count + np.arange(len(edges))
    ends = np.where(inner, 0.375, 0.5)
    sides_in = inner[index]
    rows, columns = [middles, middles, middles[index[sides_in]]], [low, high, opposite[sides_in]]
    values = [ends, ends, np.full(sides_in.sum(), 0.125)]

    valence = np.bincount(edges.ravel(), minlength=count)
    border = np.zeros(count, int)
    np.add.at(border, edges[~inner].ravel(), 1)
    safe = np.maximum(valence, 1)
    beta = (0.625 - (0.375 + 0.25 * np.cos(2.0 * np.pi / safe)) ** 2) / safe
    # a corner, where other than two borders meet or one triangle ends, stays
    triangles = np.bincount(faces.ravel(), minlength=count)
    spline = (border == 2) & (triangles > 1)
    inside = (border == 0) & (valence > 0)
    own = np.where(inside, 1.0 - valence * beta, np.where(spline, 0.75, 1.0))
    rows.append(np.arange(count))
    columns.append(np.arange(count))
    values.append(own)
    for vertex, other in ((low, high), (high, low)):
        share = np.where(inside[vertex], beta[vertex], np.where(spline[vertex] & ~inner, 0.125, 0.0))
        used = share != 0.0
        rows.append(vertex[used])
        columns.append(other[used])
        values.append(share[used])
    entries = np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))
    matrix = sparse.csr_array(entries, shape=(count + len(edges), count))
    ab, bc, ca = middles[index.reshape(-1, 3)].T
    a, b, c = faces.T
    parts = [np.stack(corners, axis=1) for corners in ((a, ab, ca), (b, bc, ab), (c, ca, bc), (ab, bc, ca))]
    return matrix, np.concatenate(parts)
