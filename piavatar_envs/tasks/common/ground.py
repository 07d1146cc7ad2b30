"""Putting bodies on the ground: any first pose, with its lowest flesh where soles are in the rest pose."""

from __future__ import annotations

from typing import TYPE_CHECKING

import warp as wp

from piavatar_envs.avatar.body.skeleton import NUM_JOINTS
from piavatar_envs.avatar.kinematics import pose_body
from piavatar_envs.avatar.rotation import quat_exp
from piavatar_envs.avatar.skinning import bones_of, weights_of
from piavatar_envs.avatar.types import Body
from piavatar_envs.mpm.types import row
from piavatar_envs.tasks.common.spawn import record_standing

if TYPE_CHECKING:
    from piavatar_envs.core.launch_graph import LaunchGraph
    from piavatar_envs.envs.batch_env import BatchEnv

wp.set_module_options({"enable_backward": False})

#: Higher than any flesh [m].
_SKY = wp.constant(1.0e6)


class Grounding:
    """Heights of the first avatar's commanded pose, and of its rest pose, in every environment."""

    def __init__(self, env: BatchEnv) -> None:
        n, device, bones = env.num_envs, env.device, (env.num_envs, NUM_JOINTS)
        self._rotation = wp.zeros(bones, dtype=wp.quat, device=device)
        self._position, self._still = (wp.zeros(bones, dtype=wp.vec3, device=device) for _ in range(2))
        self._lowest = wp.zeros((n, 2), dtype=float, device=device)

    def record_standing(self, env: BatchEnv, graph: LaunchGraph, noise: float) -> None:
        """Append: bodies of the masked environments stand on the ground, joints turned by up to ``noise`` [rad]."""
        record_standing(env, graph, noise)
        self.record_reset(env, graph)

    def record_reset(self, env: BatchEnv, graph: LaunchGraph) -> None:
        """Append, when the masked environments' first poses are commanded: put them on the ground.

        In the rest pose bodies stand on the ground, so their roots rise or sink by what the lowest particle of the
        commanded pose is off from that of the rest pose.
        """
        n, avatar = env.num_envs, env.simulation.avatar
        body, state = avatar.body, avatar.state
        graph.launch(forget_lowest, self._lowest.shape, [], [self._lowest])
        still, threads = self._still, avatar.threads
        graph.launch(
            pose_body,
            (n, threads),
            [body, 0.0, state.command_rotation, state.command_root, still, still[:, 0], threads],
            [self._rotation, self._position],
        )
        graph.launch(
            find_lowest, (n, avatar.num_points), [env.mask, body, self._rotation, self._position], [self._lowest]
        )
        graph.launch(stand_on_ground, n, [env.mask, self._lowest], [state.command_root])


@wp.kernel
def forget_lowest(lowest: wp.array2d(dtype=float)):
    """Nothing has been found yet; over ``(E, 2)``."""
    e, n = wp.tid()
    lowest[e, n] = _SKY


@wp.kernel
def find_lowest(
    mask: wp.array(dtype=wp.bool),
    body: Body,
    rotation: wp.array2d(dtype=wp.quat),
    position: wp.array2d(dtype=wp.vec3),
    # in and out
    lowest: wp.array2d(dtype=float),
):
    """Lowest particles in a pose and in the rest pose [m]. A minimum does not depend on its order."""
    e, p = wp.tid()
    if not mask[e]:
        return
    rest = body.rest[row(e, body.rest.shape[0]), p]
    joint = bones_of(body.skin, p)
    weight = weights_of(body.skin, p)
    height = float(0.0)
    for n in range(4):
        if weight[n] > 0.0:
            arm = rest - body.rest_joint[row(e, body.rest_joint.shape[0]), joint[n]]
            height += weight[n] * (position[e, joint[n]] + wp.quat_rotate(rotation[e, joint[n]], arm))[2]
    wp.atomic_min(lowest, e, 0, height)
    wp.atomic_min(lowest, e, 1, rest[2])


@wp.kernel
def stand_on_ground(
    mask: wp.array(dtype=wp.bool),
    lowest: wp.array2d(dtype=float),
    # in and out
    command_root: wp.array(dtype=wp.vec3),
):
    """Raise or sink the commanded root."""
    e = wp.tid()
    if mask[e]:
        command_root[e] = command_root[e] + wp.vec3(0.0, 0.0, lowest[e, 1] - lowest[e, 0])


@wp.func
def forward_of(yaw: float):
    """Where a body faces that is turned by ``yaw`` [rad]: a unit vector."""
    return wp.quat_rotate(quat_exp(wp.vec3(0.0, 0.0, yaw)), wp.vec3(0.0, -1.0, 0.0))
