"""Actions of avatars whose joints move under torques: joint targets (``control="pd"``) or torques (``"torque"``).

A *target* is absolute. At action 0 a joint is asked for its pose in the rest position (or in the task's reference),
at 1 and -1 for the ends of its range about that axis, and in between linearly in the rotation vector, so that the
same action always means the same pose. A *torque* is the share of the greatest that the joint has in that direction.
Joints that do not act are held in the rest position (the reference).
"""

from __future__ import annotations

import warp as wp

from piavatar_envs.avatar.joint_torques import Strength
from piavatar_envs.avatar.rotation import quat_exp, quat_log, short_of_pi
from piavatar_envs.envs.actions import ActionMap, bounded

wp.set_module_options({"enable_backward": False})


@wp.func
def action_vector(action: wp.array3d(dtype=float), e: int, agent: int, n: int):
    """Three action components, clipped; zero where they are not finite."""
    return wp.vec3(bounded(action, e, agent, n), bounded(action, e, agent, n + 1), bounded(action, e, agent, n + 2))


@wp.func
def share_of(a: wp.vec3, lower: wp.vec3, upper: wp.vec3):
    """From 0 to ``upper`` where ``a`` goes from 0 to 1, to ``lower`` where it goes to -1, axis by axis."""
    return wp.cw_mul(wp.max(a, wp.vec3(0.0)), upper) - wp.cw_mul(wp.min(a, wp.vec3(0.0)), lower)


@wp.kernel
def follow_reference(
    about_rest: int,
    reference_rotation: wp.array2d(dtype=wp.quat),
    reference_root: wp.array(dtype=wp.vec3),
    failure: wp.array(dtype=int),
    # out
    command_rotation: wp.array2d(dtype=wp.quat),
    command_root: wp.array(dtype=wp.vec3),
    goal_rotation: wp.array2d(dtype=wp.quat),
    goal_root: wp.array(dtype=wp.vec3),
):
    """The goal before actions: the reference, its joints in the rest pose if ``about_rest``.

    The reference has been commanded: it is what the next one is counted from.
    """
    e, b = wp.tid()
    if failure[e] != 0:
        return
    goal = reference_rotation[e, b]
    command_rotation[e, b] = goal
    if b == 0:
        command_root[e] = reference_root[e]
        goal_root[e] = reference_root[e]
    elif about_rest != 0:
        goal = wp.quat(0.0, 0.0, 0.0, 1.0)
    goal_rotation[e, b] = goal


@wp.kernel
def apply_targets(
    action_map: ActionMap,
    action: wp.array3d(dtype=float),
    agent: int,
    alive: wp.array2d(dtype=wp.bool),
    # in and out
    goal_rotation: wp.array2d(dtype=wp.quat),
):
    """Move the goal of every acting joint towards the ends of its range. An agent that is out does not act.

    What the goal itself exceeds (a clip may) is allowed, but actions cannot push further.
    """
    e, b = wp.tid()
    n = action_map.offset[b]
    if n < 0 or not alive[e, agent]:
        return
    v = quat_log(goal_rotation[e, b])
    lower = wp.min(action_map.lower[b] - v, wp.vec3(0.0))
    upper = wp.max(action_map.upper[b] - v, wp.vec3(0.0))
    v += share_of(action_vector(action, e, agent, n), lower, upper)
    goal_rotation[e, b] = quat_exp(short_of_pi(v))


@wp.kernel
def apply_torques(
    action_map: ActionMap,
    action: wp.array3d(dtype=float),
    agent: int,
    alive: wp.array2d(dtype=wp.bool),
    strength: Strength,
    # out
    torque: wp.array2d(dtype=wp.vec3),
):
    """Torque of every acting joint, of the reference adult [N m]. An agent that is out is limp."""
    e, b = wp.tid()
    n = action_map.offset[b]
    if n < 0:
        return
    torque[e, b] = wp.vec3(0.0)
    if alive[e, agent]:
        torque[e, b] = share_of(action_vector(action, e, agent, n), strength.lower[b], strength.upper[b])
