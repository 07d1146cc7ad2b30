"""Where bodies start."""

from __future__ import annotations

import warp as wp

from piavatar_envs.avatar.rotation import quat_exp
from piavatar_envs.avatar.types import Body
from piavatar_envs.envs.draws import STREAM_POSE, generator
from piavatar_envs.mpm.types import row

wp.set_module_options({"enable_backward": False})


@wp.kernel
def spawn_standing(
    mask: wp.array(dtype=wp.bool),
    seed: wp.array(dtype=int),
    episode: wp.array(dtype=int),
    body: Body,
    lower: wp.array(dtype=wp.vec3),
    upper: wp.array(dtype=wp.vec3),
    noise: float,
    # out
    command_rotation: wp.array2d(dtype=wp.quat),
    command_root: wp.array(dtype=wp.vec3),
):
    """Standing in the rest pose, every joint turned by up to ``noise`` [rad] about each axis, within its limits."""
    e, b = wp.tid()
    if not mask[e]:
        return
    if b == 0:
        command_rotation[e, b] = wp.quat(0.0, 0.0, 0.0, 1.0)
        command_root[e] = body.rest_joint[row(e, body.rest_joint.shape[0]), 0]
        return
    random = generator(seed[e], episode[e], STREAM_POSE, b)
    v = noise * wp.vec3(wp.randf(random, -1.0, 1.0), wp.randf(random, -1.0, 1.0), wp.randf(random, -1.0, 1.0))
    command_rotation[e, b] = quat_exp(wp.max(lower[b], wp.min(v, upper[b])))
