"""Place a camera so that a picture shows everything, and as large as it can."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from piavatar_envs.config.schema import AvatarConfig, PropConfig

#: Vertical field of view of the cameras of tasks [deg], and the share of the picture that they leave free at its edges.
FIELD_OF_VIEW, MARGIN = 29.0, 0.06
#: Height and radius of the spheres that hold a standing adult with hands half raised, from head to feet [m].
_STANDING = ((1.60, 0.24), (1.05, 0.62), (0.20, 0.36))
_NEAREST = 0.1  # distance of the eye from anything [m]

#: A place and the distance around it that is shown: x, y, z and radius [m].
Sphere = tuple[float, float, float, float]


def around_avatar(avatar: AvatarConfig) -> list[Sphere]:
    """Return spheres that hold a standing avatar in its place."""
    return [(*avatar.position, height, radius) for height, radius in _STANDING]


def around_prop(prop: PropConfig, places: Sequence[Sequence[float]] = ()) -> list[Sphere]:
    """Return spheres that hold a prop at each of some places, or where the scene puts it."""
    reach = {"sphere": max, "capsule": sum, "box": np.linalg.norm}.get(prop.shape, max)
    return [(*(float(value) for value in place), float(reach(prop.size))) for place in places or [prop.position]]


def frame(
    spheres: Sequence[Sphere], toward_eye: Sequence[float], aspect: float = 1.0
) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
    """Return eye and target of the nearest camera whose picture holds all of some spheres.

    A sphere is inside of a side of the picture's pyramid if its centre is at least its radius away from that plane. For
    two opposite sides of half angle ``a`` that bounds ``e_f``, the eye's place along the view, by
    ``-2 e_f tan a >= max(p_r + r / cos a - p_f tan a) + max(-p_r + r / cos a - p_f tan a)``, and in case of equality
    gives ``e_r``, its place aside.

    Args:
        spheres: what to show.
        toward_eye: direction from the scene to the eye.
        aspect: width over height of the picture; of a wide one the middle square is used.

    Raises:
        ValueError: nothing to show, or a direction that is vertical or zero.
    """
    place = np.array(spheres, dtype=np.float64).reshape(-1, 4)
    forward = -np.array(toward_eye, dtype=np.float64)
    if not len(place) or np.hypot(*forward[:2]) < 1e-6 * np.linalg.norm(forward) or not np.linalg.norm(forward):
        raise ValueError(f"{len(place)} spheres seen from {list(toward_eye)}; give one, and a direction from the side")
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    axes = np.stack([right, np.cross(right, forward), forward])
    seen, radius = place[:, :3] @ axes.T, place[:, 3]
    half = math.tan(math.radians(0.5 * FIELD_OF_VIEW)) * (1.0 - 2.0 * MARGIN)
    slopes = (half * min(aspect, 1.0), half)
    bounds = []
    for axis, slope in enumerate(slopes):
        reach = radius * math.hypot(1.0, slope) - slope * seen[:, 2]
        bounds.append(((seen[:, axis] + reach).max(), (reach - seen[:, axis]).max()))
    eye = np.empty(3)
    eye[2] = min(-0.5 * sum(bound) / slope for bound, slope in zip(bounds, slopes, strict=True))
    eye[2] = min(eye[2], (seen[:, 2] - radius).min() - _NEAREST)
    for axis, (slope, (high, low)) in enumerate(zip(slopes, bounds, strict=True)):
        eye[axis] = _middle(
            seen[:, axis],
            radius * math.hypot(1.0, slope),
            seen[:, 2] - eye[2],
            high + slope * eye[2],
            -low - slope * eye[2],
        )
    target = np.array([eye[0], eye[1], seen[:, 2].mean()])
    return tuple((eye @ axes).round(3).tolist()), tuple((target @ axes).round(3).tolist())


def _middle(place: np.ndarray, radius: np.ndarray, depth: np.ndarray, low: float, high: float) -> float:
    """Return the eye's place aside, within bounds, from which what is seen has equal margins on both sides."""
    for _ in range(40):
        eye = 0.5 * (low + high)
        if ((place + radius - eye) / depth).max() + ((place - radius - eye) / depth).min() > 0.0:
            low = eye
        else:
            high = eye
    return 0.5 * (low + high)
