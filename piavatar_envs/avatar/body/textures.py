"""Textures of the base colour: images on the triangles of a surface, and their colours at its vertices (NumPy)."""

from __future__ import annotations

import io
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from piavatar_envs.core.srgb import linear_to_srgb, srgb_to_linear

MAX_PIXELS = 2**26  # of an image that is decoded
TEXTURE_SIDE = 1024  # [pixels] to which larger images are averaged down
#: How an image goes on beyond its borders, as numbered in glTF.
REPEAT, CLAMP, MIRROR = 10497, 33071, 33648


@dataclass(frozen=True, eq=False)
class Texture:
    """An image of a base colour.

    Attributes:
        pixels: sRGB, shape ``(h, w, 3)`` uint8.
        wraps: how it goes on beside its left and right border, and above and below.
        alpha: opacity of the pixels, shape ``(h, w)`` uint8; None where all are opaque.
        cutoff: opacity below which there is a hole, as a share of the largest.
    """

    pixels: np.ndarray
    wraps: tuple[int, int] = (REPEAT, REPEAT)
    alpha: np.ndarray | None = None
    cutoff: float = 0.5

    def __post_init__(self) -> None:
        """Refuse an opacity that does not fit the pixels.

        Raises:
            ValueError: it does not.
        """
        if self.alpha is not None and self.alpha.shape != self.pixels.shape[:2]:
            raise ValueError(f"alpha has shape {self.alpha.shape}; give one value per pixel: {self.pixels.shape[:2]}")

    def at(self, uv: np.ndarray) -> np.ndarray:
        """Return linear colours between the pixels, shape ``(N, 3)``.

        Args:
            uv: places from the upper left corner (0, 0) to the lower right (1, 1), shape ``(N, 2)``.
        """
        height, width = self.pixels.shape[:2]
        x0, x1, tx = _neighbours(uv[:, 0], width, self.wraps[0])
        y0, y1, ty = _neighbours(uv[:, 1], height, self.wraps[1])
        corners = [self.pixels[y, x] / 255.0 for y in (y0, y1) for x in (x0, x1)]
        rows = [a + tx[:, None] * (b - a) for a, b in (corners[:2], corners[2:])]
        return srgb_to_linear(rows[0] + ty[:, None] * (rows[1] - rows[0]))


@dataclass(frozen=True, eq=False)
class Textures:
    """Textures of a surface of ``V`` vertices and ``T`` triangles.

    The base colour is the tint times that of the texture, in linear light; the tint alone where there is none.

    Attributes:
        images: the textures.
        image: index of the texture of each triangle, -1 without one, shape ``(T,)`` int32.
        uv: place of each vertex in its texture, from the upper left corner (0, 0) to the lower right (1, 1), shape
            ``(V, 2)`` float32.
        tints: sRGB of the vertices, shape ``(V, 3)`` uint8.
    """

    images: tuple[Texture, ...]
    image: np.ndarray
    uv: np.ndarray
    tints: np.ndarray

    def __post_init__(self) -> None:
        """Refuse arrays that do not fit together.

        Raises:
            ValueError: they do not.
        """
        count = len(self.uv)
        if np.shape(self.uv) != (count, 2) or np.shape(self.tints) != (count, 3):
            shapes = f"{np.shape(self.uv)} and {np.shape(self.tints)}"
            raise ValueError(f"uv and tints have shapes {shapes}; give (V, 2) and (V, 3), a row per vertex")
        if len(self.image) and not -1 <= self.image.min() <= self.image.max() < len(self.images):
            raise ValueError(f"a triangle has texture {self.image.max()} of {len(self.images)}; use -1 for none")

    def colors(self, faces: np.ndarray) -> np.ndarray:
        """Return the base colours at the vertices, sRGB, shape ``(V, 3)`` uint8.

        Args:
            faces: triangles, shape ``(T, 3)``; a vertex of several textures has the colour of the last.
        """
        light = srgb_to_linear(self.tints / 255.0)
        tints = light.copy()
        for index, texture in enumerate(self.images):
            used = np.unique(faces[self.image == index])
            light[used] = tints[used] * texture.at(self.uv[used].astype(np.float64))
        return np.round(255.0 * linear_to_srgb(light)).astype(np.uint8)

    def chosen(self, vertices: np.ndarray, triangles: np.ndarray) -> Textures:
        """Return the textures of some vertices and triangles of the surface, given by their indices."""
        return Textures(self.images, self.image[triangles], self.uv[vertices], self.tints[vertices])


def joined(pieces: Sequence[tuple[Textures | None, np.ndarray, int]]) -> Textures | None:
    """Return the textures of surfaces that are laid one after the other; None where none has any.

    Args:
        pieces: of each its textures, its colours ``(V, 3)`` uint8 and its number of triangles.
    """
    if all(textures is None for textures, _, _ in pieces):
        return None
    images: list[Texture] = []
    known: dict[int, int] = {}
    image, uv, tints = [], [], []
    for textures, colors, count in pieces:
        own = Textures((), np.full(count, -1), np.zeros((len(colors), 2)), colors) if textures is None else textures
        for texture in own.images:
            if id(texture) not in known:
                known[id(texture)] = len(images)
                images.append(texture)
        # the last entry is that of -1
        places = np.array([*(known[id(texture)] for texture in own.images), -1], np.int32)
        image.append(places[own.image])
        uv.append(np.asarray(own.uv, np.float32))
        tints.append(np.asarray(own.tints, np.uint8))
    return Textures(tuple(images), np.concatenate(image), np.concatenate(uv), np.concatenate(tints))


def decoded(content: bytes) -> np.ndarray:
    """Return the pixels of an image file, averaged down to :data:`TEXTURE_SIDE`, sRGB, shape ``(h, w, 3)`` uint8.

    Raises:
        ImportError: Pillow is not installed.
        OSError: the image is damaged, or in a format that Pillow does not read.
        ValueError: it has more than :data:`MAX_PIXELS`.
    """
    return _opened(content, reduced)


def decoded_alpha(content: bytes) -> np.ndarray | None:
    """Return the opacity of an image file as :func:`decoded` its pixels, shape ``(h, w)`` uint8; None without one.

    The colours beneath what is transparent are kept by reading them apart.
    """

    def read(picture: Any) -> np.ndarray | None:
        clear = "A" in picture.getbands() or "transparency" in picture.info
        return reduced(picture, "A") if clear else None

    return _opened(content, read)


def _opened(content: bytes, read: Callable[[Any], Any]) -> Any:
    """Return what ``read`` makes of an image file; errors as for :func:`decoded`."""
    from PIL import Image

    try:
        with Image.open(io.BytesIO(content)) as picture:
            return read(picture)
    except Image.DecompressionBombError as error:
        raise ValueError(str(error)) from None


def reduced(picture: Any, channel: str | None = None) -> np.ndarray:
    """Return the pixels of an image of Pillow that was opened, or a channel of them; errors as for :func:`decoded`."""
    if picture.width * picture.height > MAX_PIXELS:
        raise ValueError(f"it has {picture.width} x {picture.height} pixels, more than {MAX_PIXELS}")
    picture = picture.convert("RGBA").getchannel(channel) if channel else picture.convert("RGB")
    picture.thumbnail((TEXTURE_SIDE, TEXTURE_SIDE))
    return np.asarray(picture)


def encoded(texture: Texture) -> bytes:
    """Return a texture as a PNG file, with its opacity.

    Raises:
        ImportError: Pillow is not installed.
    """
    from PIL import Image

    stream = io.BytesIO()
    opacity = () if texture.alpha is None else (texture.alpha[..., None],)
    Image.fromarray(np.concatenate([texture.pixels, *opacity], axis=2)).save(stream, "PNG")
    return stream.getvalue()


def _neighbours(at: np.ndarray, size: int, wrap: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the two pixels beside each coordinate in [0, 1], and how far it is to the second."""
    place = np.clip(at * size - 0.5, -1e9, 1e9)
    first = np.floor(place).astype(np.int64)
    share = place - first

    def inside(pixel: np.ndarray) -> np.ndarray:
        if wrap == CLAMP:
            return np.clip(pixel, 0, size - 1)
        if wrap == MIRROR:
            folded = pixel % (2 * size)
            return np.where(folded < size, folded, 2 * size - 1 - folded)
        return pixel % size

    return inside(first), inside(first + 1), share
