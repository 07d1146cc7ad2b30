"""A bow from the hips, the seat going back so that the balance is kept."""

from __future__ import annotations

import numpy as np

from piavatar_envs.avatar.motion.keyframes import Arm, Key, animate
from piavatar_envs.avatar.motion.motion import Motion

_HANGING = Arm((0.45, -0.70, -0.60), (0.15, -0.95, -0.35))


def build(rest_joints: np.ndarray) -> Motion:
    """Return the clip for a body with these joints [m], shape ``(22, 3)``."""
    turns = {
        "pelvis": (38.0, 0.0, 0.0),
        "spine1": (8.0, 0.0, 0.0),
        "spine2": (8.0, 0.0, 0.0),
        "spine3": (6.0, 0.0, 0.0),
        "neck": (8.0, 0.0, 0.0),
        "head": (6.0, 0.0, 0.0),
    }
    low = {"pelvis": (0.0, 0.12, -0.045), "turns": turns, "left_arm": _HANGING, "right_arm": _HANGING}
    return animate("bow", [Key(0.0), Key(1.1, **low), Key(1.6, **low), Key(2.7), Key(3.0)], rest_joints)
