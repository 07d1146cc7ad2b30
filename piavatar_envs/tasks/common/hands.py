"""Middles of the hands: no joint marks them, so they are the centres of the hands' flesh."""

from __future__ import annotations

import warp as wp

from piavatar_envs.avatar.body.skeleton import joint_index
from piavatar_envs.avatar.types import Body
from piavatar_envs.mpm.types import row

wp.set_module_options({"enable_backward": False})

LEFT_WRIST, RIGHT_WRIST = wp.constant(joint_index("left_wrist")), wp.constant(joint_index("right_wrist"))


@wp.func
def flesh_middle(body: Body, e: int, b: int, rotation: wp.array2d(dtype=wp.quat), position: wp.array2d(dtype=wp.vec3)):
    """Return the middle of a bone's flesh [m], carried by the tracked joint."""
    arm = body.rest_center[row(e, body.rest_center.shape[0]), b]
    arm -= body.rest_joint[row(e, body.rest_joint.shape[0]), b]
    return position[e, b] + wp.quat_rotate(rotation[e, b], arm)


@wp.func
def write_hands(
    body: Body,
    e: int,
    rotation: wp.array2d(dtype=wp.quat),
    position: wp.array2d(dtype=wp.vec3),
    # out
    hands: wp.array2d(dtype=wp.vec3),
):
    """Write the middles of the left and the right hand [m]."""
    hands[e, 0] = flesh_middle(body, e, LEFT_WRIST, rotation, position)
    hands[e, 1] = flesh_middle(body, e, RIGHT_WRIST, rotation, position)
