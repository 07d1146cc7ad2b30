"""Where bodies start."""

from __future__ import annotations

from typing import TYPE_CHECKING

import warp as wp

from piavatar_envs.avatar.body.skeleton import NUM_JOINTS
from piavatar_envs.avatar.rotation import quat_exp
from piavatar_envs.avatar.types import Body
from piavatar_envs.core.rng import STREAM_POSE, generator
from piavatar_envs.mpm.types import row
from piavatar_envs.sim.checks import check_beside_standing

if TYPE_CHECKING:
    from piavatar_envs.core.launch_graph import LaunchGraph
    from piavatar_envs.envs.batch_env import BatchEnv

wp.set_module_options({"enable_backward": False})


def record_standing(env: BatchEnv, graph: LaunchGraph, noise: float) -> None:
    """Append: all avatars of the masked environments stand where the scene puts them.

    Raises:
        ConfigError: something of the scene would begin inside of one.
    """
    check_beside_standing(env.simulation)
    for index, (avatar, config) in enumerate(zip(env.simulation.avatars, env.task.scene.avatars, strict=True)):
        limits = env.action_map.lower, env.action_map.upper
        graph.launch(
            spawn_standing,
            (env.num_envs, NUM_JOINTS),
            [
                env.mask, env.seed, env.episode, avatar.body, *limits, noise, index,
                wp.vec3(*config.position, config.yaw),
            ],
            [avatar.state.command_rotation, avatar.state.command_root],
        )  # fmt: skip


@wp.kernel
def spawn_standing(
    mask: wp.array(dtype=wp.bool),
    seed: wp.array(dtype=int),
    episode: wp.array(dtype=int),
    body: Body,
    lower: wp.array(dtype=wp.vec3),
    upper: wp.array(dtype=wp.vec3),
    noise: float,
    avatar: int,
    place: wp.vec3,
    # out
    command_rotation: wp.array2d(dtype=wp.quat),
    command_root: wp.array(dtype=wp.vec3),
):
    """Standing in the rest pose, every joint turned by up to ``noise`` [rad] about each axis, within its limits.

    ``place`` is where the body stands (x and y [m]) and how far it is turned about the vertical [rad]; ``avatar``
    counts the avatars of a world, which draw apart.
    """
    e, b = wp.tid()
    if not mask[e]:
        return
    if b == 0:
        turn = quat_exp(wp.vec3(0.0, 0.0, place[2]))
        command_rotation[e, b] = turn
        root = body.rest_joint[row(e, body.rest_joint.shape[0]), 0]
        command_root[e] = wp.quat_rotate(turn, root) + wp.vec3(place[0], place[1], 0.0)
        return
    random = generator(seed[e], episode[e], STREAM_POSE, b + avatar * lower.shape[0])
    v = noise * wp.vec3(wp.randf(random, -1.0, 1.0), wp.randf(random, -1.0, 1.0), wp.randf(random, -1.0, 1.0))
    command_rotation[e, b] = quat_exp(wp.max(lower[b], wp.min(v, upper[b])))
