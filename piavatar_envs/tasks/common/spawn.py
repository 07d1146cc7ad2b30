"""First poses of an episode: standing where the scene puts the avatars, displaced, or on the ground in any pose."""

from __future__ import annotations

from typing import TYPE_CHECKING

import warp as wp

from piavatar_envs.avatar.body.skeleton import NUM_JOINTS
from piavatar_envs.avatar.correctives import displacement_of
from piavatar_envs.avatar.kinematics import pose_body
from piavatar_envs.avatar.rotation import quat_exp
from piavatar_envs.avatar.skinning import bones_of, weights_of
from piavatar_envs.avatar.types import Body
from piavatar_envs.core.rng import STREAM_POSE
from piavatar_envs.envs.episodes import EpisodeArrays, Episodes, random_of, rest_joint
from piavatar_envs.mpm.types import row
from piavatar_envs.sim.checks import check_beside_standing

if TYPE_CHECKING:
    from piavatar_envs.core.launch_graph import LaunchGraph
    from piavatar_envs.envs.episodes import EpisodeArrays, random_of

wp.set_module_options({"enable_backward": False})

#: Higher than any flesh [m].
_SKY = wp.constant(1.0e6)


def record_standing(env: EpisodeArrays, graph: LaunchGraph, noise: float) -> None:
    """Append, at a reset: stand all avatars where the scene puts them, every joint turned by up to ``noise`` [rad].

    Raises:
        ConfigError: something of the scene would begin inside of an avatar.
    """
    sim = env.simulation
    check_beside_standing(sim.config.scene, sim.scene, sim.props.points, sim.flesh, sim.subjects.names, sim.dx)
    for index, (avatar, config) in enumerate(zip(env.simulation.avatars, env.task.scene.avatars, strict=True)):
        limits = env.action_map.lower, env.action_map.upper
        place = wp.vec3(*config.position, config.yaw)
        graph.launch(
            spawn_standing,
            (env.num_envs, NUM_JOINTS),
            [env.episodes, avatar.body, *limits, noise, index, place],
            [avatar.state.command_rotation, avatar.state.command_root],
        )


def record_shift(env: EpisodeArrays, graph: LaunchGraph, noise: float) -> None:
    """Append, at a reset: displace every avatar by up to ``noise`` [m] along x and y."""
    for index, avatar in enumerate(env.simulation.avatars):
        graph.launch(shift_root, env.num_envs, [env.episodes, index, noise], [avatar.state.command_root])


class Grounding:
    """Places the first avatar's commanded pose on the ground: its lowest flesh where soles are in the rest pose."""

    def __init__(self, env: EpisodeArrays) -> None:
        n, device, bones = env.num_envs, env.device, (env.num_envs, NUM_JOINTS)
        self._rotation = wp.zeros(bones, dtype=wp.quat, device=device)
        self._position, self._still = (wp.zeros(bones, dtype=wp.vec3, device=device) for _ in range(2))
        self._lowest = wp.zeros((n, 2), dtype=float, device=device)

    def record_standing(self, env: EpisodeArrays, graph: LaunchGraph, noise: float) -> None:
        """Append, at a reset: stand the avatar on the ground, every joint turned by up to ``noise`` [rad]."""
        record_standing(env, graph, noise)
        self.record_reset(env, graph)

    def record_reset(self, env: EpisodeArrays, graph: LaunchGraph) -> None:
        """Append, at a reset, after the first pose is commanded: place it on the ground.

        In the rest pose bodies stand on the ground, so the root rises or sinks by the height of the lowest particle in
        the rest pose over that in the commanded pose.
        """
        n, avatar = env.num_envs, env.simulation.avatar
        body, state = avatar.body, avatar.state
        graph.launch(begin_lowest, self._lowest.shape, [], [self._lowest])
        still, threads = self._still, avatar.threads
        graph.launch(
            pose_body,
            (n, threads),
            [body, 0.0, state.command_rotation, state.command_root, still, still[:, 0], threads],
            [self._rotation, self._position],
        )
        inputs = [env.mask, body, state.command_rotation, self._rotation, self._position]
        graph.launch(find_lowest, (n, avatar.num_points), inputs, [self._lowest])
        graph.launch(stand_on_ground, n, [env.episodes, self._lowest], [state.command_root])


@wp.func
def forward_of(yaw: float):
    """Return the unit vector in which a body faces that is turned by ``yaw`` [rad]."""
    return wp.quat_rotate(quat_exp(wp.vec3(0.0, 0.0, yaw)), wp.vec3(0.0, -1.0, 0.0))


@wp.func
def pelvis_at(place: wp.vec3, body: Body, e: int):
    """Return the pelvis of a body [m] that stands in the rest pose at ``place``: x, y [m] and yaw [rad]."""
    rest = rest_joint(body, e, 0)
    turned = wp.quat_rotate(quat_exp(wp.vec3(0.0, 0.0, place[2])), rest)
    return turned + wp.vec3(place[0], place[1], 0.0)


@wp.kernel
def spawn_standing(
    episodes: Episodes,
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
    """Stand in the rest pose, every joint turned by up to ``noise`` [rad] about each axis, within its limits.

    ``place`` is x, y [m] and yaw [rad] of the body; ``avatar`` is its index in the scene, because each draws numbers of
    its own.
    """
    e, b = wp.tid()
    if not episodes.mask[e]:
        return
    if b == 0:
        turn = quat_exp(wp.vec3(0.0, 0.0, place[2]))
        command_rotation[e, b] = turn
        root = rest_joint(body, e, 0)
        command_root[e] = wp.quat_rotate(turn, root) + wp.vec3(place[0], place[1], 0.0)
        return
    random = random_of(episodes, e, STREAM_POSE, b + avatar * lower.shape[0])
    v = noise * wp.vec3(wp.randf(random, -1.0, 1.0), wp.randf(random, -1.0, 1.0), wp.randf(random, -1.0, 1.0))
    command_rotation[e, b] = quat_exp(wp.max(lower[b], wp.min(v, upper[b])))


@wp.kernel
def shift_root(
    episodes: Episodes,
    avatar: int,
    noise: float,
    # in and out
    command_root: wp.array(dtype=wp.vec3),
):
    """Displace the root by up to ``noise`` [m] along x and y."""
    e = wp.tid()
    if episodes.mask[e]:
        # poses draw from the indices above zero
        random = random_of(episodes, e, STREAM_POSE, -1 - avatar)
        command_root[e] += noise * wp.vec3(wp.randf(random, -1.0, 1.0), wp.randf(random, -1.0, 1.0), 0.0)


@wp.kernel
def begin_lowest(lowest: wp.array2d(dtype=float)):
    """Set heights above those of all particles, over ``(E, 2)``."""
    e, n = wp.tid()
    lowest[e, n] = _SKY


@wp.kernel
def find_lowest(
    mask: wp.array(dtype=wp.bool),
    body: Body,
    local: wp.array2d(dtype=wp.quat),
    rotation: wp.array2d(dtype=wp.quat),
    position: wp.array2d(dtype=wp.vec3),
    # in and out
    lowest: wp.array2d(dtype=float),
):
    """Take the minimum of the particles' heights in a pose and in the rest pose [m]; any order gives the same."""
    e, p = wp.tid()
    if not mask[e]:
        return
    rest = body.rest[row(e, body.rest.shape[0]), p]
    bent = rest + displacement_of(body, local, e, p)
    joint = bones_of(body.skin, p)
    weight = weights_of(body.skin, p)
    height = float(0.0)
    for n in range(4):
        if weight[n] > 0.0:
            arm = bent - body.rest_joint[row(e, body.rest_joint.shape[0]), joint[n]]
            height += weight[n] * (position[e, joint[n]] + wp.quat_rotate(rotation[e, joint[n]], arm))[2]
    wp.atomic_min(lowest, e, 0, height)
    wp.atomic_min(lowest, e, 1, rest[2])


@wp.kernel
def stand_on_ground(
    episodes: Episodes,
    lowest: wp.array2d(dtype=float),
    # in and out
    command_root: wp.array(dtype=wp.vec3),
):
    """Raise or sink the commanded root so that the lowest particles of both poses are at the same height."""
    e = wp.tid()
    if episodes.mask[e]:
        command_root[e] = command_root[e] + wp.vec3(0.0, 0.0, lowest[e, 1] - lowest[e, 0])
