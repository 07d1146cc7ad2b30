"""Stepping on the spot: weight on the right, left knee up, weight on the left, right knee up, arms swinging."""

from __future__ import annotations

import numpy as np

from piavatar_envs.avatar.motion.keyframes import Arm, Foot, Key, animate
from piavatar_envs.avatar.motion.motion import Motion

_UP = Foot((0.0, 0.02, 0.24), pitch=12.0)
_AHEAD = Arm((0.38, -0.48, -0.80), (0.10, -0.92, -0.10))
_BEHIND = Arm((0.48, 0.42, -0.80), (0.45, -0.30, -0.85))
_SHIFT = 0.13  # how far the pelvis moves over the foot that stands, in leg lengths


def build(rest_joints: np.ndarray) -> Motion:
    """Return the clip for a body with these joints [m], shape ``(22, 3)``."""
    on_right = {"pelvis": (-_SHIFT, -0.01, -0.035), "turns": {"pelvis": (2.0, 0.0, 0.0), "spine2": (2.0, 5.0, 0.0)}}
    on_left = {"pelvis": (_SHIFT, -0.01, -0.035), "turns": {"pelvis": (2.0, 0.0, 0.0), "spine2": (2.0, -5.0, 0.0)}}
    left_up = {**on_right, "left_foot": _UP, "right_arm": _AHEAD, "left_arm": _BEHIND}
    right_up = {**on_left, "right_foot": _UP, "left_arm": _AHEAD, "right_arm": _BEHIND}
    keys = [
        Key(0.0),
        Key(0.45, **on_right),
        Key(0.85, **left_up),
        Key(1.25, **on_right),
        Key(1.75, **on_left),
        Key(2.15, **right_up),
        Key(2.55, **on_left),
        Key(3.0),
    ]
    return animate("step", keys, rest_joints)
