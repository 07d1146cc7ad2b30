"""Pushing a box, in kernels: where box and target are drawn, what it is worth, what is observed of it."""

from __future__ import annotations

import warp as wp

from piavatar_envs.avatar.rotation import quat_exp, quat_log, turn_about_z
from piavatar_envs.avatar.types import Body
from piavatar_envs.core.rng import STREAM_TASK, generator
from piavatar_envs.envs.observations import write_vector
from piavatar_envs.mpm.colliders import BOX, solid_distance
from piavatar_envs.mpm.types import Sensors
from piavatar_envs.tasks.common.hands import write_hands
from piavatar_envs.tasks.common.rewards import mean_square_action, tolerance

wp.set_module_options({"enable_backward": False})

#: Margin of the reward for a box that starts at its target [m].
LEAST_MARGIN = wp.constant(0.1)


@wp.struct
class Push:
    """Constants of the task. Ranges are a lower and an upper bound."""

    box: int  # index among the props
    pair: int  # sensor of the avatar with the box
    half_size: wp.vec3  # [m]
    volume: float  # [m^3]
    place: wp.vec3  # where the avatar starts: x, y [m] and yaw [rad]
    mass: wp.vec2  # [kg]
    distance: wp.vec2  # of the box from the avatar [m]
    turn: float  # [rad]
    way: wp.vec2  # from the box to the target [m]
    angle: float  # [rad]
    reached: float
    hand_margin: float
    control_cost: float


@wp.func
def ahead(place: wp.vec3, angle: float):
    """Unit vector at ``angle`` [rad] from straight ahead of an avatar at ``place``."""
    return wp.quat_rotate(quat_exp(wp.vec3(0.0, 0.0, place[2] + angle)), wp.vec3(0.0, -1.0, 0.0))


@wp.kernel
def draw_push(
    mask: wp.array(dtype=wp.bool),
    seed: wp.array(dtype=int),
    episode: wp.array(dtype=int),
    push: Push,
    # out
    position: wp.array2d(dtype=wp.vec3),
    rotation: wp.array2d(dtype=wp.quat),
    density: wp.array2d(dtype=float),
    target: wp.array(dtype=wp.vec3),
    way: wp.array(dtype=float),
):
    """A box before the avatar, its mass, where it shall go, and how far that is [m]."""
    e = wp.tid()
    if not mask[e]:
        return
    random = generator(seed[e], episode[e], STREAM_TASK, 0)
    out = wp.randf(random, push.distance[0], push.distance[1]) * ahead(push.place, 0.0)
    at = wp.vec3(push.place[0] + out[0], push.place[1] + out[1], push.half_size[2])
    position[e, push.box] = at
    turn = push.place[2] + wp.randf(random, -push.turn, push.turn)
    rotation[e, push.box] = quat_exp(wp.vec3(0.0, 0.0, turn))
    density[e, push.box] = wp.randf(random, push.mass[0], push.mass[1]) / push.volume
    way[e] = wp.randf(random, push.way[0], push.way[1])
    to = at + way[e] * ahead(push.place, wp.randf(random, -push.angle, push.angle))
    target[e] = wp.vec3(to[0], to[1], 0.0)


@wp.kernel
def find_hands(
    body: Body,
    rotation: wp.array2d(dtype=wp.quat),
    position: wp.array2d(dtype=wp.vec3),
    # out
    hands: wp.array2d(dtype=wp.vec3),
):
    """Middles of both hands in the world."""
    e = wp.tid()
    write_hands(body, e, rotation, position, hands)


@wp.func
def to_go(box: wp.vec3, target: wp.vec3):
    """Horizontal way from the box to the target [m]."""
    return wp.vec3(target[0] - box[0], target[1] - box[1], 0.0)


@wp.kernel
def judge(
    push: Push,
    box_position: wp.array2d(dtype=wp.vec3),
    box_rotation: wp.array2d(dtype=wp.quat),
    box_velocity: wp.array2d(dtype=wp.vec3),
    hands: wp.array2d(dtype=wp.vec3),
    target: wp.array(dtype=wp.vec3),
    way: wp.array(dtype=float),
    sensors: Sensors,
    action: wp.array3d(dtype=float),
    # out
    terms: wp.array3d(dtype=float),
    metrics: wp.array3d(dtype=float),
    success: wp.array2d(dtype=wp.bool),
):
    """Reward of a box near its target and of hands near the box, and what actions cost."""
    e = wp.tid()
    distance = wp.length(to_go(box_position[e, push.box], target[e]))
    near = float(0.0)
    for hand in range(2):
        p = wp.quat_rotate_inv(box_rotation[e, push.box], hands[e, hand] - box_position[e, push.box])
        gap = wp.max(solid_distance(BOX, push.half_size, p)[3], 0.0)
        near += 0.5 * tolerance(gap, 0.1, push.hand_margin)
        metrics[e, 0, 1 + hand] = gap
    terms[e, 0, 0] = 0.8 * tolerance(distance, push.reached, wp.max(way[e] - push.reached, LEAST_MARGIN))
    terms[e, 0, 1] = 0.2 * near
    terms[e, 0, 2] = -push.control_cost * mean_square_action(action, e, 0)
    metrics[e, 0, 0] = distance
    metrics[e, 0, 3] = wp.length(box_velocity[e, push.box])
    metrics[e, 0, 4] = wp.length(sensors.pair_impulse[e, push.pair])
    success[e, 0] = distance <= push.reached


@wp.kernel
def observe(
    push: Push,
    agent: int,
    start: int,
    rotation: wp.array2d(dtype=wp.quat),
    position: wp.array2d(dtype=wp.vec3),
    box_position: wp.array2d(dtype=wp.vec3),
    density: wp.array2d(dtype=float),
    hands: wp.array2d(dtype=wp.vec3),
    target: wp.array(dtype=wp.vec3),
    # out
    observation: wp.array3d(dtype=float),
):
    """The first terms of ``PushBoxTask.observation_terms``."""
    e = wp.tid()
    to_root = wp.quat_inverse(rotation[e, 0])
    box = box_position[e, push.box]
    write_vector(observation, e, agent, start, wp.quat_rotate(to_root, target[e] - position[e, 0]))
    write_vector(observation, e, agent, start + 3, wp.quat_rotate(to_root, to_go(box, target[e])))
    write_vector(observation, e, agent, start + 6, wp.quat_rotate(to_root, box - hands[e, 0]))
    write_vector(observation, e, agent, start + 9, wp.quat_rotate(to_root, box - hands[e, 1]))
    observation[e, agent, start + 12] = push.volume * density[e, push.box]


@wp.kernel
def observe_lead(
    agent: int,
    start: int,
    rotation: wp.array2d(dtype=wp.quat),
    position: wp.array2d(dtype=wp.vec3),
    command_rotation: wp.array2d(dtype=wp.quat),
    command_root: wp.array(dtype=wp.vec3),
    # out
    observation: wp.array3d(dtype=float),
):
    """How far the command is ahead of the pelvis: to its left and backwards [m], and its turn [rad]."""
    e = wp.tid()
    heading = turn_about_z(rotation[e, 0])
    lead = wp.quat_rotate_inv(heading, command_root[e] - position[e, 0])
    turn = quat_log(turn_about_z(command_rotation[e, 0]) * wp.quat_inverse(heading))
    write_vector(observation, e, agent, start, wp.vec3(lead[0], lead[1], turn[2]))
