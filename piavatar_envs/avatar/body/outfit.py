"""Clothes for a body without any: its skin, cut along seams, in the colours of shirt, shorts and hair; shoes, and eyes.

Every garment is a field over the skin [m]: positive inside, zero on its seam. Triangles are cut where the field is just
outside and just inside of zero, so that a seam is a clean line however coarse the skin is. Cloth lies a few millimetres
above the skin, and is smoother than it. Seams are placed by the joints, so that bodies of any size can be dressed.

All of it is done when a body is first drawn; it has no part in the simulation.
"""

from __future__ import annotations

from dataclasses import astuple, dataclass
from enum import IntEnum

import numpy as np
from scipy import sparse
from scipy.spatial import ConvexHull, cKDTree

from piavatar_envs.avatar.body.asset import AvatarAsset, Look, dense_weights, top_weights, turned_shares, vertex_normals
from piavatar_envs.avatar.body.eyes import find_eyes
from piavatar_envs.avatar.body.skeleton import JOINT_NAMES

_SEAM = 0.0012  # half the width over which colour and height change at a seam [m]
_TRIM = 0.014  # width of the trim along the seams of a shirt [m]
_SHIRT, _SHORTS, _HAIR, _LEATHER = 0.006, 0.004, 0.013, 0.006  # heights above the skin [m]
_SMOOTHING, _SET_IN = 60, 0.03  # pairs of passes that smooth cloth, and the way from a seam over which they set in [m]
_SECTIONS, _AROUND, _SOLE = 26, 36, 0.017  # of a shoe: cross-sections, points of each; thickness of its sole [m]
#: Outline of the hair from the side: places behind and above the joint of the head, over the height from there to the
#: crown. It runs along the forehead, down before the ear, around it, and along the neck.
_HAIRLINE = np.array(
    [
        (-2.0, 0.78), (-0.62, 0.77), (-0.50, 0.75), (-0.36, 0.69), (-0.27, 0.63), (-0.23, 0.54), (-0.215, 0.40),
        (-0.165, 0.40), (-0.15, 0.55), (-0.10, 0.60), (-0.03, 0.59), (0.02, 0.50), (0.045, 0.35), (0.06, 0.20),
        (0.08, 0.08), (2.0, 0.02), (2.0, 3.0), (-2.0, 3.0),
    ]
)  # fmt: skip
_SIDES = ("left", "right")


class _Part(IntEnum):
    """Colour of a vertex, counted as the fields of :class:`Kit`."""

    SKIN, HAIR, SHIRT, TRIM, SHORTS, SHOES, SOLES, PUPILS, IRISES, WHITES = range(10)


@dataclass(frozen=True)
class Kit:
    """Colours of one person, sRGB in [0, 255]."""

    skin: tuple[int, int, int]
    hair: tuple[int, int, int]
    shirt: tuple[int, int, int]
    trim: tuple[int, int, int]
    shorts: tuple[int, int, int]
    shoes: tuple[int, int, int]
    soles: tuple[int, int, int] = (236, 236, 232)
    pupils: tuple[int, int, int] = (20, 16, 14)
    irises: tuple[int, int, int] = (92, 62, 42)
    whites: tuple[int, int, int] = (238, 234, 228)


#: Kits of the avatars of a scene, in their order; the first two differ in lightness, too.
KITS = (
    Kit((226, 184, 158), (62, 46, 38), (38, 104, 176), (240, 240, 236), (34, 44, 66), (60, 66, 78)),
    Kit((190, 138, 106), (36, 30, 28), (240, 148, 56), (110, 52, 24), (238, 230, 216), (120, 62, 40)),
    Kit(
        (238, 200, 178),
        (150, 106, 62),
        (60, 140, 92),
        (238, 228, 140),
        (46, 58, 50),
        (228, 226, 220),
        irises=(86, 112, 124),
    ),
    Kit((146, 102, 78), (28, 24, 24), (140, 74, 150), (236, 216, 240), (200, 196, 206), (70, 48, 84)),
)


def dressed(asset: AvatarAsset, with_shirt: bool = True) -> Look:
    """Return a body's skin in clothes, with a colouring for each of :data:`KITS`.

    Args:
        asset: the body.
        with_shirt: whether it wears a shirt; not where a garment is worn instead.
    """
    at = {name: asset.joints[index].astype(np.float64) for index, name in enumerate(JOINT_NAMES)}
    shares = turned_shares(asset.skin_joints, asset.skin_weights)
    share = {name: shares[:, index] for index, name in enumerate(JOINT_NAMES)}
    points, garments = asset.vertices.astype(np.float64), (_shirt if with_shirt else _nothing, _shorts, _hair, _foot)
    fields = np.stack([garment(points, at, share) for garment in garments], axis=1)
    points = _smoothed(points, asset.faces, fields[:, :3].max(axis=1))
    fields = np.stack([garment(points, at, share) for garment in garments], axis=1)
    blend, faces = sparse.eye_array(len(points), format="csr"), asset.faces.astype(np.int64)
    for garment, level in ((0, -_SEAM), (0, _SEAM), (0, _TRIM - _SEAM), (0, _TRIM + _SEAM), *_both(1), *_both(2)):
        rows, faces = cut_triangles(fields[:, garment] - level, faces)
        blend, fields = (rows @ blend).tocsr(), rows @ fields
    faces = faces[(fields[faces, 3] < _SOLE).any(axis=1)]  # the foot in a shoe is not seen
    used, faces = np.unique(faces, return_inverse=True)
    blend, fields, faces = blend[used], fields[used], faces.reshape(-1, 3)
    normals = blend @ vertex_normals(points, asset.faces)
    weights = blend @ dense_weights(asset.skin_joints, asset.skin_weights)
    skin = _Surface(blend @ points + _heights(fields) * normals, faces, _materials(fields), blend, weights)
    pieces = [skin, *(_shoe(asset, points, at, share, side) for side in _SIDES), *_eyes(asset, at)]
    ends = np.cumsum([0, *(len(piece.vertices) for piece in pieces)])
    material = np.concatenate([piece.material for piece in pieces])
    joints, values = top_weights(np.concatenate([piece.weights for piece in pieces]))
    blends = sparse.vstack([piece.blend for piece in pieces]).tocsr().astype(np.float32)
    deltas = asset.shape_deltas.reshape(-1, *asset.shape_deltas.shape[2:])
    return Look(
        vertices=np.concatenate([piece.vertices for piece in pieces]).astype(np.float32),
        faces=np.concatenate([piece.faces + first for piece, first in zip(pieces, ends, strict=False)]).astype(
            np.int32
        ),
        skin_joints=joints,
        skin_weights=values,
        colors=np.stack([np.array(astuple(kit), np.uint8)[material] for kit in KITS]),
        shape_deltas=np.stack([blends @ delta for delta in deltas]).reshape(*asset.shape_deltas.shape[:2], -1, 3),
    )


@dataclass(frozen=True, eq=False)
class _Surface:
    """A piece of a look: its mesh, materials, shares of the skin's vertices in its own, and weights of all joints."""

    vertices: np.ndarray
    faces: np.ndarray
    material: np.ndarray
    blend: sparse.csr_array
    weights: np.ndarray


def _both(garment: int) -> tuple[tuple[int, float], tuple[int, float]]:
    return (garment, -_SEAM), (garment, _SEAM)


def _shirt(points: np.ndarray, at: dict[str, np.ndarray], share: dict[str, np.ndarray]) -> np.ndarray:
    """Return the field of a shirt: to the middle of the upper arms, the base of the neck and below the waist."""
    neck, pelvis = at["neck"], at["pelvis"]
    lower = np.array([0.0, 0.5, -1.0]) / np.hypot(0.5, 1.0)  # its collar is lower in front
    field = np.minimum((points - neck - [0.0, 0.0, 0.012]) @ lower, points[:, 2] - pelvis[2] - 0.02)
    return np.minimum(field, _short_of(points, at, share, "shoulder", "elbow", 0.46))


def _nothing(points: np.ndarray, _at: dict[str, np.ndarray], _share: dict[str, np.ndarray]) -> np.ndarray:
    """Return the field of what is not worn."""
    return np.full(len(points), -1.0)


def _shorts(points: np.ndarray, at: dict[str, np.ndarray], share: dict[str, np.ndarray]) -> np.ndarray:
    """Return the field of shorts: from the waist to above the knees."""
    waist = at["spine1"][2] - points[:, 2]
    field = np.minimum(waist, _short_of(points, at, share, "hip", "knee", 0.62))
    arms = np.max([share[f"{side}_shoulder"] for side in _SIDES], axis=0)
    return np.where(arms > 0.5, -1.0, field)


def _short_of(
    points: np.ndarray, at: dict[str, np.ndarray], share: dict[str, np.ndarray], first: str, second: str, part: float
) -> np.ndarray:
    """Return the distance from the end of a sleeve or leg, at a part of the way between two joints; else 1 m."""
    field = np.full(len(points), 1.0)
    for side in _SIDES:
        start, way = at[f"{side}_{first}"], at[f"{side}_{second}"] - at[f"{side}_{first}"]
        length = np.linalg.norm(way)
        along = part * length - (points - start) @ way / length
        field = np.where(share[f"{side}_{first}"] > 0.5, along, field)
    return field


def _hair(points: np.ndarray, at: dict[str, np.ndarray], share: dict[str, np.ndarray]) -> np.ndarray:
    """Return the field of short hair: the distance from its outline, seen from the side."""
    head = at["head"]
    size = points[:, 2].max() - head[2]
    side = (points - head)[:, 1:] / size
    start, end = _HAIRLINE, np.roll(_HAIRLINE, -1, axis=0)
    way = end - start
    part = np.clip(np.einsum("psd,sd->ps", side[:, None] - start, way) / (way**2).sum(axis=1), 0.0, 1.0)
    distance = np.linalg.norm(side[:, None] - start - part[..., None] * way, axis=-1).min(axis=1)
    x, y = side.T
    crossed = (start[:, 1] > y[:, None]) != (end[:, 1] > y[:, None])
    with np.errstate(divide="ignore", invalid="ignore"):
        crossing = start[:, 0] + (y[:, None] - start[:, 1]) * way[:, 0] / way[:, 1]
    inside = (crossed & (x[:, None] < crossing)).sum(axis=1) % 2 == 1
    return np.where(share["head"] > 0.3, size * np.where(inside, distance, -distance), -1.0)


def _foot(points: np.ndarray, at: dict[str, np.ndarray], share: dict[str, np.ndarray]) -> np.ndarray:
    """Return how far points lie below the collars of the shoes [m]."""
    field = np.full(len(points), -1.0)
    for side in _SIDES:
        field = np.where(share[f"{side}_knee"] > 0.5, at[f"{side}_ankle"][2] - points[:, 2], field)
    return field


def _materials(fields: np.ndarray) -> np.ndarray:
    """Return the material of every vertex; a shirt lies over shorts."""
    shirt, shorts, hair = fields.T[:3]
    material = np.where(hair > 0.0, _Part.HAIR, np.where(shorts > 0.0, _Part.SHORTS, _Part.SKIN))
    return np.where(shirt > _TRIM, _Part.SHIRT, np.where(shirt > 0.0, _Part.TRIM, material))


def _smoothed(vertices: np.ndarray, faces: np.ndarray, field: np.ndarray) -> np.ndarray:
    """Return vertices without bumps that cloth would bridge, the more the farther they are inside of a garment [m].

    Averages and counter-steps in turn, which keep the size (G. Taubin, "A signal processing approach to fair surface
    design", 1995).
    """
    start, end = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    edges = sparse.csr_array((np.ones(len(start)), (start, end)), shape=(len(vertices), len(vertices)))
    edges = ((edges + edges.T) > 0).astype(np.float64)
    edges = sparse.diags_array(1.0 / np.maximum(edges.sum(axis=1), 1.0)) @ edges
    share = np.clip(field / _SET_IN, 0.0, 1.0)[:, None]
    for _ in range(_SMOOTHING):
        for step in (0.63, -0.65):
            vertices = vertices + step * share * (edges @ vertices - vertices)
    return vertices


def _heights(fields: np.ndarray) -> np.ndarray:
    """Return the heights of cloth and hair above the skin [m], shape ``(V, 1)``."""
    shirt, shorts, hair = fields.T[:3]
    height = np.where(hair > 0.0, _HAIR * np.clip(0.25 + hair / 0.03, 0.0, 1.0), 0.0)
    return np.where(shirt > 0.0, _SHIRT, np.where(shorts > 0.0, _SHORTS, height))[:, None]


def cut_triangles(field: np.ndarray, faces: np.ndarray) -> tuple[sparse.csr_array, np.ndarray]:
    """Cut triangles where a field crosses zero.

    Args:
        field: of the vertices, shape ``(V,)``.
        faces: triangles, shape ``(T, 3)``.

    Returns:
        The shares of the old vertices in the new ones, ``(W, V)``, of which the first ``V`` are the old ones; and the
        triangles, none of which has corners on both sides.
    """
    above = field > 0.0
    sides = above[faces].sum(axis=1)
    crossed = (sides == 1) | (sides == 2)
    apart = faces[crossed]
    # turn each such that its first corner is alone on its side
    lone = np.argmax(above[apart] == (sides[crossed] == 1)[:, None], axis=1)
    a, b, c = (np.take_along_axis(apart, ((lone + turn) % 3)[:, None], axis=1)[:, 0] for turn in range(3))
    edges = np.sort(np.concatenate([np.stack([a, b], 1), np.stack([a, c], 1)]), axis=1)
    edges, index = np.unique(edges, axis=0, return_inverse=True)
    ab, ac = (len(field) + index.reshape(2, -1)) if len(edges) else (a, a)
    low, high = edges.T
    part = field[low] / (field[low] - field[high])
    count, rows = len(field), len(field) + np.arange(len(edges))
    blend = sparse.csr_array(
        (
            np.concatenate([np.ones(count), 1.0 - part, part]),
            (np.concatenate([np.arange(count), rows, rows]), np.concatenate([np.arange(count), low, high])),
        ),
        shape=(count + len(edges), count),
    )
    pieces = [np.stack(corners, axis=1) for corners in ((a, ab, ac), (ab, b, c), (ab, c, ac))]
    return blend, np.concatenate([faces[~crossed], *pieces])


def _shoe(
    asset: AvatarAsset, points: np.ndarray, at: dict[str, np.ndarray], share: dict[str, np.ndarray], side: str
) -> _Surface:
    """Return a shoe: convex cross-sections along the foot, around its toes together, closed at both ends."""
    collar = at[f"{side}_ankle"][2]
    own = np.flatnonzero((share[f"{side}_knee"] > 0.5) & (points[:, 2] < collar))
    foot = points[own]
    floor = foot[:, 2].min()
    toe, heel = foot[:, 1].min(), foot[:, 1].max()
    angle = np.linspace(0.0, 2.0 * np.pi, _AROUND, endpoint=False)
    rays = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    # equal turns of a half circle put sections closer to each other at the ends
    places = 0.5 * (toe + heel) - 0.5 * (heel - toe) * np.cos(np.linspace(0.0, np.pi, _SECTIONS))
    middles, radii = [], []
    for place in places:
        near = foot[np.abs(foot[:, 1] - place) < 0.018][:, [0, 2]]
        hull = ConvexHull(near)
        middle = np.array([0.5 * (near[:, 0].min() + near[:, 0].max()), floor + _SOLE + 1e-4])
        reach = rays @ hull.equations[:, :2].T
        gap = -(hull.equations[:, 2] + hull.equations[:, :2] @ middle)
        ways = np.where(reach > 1e-6, np.maximum(gap, 0.0) / np.maximum(reach, 1e-6), np.inf)
        middles.append(middle)
        radii.append(ways.min(axis=1))
    middles, radii = (_averaged(np.array(values)) for values in (middles, radii))
    round_off = np.sqrt(np.maximum(1.0 - np.linspace(-1.0, 1.0, _SECTIONS) ** 8, 0.12))
    sections = middles[:, None] + ((radii + _LEATHER) * round_off[:, None])[..., None] * rays
    ring = np.stack([sections[..., 0], np.broadcast_to(places[:, None], sections.shape[:2]), sections[..., 1]], axis=-1)
    ring[:, :, 1] += _LEATHER * np.linspace(-1.0, 1.0, _SECTIONS)[:, None]
    vertices = np.concatenate([ring.reshape(-1, 3), ring[[0, -1]].mean(axis=1)])
    faces = _tube(_SECTIONS, _AROUND)
    blend, faces = cut_triangles(vertices[:, 2] - floor - _SOLE, faces)
    vertices = blend @ vertices
    material = np.where(vertices[:, 2] > floor + _SOLE + 1e-6, _Part.SHOES, _Part.SOLES)
    vertices[:, 2] = np.maximum(vertices[:, 2], floor)
    distance, near = cKDTree(points[own]).query(vertices, k=6)
    closeness = 1.0 / np.maximum(distance, 1e-4) ** 2
    closeness /= closeness.sum(axis=1, keepdims=True)
    rows = np.repeat(np.arange(len(vertices)), 6)
    bound = sparse.csr_array((closeness.ravel(), (rows, own[near.ravel()])), shape=(len(vertices), len(points)))
    weights = bound @ dense_weights(asset.skin_joints, asset.skin_weights)
    return _Surface(vertices, faces, material, bound, weights)


def _eyes(asset: AvatarAsset, at: dict[str, np.ndarray]) -> list[_Surface]:
    """Return the eyeballs of a face with hollow sockets, each of which moves as a whole with the lids around it."""
    weights, surfaces = dense_weights(asset.skin_joints, asset.skin_weights), []
    for eye in find_eyes(asset.vertices.astype(np.float64), asset.faces, at["head"]):
        shape = len(eye.vertices), len(eye.lids)
        rows, columns = np.repeat(np.arange(shape[0]), shape[1]), np.tile(eye.lids, shape[0])
        bound = sparse.csr_array((np.full(len(rows), 1.0 / shape[1]), (rows, columns)), (shape[0], len(weights)))
        material = eye.zone + _Part.PUPILS
        surfaces.append(_Surface(eye.vertices, eye.faces, material, bound, bound @ weights))
    return surfaces


def _averaged(rows: np.ndarray) -> np.ndarray:
    """Return rows, each averaged with its neighbours; twice."""
    for _ in range(2):
        padded = np.concatenate([rows[:1], rows, rows[-1:]])
        rows = 0.25 * padded[:-2] + 0.5 * padded[1:-1] + 0.25 * padded[2:]
    return rows


def _tube(sections: int, around: int) -> np.ndarray:
    """Return outward triangles of a closed tube towards +y; its last two vertices close the ends."""
    section, point = (grid.ravel() for grid in np.mgrid[: sections - 1, :around])
    following = (point + 1) % around
    a, b = section * around + point, section * around + following
    c, d = a + around, b + around
    first, last = sections * around, sections * around + 1
    turn = np.arange(around)
    after = (turn + 1) % around
    far = (sections - 1) * around
    return np.concatenate(
        [
            np.stack([a, c, d], 1), np.stack([a, d, b], 1),
            np.stack([turn, after, np.full(around, first)], 1),
            np.stack([far + after, far + turn, np.full(around, last)], 1),
        ]
    )  # fmt: skip
