"""A scarf: a long rectangle around the back of the neck, both ends of which hang down in front."""

from __future__ import annotations

from itertools import pairwise
from typing import Annotated

import numpy as np
from pydantic import Field
from scipy.interpolate import PchipInterpolator

from piavatar_envs.cloth.cut import Cut
from piavatar_envs.cloth.pattern import ROW, between
from piavatar_envs.cloth.proxy import HEAD, LEFT_FOOT, LEFT_LEG, RIGHT_FOOT, RIGHT_LEG, TRUNK
from piavatar_envs.cloth.wearer import Wearer

#: Distance from the skin at which a scarf is laid, and its thickness [m].
_EASE, THICKNESS = 0.012, 0.006
#: Default length over the wearer's height, and half the size of the part that is held at the nape [m].
_LENGTH, _HELD = 0.95, 0.03
#: Distance of the middle line from the neck, over that of the shoulder joint; distance from the neck at which the scarf
#: begins to hang, and half width of the skin that is measured, both over the wearer's height; shift outwards over the
#: scarf's width.
_BESIDE, _CHEST, _NEAR, _SHIFT = 0.5, 0.09, 0.02, 0.1
_SAMPLES = 600
#: Times that what is held is pushed out of the skin, by what the deepest vertex lacks.
_PUSHES = 6
#: Direction out of the nape.
_BACK = np.array([0.0, 1.0, 0.2])


def cut(
    wearer: Wearer,
    length: Annotated[float, Field(ge=0.4, le=3.0, description="of the scarf [m]")] | None = None,
    width: Annotated[float, Field(ge=0.05, le=0.5, description="of the scarf [m]")] = 0.14,
    edge: Annotated[float, Field(ge=0.01, le=0.1, description="length of the mesh's edges, about [m]")] = 0.027,
) -> Cut:
    """Return a scarf.

    Args:
        wearer: the body.
        length: from end to end; by default nearly the wearer's height.
        width: of the flat cloth.
        edge: of the mesh.

    Raises:
        ValueError: its ends would hang to the ground.
    """
    length = _LENGTH * float(np.ptp(wearer.vertices[:, 2])) if length is None else length
    most = 2.0 * float(wearer.at("neck")[2])
    if length > most:
        raise ValueError(f"length={length:.3g} of the garment 'scarf' must be at most {most:.3g} [m]")
    along, across, faces = _rectangle(length, width, edge)

    held = np.flatnonzero((np.abs(along) < _HELD) & (np.abs(across) < _HELD)).astype(np.int32)

    def fit(other: Wearer) -> np.ndarray:
        positions = other.outside(_placed(other, along, across), THICKNESS)
        positions[held] = _laid_flat(other, along[held], across[held] - _SHIFT * np.ptp(across))
        return positions

    def lengths(pairs: np.ndarray) -> np.ndarray:
        first, second = pairs.T
        return np.hypot(along[first] - along[second], across[first] - across[second])

    sees = np.full(len(along), TRUNK | HEAD | LEFT_LEG | RIGHT_LEG | LEFT_FOOT | RIGHT_FOOT, np.int32)
    return Cut(fit(wearer), faces, sees, held, lengths, fit, THICKNESS)


def _rectangle(length: float, width: float, edge: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return places along and across a flat rectangle [m], each ``(V,)``, and its triangles ``(T, 3)``."""
    count, rows = max(4, round(length / edge)), max(2, round(width / (edge * ROW)))
    along, across, row = [], [], []
    for index in range(rows + 1):
        steps = np.arange(count) + 0.5 * (index % 2)
        steps = np.concatenate([[0.0], steps[steps > 0.0], [count]])
        row.append(sum(map(len, row)) + np.arange(len(steps)))
        along.append((steps / count - 0.5) * length)
        across.append(np.full(len(steps), 0.5 * width - width * index / rows))
    flat = np.concatenate(along)
    faces = np.concatenate([between(upper, lower, flat, closed=False) for upper, lower in pairwise(row)])
    return flat, np.concatenate(across), np.ascontiguousarray(faces[:, ::-1])


def _placed(wearer: Wearer, along: np.ndarray, across: np.ndarray) -> np.ndarray:
    """Return places of the rectangle over the shoulders and down the front [m], shape ``(V, 3)``.

    The middle line goes from the nape over the shoulder beside the neck and falls along the chest; on the way the cloth
    turns from standing at the nape to lying on the shoulder, which needs no stretch.
    """
    neck, nape, size = wearer.at("neck"), _nape(wearer), float(np.ptp(wearer.vertices[:, 2]))
    beside, chest = _BESIDE * wearer.at("left_shoulder")[0], neck[2] - _CHEST * size
    top = _farthest(wearer, (beside, neck[1]), (0, 1), 2, size)
    upper, lower = (-_farthest(wearer, (beside, z), (0, 2), -1, size) for z in (0.5 * (neck[2] + chest), chest))
    out = min(upper, lower) - _EASE
    points = np.array(
        [
            nape,
            [beside, neck[1], top + _EASE],
            [beside, upper - _EASE, 0.5 * (neck[2] + chest)],
            [beside, out, chest],
            [beside, out, chest - along.max()],
        ]
    )
    normals = np.array([_BACK, [0.3, 0.0, 1.0], [0.1, -1.0, 0.3], [0.0, -1.0, 0.0], [0.0, -1.0, 0.0]])
    place = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    steps = np.linspace(0.0, place[-1], _SAMPLES)
    line, outward = PchipInterpolator(place, points)(steps), PchipInterpolator(place, normals)(steps)
    upwards = np.cross(np.gradient(line, axis=0), outward)
    upwards /= np.linalg.norm(upwards, axis=1, keepdims=True)
    far = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
    point, up = (np.stack([np.interp(np.abs(along), far, axis) for axis in each.T], axis=1) for each in (line, upwards))
    positions = point + (across - _SHIFT * np.ptp(across))[:, None] * up
    positions[:, 0] = np.where(along < 0.0, -positions[:, 0], positions[:, 0])
    return positions


def _laid_flat(wearer: Wearer, along: np.ndarray, across: np.ndarray) -> np.ndarray:
    """Return places of a part of the rectangle that lies flat against the nape [m], shape ``(H, 3)``.

    What the body holds does not relax in the drape: vertices that each took their nearest way out of the skin would
    keep the stretch.
    """
    outward = _BACK / np.linalg.norm(_BACK)
    sideways = np.array([1.0, 0.0, 0.0])
    places = _nape(wearer) + np.outer(along, sideways) + np.outer(across, np.cross(sideways, outward))
    for _ in range(_PUSHES):
        places += max(0.0, THICKNESS - float(wearer.surface.distance(places).min())) * outward
    return places


def _nape(wearer: Wearer) -> np.ndarray:
    """Return the place of the middle of a scarf behind the neck [m], shape ``(3,)``."""
    height, size = wearer.at("neck")[2], float(np.ptp(wearer.vertices[:, 2]))
    return np.array([0.0, _farthest(wearer, (0.0, height), (0, 2), 1, size) + _EASE, height])


def _farthest(wearer: Wearer, place: tuple[float, float], axes: tuple[int, int], direction: int, size: float) -> float:
    """Return how far the skin of trunk and neck reaches along an axis, near a place on the other two [m].

    Args:
        wearer: the body.
        place: coordinates on two axes [m].
        axes: indices of these two axes.
        direction: the third axis; -1 for against y.
        size: of the wearer [m].
    """
    apart = np.linalg.norm(wearer.vertices[:, axes] - np.array(place), axis=1)
    near = (apart < _NEAR * size) & ~wearer.arms & (wearer.turned_by("head") < 0.5)
    if not near.any():
        near = apart == apart.min()
    reach = -wearer.vertices[near, 1] if direction < 0 else wearer.vertices[near, direction]
    return float(reach.max())
