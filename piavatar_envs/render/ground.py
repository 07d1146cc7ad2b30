"""The ground: a pale checker that fades into the background, and the soft shadow on it.

The shadow is the area of the surfaces, cast along the key light and blurred with height.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from piavatar_envs.render.shading import KEY, Casters

#: Side of a checker square [m]; the tile that repeats holds two by two.
SQUARE = 0.5
#: Just below z = 0 [m], so that soles on it stay visible.
HEIGHT, SHADOW_HEIGHT = -0.004, -0.002
FADE_START, FADE_END = 1.6, 7.5
#: sRGB in [0, 1].
BACKGROUND_TOP = (0.80, 0.83, 0.87)
BACKGROUND_BOTTOM = (0.95, 0.95, 0.945)
SHADOW_COLOR = (0.20, 0.19, 0.22)
LIGHT_SQUARE = (0.915, 0.91, 0.90)
DARK_SQUARE = (0.875, 0.87, 0.862)
LINE = (0.80, 0.795, 0.79)
TILE_PIXELS = 256
LINE_PIXELS = 1
#: Texels of the shadow's patch along a side, the least size of one [m], and room around the surfaces [m].
_SIZE, _TEXEL, _MARGIN = 192, 0.016, 0.25
#: Upper end of the height bands [m] and the pyramid level each is drawn at: the higher, the softer.
_BANDS = ((0.25, 0), (0.9, 1), (np.inf, 2))
#: Height over which the shadow of contact fades [m], and the greatest opacities of the cast shadow and of that one.
_CONTACT_HEIGHT, _STRENGTH, _CONTACT_STRENGTH = 0.04, 0.42, 0.50


def tile() -> np.ndarray:
    """Return the repeating tile, ``2 SQUARE`` wide, shape ``(256, 256, 3)`` uint8, indexed ``[y, x]``."""
    half = TILE_PIXELS // 2
    cell = np.arange(TILE_PIXELS) // half
    dark = (cell[:, None] + cell[None, :]) % 2 == 1
    image = np.where(dark[..., None], DARK_SQUARE, LIGHT_SQUARE)
    line = np.arange(TILE_PIXELS) % half < LINE_PIXELS
    image[line, :] = LINE
    image[:, line] = LINE
    return np.rint(255.0 * image).astype(np.uint8)


def fade(distance: np.ndarray) -> np.ndarray:
    """Return the ground's opacity in [0, 1] at a horizontal distance [m] from the camera's centre."""
    share = np.clip((FADE_END - np.asarray(distance)) / (FADE_END - FADE_START), 0.0, 1.0)
    return share * share * (3.0 - 2.0 * share)


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
