"""Ranges of the joints: bounds on the rotation vector of every joint relative to the rest pose.

The rest pose stands with the arms lowered by some 45 degrees, so the ranges of the arms are those of an adult counted
from there. Axes are the world's in the rest pose: +x to the left, -y forward, +z up. Values follow the ranges of motion
of the American Academy of Orthopaedic Surgeons (Greene & Heckman, "The Clinical Measurement of Joint Motion", 1994),
rounded to 5 degrees and split evenly over the joints of the spine.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from piavatar_envs.avatar.skeleton import JOINT_NAMES

Bounds = tuple[tuple[float, float], ...]

# Degrees about x (bending forward is positive for the trunk, backward for hip and knee), y and z, for the left side.
_SPINE = ((-10.0, 30.0), (-15.0, 15.0), (-15.0, 15.0))
_LEFT_DEGREES: dict[str, Bounds] = {
    "hip": ((-120.0, 30.0), (-45.0, 30.0), (-45.0, 45.0)),
    "knee": ((-5.0, 140.0), (-5.0, 5.0), (-15.0, 15.0)),
    "ankle": ((-20.0, 50.0), (-30.0, 20.0), (-20.0, 20.0)),
    "foot": ((-40.0, 40.0), (-5.0, 5.0), (-5.0, 5.0)),
    "collar": ((-10.0, 10.0), (-30.0, 10.0), (-20.0, 20.0)),
    "shoulder": ((-120.0, 60.0), (-120.0, 50.0), (-90.0, 90.0)),
    "elbow": ((-140.0, 20.0), (-60.0, 60.0), (-140.0, 20.0)),
    "wrist": ((-70.0, 70.0), (-70.0, 70.0), (-70.0, 70.0)),
}
_CENTER_DEGREES: dict[str, Bounds] = {
    "spine1": _SPINE,
    "spine2": _SPINE,
    "spine3": _SPINE,
    "neck": ((-30.0, 25.0), (-20.0, 20.0), (-40.0, 40.0)),
    "head": ((-30.0, 25.0), (-20.0, 20.0), (-40.0, 40.0)),
}


def left_and_right(
    center: Mapping[str, Bounds], left: Mapping[str, Bounds], root: tuple[float, float]
) -> tuple[np.ndarray, np.ndarray]:
    """Bounds of all joints about x, y and z, each ``(22, 3)``, from those of the middle and of the left side.

    Args:
        center: by joint.
        left: by joint without its side.
        root: of the pelvis, about every axis.
    """
    bounds = np.zeros((len(JOINT_NAMES), 3, 2))
    for index, name in enumerate(JOINT_NAMES):
        side, _, joint = name.partition("_")
        if name == "pelvis":
            bounds[index] = root
        elif name in center:
            bounds[index] = center[name]
        else:
            bounds[index] = left[joint]
            if side == "right":
                # mirrored in x: rotations about y and z change sign
                bounds[index, 1:] = -bounds[index, 1:, ::-1]
    return bounds[..., 0], bounds[..., 1]


def joint_limits() -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper bounds of the joints' rotation vectors [rad], each of shape ``(22, 3)``.

    The root is unbounded here; tasks bound its speed.
    """
    lower, upper = left_and_right(_CENTER_DEGREES, _LEFT_DEGREES, (-180.0, 180.0))
    return np.radians(lower), np.radians(upper)
