"""Eyeballs for a closed skin whose eye sockets are hollows of the face."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

#: Side of the cells of the face's depth map, least depth of a hollow, and radius of the disc that bridges it [m].
_CELL, _HOLLOW, _BRIDGE = 0.001, 0.004, 0.016
#: Least and greatest height of eyes above the joint of the head, and their distance from its middle, over the height of
#: the head above that joint.
_HEIGHTS, _ASIDE = (0.3, 0.6), (0.1, 0.25)
#: Radius of an eyeball over that height: 12 mm in 195 mm.
_RADIUS = 0.0615
_AROUND = 28
#: Angles from the line of sight of the rings of an eyeball [rad], and how many of the first belong to pupil and iris.
_RINGS = np.array([0.09, 0.172, 0.182, 0.34, 0.495, 0.515, 0.8, 1.1, 1.4])
_IN_PUPIL, _IN_IRIS = 2, 5
_SET_BACK = 0.55  # share of the lids that lie before an eyeball's surface
_SAMPLES = 8  # points along the side of a triangle, which fill the depth map


@dataclass(frozen=True, eq=False)
class Eye:
    """The front half of an eyeball.

    Attributes:
        vertices: in the frame of the skin [m], shape ``(W, 3)``.
        faces: outward triangles, shape ``(U, 3)``.
        zone: 0 in the pupil, 1 in the iris, 2 in the white, of every vertex.
        lids: vertices of the skin around it, with whose mean it moves.
    """

    vertices: np.ndarray
    faces: np.ndarray
    zone: np.ndarray
    lids: np.ndarray


def find_eyes(vertices: np.ndarray, faces: np.ndarray, head: np.ndarray) -> list[Eye]:
    """Return eyeballs in the two hollows at either side of a face that looks along -y; none if it has no such pair.

    Args:
        vertices: of a skin [m], shape ``(V, 3)``.
        faces: its triangles, shape ``(T, 3)``.
        head: joint of the head [m], shape ``(3,)``.
    """
    size = vertices[:, 2].max() - head[2]
    face = (vertices[:, 2] > head[2]) & (vertices[:, 1] < head[1])
    if size <= 0.0 or not face[faces].all(axis=1).any():
        return []
    corners = vertices[faces[face[faces].all(axis=1)]]
    origin = corners.min(axis=(0, 1))
    depth = _depth_map(corners, origin)
    depth = np.where(np.isfinite(depth), depth, head[1])
    reach = round(_BRIDGE / _CELL)
    across = np.arange(-reach, reach + 1) ** 2
    hollow = depth - ndimage.grey_opening(depth, footprint=across[:, None] + across <= reach**2) > _HOLLOW
    marks, count = ndimage.label(hollow)
    places = [origin[[0, 2]] + _CELL * (np.argwhere(marks == mark).mean(axis=0) + 0.5) for mark in range(1, count + 1)]
    sizes = np.bincount(marks.ravel(), minlength=count + 1)[1:]
    pair = _pair([((place - head[[0, 2]]) / size, cells) for place, cells in zip(places, sizes, strict=True)])
    return [_eye(vertices, np.flatnonzero(face), head[[0, 2]] + size * place, _RADIUS * size) for place in pair]


def _pair(hollows: list[tuple[np.ndarray, int]]) -> tuple[np.ndarray, ...]:
    """Return the places of the largest two hollows where eyes may be that mirror each other; none without such."""
    best: tuple[int, tuple[np.ndarray, ...]] = (0, ())
    fits = [
        each for each in hollows if _HEIGHTS[0] < each[0][1] < _HEIGHTS[1] and _ASIDE[0] < abs(each[0][0]) < _ASIDE[1]
    ]
    for left, size in fits:
        for right, other in fits:
            if left[0] > 0.0 > right[0] and np.abs(left - right * [-1.0, 1.0]).max() < 0.03 and size + other > best[0]:
                best = size + other, (left, right)
    return best[1]


def _depth_map(corners: np.ndarray, origin: np.ndarray) -> np.ndarray:
    """Return the least y of triangles ``(T, 3, 3)`` in cells along x and z [m], infinite in empty ones."""
    i, j = np.mgrid[:_SAMPLES, :_SAMPLES].reshape(2, -1)
    i, j = i[i + j < _SAMPLES] / (_SAMPLES - 1), j[i + j < _SAMPLES] / (_SAMPLES - 1)
    points = np.einsum("sc,tcd->tsd", np.stack([1.0 - i - j, i, j], axis=1), corners).reshape(-1, 3)
    cells = ((points - origin)[:, [0, 2]] / _CELL).astype(int)
    depth = np.full(cells.max(axis=0) + 1, np.inf)
    np.minimum.at(depth, tuple(cells.T), points[:, 1])
    return ndimage.grey_erosion(depth, size=(3, 3))


def _eye(vertices: np.ndarray, face: np.ndarray, middle: np.ndarray, radius: float) -> Eye:
    """Return the eyeball behind an opening, so far back that it hardly pierces the lids."""
    aside = np.linalg.norm(vertices[face][:, [0, 2]] - middle, axis=1)
    lids, aside = face[aside < 1.2 * radius], aside[aside < 1.2 * radius]
    fronts = vertices[lids, 1]
    near = fronts < fronts.min() + 1.2 * radius  # the others are at the back of the socket
    lids, aside, fronts = lids[near], aside[near], fronts[near]
    touched = aside < 0.95 * radius
    depth = np.quantile(fronts[touched] + np.sqrt(radius**2 - aside[touched] ** 2), _SET_BACK)
    center = np.array([middle[0], depth, middle[1]])
    angle = 2.0 * np.pi * np.arange(_AROUND) / _AROUND
    ring = np.stack([np.cos(angle), np.zeros(_AROUND), np.sin(angle)], axis=1)
    rings = np.sin(_RINGS)[:, None, None] * ring - np.cos(_RINGS)[:, None, None] * np.array([0.0, 1.0, 0.0])
    points = np.concatenate([[[0.0, -1.0, 0.0]], rings.reshape(-1, 3)])
    place = 1 + np.arange(len(_RINGS) * _AROUND).reshape(len(_RINGS), _AROUND)
    after = np.roll(place, -1, axis=1)
    cap = np.stack([np.zeros(_AROUND, int), place[0], after[0]], axis=1)
    a, b, c, d = (grid.ravel() for grid in (place[:-1], after[:-1], place[1:], after[1:]))
    faces = np.concatenate([cap, np.stack([a, c, d], axis=1), np.stack([a, d, b], axis=1)])
    zone = np.repeat(np.searchsorted([_IN_PUPIL, _IN_IRIS], np.arange(len(_RINGS)), side="right"), _AROUND)
    return Eye(center + radius * points, faces, np.concatenate([[0], zone]), lids)
