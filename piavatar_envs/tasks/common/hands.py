"""Middles of the hands: no joint marks them, so they are the centres of the hands' flesh."""

from __future__ import annotations

import warp as wp

from piavatar_envs.avatar.body.skeleton import joint_index
from piavatar_envs.envs.episodes import Bones, rest_joint
from piavatar_envs.mpm.types import row

wp.set_module_options({"enable_backward": False})

LEFT_WRIST, RIGHT_WRIST = wp.constant(joint_index("left_wrist")), wp.constant(joint_index("right_wrist"))


@wp.func
def flesh_middle(bones: Bones, e: int, b: int):
    """Return the middle of a bone's flesh [m], carried by the tracked joint."""
    arm = bones.body.rest_center[row(e, bones.body.rest_center.shape[0]), b]
    arm -= rest_joint(bones.body, e, b)
    return bones.position[e, b] + wp.quat_rotate(bones.rotation[e, b], arm)


@wp.func
def write_hands(bones: Bones, e: int, hands: wp.array2d(dtype=wp.vec3)):
    """Write the middles of the left and the right hand [m]."""
    hands[e, 0] = flesh_middle(bones, e, LEFT_WRIST)
    hands[e, 1] = flesh_middle(bones, e, RIGHT_WRIST)
