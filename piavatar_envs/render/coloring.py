"""Colours: a perceptually uniform map and its scale, and bodies in bands of one colour."""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike
from scipy.cluster.vq import kmeans2, vq

from piavatar_envs.core.srgb import linear_to_srgb
from piavatar_envs.render.scene import Body, Color

_TABLE_SIZE = 256
#: Colours of a body where the viewer has no colours of vertices.
NUM_BANDS = 16
#: Anchors (lightness, chroma, hue [deg]) of the strain map in Oklch: pale where unstrained, so that the body still
#: reads as a body; then orange, crimson and a dark violet, in equal steps of lightness.
_STRAIN_ANCHORS = np.array(
    [[0.92, 0.025, 85.0], [0.79, 0.115, 66.0], [0.65, 0.190, 35.0], [0.51, 0.195, 10.0], [0.37, 0.150, -30.0]]
)


@lru_cache(maxsize=1)
def strain_table() -> np.ndarray:
    """Return the strain colour map, shape ``(256, 3)`` sRGB in [0, 1]; read-only."""
    at = np.linspace(0.0, len(_STRAIN_ANCHORS) - 1.0, _TABLE_SIZE)
    lightness, chroma, hue = (
        np.interp(at, np.arange(len(_STRAIN_ANCHORS)), _STRAIN_ANCHORS[:, column]) for column in range(3)
    )
    angle = np.deg2rad(hue)
    table = oklab_to_srgb(np.stack([lightness, chroma * np.cos(angle), chroma * np.sin(angle)], axis=-1))
    table.setflags(write=False)
    return table


def color_by(values: ArrayLike, maximum: float) -> np.ndarray:
    """Map scalars in ``[0, maximum]`` to colours; values outside, and NaN, take the colour of the nearest end.

    Args:
        values: scalars, shape ``(N,)``.
        maximum: the value of the last colour.

    Returns:
        sRGB in [0, 1], shape ``(N, 3)``.

    Raises:
        ValueError: the maximum is not positive.
    """
    return strain_table()[strain_color(values, maximum)]


def strain_color(values: ArrayLike, maximum: float) -> np.ndarray:
    """Return the rows of :func:`strain_table` that :func:`color_by` shows for scalars, shape ``(N,)``."""
    if not maximum > 0.0:
        raise ValueError(f"maximum={maximum} must be positive: it is the value of the last colour")
    position = np.nan_to_num(np.asarray(values, dtype=np.float64) / maximum, nan=1.0)
    return np.rint(np.clip(position, 0.0, 1.0) * (_TABLE_SIZE - 1)).astype(np.int64)


def oklab_to_srgb(lab: ArrayLike) -> np.ndarray:
    """Convert Oklab colours to sRGB in [0, 1], ``(..., 3)`` (B. Ottosson, "A perceptual color space", 2020)."""
    lab = np.asarray(lab, dtype=np.float64)
    to_lms = np.array(
        [
            [1.0, 0.3963377774, 0.2158037573],
            [1.0, -0.1055613458, -0.0638541728],
            [1.0, -0.0894841775, -1.2914855480],
        ]
    )
    to_rgb = np.array(
        [
            [4.0767416621, -3.3077115913, 0.2309699292],
            [-1.2684380046, 2.6097574011, -0.3413193965],
            [-0.0041960863, -0.7034186147, 1.7076147010],
        ]
    )
    return linear_to_srgb((lab @ to_lms.T) ** 3 @ to_rgb.T)


@dataclass(frozen=True, eq=False)
class Band:
    """The triangles of a body between two strains, or of about one colour.

    Attributes:
        number: of the band, counted from the least strain or darkest colour.
        vertices: theirs alone [m], shape ``(V, 3)``.
        faces: the triangles, shape ``(T, 3)``.
        color: sRGB in [0, 1], of the middle of the band.
    """

    number: int
    vertices: np.ndarray
    faces: np.ndarray
    color: Color


def bands_of(body: Body) -> list[Band]:
    """Split a body into bands of equal width in its scalars, or of about one colour; empty ones are left out.

    A triangle belongs where the mean of its corners does; beyond the range, and NaN, to the last band.
    """
    if body.scalars is None:
        return [
            Band(number, np.asarray(body.vertices)[used], faces, color)
            for number, (used, faces, color) in enumerate(_split(body))
        ]
    middles = (np.arange(NUM_BANDS) + 0.5) / NUM_BANDS
    colors = color_by(middles, 1.0)
    share = np.nan_to_num(np.asarray(body.scalars)[body.faces].mean(axis=1) / body.scalar_max, nan=1.0, posinf=1.0)
    band = np.clip(share * NUM_BANDS, 0.0, NUM_BANDS - 1.0).astype(np.int64)
    found = []
    for number in np.unique(band):
        used, faces = _compact(body.faces[band == number])
        found.append(Band(int(number), np.asarray(body.vertices)[used], faces, tuple(colors[number])))
    return found


#: Vertices, triangles and colour of every band of a surface.
_Split = list[tuple[np.ndarray, np.ndarray, Color]]
#: Splits by colours, of surfaces by the identity of their arrays, which are kept with them.
_splits: OrderedDict[tuple[int, int], tuple[Body, _Split]] = OrderedDict()
_MOST_SPLITS = 8


def _split(body: Body) -> _Split:
    """Split a surface by the colours of its triangles, into at most :data:`NUM_BANDS`; the same on every call."""
    key = (id(body.colors), id(body.faces))
    if key not in _splits:
        triangles = np.asarray(body.colors, np.float64)[body.faces].mean(axis=1) / 255.0
        palette = np.unique(body.colors, axis=0) / 255.0
        if len(palette) > NUM_BANDS:
            chosen = triangles[np.linspace(0, len(triangles) - 1, 4096).astype(int)]
            palette = np.unique(kmeans2(chosen, NUM_BANDS, minit="++", seed=0)[0], axis=0)
        band = vq(triangles, palette)[0]
        _splits[key] = (
            body,
            [(*_compact(body.faces[band == number]), tuple(palette[number].tolist())) for number in np.unique(band)],
        )
        while len(_splits) > _MOST_SPLITS:
            _splits.popitem(last=False)
    return _splits[key][1]


def _compact(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the vertices of some triangles, and the triangles among them alone."""
    used, corners = np.unique(faces, return_inverse=True)
    return used, corners.reshape(-1, 3).astype(np.int32)
