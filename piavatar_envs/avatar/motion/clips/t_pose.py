"""Both arms up to the T-pose, held, and down again."""

from __future__ import annotations

import numpy as np

from piavatar_envs.avatar.motion.keyframes import Arm, Key, animate
from piavatar_envs.avatar.motion.motion import Motion

_SIDEWAYS = Arm((1.0, 0.0, 0.0), (0.998, -0.06, 0.0))  # a trace of a bend, which says where the elbow's hinge is


def build(rest_joints: np.ndarray) -> Motion:
    """Return the clip for a body with these joints [m], shape ``(22, 3)``."""
    held = {"left_arm": _SIDEWAYS, "right_arm": _SIDEWAYS}
    return animate("t_pose", [Key(0.0), Key(0.9, **held), Key(1.5, **held), Key(2.4), Key(2.6)], rest_joints)
