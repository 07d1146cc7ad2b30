"""A commanded root that cannot run away from a body that something blocks.

Root actions move the command, and the root wrench pulls the body after it, the harder the farther it is ahead. A body
that is pushed or blocked would fall behind until its root lets go; with a leash the command waits for it, and the
length of the leash bounds how hard the body pushes.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import warp as wp

from piavatar_envs.avatar.rotation import quat_exp, quat_log, turn_about_z

if TYPE_CHECKING:
    from piavatar_envs.core.launch_graph import LaunchGraph
    from piavatar_envs.envs.batch_env import BatchEnv

wp.set_module_options({"enable_backward": False})


def record_leash(env: BatchEnv, graph: LaunchGraph, length: float, turn: float) -> list[tuple[wp.array, wp.array]]:
    """Append, before the physics: take every commanded root back onto its leash.

    Use as ``Task.record_references``. The command itself changes, not the way from it to the goal: what takes a body
    along must not become a motion that it makes by itself on top.

    Args:
        env: the batch.
        graph: records.
        length: greatest horizontal distance of the command from the tracked pelvis, before an action is added [m].
        turn: greatest turn of the command about the vertical from the tracked pelvis [rad].

    Returns:
        The poses that actions are added to, of every avatar: what was commanded last.
    """
    references = []
    for avatar in env.simulation.avatars:
        tracked, state = avatar.tracked, avatar.state
        graph.launch(
            leash_root,
            env.num_envs,
            [length, turn, tracked.rotation, tracked.position, state.let_go],
            [state.command_rotation, state.command_root],
        )
        references.append((state.command_rotation, state.command_root))
    return references


@wp.func
def held_back(root: wp.vec3, center: wp.vec3, reach: float):
    """``root``, or what is nearest to it within the horizontal distance ``reach`` [m] of ``center``."""
    off = root - center
    off = wp.vec3(off[0], off[1], 0.0)
    excess = 1.0 - wp.min(1.0, reach / wp.max(wp.length(off), 1.0e-6))
    return root - excess * off


@wp.kernel
def leash_root(
    length: float,
    turn: float,
    rotation: wp.array2d(dtype=wp.quat),
    position: wp.array2d(dtype=wp.vec3),
    let_go: wp.array(dtype=int),
    # in and out
    command_rotation: wp.array2d(dtype=wp.quat),
    command_root: wp.array(dtype=wp.vec3),
):
    """Bring the command as near to the tracked pelvis as the leash asks; its height and tilt stay."""
    e = wp.tid()
    if let_go[e] != 0:
        return
    command_root[e] = held_back(command_root[e], position[e, 0], length)
    q = command_rotation[e, 0]
    heading = quat_log(turn_about_z(q) * wp.quat_inverse(turn_about_z(rotation[e, 0])))[2]
    back = wp.clamp(heading, -turn, turn) - heading
    command_rotation[e, 0] = wp.normalize(quat_exp(wp.vec3(0.0, 0.0, back)) * q)
