"""Panels cut from the skin itself: the body's surface inside of seams, moved outwards, smoothed and meshed anew.

A garment close to the body, such as a shirt, follows its skin. It is cut where a field over the skin crosses zero,
parts of which are planes placed by joints, so that bodies of any size can be dressed. It is eased outwards along the
normals, and smoothed without loss of size (G. Taubin, "A signal processing approach to fair surface design", 1995),
borders along themselves. What the smoothing took inwards comes out of the skin again.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import connected_components

from piavatar_envs.avatar.body.asset import vertex_normals
from piavatar_envs.avatar.body.outfit import cut_triangles
from piavatar_envs.cloth.pattern import ROW
from piavatar_envs.cloth.remesh import boundary_loops, remesh
from piavatar_envs.cloth.subdivision import levels_for, subdivided
from piavatar_envs.cloth.wearer import Wearer

#: Ways outwards [m], shape ``(W, 3)``, of a piece's points with normals, and its shares of the wearer's vertices.
Ease = Callable[[Wearer, sparse.csr_array, np.ndarray, np.ndarray], np.ndarray]
#: Base of the neck below its joint, over the way to that of the chest, slope of its plane, lower in front, and width of
#: a neckline over that of the shoulders' joints.
_COLLAR, _TILT, _WIDTH = 0.03, 0.45, 0.45
#: Shares of a smoothing pass and of the one back, which keeps the size.
_SHARES = 0.63, -0.65
#: Passes along the coarse mesh, which make its edges even.
_EVENING = 12
#: Longest edges of a piece of skin, on average, over the wanted length: cloth has some of the piece's vertices.
_FINEST = 0.9
#: Fewest vertices of a piece of skin.
_FEWEST = 20
#: Length of a border over the height of the wearer, below which it is a hole and no hem.
_HOLE = 0.06
#: Shortest edge that stays, over the wanted length.
SHORTEST = 0.6
#: Turns of edges in which a mesh is made of better triangles, over the number of its edges.
_MOST_FLIPS = 10
#: Sum of two angles from which an edge between them is turned.
_FLAT = math.pi + 1.0e-6


@dataclass(frozen=True, eq=False)
class Sheet:
    """A surface with borders.

    Attributes:
        faces: triangles, shape ``(T, 3)``; all vertices up to the highest have one.
    """

    faces: np.ndarray

    @cached_property
    def loops(self) -> list[np.ndarray]:
        """Borders, each a loop of vertices."""
        return boundary_loops(self.faces)

    @cached_property
    def rim(self) -> np.ndarray:
        """Whether each vertex is on a border, shape ``(V,)`` bool."""
        rim = np.zeros(int(self.faces.max()) + 1, bool)
        for loop in self.loops:
            rim[loop] = True
        return rim

    @cached_property
    def beside(self) -> tuple[np.ndarray, np.ndarray]:
        """Vertices before and after each on its border, itself elsewhere, both shape ``(V,)``."""
        before, after = np.arange(len(self.rim)), np.arange(len(self.rim))
        for loop in self.loops:
            before[loop], after[loop] = np.roll(loop, 1), np.roll(loop, -1)
        return before, after

    @cached_property
    def mean(self) -> sparse.csr_array:
        """The matrix that takes the mean of each vertex's neighbors; on a border, of those along it."""
        count = len(self.rim)
        links = np.concatenate([self.faces[:, [0, 1]], self.faces[:, [1, 2]], self.faces[:, [2, 0]]])
        near = sparse.coo_array((np.ones(len(links)), links.T), shape=(count, count)).tocsr()
        both = sparse.diags_array((~self.rim).astype(np.float64)) @ ((near + near.T) > 0).astype(np.float64)
        if self.loops:
            start, end = np.concatenate(self.loops), np.concatenate([np.roll(loop, -1) for loop in self.loops])
            along = sparse.coo_array((np.ones(len(start)), (start, end)), shape=near.shape).tocsr()
            both = both + ((along + along.T) > 0).astype(np.float64)
        return (sparse.diags_array(1.0 / np.maximum(both.sum(axis=1), 1.0)) @ both).tocsr()


@dataclass(frozen=True, eq=False)
class Panel:
    """A piece of the skin on which a garment is laid out.

    Attributes:
        blend: shares of the skin's vertices in those of the piece, rows sum to one, shape ``(W, V)``.
        piece: of the skin, ``W`` vertices.
        keep: vertices of the piece that are those of the garment, shape ``(N,)``.
        cloth: the garment, ``N`` vertices.
    """

    blend: sparse.csr_array
    piece: Sheet
    keep: np.ndarray
    cloth: Sheet

    @property
    def faces(self) -> np.ndarray:
        """Triangles of the garment, shape ``(T, 3)`` int32."""
        return self.cloth.faces

    @property
    def anchors(self) -> sparse.csr_array:
        """Shares of the skin's vertices in those of the garment, shape ``(N, V)``."""
        return self.blend[self.keep]


def lay_out(wearer: Wearer, field: np.ndarray, ease: Ease, gap: float, edge: float, smoothing: int) -> Panel:
    """Return the largest piece of skin inside of a field, meshed for cloth.

    Args:
        wearer: the body.
        field: of its vertices, positive inside, zero on the seams, shape ``(V,)``.
        ease: way outwards of the cloth.
        gap: least distance from the skin [m].
        edge: length of the garment's edges, about [m].
        smoothing: passes of it.

    Raises:
        ValueError: less than a few edges' size is inside.
    """
    blend, triangles = cut_triangles(field, wearer.faces.astype(np.int64))
    inside = blend @ field > -1.0e-9
    triangles = triangles[inside[triangles].all(axis=1)]
    triangles = _largest(triangles, blend.shape[0])
    used, rows = np.unique(triangles, return_inverse=True)
    blend, piece = blend[used].tocsr(), Sheet(rows.reshape(-1, 3))
    if len(used) < _FEWEST or not piece.loops:
        raise ValueError("nothing of the body is inside of the garment's seams, or all of it; change where they are")
    piece = _without_holes(piece, blend @ wearer.vertices, _HOLE * float(np.ptp(wearer.vertices[:, 2])))
    levels = levels_for(piece.faces, blend @ wearer.vertices, _FINEST * edge, most=4)
    if levels:
        fine = subdivided(piece.faces, blend.shape[0], levels, smooth=False)
        blend, piece = (fine.matrix @ blend).tocsr(), Sheet(fine.faces)
    points = _laid(wearer, blend, piece, ease, gap, smoothing)
    area = 0.5 * np.linalg.norm(np.cross(*_sides(points, piece.faces)), axis=1).sum()
    least = sum(max(3, round(_around(points[loop]) / edge)) for loop in piece.loops)
    count = min(max(int(area / (ROW * edge**2)), least + 4, 12), blend.shape[0])
    found = remesh(points, piece.faces, count, first=piece.loops, spacing=edge)
    faces = _without_notches(found.faces, piece.rim[found.keep])
    panel = Panel(blend, piece, found.keep, Sheet(flipped(points[found.keep], faces)))
    there, faces = without_short(_evened(wearer, panel, points, gap), panel.faces, SHORTEST * edge)
    panel = replace(panel, keep=panel.keep[there], cloth=Sheet(faces))
    return replace(panel, cloth=Sheet(flipped(_evened(wearer, panel, points, gap), faces)))


def laid(wearer: Wearer, panel: Panel, ease: Ease, gap: float, smoothing: int) -> np.ndarray:
    """Return the vertices of a garment on a wearer [m], shape ``(N, 3)``; arguments as of :func:`lay_out`."""
    return _evened(wearer, panel, _laid(wearer, panel.blend, panel.piece, ease, gap, smoothing), gap)


def _evened(wearer: Wearer, panel: Panel, points: np.ndarray, gap: float) -> np.ndarray:
    """Return the vertices of a garment on its piece of skin, moved along it for even edges [m], ``(N, 3)``."""
    points = points[panel.keep]
    before, after = panel.cloth.beside
    for _ in range(_EVENING):
        way, normals = panel.cloth.mean @ points - points, vertex_normals(points, panel.faces)
        tangent = points[after] - points[before]  # of a border, which is to keep its place; zero elsewhere
        tangent /= np.maximum(np.linalg.norm(tangent, axis=1, keepdims=True), 1.0e-9)
        inside = way - np.einsum("nd,nd->n", way, normals)[:, None] * normals
        along = np.einsum("nd,nd->n", way, tangent)[:, None] * tangent
        points = points + 0.5 * np.where(panel.cloth.rim[:, None], along, inside)
    return wearer.outside(points, gap)


def along_limb(wearer: Wearer, first: str, second: str, third: str) -> np.ndarray:
    """Return how far each vertex is along the limbs of both sides, shape ``(V,)``; minus infinity elsewhere.

    It is 0 at the first joint, 1 at the second and 2 at the third, and goes on beyond them.
    """
    along = np.full(len(wearer.vertices), -np.inf)
    for side in ("left", "right"):
        joints = [wearer.at(f"{side}_{joint}") for joint in (first, second, third)]
        for index, joint in enumerate((first, second)):
            way = joints[index + 1] - joints[index]
            own = wearer.turned_by(f"{side}_{joint}") > 0.5
            along = np.where(own, index + (wearer.vertices - joints[index]) @ way / (way @ way), along)
    return along


def limb_field(wearer: Wearer, along: np.ndarray, end: float, first: str, second: str) -> np.ndarray:
    """Return the distance of each vertex from a limb's seam [m], positive before it; 1 m elsewhere; shape ``(V,)``.

    Args:
        wearer: the body.
        along: of :func:`along_limb`.
        end: place of the seam along it.
        first: joint at its beginning, without the side.
        second: the next one.
    """
    size = np.linalg.norm(wearer.at(f"left_{second}") - wearer.at(f"left_{first}"))
    return np.where(np.isfinite(along), (end - along) * size, 1.0)


def below_neck(wearer: Wearer, depth: float) -> np.ndarray:
    """Return the distance of each vertex from a round neckline [m], positive outside of it, shape ``(V,)``.

    Args:
        wearer: the body.
        depth: of the neckline in front, below the base of the neck, over the way from there to the joint of the chest;
            half of it at the back.
    """
    neck, unit = wearer.at("neck"), wearer.at("neck")[2] - wearer.at("spine3")[2]
    down = np.array([0.0, _TILT, -1.0]) / np.hypot(_TILT, 1.0)
    from_neck = wearer.vertices - neck
    low = from_neck @ down - _COLLAR * unit
    wide = _WIDTH * wearer.at("left_shoulder")[0] - wearer.at("right_shoulder")[0] * _WIDTH
    deep = np.maximum(depth - _COLLAR, 1.0e-3) * unit * np.where(from_neck[:, 1] < 0.0, 1.0, 0.5)
    scoop = np.hypot(from_neck[:, 0] / (0.5 * wide), np.maximum(low, 0.0) / deep) - 1.0
    field = np.where(low > 0.0, np.minimum(low, scoop * np.minimum(0.5 * wide, deep)), low)
    return np.where(wearer.turned_by("head") > 0.5, -1.0, field)


def _laid(wearer: Wearer, blend: sparse.csr_array, piece: Sheet, ease: Ease, gap: float, smoothing: int) -> np.ndarray:
    """Return the vertices of a piece of skin, eased outwards and smoothed [m], shape ``(W, 3)``."""
    points = blend @ wearer.vertices
    points = points + ease(wearer, blend, points, vertex_normals(points, piece.faces))
    for step in range(smoothing):
        for share in _SHARES:
            points = points + share * (piece.mean @ points - points)
        if step % 8 == 7:
            points = wearer.outside(points, gap)
    return wearer.outside(points, gap)


def _around(points: np.ndarray) -> float:
    """Return the length of a closed line [m]."""
    return float(np.linalg.norm(np.roll(points, -1, axis=0) - points, axis=1).sum())


def _without_holes(piece: Sheet, points: np.ndarray, least: float) -> Sheet:
    """Return a surface with fans over the borders that are shorter than a length [m]."""
    fans = []
    for loop in piece.loops:
        if _around(points[loop]) < least:
            around = loop[::-1]  # against the edges of the triangles beside it
            fans += [(around[0], around[k], around[k + 1]) for k in range(1, len(around) - 1)]
    return Sheet(np.concatenate([piece.faces, np.array(fans, piece.faces.dtype).reshape(-1, 3)])) if fans else piece


def _without_notches(faces: np.ndarray, rim: np.ndarray) -> np.ndarray:
    """Return the triangles of a mesh, and one more where a vertex within it came to lie on its border."""
    more = []
    for loop in boundary_loops(faces):
        for before, at, after in zip(np.roll(loop, 1), loop, np.roll(loop, -1), strict=True):
            if not rim[at] and rim[before] and rim[after]:
                more.append((before, after, at))
    return np.concatenate([faces, np.array(more, faces.dtype).reshape(-1, 3)])


def without_short(points: np.ndarray, faces: np.ndarray, least: float) -> tuple[np.ndarray, np.ndarray]:
    """Return a mesh with edges shorter than a length collapsed: vertices that remain ``(N,)``, and triangles over them.

    An edge is collapsed to one of its ends, that on a border if one is; not where the surface would touch itself
    (Dey et al., "Topology preserving edge contraction", 1999).

    Args:
        points: vertices [m], shape ``(V, 3)``.
        faces: triangles, shape ``(T, 3)``.
        least: the length [m].
    """
    around: list[set[tuple[int, int, int]]] = [set() for _ in points]
    for face in faces.tolist():
        for vertex in face:
            around[vertex].add(tuple(face))
    border = set(np.concatenate([*boundary_loops(faces), np.zeros(0, np.int64)]).tolist())
    pairs = np.unique(np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1), axis=0)
    size = np.linalg.norm(points[pairs[:, 0]] - points[pairs[:, 1]], axis=1)
    for stay, go in pairs[np.argsort(size, kind="stable")][: np.count_nonzero(size < least)].tolist():
        if go in border and stay not in border:
            stay, go = go, stay
        shared = around[stay] & around[go]
        if not shared or len(shared) != (1 if stay in border and go in border else 2):
            continue  # no edge any more, or one across the inside between two borders
        near = [{vertex for face in around[end] for vertex in face} - {stay, go} for end in (stay, go)]
        if len(near[0] & near[1]) != len(shared):
            continue
        for face in list(around[go]):
            for vertex in face:
                around[vertex].discard(face)
            if face not in shared:
                moved = tuple(stay if vertex == go else vertex for vertex in face)
                for vertex in moved:
                    around[vertex].add(moved)
    left = np.array(sorted({face for own in around for face in own}), faces.dtype)
    there, left = np.unique(left, return_inverse=True)
    return there, left.reshape(-1, 3).astype(faces.dtype)


def flipped(points: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return triangles with edges turned where the angles opposite to them are more than pi together.

    Such edges are those that are not of the intrinsic Delaunay triangulation (Bobenko & Springborn, "A discrete
    Laplace-Beltrami operator for simplicial surfaces", 2007), which has the largest least angles.
    """
    places, triangles = points.tolist(), [tuple(face) for face in faces.tolist()]
    beside = {(t[k], t[(k + 1) % 3]): index for index, t in enumerate(triangles) for k in range(3)}
    queue = [edge for edge in beside if edge[0] < edge[1]]
    for _ in range(_MOST_FLIPS * len(queue)):
        if not queue:
            break
        a, b = queue.pop()
        one, two = beside.get((a, b)), beside.get((b, a))
        if one is None or two is None:
            continue
        c, d = (next(v for v in triangles[index] if v not in (a, b)) for index in (one, two))
        taken = c == d or (c, d) in beside or (d, c) in beside
        if taken or _angle(places[c], places[a], places[b]) + _angle(places[d], places[a], places[b]) <= _FLAT:
            continue
        del beside[a, b], beside[b, a]
        triangles[one], triangles[two] = (c, a, d), (d, b, c)
        for index in (one, two):
            t = triangles[index]
            beside |= {(t[k], t[(k + 1) % 3]): index for k in range(3)}
        queue += [(c, a), (a, d), (d, b), (b, c)]
    return np.array(triangles, faces.dtype)


def _angle(at: list[float], first: list[float], second: list[float]) -> float:
    """Return the angle at a point between two others."""
    a, b = [x - y for x, y in zip(first, at, strict=True)], [x - y for x, y in zip(second, at, strict=True)]
    cross = math.hypot(a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])
    return math.atan2(cross, a[0] * b[0] + a[1] * b[1] + a[2] * b[2])


def _largest(triangles: np.ndarray, count: int) -> np.ndarray:
    """Return the triangles of the piece with most of them."""
    if not len(triangles):
        return triangles
    links = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]]])
    graph = sparse.coo_array((np.ones(len(links)), links.T), shape=(count, count))
    piece = connected_components(graph, directed=False)[1][triangles[:, 0]]
    return triangles[piece == np.bincount(piece).argmax()]


def _sides(points: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return two sides of each triangle [m], each shape ``(T, 3)``."""
    corner = points[faces[:, 0]]
    return points[faces[:, 1]] - corner, points[faces[:, 2]] - corner
