"""Closed skins from the surfaces of a character: what is body, what is only worn, and one watertight mesh of the body.

Files of characters are soups: a body with holes at eyes and mouth, clothes over it, hair of single sheets, parts that
overlap. Vertices at one place are welded and the triangles split into *shells*, which share edges. Whether a shell
encloses a volume is read from its boundary loops: what would close them, flat *caps*, is small for a body with a mouth
and most of the area for a skirt or a strand of hair. Shells that enclose a volume are body, others are worn.

With its caps a shell has no boundary, so that its winding number is a whole number at every point; a point is inside
the body where that of any body shell is positive (Jacobson, Kavan & Sorkine-Hornung, "Robust Inside-Outside
Segmentation using Generalized Winding Numbers", ACM Trans. Graph. 32 (2013); with caps the numbers are whole ones).
The body's skin is the iso-surface of the signed distance to the union on a grid, by marching cubes (Lorensen & Cline,
SIGGRAPH 1987). Its largest piece is kept and its cavities are filled.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import warp as wp
from scipy import ndimage, sparse
from scipy.sparse.csgraph import connected_components

from piavatar_envs.avatar.body.asset import area_vectors, mesh_volume
from piavatar_envs.avatar.body.sampling import ClosedSurface
from piavatar_envs.core.kernel_cache import init_warp

#: Vertices nearer than this are one [m].
WELD = 1e-5
#: Share of a shell's area that the caps of a body may have.
MOST_CAP_SHARE = 0.04
#: Spacing of the grid [m].
CELL = 0.012
#: Mean thickness of a body shell over the spacing: thinner ones the grid would tear.
LEAST_THICKNESS = 0.25
#: Triangles up to which a surface that is one closed shell is taken as it is.
MOST_TRIANGLES = 100_000
#: Nodes of the largest grid, which bounds memory.
MOST_NODES = 40_000_000
#: Distance from the surface in which distances are computed, over the spacing; more than a diagonal of a cell.
_BAND = 2.0
#: Least distance of a node from the iso-surface, over the spacing, so that no triangle degenerates.
_LEAST_DISTANCE = 1e-3


@dataclass(frozen=True, eq=False)
class Shell:
    """Triangles that share edges, outward oriented where they enclose a volume.

    Attributes:
        rows: indices of its triangles in the soup, shape ``(T,)``.
        faces: its triangles, shape ``(T, 3)`` int32.
        caps: triangles that close it, with vertices of their own at the end of :attr:`Soup.vertices`, ``(C, 3)`` int32.
        area: without caps [m^2].
        cap_share: area of the flat caps over that of the shell.
        volume: with caps [m^3].
        body: whether it is body; else it is worn.
    """

    rows: np.ndarray
    faces: np.ndarray
    caps: np.ndarray
    area: float
    cap_share: float
    volume: float
    body: bool


@dataclass(frozen=True, eq=False)
class Soup:
    """The welded surfaces of a character.

    Attributes:
        origin: vertices of the file that are welded to each vertex, as a matrix of means, shape ``(N, V)``; rows of
            cap centres are means of their loops.
        flipped: triangles of the file to be turned round, shape ``(T,)`` bool.
        shells: by descending volume of the shells with caps.
    """

    origin: sparse.csr_array
    flipped: np.ndarray
    shells: tuple[Shell, ...]

    @property
    def body(self) -> tuple[Shell, ...]:
        """Shells that are body."""
        return tuple(shell for shell in self.shells if shell.body)

    @property
    def worn(self) -> tuple[Shell, ...]:
        """Shells that are only drawn."""
        return tuple(shell for shell in self.shells if not shell.body)


@dataclass(frozen=True, eq=False)
class ClosedSkin:
    """A watertight, outward oriented mesh, and where its vertices are on the surface that it closes.

    Attributes:
        vertices: shape ``(N, 3)`` float64 [m].
        faces: shape ``(F, 3)`` int32.
        anchors: from values at the vertices of the file to values at these, rows sum to one, shape ``(N, V)``.
    """

    vertices: np.ndarray
    faces: np.ndarray
    anchors: sparse.csr_array


def read_soup(vertices: np.ndarray, faces: np.ndarray, held: np.ndarray | None = None, cell: float = CELL) -> Soup:
    """Weld, split and orient the surfaces of a file, and decide what is body.

    Args:
        vertices: in the file's rest pose, where seams meet exactly [m], shape ``(V, 3)``.
        faces: triangles, shape ``(T, 3)``.
        held: triangles that are never body, shape ``(T,)`` bool.
        cell: spacing of the grid that is to resolve the body [m].

    Raises:
        ValueError: there are no triangles, or a vertex is not finite.
    """
    vertices, faces = np.asarray(vertices, np.float64), np.asarray(faces, np.int64)
    if not len(faces):
        raise ValueError("the surface has no triangles")
    if not np.isfinite(vertices).all():
        raise ValueError(f"vertex {int(np.flatnonzero(~np.isfinite(vertices).all(axis=1))[0])} is not finite")
    held = np.zeros(len(faces), bool) if held is None else np.asarray(held, bool)
    place = _welded(vertices)
    count = int(place.max()) + 1
    rows = distinct(place[faces])
    welded = place[faces[rows]]
    means = sparse.csr_array((np.ones(len(place)), (place, np.arange(len(place)))), shape=(count, len(place)))
    means = sparse.csr_array(sparse.diags_array(1.0 / means.sum(axis=1)) @ means)
    points = means @ vertices
    edges = _Edges(welded)
    turned = edges.inconsistent()
    welded[turned] = welded[turned, ::-1]
    label = edges.shells()
    shells, centres, flipped = [], [], np.zeros(len(faces), bool)
    flipped[rows] = turned
    order = np.argsort(label, kind="stable")
    for own in np.split(order, np.flatnonzero(np.diff(label[order])) + 1):
        shell, loops = _shell(points, welded[own], rows[own], count + len(centres))
        if shell.volume < 0.0:
            flipped[shell.rows] ^= True
            shell = replace(shell, faces=shell.faces[:, ::-1], caps=shell.caps[:, ::-1], volume=-shell.volume)
        thick = 2.0 * shell.volume > LEAST_THICKNESS * cell * shell.area
        body = thick and shell.cap_share <= MOST_CAP_SHARE and not held[shell.rows].any()
        shells.append(replace(shell, body=body))
        centres += loops if body else []
    if centres:
        means = sparse.csr_array(sparse.vstack([means, _means(centres, count) @ means]))
    return Soup(means, flipped, tuple(sorted(shells, key=lambda shell: (-shell.volume, shell.rows[0]))))


def close_skin(soup: Soup, vertices: np.ndarray, cell: float = CELL) -> ClosedSkin:
    """Return the closed skin of the body shells, the same on every call.

    Args:
        soup: the surfaces.
        vertices: of the file, in the pose in which the skin is closed [m], shape ``(V, 3)``.
        cell: spacing of the grid [m].

    Raises:
        ValueError: no shell is body, or the grid would be too large.
    """
    if not soup.body:
        raise ValueError(
            "no part of the surface encloses a volume: the flat caps of all boundary loops would have more than "
            f"{MOST_CAP_SHARE:.0%} of the area; close the largest holes"
        )
    points = (soup.origin @ np.asarray(vertices, np.float64)).astype(np.float32)
    only = soup.body[0]
    if len(soup.body) == 1 and not len(only.caps) and len(only.faces) <= MOST_TRIANGLES and _is_manifold(only.faces):
        used, faces = np.unique(only.faces, return_inverse=True)
        faces = faces.reshape(-1, 3).astype(np.int32)
        return ClosedSkin(points[used].astype(np.float64), faces, sparse.csr_array(soup.origin[used]))
    closed = [np.concatenate([shell.faces, shell.caps]).astype(np.int32) for shell in soup.body]
    skin, faces = _iso_surface(points, closed, cell)
    return ClosedSkin(skin, faces, _anchors(skin, points, np.concatenate(closed), soup.origin))


class _Edges:
    """Edges of triangles, each in the two directions that its triangles may run along it."""

    def __init__(self, faces: np.ndarray) -> None:
        start, end = faces.T.ravel(), np.roll(faces, -1, axis=1).T.ravel()
        key = np.minimum(start, end) * (int(faces.max()) + 1) + np.maximum(start, end)
        self._forwards = start < end
        _, self._edge, self._uses = np.unique(key, return_inverse=True, return_counts=True)
        self._face = np.tile(np.arange(len(faces)), 3)
        self._count = len(faces)

    def shells(self) -> np.ndarray:
        """Return the shell of every triangle: those that are joined by edges."""
        size = self._count + len(self._uses)
        links = (np.ones(len(self._face), np.int8), (self._face, self._count + self._edge))
        return connected_components(sparse.coo_array(links, shape=(size, size)), directed=False)[1][: self._count]

    def inconsistent(self) -> np.ndarray:
        """Return which triangles run against most of those that they are joined to, shape ``(T,)`` bool.

        Each triangle is a node of a graph twice, as it is and turned round; edges that two triangles share link the
        nodes that agree. A patch that can be oriented has then two components, mirror images of each other.
        """
        order = np.argsort(self._edge, kind="stable")
        pairs = order[self._uses[self._edge[order]] == 2].reshape(-1, 2)
        first, second = self._face[pairs].T
        agree = self._forwards[pairs[:, 0]] != self._forwards[pairs[:, 1]]
        if agree.all():
            return np.zeros(self._count, bool)
        partner = np.where(agree, second, second + self._count)
        mirror = np.where(agree, second + self._count, second)
        links = (np.concatenate([first, first + self._count]), np.concatenate([partner, mirror]))
        graph = sparse.coo_array((np.ones(2 * len(first), np.int8), links), shape=(2 * self._count,) * 2)
        label = connected_components(graph, directed=False)[1]
        own, other = label[: self._count], label[self._count :]
        turned, patch = own > other, np.minimum(own, other)
        size = np.bincount(patch)
        most = 2 * np.bincount(patch, turned, len(size)) > size
        return (turned ^ most[patch]) & (own != other)


def _welded(vertices: np.ndarray) -> np.ndarray:
    """Return for every vertex the number of the place that it is at, shape ``(V,)``."""
    return unique_rows(np.round(vertices / WELD).astype(np.int64))[1]


def distinct(faces: np.ndarray) -> np.ndarray:
    """Return rows of triangles with three corners, of those with the same corners (two sides of a sheet) the first."""
    a, b, c = faces.T
    good = np.flatnonzero((a != b) & (b != c) & (c != a))
    return np.sort(good[unique_rows(np.sort(faces[good], axis=1))[0]])


def unique_rows(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the first of each set of equal rows of integers ``(N, 3)``, and for every row the number of its set."""
    low = rows.min(axis=0)
    size = [int(width) + 1 for width in rows.max(axis=0) - low]
    if math.prod(size) < 2**62:  # one number per row sorts many times faster
        rows = ((rows - low) * [size[1] * size[2], size[2], 1]).sum(axis=1)
    _, first, inverse = np.unique(rows, axis=0, return_index=True, return_inverse=True)
    return first, inverse.ravel()


def _shell(points: np.ndarray, faces: np.ndarray, rows: np.ndarray, first: int) -> tuple[Shell, list[np.ndarray]]:
    """Return a shell, and the corners of its boundary loops, whose means are the vertices from ``first`` on."""
    area = float(np.linalg.norm(area_vectors(points, faces), axis=1).sum())
    start, end = _boundary(faces)
    used, local = np.unique(np.concatenate([start, end]), return_inverse=True)
    ring = local.reshape(2, -1)
    links = sparse.coo_array((np.ones(len(start), np.int8), tuple(ring)), shape=(len(used), len(used)))
    count, part = connected_components(links, directed=False)
    caps, loops, cap_area = [], [], 0.0
    for loop in range(count):
        own = part[ring[0]] == loop
        a, b, middle = start[own], end[own], points[start[own]].mean(axis=0)
        cap_area += 0.5 * float(np.linalg.norm(np.cross(points[a] - middle, points[b] - middle).sum(axis=0)))
        caps.append(np.stack([b, a, np.full(len(a), first + loop)], axis=1))
        loops.append(a)
    cap = np.concatenate(caps) if caps else np.zeros((0, 3), np.int64)
    centres = np.array([points[loop].mean(axis=0) for loop in loops]).reshape(-1, 3)
    volume = _enclosed(points, centres, faces, cap, first)
    share = cap_area / max(area, 1e-12)
    return Shell(rows, faces.astype(np.int32), cap.astype(np.int32), area, share, volume, body=False), loops


def _enclosed(points: np.ndarray, centres: np.ndarray, faces: np.ndarray, caps: np.ndarray, first: int) -> float:
    """Return the volume within triangles and the caps on their loops, from a corner of theirs [m^3]."""
    origin = points[faces[0, 0]]
    volume = mesh_volume(points[faces].reshape(-1, 3) - origin, np.arange(faces.size).reshape(-1, 3))
    if len(caps):
        corners = np.concatenate([points[caps[:, :2]], centres[caps[:, 2:] - first]], axis=1)
        volume += mesh_volume(corners.reshape(-1, 3) - origin, np.arange(caps.size).reshape(-1, 3))
    return volume


def _means(loops: Sequence[np.ndarray], count: int) -> sparse.csr_array:
    """Return the matrix that takes the mean over each loop of ``count`` points, shape ``(L, count)``."""
    lengths = np.array([len(loop) for loop in loops])
    columns = (np.repeat(1.0 / lengths, lengths), (np.repeat(np.arange(len(loops)), lengths), np.concatenate(loops)))
    return sparse.csr_array(columns, shape=(len(loops), count))


def _boundary(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return start and end of the directed edges that are not run in both directions equally often.

    They are a cycle: triangles from each of them to one point close the shell.
    """
    start, end = faces.T.ravel(), np.roll(faces, -1, axis=1).T.ravel()
    size = int(faces.max()) + 1
    key, net = np.minimum(start, end) * size + np.maximum(start, end), np.where(start < end, 1, -1)
    edges, number = np.unique(key, return_inverse=True)
    total = np.bincount(number, net, len(edges)).astype(np.int64)
    low, high = np.divmod(np.repeat(edges, np.abs(total)), size)
    forwards = np.repeat(total, np.abs(total)) > 0
    return np.where(forwards, low, high), np.where(forwards, high, low)


def _is_manifold(faces: np.ndarray) -> bool:
    """Return whether every edge has two triangles, one in each direction."""
    start, end = faces.T.ravel().astype(np.int64), np.roll(faces, -1, axis=1).T.ravel().astype(np.int64)
    size = int(faces.max()) + 1
    directed = np.sort(start * size + end)
    return bool((np.diff(directed) > 0).all() and np.array_equal(directed, np.sort(end * size + start)))


def _iso_surface(points: np.ndarray, closed: Sequence[np.ndarray], cell: float) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices ``(N, 3)`` float64 and triangles ``(F, 3)`` of the union of closed shells."""
    from warp.geometry import IsoSurfaceMarchingCubes

    init_warp()
    used = np.zeros(len(points), bool)
    for faces in closed:
        used[faces] = True
    low = np.floor(points[used].min(axis=0) / cell).astype(int) - 3
    counts = np.ceil(points[used].max(axis=0) / cell).astype(int) + 4 - low
    if np.prod(counts.astype(float)) > MOST_NODES:
        raise ValueError(
            f"the body is {np.round(counts * cell, 2).tolist()} m large, too large for a grid of {cell:g} m; give its "
            "height in metres"
        )
    field = np.full(counts, np.inf, np.float32)
    for faces in closed:
        _unite(field, points, faces, low, cell)
    field = np.clip(field, -_BAND * cell, _BAND * cell)
    inside = _filled(field < 0.0)
    # nodes of other pieces and of cavities change their side
    field = np.where(inside == (field < 0.0), field, -field)
    least = np.float32(_LEAST_DISTANCE * cell)
    field = np.where(np.abs(field) < least, np.where(inside, -least, least), field)
    found, indices = IsoSurfaceMarchingCubes.extract(wp.array(field, dtype=float, device="cpu"), threshold=0.0)
    vertices, faces = found.numpy().astype(np.float64), indices.numpy().reshape(-1, 3)
    if mesh_volume(vertices, faces) < 0.0:
        faces = faces[:, ::-1]
    faces = _largest(vertices, faces)
    used, faces = np.unique(faces, return_inverse=True)
    return (vertices[used] + low) * cell, faces.reshape(-1, 3).astype(np.int32)


def _unite(field: np.ndarray, points: np.ndarray, faces: np.ndarray, low: np.ndarray, cell: float) -> None:
    """Lower the signed distances at the nodes about a shell to its own [m]."""
    used = np.zeros(len(points), bool)
    used[faces] = True
    own, corners = (np.cumsum(used) - 1)[faces], points[used]
    first = np.maximum(np.floor(corners.min(axis=0) / cell).astype(int) - low - 3, 0)
    last = np.minimum(np.ceil(corners.max(axis=0) / cell).astype(int) - low + 4, field.shape)
    part = field[tuple(slice(a, b) for a, b in zip(first, last, strict=True))]
    nodes = np.stack(np.meshgrid(*[np.arange(n) for n in part.shape], indexing="ij"), axis=-1).reshape(-1, 3)
    nodes = ((nodes + first + low) * cell).astype(np.float32)
    distance = ClosedSurface(corners, own.astype(np.int32)).distance_near(nodes, _BAND * cell)
    np.minimum(part, distance.reshape(part.shape), out=part)


def _filled(inside: np.ndarray) -> np.ndarray:
    """Return the largest piece of a solid, without cavities."""
    label, count = ndimage.label(inside)
    if count > 1:
        inside = label == 1 + int(np.bincount(label.ravel())[1:].argmax())
    label, _ = ndimage.label(~inside)
    return label != label[0, 0, 0]


def _largest(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return the triangles of the piece with the largest volume: corners of cells may join what nodes do not."""
    count = len(vertices)
    links = sparse.coo_array(
        (np.ones(2 * len(faces), np.int8), (faces[:, [0, 1]].T.ravel(), faces[:, [1, 2]].T.ravel())),
        shape=(count, count),
    )
    label = connected_components(links, directed=False)[1][faces[:, 0]]
    a, b, c = (vertices[faces[:, corner]] for corner in range(3))
    volume = np.bincount(label, np.einsum("ti,ti->t", a, np.cross(b, c)))
    return faces[label == volume.argmax()]


def _anchors(skin: np.ndarray, points: np.ndarray, faces: np.ndarray, origin: sparse.csr_array) -> sparse.csr_array:
    """Return the matrix from values of the file's vertices to the nearest points of its surface, ``(N, V)``."""
    _, face, coordinates = ClosedSurface(points, faces).query(skin)
    rows, weights = np.repeat(np.arange(len(skin)), 3), np.clip(coordinates, 0.0, 1.0).astype(np.float64)
    weights /= weights.sum(axis=1, keepdims=True)
    nearest = sparse.csr_array((weights.ravel(), (rows, faces[face].ravel())), shape=(len(skin), len(points)))
    return sparse.csr_array(nearest @ origin)
