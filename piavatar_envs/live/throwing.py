"""Throws at a click: from the ray below the mouse to place and velocity of a ball."""

from __future__ import annotations

import numpy as np

#: Distance from a click's target at which a throw starts [m], and the clearance of its start from walls [m].
DISTANCE, CLEARANCE = 1.3, 0.06
#: Greatest distance of a ray from a particle that it hits [m].
_NEAR = 0.12


def aim(origin: np.ndarray, direction: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return the point that a ray hits: the first particle near it, else the place where it passes nearest to them.

    Args:
        origin: of the ray [m], shape ``(3,)``.
        direction: of the ray, shape ``(3,)``.
        points: particles [m], shape ``(P, 3)``.
    """
    direction = direction / np.linalg.norm(direction)
    along = (points - origin) @ direction
    beside = np.linalg.norm(points - origin - along[:, None] * direction, axis=1)
    ahead = along > 0.0
    hit = ahead & (beside < _NEAR)
    if hit.any():
        first = np.flatnonzero(hit)[along[hit].argmin()]
    else:
        first = np.where(ahead, beside, np.inf).argmin()
    return origin + along[first] * direction


def throw(
    origin: np.ndarray,
    target: np.ndarray,
    speed: float,
    gravity: float,
    radius: float,
    box: tuple[np.ndarray, np.ndarray],
) -> tuple[np.ndarray, np.ndarray]:
    """Return where a throw starts [m] and its velocity [m/s], shape ``(3,)`` each.

    It starts between viewer and target, :data:`DISTANCE` from the target or nearer where the box ends, and flies a
    parabola to it in the time that the straight way takes at ``speed``.

    Args:
        origin: the viewer's eye [m].
        target: that is to be hit [m].
        speed: distance over time of flight [m/s].
        gravity: along -z [m/s^2].
        radius: of the ball [m].
        box: corners in which it must stay [m]; below is the ground at height 0.
    """
    back = origin - target
    back = back / max(float(np.linalg.norm(back)), 1.0e-9)
    lower, upper = (np.array(corner, float) for corner in box)
    lower[2] = max(lower[2], 0.0)
    start = np.clip(target + DISTANCE * back, lower + radius + CLEARANCE, upper - radius - CLEARANCE)
    way = target - start
    time = max(float(np.linalg.norm(way)), radius) / speed
    return start, way / time + np.array([0.0, 0.0, 0.5 * gravity * time])
