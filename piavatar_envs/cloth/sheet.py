"""Cloth from the triangles of a file: one layer, turned outwards, of even edges, and held at its top."""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from pydantic import Field
from scipy import sparse
from scipy.sparse.csgraph import breadth_first_order, connected_components

from piavatar_envs.avatar.body.asset import area_vectors
from piavatar_envs.cloth.cut import Cut
from piavatar_envs.cloth.panels import SHORTEST, flipped, without_short
from piavatar_envs.cloth.pattern import ROW
from piavatar_envs.cloth.proxy import ALL_PARTS, LEFT_HAND, RIGHT_HAND
from piavatar_envs.cloth.remesh import boundary_loops, remesh
from piavatar_envs.cloth.wearer import Wearer

#: Distance at which it lies on the skin; places that are one vertex [m].
THICKNESS, _WELD = 0.005, 1.0e-5
#: Area of a piece over that of all, from which it is cloth and no button.
_LEAST_PIECE = 0.05
#: Fewest vertices within its borders.
_FEWEST = 12
#: Number of vertices over that of the wanted edges, from which triangles are meshed anew.
_TOO_FINE = 1.3

#: Number and length [m] of the steps in which a held border is led out of the skin, and passes over its edges in each.
_LED_STEPS, _LED, _EVENING = 60, 0.003, 8

#: Settings of the kinds that are made from triangles.
Holding = Annotated[
    Literal["top", "none"], Field(description="what the body holds: the border that is highest, or nothing")
]
Edge = Annotated[float, Field(ge=0.01, le=0.1, description="length of edges; finer triangles are meshed anew [m]")]


def welded_pieces(points: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return a surface with one vertex at each place, without buttons and edges of more than two triangles.

    Args:
        points: shape ``(V, 3)`` [m].
        faces: triangles, shape ``(T, 3)``.

    Raises:
        ValueError: nothing is left.
    """
    return _pieces(*_welded(points, faces))


def sheet_of(wearer: Wearer, name: str, points: np.ndarray, faces: np.ndarray, held: str, edge: float) -> Cut:
    """Return the cut of a surface in its place around a body.

    Args:
        wearer: the body, in its rest pose.
        name: of the surface, for errors.
        points: of :func:`welded_pieces` [m], shape ``(V, 3)``.
        faces: triangles, shape ``(T, 3)``.
        held: ``"top"`` or ``"none"``.
        edge: length of edges [m].

    Raises:
        ValueError: it has no border to hold, or one side only.
    """
    faces = _oriented(wearer, points, faces)
    loops = boundary_loops(faces)
    if held == "top" and not loops:
        raise ValueError(f"{name} has no border that could be held; set held='none', or open the surface")
    count = int(np.linalg.norm(area_vectors(points, faces), axis=1).sum() / (ROW * edge**2))
    if len(points) > _TOO_FINE * max(count, _FEWEST):
        around = [np.linalg.norm(np.diff(points[loop], axis=0), axis=1).sum() for loop in loops]
        border = sum(max(3, round(length / edge)) for length in around)
        count = min(max(count, border + _FEWEST), len(points))
        found = remesh(points, faces, count, first=loops, spacing=edge)
        points = points[found.keep]
        there, faces = without_short(points, flipped(points, found.faces), SHORTEST * edge)
        points = points[there]
        faces = flipped(points, faces)
    top = np.zeros(0, np.int32)
    if held == "top":
        top = max(boundary_loops(faces), key=lambda loop: points[loop, 2].mean()).astype(np.int32)
    sees = np.full(len(points), ALL_PARTS & ~(LEFT_HAND | RIGHT_HAND), np.int32)
    shape = points.copy()

    def lengths(pairs: np.ndarray) -> np.ndarray:
        return np.linalg.norm(shape[pairs[:, 0]] - shape[pairs[:, 1]], axis=1)

    points = wearer.outside(points, THICKNESS)
    if len(top):
        points[top] = _led_out(wearer, shape[top])
    return Cut(points, faces, sees, top, lengths, None, THICKNESS, source=shape)


def _led_out(wearer: Wearer, loop: np.ndarray) -> np.ndarray:
    """Return a closed border moved out of the skin in small steps, in which its stretch evens out along it.

    Vertices that each take their nearest way out crowd on ridges of the body and leave gaps beside them.

    Args:
        wearer: the body.
        loop: the border, in order, shape ``(H, 3)`` [m].
    """
    if (wearer.surface.distance(loop) > THICKNESS - 1.0e-5).all():
        return loop
    rest = np.linalg.norm(np.roll(loop, -1, axis=0) - loop, axis=1)
    for _ in range(_LED_STEPS):
        loop = wearer.outside(loop, THICKNESS, longest=_LED, steps=1)
        for _ in range(_EVENING):
            edge = np.roll(loop, -1, axis=0) - loop
            length = np.linalg.norm(edge, axis=1)
            excess = 1.0 - rest * (length.sum() / rest.sum()) / np.maximum(length, 1.0e-12)
            move = 0.25 * excess[:, None] * edge
            loop = loop + move - np.roll(move, 1, axis=0)
    return wearer.outside(loop, THICKNESS)


def _welded(points: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the surface with one vertex at each place, and no triangle twice or without three of them."""
    _, first, number = np.unique(
        np.round(points / _WELD).astype(np.int64), axis=0, return_index=True, return_inverse=True
    )
    faces = number.reshape(-1)[faces]
    a, b, c = faces.T
    faces = faces[(a != b) & (b != c) & (c != a)]
    _, once = np.unique(np.sort(faces, axis=1), axis=0, return_index=True)
    return points[first], faces[np.sort(once)]


def _pieces(points: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the surface without small pieces and without edges of more than two triangles.

    Raises:
        ValueError: nothing is left.
    """
    sides = np.sort(np.stack([faces, np.roll(faces, -1, axis=1)], axis=2).reshape(-1, 2), axis=1)
    _, edge, count = np.unique(sides, axis=0, return_inverse=True, return_counts=True)
    faces = faces[(count[edge.reshape(-1, 3)] <= 2).all(axis=1)]
    if not len(faces):
        raise ValueError("there is no surface of single sheets; export one layer of cloth")
    corner = points[faces[:, 0]]
    area = np.linalg.norm(np.cross(points[faces[:, 1]] - corner, points[faces[:, 2]] - corner), axis=1)
    links = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]]])
    graph = sparse.coo_array((np.ones(len(links)), links.T), shape=(len(points),) * 2)
    piece = connected_components(graph, directed=False)[1][faces[:, 0]]
    large = np.bincount(piece, area) >= _LEAST_PIECE * area.sum()
    used, faces = np.unique(faces[large[piece]], return_inverse=True)
    return points[used], faces.reshape(-1, 3).astype(np.int32)


def _oriented(wearer: Wearer, points: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return the triangles of each piece turned alike, their outsides away from the wearer.

    Raises:
        ValueError: a piece has one side only.
    """
    sides = np.stack([faces, np.roll(faces, -1, axis=1)], axis=2).reshape(-1, 2)
    _, edge = np.unique(np.sort(sides, axis=1), axis=0, return_inverse=True)
    order = np.argsort(edge, kind="stable")
    same = np.flatnonzero(edge[order][1:] == edge[order][:-1])
    one, two = order[same] // 3, order[same + 1] // 3
    turned = sides[order[same], 0] == sides[order[same + 1], 0]  # both run along the edge in the same direction
    count = len(faces)
    graph = sparse.coo_array((np.ones(2 * len(one)), (np.r_[one, two], np.r_[two, one])), shape=(count, count)).tocsr()
    against = {(a, b): t for a, b, t in zip(one.tolist(), two.tolist(), turned.tolist(), strict=True)}
    piece = connected_components(graph, directed=False)[1]
    flip = np.zeros(count, bool)
    for number in range(piece.max() + 1):
        reached, before = breadth_first_order(graph, int(np.argmax(piece == number)), directed=False)
        for face in reached[1:].tolist():
            parent = int(before[face])
            way = against[parent, face] if (parent, face) in against else against[face, parent]
            flip[face] = flip[parent] ^ way
    if (flip[one] ^ flip[two] ^ turned).any():
        raise ValueError("the surface has one side only, as a Moebius strip; cut it open")
    faces = np.where(flip[:, None], faces[:, ::-1], faces)
    middle, corner = points[faces].mean(axis=1), points[faces[:, 0]]
    normal = np.cross(points[faces[:, 1]] - corner, points[faces[:, 2]] - corner)
    _, near, coordinates = wearer.surface.query(middle)
    outward = np.einsum("nc,ncd->nd", coordinates, wearer.normals[wearer.faces[near]])
    inside_out = np.bincount(piece, np.einsum("nd,nd->n", normal, outward)) < 0.0
    return np.where(inside_out[piece][:, None], faces[:, ::-1], faces).astype(np.int32)
