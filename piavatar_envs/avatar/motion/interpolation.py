"""Interpolation of quaternions (wxyz) and the smooth step."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation


def ease(phase: np.ndarray) -> np.ndarray:
    """Return the smooth step from 0 to 1 with zero speed and acceleration at both ends, ``6 s^5 - 15 s^4 + 10 s^3``."""
    s = np.clip(phase, 0.0, 1.0)
    return s * s * s * (s * (6.0 * s - 15.0) + 10.0)


def slerp(start: np.ndarray, end: np.ndarray, blend: np.ndarray) -> np.ndarray:
    """Return a fraction of the way along the shorter arc (Shoemake, "Animating rotation with quaternion curves", 1985).

    Args:
        start: wxyz, shape ``(..., 4)``.
        end: wxyz, shape ``(..., 4)``.
        blend: fraction in [0, 1], of a shape that broadcasts to ``(...)``.

    Returns:
        Unit quaternions wxyz, shape ``(..., 4)``, in the hemisphere of ``start``.
    """
    blend = np.broadcast_to(blend, start.shape[:-1]).reshape(-1, 1)
    first = Rotation.from_quat(start.reshape(-1, 4), scalar_first=True)
    arc = (first.inv() * Rotation.from_quat(end.reshape(-1, 4), scalar_first=True)).as_rotvec()
    result = (first * Rotation.from_rotvec(blend * arc)).as_quat(scalar_first=True).reshape(start.shape)
    return np.where((result * start).sum(-1, keepdims=True) < 0.0, -result, result)


def hemisphere_consistent(quaternions: np.ndarray) -> np.ndarray:
    """Choose signs so that no quaternion is more than a right angle (in 4D) from the one a frame before.

    Args:
        quaternions: shape ``(num_frames, ..., 4)``; the first frame's scalar part is made non-negative.
    """
    signs = np.empty(quaternions.shape[:-1])
    signs[0] = np.where(quaternions[0, ..., 0] < 0.0, -1.0, 1.0)
    signs[1:] = np.where((quaternions[1:] * quaternions[:-1]).sum(-1) < 0.0, -1.0, 1.0)
    return quaternions * np.cumprod(signs, axis=0)[..., None]


def turned(heading: float | np.ndarray, quaternion: np.ndarray) -> np.ndarray:
    """Return ``quaternion`` after a turn by ``heading`` [rad] about the vertical."""
    c, s = np.cos(0.5 * np.asarray(heading)), np.sin(0.5 * np.asarray(heading))
    w, x, y, z = np.moveaxis(quaternion, -1, 0)
    return np.stack([c * w - s * z, c * x - s * y, c * y + s * x, c * z + s * w], axis=-1)
