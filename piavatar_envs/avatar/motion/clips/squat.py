"""A squat with the arms stretched out in front for balance."""

from __future__ import annotations

import numpy as np

from piavatar_envs.avatar.motion.keyframes import Arm, Key, animate
from piavatar_envs.avatar.motion.motion import Motion

_FORWARD = Arm((0.25, -0.78, 0.45), (0.05, -0.85, 0.48))


def build(rest_joints: np.ndarray) -> Motion:
    """Return the clip for a body with these joints [m], shape ``(22, 3)``."""
    down = {
        "pelvis": (32.0, 0.0, 0.0),
        "spine1": (6.0, 0.0, 0.0),
        "spine2": (4.0, 0.0, 0.0),
        "neck": (-10.0, 0.0, 0.0),
        "head": (-12.0, 0.0, 0.0),
    }
    low = {"pelvis": (0.0, 0.26, -0.46), "turns": down, "left_arm": _FORWARD, "right_arm": _FORWARD}
    return animate("squat", [Key(0.0), Key(1.0, **low), Key(1.3, **low), Key(2.4), Key(2.6)], rest_joints)
