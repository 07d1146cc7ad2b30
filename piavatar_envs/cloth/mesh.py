"""Meshes of cloth: edges in colours, areas and the bending matrix of a flat pattern.

The lengths of a pattern, not the positions on a body, say how large a garment is. Bending is the quadratic model of
Bergou et al., "A quadratic bending model for inextensible surfaces" (2006): the energy is ``D / 2 x^T Q x`` with a
constant matrix that annihilates every linear function, so that rigid motion costs nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import eigsh


@dataclass(frozen=True, eq=False)
class ClothMesh:
    """Mesh as the solver reads it, of ``V`` vertices, ``T`` triangles and ``M`` edges; lengths are of the pattern.

    Attributes:
        num_vertices: ``V``.
        faces: shape ``(T, 3)`` int32.
        edges: sorted by color, shape ``(M, 2)`` int32; edges of a color share no vertex.
        color_start: first edge of each color and ``M``, shape ``(C + 1,)`` int32.
        length: of the edges [m], shape ``(M,)``.
        edge_area: area of an edge's triangles [m^2], shape ``(M,)``.
        area: a third of the area of a vertex's triangles [m^2], shape ``(V,)``.
        bending_start: rows of Q, CSR, shape ``(V + 1,)`` int32.
        bending_column: its columns, shape ``(nonzeros,)`` int32.
        bending_value: its values [1/m^2], shape ``(nonzeros,)``.
    """

    num_vertices: int
    faces: np.ndarray
    edges: np.ndarray
    color_start: np.ndarray
    length: np.ndarray
    edge_area: np.ndarray
    area: np.ndarray
    bending_start: np.ndarray
    bending_column: np.ndarray
    bending_value: np.ndarray

    @classmethod
    def build(cls, faces: np.ndarray, lengths: Callable[[np.ndarray], np.ndarray]) -> ClothMesh:
        """Return the mesh of some triangles.

        Args:
            faces: shape ``(T, 3)``; every vertex up to the highest has a triangle, no edge more than two.
            lengths: of pairs of vertices in the pattern, shape ``(K, 2)`` to ``(K,)`` [m]; asked for edges only.

        Raises:
            ValueError: a vertex without a triangle, an edge with three, or a triangle without an area.
        """
        faces = np.ascontiguousarray(faces, np.int32).reshape(-1, 3)
        if not len(faces):
            raise ValueError("a mesh of cloth has no triangles; give at least one")
        num = int(faces.max()) + 1
        unused = np.setdiff1d(np.arange(num), faces)
        if len(unused):
            raise ValueError(f"vertex {unused[0]} of the cloth has no triangle; remove it")
        edges, of_side = _edges(faces)
        colors = _colors(edges, num)
        order = np.argsort(colors, kind="stable")
        edges, of_side = edges[order], np.argsort(order)[of_side]
        length = np.asarray(lengths(edges), np.float64)
        sides = length[of_side]  # (T, 3), of corners 01, 12 and 20
        area = _areas(sides)
        if not np.all(area > 0.0):
            bad = int(np.argmin(area > 0.0))
            raise ValueError(f"triangle {bad} of the cloth has sides {sides[bad].tolist()} m, hence no area; remove it")
        edge_area = np.bincount(of_side.ravel(), np.repeat(area, 3), len(edges))
        vertex_area = np.bincount(faces.ravel(), np.repeat(area / 3.0, 3), num)
        start = _color_start(colors[order])
        q = _bending(faces, edges, of_side, sides, area)
        return cls(
            num, faces, edges, start, length, edge_area, vertex_area,
            q.indptr.astype(np.int32), q.indices.astype(np.int32), q.data,
        )  # fmt: skip

    @property
    def num_edges(self) -> int:
        """``M``."""
        return len(self.edges)

    @property
    def num_colors(self) -> int:
        """Number of colors of the edges."""
        return len(self.color_start) - 1

    @property
    def sides(self) -> np.ndarray:
        """Edges between corners 01, 12 and 20 of each triangle, shape ``(T, 3)``."""
        ends = np.sort(self.edges, axis=1).astype(np.int64)
        key = ends[:, 0] * self.num_vertices + ends[:, 1]
        order = np.argsort(key)
        side = np.sort(np.stack([self.faces, np.roll(self.faces, -1, axis=1)], axis=2), axis=2).astype(np.int64)
        return order[np.searchsorted(key[order], side[..., 0] * self.num_vertices + side[..., 1])]

    @property
    def face_area(self) -> np.ndarray:
        """Areas of the triangles [m^2], shape ``(T,)``."""
        return _areas(self.length[self.sides])

    def stiffest_bending(self, held: np.ndarray) -> float:
        """Return the greatest eigenvalue of bending [1/m^4]: of Q over the areas of the vertices.

        A wave of this kind has the frequency ``sqrt(D / sigma)`` times its root [rad/s], the highest of the mesh.

        Args:
            held: vertices that do not move, shape ``(H,)``.
        """
        root = 1.0 / np.sqrt(self.area)
        root[held] = 0.0
        q = sparse.csr_array((self.bending_value, self.bending_column, self.bending_start), shape=2 * (len(root),))
        scaled = sparse.diags_array(root) @ q @ sparse.diags_array(root)
        start = np.random.default_rng(0).standard_normal(len(root))  # the library's own would differ from run to run
        return float(eigsh(scaled, k=1, v0=start, tol=1e-3, return_eigenvectors=False)[0])

    def strain(self, positions: np.ndarray) -> np.ndarray:
        """Return how much longer than in the pattern the edges are, relative to it.

        Args:
            positions: of the vertices [m], shape ``(..., V, 3)``.

        Returns:
            Shape ``(..., M)``.
        """
        way = positions[..., self.edges[:, 0], :] - positions[..., self.edges[:, 1], :]
        return np.linalg.norm(way, axis=-1) / self.length - 1.0


def joined(meshes: Sequence[ClothMesh]) -> ClothMesh:
    """Return several meshes as one: vertices one after another, edges of a color in the order of the meshes."""
    first = np.cumsum([0, *(mesh.num_vertices for mesh in meshes)])
    colors = np.concatenate([np.repeat(np.arange(mesh.num_colors), np.diff(mesh.color_start)) for mesh in meshes])
    order = np.argsort(colors, kind="stable")

    def shifted(name: str) -> np.ndarray:
        each = [getattr(mesh, name) + at for mesh, at in zip(meshes, first, strict=False)]
        return np.concatenate(each).astype(np.int32)

    def all_of(name: str) -> np.ndarray:
        return np.concatenate([getattr(mesh, name) for mesh in meshes])

    rows = np.concatenate([np.diff(mesh.bending_start) for mesh in meshes])
    return ClothMesh(
        int(first[-1]),
        shifted("faces"),
        shifted("edges")[order],
        _color_start(colors[order]),
        all_of("length")[order],
        all_of("edge_area")[order],
        all_of("area"),
        np.concatenate([[0], np.cumsum(rows)]).astype(np.int32),
        shifted("bending_column"),
        all_of("bending_value"),
    )


def _edges(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return all edges, ``(M, 2)``, and the edge of every side of a triangle, ``(T, 3)``."""
    side = np.stack([faces, np.roll(faces, -1, axis=1)], axis=2)
    edges, of_side, count = np.unique(
        np.sort(side.reshape(-1, 2), axis=1), axis=0, return_inverse=True, return_counts=True
    )
    if count.max() > 2:
        a, b = edges[count.argmax()]
        raise ValueError(f"the edge between vertices {a} and {b} of the cloth has {count.max()} triangles; keep two")
    return edges.astype(np.int32), of_side.reshape(-1, 3)


def _colors(edges: np.ndarray, num: int) -> np.ndarray:
    """Return a color for every edge, the lowest that no edge at its two vertices has."""
    used = [0] * num
    colors = np.zeros(len(edges), np.int32)
    for n, (a, b) in enumerate(edges.tolist()):
        taken = used[a] | used[b]
        free = ~taken & (taken + 1)
        colors[n] = free.bit_length() - 1
        used[a] |= free
        used[b] |= free
    return colors


def _areas(sides: np.ndarray) -> np.ndarray:
    """Return the areas of triangles by Heron's formula, NaN or 0 where sides make none."""
    half = 0.5 * sides.sum(axis=1)
    with np.errstate(invalid="ignore"):
        return np.sqrt(half * np.prod(half[:, None] - sides, axis=1))


def _color_start(colors: np.ndarray) -> np.ndarray:
    """Return the first edge of each color, and the number of edges, of ascending colors."""
    return np.searchsorted(colors, np.arange(colors.max() + 2)).astype(np.int32)


def _bending(
    faces: np.ndarray, edges: np.ndarray, of_side: np.ndarray, sides: np.ndarray, area: np.ndarray
) -> sparse.csr_array:
    """Return Q, the sum of ``K^T K / (A1 + A2)`` over the edges between two triangles of areas A1 and A2.

    ``K x`` is an edge's length times the angle of its hinge (Bergou et al. 2006). Their factor is three times as large,
    for which a cylinder of equilateral triangles bends three times too stiffly.
    """
    # cotangents at the corners, which lie opposite the sides 12, 20 and 01
    a, b, c = (np.roll(sides, -shift, axis=1) for shift in (1, 2, 0))
    cotangent = (b * b + c * c - a * a) / (4.0 * area[:, None])
    by_edge = np.argsort(of_side.ravel(), kind="stable")
    count = np.bincount(of_side.ravel(), minlength=len(edges))
    inner = np.flatnonzero(count == 2)
    first = (np.cumsum(count) - count)[inner]
    triangle, corner = np.divmod(np.stack([by_edge[first], by_edge[first + 1]], axis=1), 3)  # (H, 2): both sides
    i, j = edges[inner].T
    k, l = faces[triangle, (corner + 2) % 3].T  # opposite the edge
    forward = faces[triangle, corner] == i[:, None]
    at_i = cotangent[triangle, np.where(forward, corner, (corner + 1) % 3)]
    at_j = cotangent[triangle, np.where(forward, (corner + 1) % 3, corner)]
    hinge = np.stack([i, j, k, l], axis=1)
    row = np.stack([at_j.sum(axis=1), at_i.sum(axis=1), *(-(at_i + at_j)).T], axis=1)
    value = row[:, :, None] * row[:, None, :] / area[triangle].sum(axis=1)[:, None, None]
    at = np.broadcast_to(hinge[:, :, None], value.shape), np.broadcast_to(hinge[:, None, :], value.shape)
    num = int(faces.max()) + 1
    q = sparse.csr_array((value.ravel(), (at[0].ravel(), at[1].ravel())), shape=(num, num))
    q.sum_duplicates()
    q.sort_indices()
    return q
