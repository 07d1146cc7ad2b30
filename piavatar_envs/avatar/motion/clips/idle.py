"""Standing: breathing, and the weight going gently from foot to foot."""

from __future__ import annotations

import numpy as np

from piavatar_envs.avatar.motion.keyframes import Key, animate
from piavatar_envs.avatar.motion.motion import Motion


def build(rest_joints: np.ndarray) -> Motion:
    """Return the clip for a body with these joints [m], shape ``(22, 3)``."""
    inhaled = {"spine3": (-2.0, 0.0, 0.0), "left_collar": (0.0, -2.5, 0.0), "right_collar": (0.0, 2.5, 0.0)}
    keys = [
        Key(0.0),
        Key(1.0, pelvis=(0.012, 0.0, -0.004), turns={**inhaled, "spine2": (0.0, -1.2, 0.0), "head": (2.0, 0.0, 3.0)}),
        Key(2.0),
        Key(3.0, pelvis=(-0.012, 0.0, -0.004), turns={**inhaled, "spine2": (0.0, 1.2, 0.0), "head": (2.0, 0.0, -3.0)}),
        Key(4.0),
    ]
    return animate("idle", keys, rest_joints)
