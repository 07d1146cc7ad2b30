"""Textures on the device: their reduced levels, and the texels around a place."""

from __future__ import annotations

import numpy as np
import warp as wp

from piavatar_envs.avatar.body import textures

wp.set_module_options({"enable_backward": False})

CLAMP, MIRROR = wp.constant(textures.CLAMP), wp.constant(textures.MIRROR)
#: Opacity below which there is a hole, in all levels of every texture.
OPAQUE = 128


def color_levels(image: np.ndarray, size: int) -> np.ndarray:
    """Return an image at ``size`` by ``size`` texels and its halves, one after the other, shape ``(n, 3)`` uint8."""
    flat = np.concatenate([level.reshape(-1, image.shape[2]) for level in _levels(_resized(image, size))])
    return np.clip(np.rint(flat), 0, 255).astype(np.uint8)


def alpha_levels(alpha: np.ndarray, cutoff: float, size: int) -> np.ndarray:
    """Return the levels of an opacity, shape ``(n,)`` uint8, shifted to have holes below :data:`OPAQUE`.

    As large a share of each is opaque as of the image, or fine hair would vanish from afar (I. Castano, "Computing
    alpha mipmaps", 2010).

    Args:
        alpha: the image, shape ``(h, w)`` uint8.
        cutoff: opacity below which it has a hole, as a share of 255.
        size: side of the first level [texels].
    """
    share = float((alpha >= 255.0 * cutoff).mean())
    levels = [level.ravel() for level in _levels(_resized(alpha[..., None], size))]
    shifted = [level - _least(level, share) + OPAQUE for level in levels]
    return np.clip(np.floor(np.concatenate(shifted)), 0, 255).astype(np.uint8)


def _least(values: np.ndarray, share: float) -> float:
    """Return a value which, as nearly as can be, a share of values is not below."""
    ordered = np.sort(values)
    below = len(ordered) - round(share * len(ordered))
    if below == 0:
        return float(ordered[0])
    if below == len(ordered):
        return float(ordered[-1]) + 1.0
    return 0.5 * float(ordered[below - 1] + ordered[below])


def _resized(image: np.ndarray, size: int) -> np.ndarray:
    """Return an image at ``size`` by ``size`` texels, averaged where it shrinks, shape ``(size, size, C)`` float."""
    values = np.asarray(image, dtype=np.float32)
    for axis in (0, 1):
        length = values.shape[axis]
        # The integral of the image between the edges of the new texels, over their width.
        total = np.concatenate([np.zeros_like(values.take([0], axis)), np.cumsum(values, axis, np.float64)], axis)
        edges = np.linspace(0.0, length, size + 1)
        low = np.minimum(edges.astype(int), length - 1)
        share = (edges - low).reshape([-1 if axis == each else 1 for each in range(3)])
        at_edges = total.take(low, axis) * (1.0 - share) + total.take(low + 1, axis) * share
        values = (np.diff(at_edges, axis=axis) * (size / length)).astype(np.float32)
    return values


def _levels(image: np.ndarray) -> list[np.ndarray]:
    """Return a square image and its halves down to one texel."""
    levels = [image]
    while len(levels[-1]) > 1:
        side = len(levels[-1]) // 2
        levels.append(levels[-1].reshape(side, 2, side, 2, -1).mean(axis=(1, 3)))
    return levels


@wp.struct
class Level:
    """A level of a texture: its first texel among those of all levels, and its side [texels]."""

    first: int
    side: int


@wp.struct
class Around:
    """Four texels around a place of a texture, and how far it is from the left and the upper ones."""

    upper_left: int
    upper_right: int
    lower_left: int
    lower_right: int
    across: float
    down: float


@wp.func
def level_of(size: int, texels: float) -> Level:
    """Return the level with about one texel a pixel of a texture of a side, which has ``texels`` at full size."""
    level = Level()
    level.side = size
    while level.side > 1 and texels * float(level.side * level.side) > 2.0 * float(size * size):
        level.first += level.side * level.side
        level.side = level.side // 2
    return level


@wp.func
def wrapped(cell: int, size: int, wrap: int) -> int:
    """Return the row or column of a texture, of a power of two of them, that is shown where it may be beyond."""
    if wrap == CLAMP:
        return wp.clamp(cell, 0, size - 1)
    if wrap == MIRROR:
        folded = cell & (2 * size - 1)
        return wp.min(folded, 2 * size - 1 - folded)
    return cell & (size - 1)


@wp.func
def texels_around(level: Level, wraps: wp.array2d[int], texture: int, uv: wp.vec2) -> Around:
    """Return the texels around a place, from the upper left corner (0, 0) to the lower right (1, 1)."""
    around = Around()
    x = uv[0] * float(level.side) - 0.5
    y = uv[1] * float(level.side) - 0.5
    column = int(wp.floor(x))
    row = int(wp.floor(y))
    around.across = x - float(column)
    around.down = y - float(row)
    left = wrapped(column, level.side, wraps[texture, 0])
    right = wrapped(column + 1, level.side, wraps[texture, 0])
    top = level.first + wrapped(row, level.side, wraps[texture, 1]) * level.side
    bottom = level.first + wrapped(row + 1, level.side, wraps[texture, 1]) * level.side
    around.upper_left = top + left
    around.upper_right = top + right
    around.lower_left = bottom + left
    around.lower_right = bottom + right
    return around
