"""A front kick with the right leg: weight on the left, leg back, strike, foot down again."""

from __future__ import annotations

import numpy as np

from piavatar_envs.avatar.motion.keyframes import Arm, Foot, Key, animate
from piavatar_envs.avatar.motion.motion import Motion

_GUARD = Arm((0.55, -0.35, -0.75), (0.05, -0.80, 0.35))
_AHEAD = Arm((0.45, -0.70, -0.45), (0.05, -0.90, 0.25))
_BACK = Arm((0.70, 0.45, -0.55), (0.50, -0.15, -0.85))


def build(rest_joints: np.ndarray) -> Motion:
    """Return the clip for a body with these joints [m], shape ``(22, 3)``."""
    guard = {"left_arm": _GUARD, "right_arm": _GUARD}
    shift = {"pelvis": (0.16, 0.0, -0.05), "turns": {"spine2": (0.0, -5.0, 0.0)}, **guard}
    wind_up = {
        "pelvis": (0.18, -0.02, -0.06),
        "turns": {"pelvis": (10.0, 0.0, -8.0), "spine2": (4.0, -5.0, 10.0)},
        "right_foot": Foot((0.05, 0.38, 0.22), pitch=55.0),
        "left_arm": _BACK,
        "right_arm": _AHEAD,
    }
    strike = {
        "pelvis": (0.18, -0.04, -0.03),
        "turns": {"pelvis": (-18.0, 0.0, 10.0), "spine2": (4.0, -5.0, -12.0), "neck": (10.0, 0.0, 0.0)},
        "right_foot": Foot((0.06, -0.92, 0.56), pitch=-12.0),
        "left_arm": _AHEAD,
        "right_arm": _BACK,
    }
    back = {**shift, "right_foot": Foot((0.03, -0.06, 0.20), pitch=15.0)}
    keys = [
        Key(0.0),
        Key(0.5, **shift),
        Key(0.95, **wind_up),
        Key(1.45, **strike),
        Key(1.6, **strike),
        Key(2.2, **back),
        Key(2.6, **shift),
        Key(3.1),
    ]
    return animate("kick", keys, rest_joints)
