"""Conversions between sRGB and linear light (IEC 61966-2-1)."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike


def srgb_to_linear(color: ArrayLike) -> np.ndarray:
    """Return light intensities of sRGB values in [0, 1]."""
    color = np.asarray(color, dtype=np.float64)
    return np.where(color <= 0.04045, color / 12.92, ((np.maximum(color, 0.0) + 0.055) / 1.055) ** 2.4)


def linear_to_srgb(light: ArrayLike) -> np.ndarray:
    """Convert light intensities to sRGB in [0, 1], clipped."""
    light = np.clip(np.asarray(light, dtype=np.float64), 0.0, 1.0)
    return np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1.0 / 2.4) - 0.055)
