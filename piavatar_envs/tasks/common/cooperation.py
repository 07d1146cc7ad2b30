"""What worlds of agents with one aim have in common: places that vary, and an end for all of them at once."""

from __future__ import annotations

from typing import TYPE_CHECKING

import warp as wp

from piavatar_envs.core.rng import STREAM_POSE, generator

if TYPE_CHECKING:
    from piavatar_envs.core.launch_graph import LaunchGraph
    from piavatar_envs.envs.batch_env import BatchEnv

wp.set_module_options({"enable_backward": False})


def record_shift(env: BatchEnv, graph: LaunchGraph, noise: float) -> None:
    """Append, at a reset: displace every avatar by up to ``noise`` [m] along x and y."""
    for index, avatar in enumerate(env.simulation.avatars):
        graph.launch(
            shift_root, env.num_envs, [env.mask, env.seed, env.episode, index, noise], [avatar.state.command_root]
        )


def record_fall_together(env: BatchEnv, graph: LaunchGraph, out: wp.array) -> None:
    """Append, after the judging: where one is ``out``, ``(num_envs, num_agents)``, the episode is over for all."""
    graph.launch(fall_together, env.num_envs, [out], [env.terminated])


@wp.kernel
def shift_root(
    mask: wp.array(dtype=wp.bool),
    seed: wp.array(dtype=int),
    episode: wp.array(dtype=int),
    avatar: int,
    noise: float,
    # in and out
    command_root: wp.array(dtype=wp.vec3),
):
    """Displace the root by up to ``noise`` [m] along x and y."""
    e = wp.tid()
    if mask[e]:
        # poses draw from the indices above zero
        random = generator(seed[e], episode[e], STREAM_POSE, -1 - avatar)
        command_root[e] += noise * wp.vec3(wp.randf(random, -1.0, 1.0), wp.randf(random, -1.0, 1.0), 0.0)


@wp.kernel
def fall_together(
    out: wp.array2d(dtype=wp.bool),
    # in and out
    terminated: wp.array2d(dtype=wp.bool),
):
    """Terminate all agents of an environment in which one is out."""
    e = wp.tid()
    fallen = bool(False)
    for agent in range(out.shape[1]):
        fallen = fallen or out[e, agent]
    for agent in range(out.shape[1]):
        terminated[e, agent] = terminated[e, agent] or fallen
