"""Text on pictures: the colour scale and labels (Pillow)."""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

from piavatar_envs.render.coloring import strain_table

if TYPE_CHECKING:
    from PIL import ImageFont

_TEXT = (45, 48, 54)
_BAR_HEIGHT, _BAR_WIDTH = 0.34, 0.022  # of the picture's height


def draw_scale(frame: np.ndarray, maximum: float, title: str, seen: np.ndarray | None = None, last: int = 0) -> int:
    """Draw the colour scale from 0 to ``maximum`` into the corner that shows least of the bodies, in place.

    Args:
        frame: the picture, shape ``(H, W, 3)`` uint8.
        maximum: the value of the last colour.
        title: what the colours show.
        seen: pixels of the bodies' vertices, x to the right and y down, shape ``(n, 2)``; none if not given.
        last: corner of the last picture, where the scale stays while nothing is behind it.

    Returns:
        The corner: 0 lower right, 1 upper right, 2 lower left, 3 upper left.
    """
    overlay, alpha = _scale_image(frame.shape[0], float(maximum), title)
    height, width = min(overlay.shape[0], frame.shape[0]), min(overlay.shape[1], frame.shape[1])
    places = [
        (slice(top, top + height), slice(left, left + width))
        for left in (frame.shape[1] - width, 0)
        for top in (frame.shape[0] - height, 0)
    ]
    behind = np.zeros(len(places)) if seen is None else np.array([_count_in(place, seen) for place in places])
    corner = last if behind[last] == behind.min() else int(behind.argmin())
    shown = frame[places[corner]]
    overlay, alpha = overlay[-height:, -width:], alpha[-height:, -width:]
    shown[:] = (shown * (1.0 - alpha) + overlay * alpha + 0.5).astype(np.uint8)
    return corner


def _count_in(place: tuple[slice, slice], pixels: np.ndarray) -> int:
    """Return how many pixels ``(n, 2)``, x and y, lie in rows and columns of a picture."""
    rows, columns = place
    x, y = pixels.T
    return int(((columns.start <= x) & (x < columns.stop) & (rows.start <= y) & (y < rows.stop)).sum())


def label(frame: np.ndarray, text: str) -> np.ndarray:
    """Return a copy of the picture, ``(H, W, 3)`` uint8, with ``text`` on a light plate in its upper left corner."""
    from PIL import Image, ImageDraw

    image = Image.fromarray(np.ascontiguousarray(frame))
    size = max(11, frame.shape[0] // 26)
    draw, font = ImageDraw.Draw(image, "RGBA"), _font(size)
    left, top, right, bottom = draw.textbbox((size, size), text, font=font)
    pad = 0.45 * size
    draw.rounded_rectangle((left - pad, top - pad, right + pad, bottom + pad), radius=pad, fill=(255, 255, 255, 190))
    draw.text((size, size), text, font=font, fill=_TEXT)
    return np.array(image)


def side_by_side(left: np.ndarray, right: np.ndarray, gap: int = 4) -> np.ndarray:
    """Join two pictures of one height side by side.

    Args:
        left: shape ``(H, W1, 3)`` uint8.
        right: shape ``(H, W2, 3)`` uint8.
        gap: white columns between them [px].

    Returns:
        Shape ``(H, W1 + gap + W2, 3)`` uint8.

    Raises:
        ValueError: the heights differ.
    """
    if left.shape[0] != right.shape[0]:
        raise ValueError(f"the pictures are {left.shape[0]} and {right.shape[0]} px high; render both at one height")
    return np.concatenate([left, np.full((left.shape[0], gap, 3), 255, dtype=np.uint8), right], axis=1)


@lru_cache(maxsize=8)
def _scale_image(frame_height: int, maximum: float, title: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the scale's colours ``(h, w, 3)`` and opacity ``(h, w, 1)``, both float."""
    from PIL import Image, ImageDraw

    size = max(10, frame_height // 36)
    font, height, width = _font(size), int(_BAR_HEIGHT * frame_height), max(6, int(_BAR_WIDTH * frame_height))
    values = (maximum, 0.5 * maximum, 0.0)
    ticks = [f"{value:.3g}" for value in values]
    tick_width = max(int(font.getlength(tick)) for tick in ticks)
    title_width = int(font.getlength(title))
    canvas = max(title_width, width + size // 2 + tick_width) + 2 * size
    image = Image.new("RGBA", (canvas, height + 5 * size), (255, 255, 255, 0))
    draw = ImageDraw.Draw(image)
    draw.text((canvas - size, size // 2), title, font=font, fill=_TEXT, anchor="ra")
    left, top = canvas - size - tick_width - size // 2 - width, 5 * size // 2
    rows = np.rint(np.linspace(len(strain_table()) - 1, 0, height)).astype(int)
    bar = np.rint(255.0 * np.repeat(strain_table()[rows, None, :], width, axis=1)).astype(np.uint8)
    image.paste(Image.fromarray(bar), (left, top))
    draw.rectangle((left - 1, top - 1, left + width, top + height), outline=_TEXT)
    for tick, value in zip(ticks, values, strict=True):
        y = top + (1.0 - value / maximum) * (height - 1)
        draw.text((left + width + size // 2, y), tick, font=font, fill=_TEXT, anchor="lm")
    array = np.asarray(image, dtype=np.float32)
    return array[..., :3], array[..., 3:] / 255.0


@lru_cache(maxsize=16)
def _font(size: int) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    from PIL import ImageFont

    return ImageFont.load_default(size)
