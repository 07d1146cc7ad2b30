"""The ground's look, shared by both back ends: a pale checker that fades into the background."""

from __future__ import annotations

import numpy as np

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
