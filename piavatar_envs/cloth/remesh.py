"""Remeshing: a surface with fewer vertices, a subset of its own, evenly spread.

The vertices are farthest points by distance along the edges (Gonzalez, "Clustering to minimize the maximum
intercluster distance", 1985; on surfaces Peyre & Cohen, "Geodesic remeshing using front propagation", 2006). Each of
them owns the vertices that are nearest to it, its Voronoi cell, and the new triangles are dual to the cells: one for
each old triangle between three cells. Where four cells or more meet, a fan of triangles closes the hole. No edge has
more than two triangles; holes may stay where a surface is narrower than a cell, as at fingers.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import dijkstra

#: How many times as wide cells are where a surface may be coarse.
COARSENESS = 3.0
#: Most edges around a hole that is closed.
_WIDEST_HOLE = 12


@dataclass(frozen=True, eq=False)
class Remeshed:
    """A coarser mesh of a surface.

    Attributes:
        keep: its vertices, as indices into the old ones, shape ``(N,)`` int32; those of ``first`` come first.
        faces: its triangles, oriented as the old ones, over the ``N`` vertices, shape ``(T, 3)`` int32.
    """

    keep: np.ndarray
    faces: np.ndarray


def remesh(
    vertices: np.ndarray,
    faces: np.ndarray,
    count: int,
    *,
    coarse: np.ndarray | None = None,
    first: Sequence[np.ndarray] = (),
    spacing: float = 0.03,
) -> Remeshed:
    """Return a mesh of ``count`` of a surface's vertices, evenly spread.

    Args:
        vertices: of the surface [m], shape ``(V, 3)``.
        faces: its triangles, shape ``(T, 3)``.
        count: vertices to keep; fewer remain where a piece of the surface is too small for a triangle.
        coarse: vertices around which cells may be :data:`COARSENESS` times as wide, shape ``(V,)`` bool.
        first: borders, as from :func:`boundary_loops`, whose vertices are sampled by arc length before all others.
        spacing: of the samples on a border [m].

    Raises:
        ValueError: ``count`` is less than the border samples and four, or more than the surface's vertices.
    """
    vertices, faces = np.asarray(vertices, np.float64), np.asarray(faces)
    used = np.unique(faces)
    start = _border_samples(vertices, first, spacing)
    if not max(len(start), 4) <= count <= len(used):
        raise ValueError(
            f"count={count} vertices of a surface of {len(used)} with {len(start)} on its borders; "
            f"choose one from {max(len(start), 4)} to {len(used)}"
        )
    graph = _edge_graph(vertices, faces, coarse)
    keep = np.array(start or [int(used[vertices[used, 2].argmin()])])
    distance, _, owner = dijkstra(graph, indices=keep, min_only=True, return_predecessors=True)
    distance[np.setdiff1d(np.arange(len(vertices)), used)] = -1.0
    chosen = keep.tolist()
    while len(chosen) < count:
        new = int(distance.argmax())  # infinite on a piece without one
        chosen.append(new)
        own = dijkstra(graph, indices=new, limit=distance[new])
        nearer = own < distance
        distance[nearer], owner[nearer] = own[nearer], new
    cell = np.full(len(vertices), -1)
    cell[chosen] = np.arange(count)
    triangles = _dual(cell[owner[faces]])
    triangles = _close(triangles, len(start))
    there, triangles = np.unique(triangles, return_inverse=True)
    return Remeshed(np.array(chosen, np.int32)[there], triangles.reshape(-1, 3).astype(np.int32))


def boundary_loops(faces: np.ndarray) -> list[np.ndarray]:
    """Return the borders of an oriented surface, each a loop of vertices in the direction of its triangles' edges.

    Loops that meet at a vertex are separated there. They begin at their least vertex, and come in the order of it.
    """
    half = _half_edges(faces)
    both = {(a, b) for a, b in half.tolist()}
    follow: dict[int, list[int]] = {}
    for a, b in sorted(both):
        if (b, a) not in both:
            follow.setdefault(a, []).append(b)
    loops = []
    while follow:
        at = min(follow)
        path, place = [at], {at: 0}
        while at in follow:
            ahead = follow[at]
            at = ahead.pop(0)
            if not ahead:
                del follow[path[-1]]
            if at in place:  # closes a loop, perhaps before its way ends
                loop = path[place[at] :]
                loops.append(np.roll(loop, -int(np.argmin(loop))))
                for vertex in loop[1:]:
                    del place[vertex]
                path = path[: place[at] + 1]
            else:
                place[at] = len(path)
                path.append(at)
    return sorted(loops, key=lambda loop: loop.tolist())


def _half_edges(faces: np.ndarray) -> np.ndarray:
    """Return the directed edges of triangles, shape ``(3 T, 2)``."""
    return np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])


def _edge_graph(vertices: np.ndarray, faces: np.ndarray, coarse: np.ndarray | None) -> sparse.csr_array:
    """Return the lengths of edges [m], less where a surface may be coarse, shape ``(V, V)``."""
    edges = np.unique(np.sort(_half_edges(faces), axis=1), axis=0)
    length = np.maximum(np.linalg.norm(vertices[edges[:, 0]] - vertices[edges[:, 1]], axis=1), 1e-9)
    if coarse is not None:
        length = np.where(np.asarray(coarse)[edges].any(axis=1), length / COARSENESS, length)
    rows = np.concatenate([edges[:, 0], edges[:, 1]]), np.concatenate([edges[:, 1], edges[:, 0]])
    return sparse.csr_array((np.concatenate([length, length]), rows), shape=(len(vertices),) * 2)


def _border_samples(vertices: np.ndarray, loops: Sequence[np.ndarray], spacing: float) -> list[int]:
    """Return the vertices of loops nearest to even steps of arc length, three of each at least."""
    samples: dict[int, None] = {}
    for loop in loops:
        points = vertices[loop]
        steps = np.linalg.norm(np.roll(points, -1, axis=0) - points, axis=1)
        length, at = steps.sum(), np.concatenate([[0.0], np.cumsum(steps)[:-1]])
        count = max(3, round(length / spacing))
        samples |= dict.fromkeys(int(loop[np.abs(at - goal).argmin()]) for goal in np.arange(count) * length / count)
    return list(samples)


def _dual(cells: np.ndarray) -> np.ndarray:
    """Return the triangles between three different cells, each once, from the cells at old triangles' corners."""
    a, b, c = cells.T
    apart = cells[(a != b) & (b != c) & (c != a)]
    _, once = np.unique(np.sort(apart, axis=1), axis=0, return_index=True)
    return np.array(_oriented([], apart[np.sort(once)].tolist()), cells.dtype).reshape(-1, 3)


def _oriented(there: list[list[int]], more: list[list[int]]) -> list[list[int]]:
    """Return triangles and those of ``more``, in order, that give no edge a second triangle on the same side.

    Such are left out where a surface is narrower than a cell, as a finger.
    """
    taken = {(t[k - 1], t[k]) for t in there for k in range(3)}
    triangles = list(there)
    for t in more:
        own = {(t[k - 1], t[k]) for k in range(3)}
        if not own & taken:
            taken |= own
            triangles.append(t)
    return triangles


def _close(faces: np.ndarray, borders: int) -> np.ndarray:
    """Return the triangles and fans over small holes, but not over those between the first vertices, the borders."""
    fans = []
    for loop in boundary_loops(faces):
        of_border = np.count_nonzero(loop < borders)  # a border may have a vertex more that has come to lie on it
        if 3 <= len(loop) <= _WIDEST_HOLE and (2 * of_border <= len(loop) or of_border < len(loop) <= 4):
            around = loop[::-1]  # the hole's edges run against those of its triangles
            fans += [[around[0], around[k], around[k + 1]] for k in range(1, len(loop) - 1)]
    return np.array(_oriented(faces.tolist(), fans), faces.dtype)
