"""Root command clamp: the commanded root keeps within a distance and a turn of the tracked pelvis.

Root actions move the command, and the root wrench pulls the body after it, the harder the farther the command is ahead.
Without the clamp the command of a blocked body would run away from it until the root is released. With it the command
waits, and the greatest lead bounds how hard the body pushes.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import warp as wp

from piavatar_envs.avatar.rotation import quat_exp, quat_log, turn_about_z
from piavatar_envs.envs.episodes import Bones

if TYPE_CHECKING:
    from piavatar_envs.core.launch_graph import LaunchGraph
    from piavatar_envs.envs.episodes import EpisodeArrays

wp.set_module_options({"enable_backward": False})


def record_root_clamp(
    env: EpisodeArrays, graph: LaunchGraph, lead: float, turn: float
) -> list[tuple[wp.array, wp.array]]:
    """Append, before the physics: clamp every commanded root; use as ``Task.record_references``.

    The command itself changes, not the difference between it and the goal, so that the pull by which something else
    moves the body is not added to the motion that the body makes by itself.

    Args:
        env: the batch.
        graph: records.
        lead: greatest horizontal distance of the command from the tracked pelvis, before an action is added [m].
        turn: greatest turn of the command about the vertical from the tracked pelvis [rad].

    Returns:
        The poses that actions are added to, of every avatar: the commanded ones.
    """
    references = []
    for bones, avatar in zip(env.bones, env.simulation.avatars, strict=True):
        command = avatar.state.command_rotation, avatar.state.command_root
        graph.launch(clamp_root, env.num_envs, [lead, turn, bones, avatar.state.released], list(command))
        references.append(command)
    return references


@wp.func
def clamp_to_circle(root: wp.vec3, center: wp.vec3, reach: float):
    """Return ``root``, moved horizontally to within ``reach`` [m] of ``center``."""
    off = root - center
    off = wp.vec3(off[0], off[1], 0.0)
    excess = 1.0 - wp.min(1.0, reach / wp.max(wp.length(off), 1.0e-6))
    return root - excess * off


@wp.kernel
def clamp_root(
    lead: float,
    turn: float,
    bones: Bones,
    released: wp.array(dtype=int),
    # in and out
    command_rotation: wp.array2d(dtype=wp.quat),
    command_root: wp.array(dtype=wp.vec3),
):
    """Clamp the command's horizontal place and its heading; its height and tilt stay."""
    e = wp.tid()
    if released[e] != 0:
        return
    command_root[e] = clamp_to_circle(command_root[e], bones.position[e, 0], lead)
    q = command_rotation[e, 0]
    heading = quat_log(turn_about_z(q) * wp.quat_inverse(turn_about_z(bones.rotation[e, 0])))[2]
    back = wp.clamp(heading, -turn, turn) - heading
    command_rotation[e, 0] = wp.normalize(quat_exp(wp.vec3(0.0, 0.0, back)) * q)
