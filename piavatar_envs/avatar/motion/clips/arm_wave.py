"""The left arm goes up and waves."""

from __future__ import annotations

import numpy as np

from piavatar_envs.avatar.motion.keyframes import Arm, Key, animate
from piavatar_envs.avatar.motion.motion import Motion

_UPPER = (0.90, -0.10, 0.28)
_OUT, _IN = Arm(_UPPER, (0.62, -0.25, 0.85)), Arm(_UPPER, (-0.30, -0.30, 0.95))


def build(rest_joints: np.ndarray) -> Motion:
    """Return the clip for a body with these joints [m], shape ``(22, 3)``; leaning a little away from the arm."""
    lean = {"spine2": (0.0, -4.0, 0.0), "head": (0.0, 4.0, 8.0)}
    keys = [Key(0.0), Key(0.8, turns=lean, left_arm=_IN)]
    keys += [Key(0.8 + 0.4 * i, turns=lean, left_arm=_OUT if i % 2 else _IN) for i in range(1, 6)]
    return animate("arm_wave", [*keys, Key(3.6)], rest_joints)
