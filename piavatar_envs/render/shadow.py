"""The soft shadow on the ground: the surface's area, cast along the key light and blurred with height."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from piavatar_envs.render.shading import KEY, Casters

_SIZE = 192
_TEXEL = 0.016
_MARGIN = 0.25
#: Upper end of the height bands [m] and the pyramid level each is drawn at: the higher, the softer.
_BANDS = ((0.25, 0), (0.9, 1), (np.inf, 2))
_CONTACT_HEIGHT = 0.04
_STRENGTH = 0.42
_CONTACT_STRENGTH = 0.50


@dataclass(frozen=True, eq=False)
class GroundShadow:
    """A square patch of the ground.

    Attributes:
        opacity: how dark, in [0, 1], shape ``(192, 192)`` float32 indexed ``[x, y]``.
        origin: its corner of least x and y [m], shape ``(2,)``.
        size: its side [m].
    """

    opacity: np.ndarray
    origin: np.ndarray
    size: float


def ground_shadow(casters: Casters) -> GroundShadow:
    """Cast the shadow of all surfaces on z = 0."""
    height = np.maximum(casters.points[2], 0.0)
    cast = casters.points[:2] - height * (KEY[:2] / KEY[2])[:, None]
    low, high = cast.min(axis=1), cast.max(axis=1)
    texel = _TEXEL
    while _SIZE * texel < (high - low).max() + 2.0 * _MARGIN and texel < 0.5:
        texel *= 1.25  # in steps: a patch that grew with every frame would make the shadow shimmer
    origin = np.floor((0.5 * (low + high) - 0.5 * _SIZE * texel) / texel) * texel
    # The sides that face the light, seen from it and laid on the ground, add up to the silhouette.
    covered = np.maximum(KEY @ casters.areas, 0.0) / (KEY[2] * texel**2)
    clear, below = np.ones((_SIZE, _SIZE), dtype=np.float32), -1.0
    for top, level in _BANDS:
        band = np.flatnonzero((height > below) & (height <= top) & (covered > 0.0))
        clear *= 1.0 - np.minimum(_splat(cast[:, band], covered[band], origin, texel, level), 1.0)
        below = top
    near = np.flatnonzero(height < 4.0 * _CONTACT_HEIGHT)
    weight = np.maximum(-casters.areas[2, near], 0.0) / texel**2 * np.exp(-height[near] / _CONTACT_HEIGHT)
    contact = np.minimum(_splat(casters.points[:2, near], weight, origin, texel, 1), 1.0)
    opacity = 1.0 - (1.0 - _STRENGTH * (1.0 - clear)) * (1.0 - _CONTACT_STRENGTH * contact)
    return GroundShadow(opacity=opacity, origin=origin, size=_SIZE * texel)


def _splat(points: np.ndarray, weights: np.ndarray, origin: np.ndarray, texel: float, level: int) -> np.ndarray:
    """Sum weights of points ``(2, N)`` on the patch, blurred by about ``2**level`` texels, ``(192, 192)``."""
    size = _SIZE >> level
    x, y = np.floor((points - origin[:, None]) / (texel * 2**level)).astype(np.int32)
    inside = (x >= 0) & (x < size) & (y >= 0) & (y < size)
    # What falls outside is summed on a cell of its own, and dropped.
    cell = np.where(inside, x * size + y, size * size)
    image = np.bincount(cell, weights=weights, minlength=size * size + 1)[:-1]
    image = (image / 4**level).astype(np.float32).reshape(size, size)
    for _ in range(2):
        image = ndimage.uniform_filter(image, 3, mode="constant")
    if level:
        image = np.minimum(image, 1.0).repeat(2**level, axis=0).repeat(2**level, axis=1)
        for _ in range(2):
            image = ndimage.uniform_filter(image, 2**level + 1, mode="constant")
    return image
