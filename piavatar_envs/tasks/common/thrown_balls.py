"""Balls that are thrown at an avatar, caught where they have flown past, and thrown again.

A throw depends on the episode's seed, its number and the present pose of the body, so it needs no state. The tasks say
when balls are thrown.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Protocol

import numpy as np
import warp as wp

from piavatar_envs.avatar.body.skeleton import joint_index
from piavatar_envs.avatar.rotation import quat_exp
from piavatar_envs.core.rng import STREAM_BALL
from piavatar_envs.core.structs import fill
from piavatar_envs.envs.episodes import Bones, EpisodeArrays, Episodes, Props, random_of
from piavatar_envs.sim.scene import Domain

if TYPE_CHECKING:
    from piavatar_envs.config import PhysicsConfig
    from piavatar_envs.core.launch_graph import LaunchGraph
    from piavatar_envs.envs.episodes import EpisodeArrays, random_of

wp.set_module_options({"enable_backward": False})

#: Heights that balls are thrown from [m].
HEIGHT = (1.0, 1.5)
#: A ball that moves outwards faster than this beyond the catching radius is caught [m/s]; a slower one may lie there.
OUTWARDS = wp.constant(0.2)
#: Greatest angular velocity of a throw about each axis [rad/s].
MAX_SPIN = wp.constant(6.0)
#: Least distance of a throw's origin from every joint: a hand's or a foot's length and the ball's radius [m].
CLEARANCE = wp.constant(0.4)
#: Longest way from a throw's origin, out of the body's reach, to the body wherever it has moved [m].
REACH = 2.5
#: Index of the first ball's mass in the stream of the balls; the draws before and after the masses are the schedule's.
MASSES = wp.constant(1)


class ThrowConfig(Protocol):
    """Settings of a task that throws balls. Ranges are a lower and an upper bound."""

    physics: PhysicsConfig
    num_balls: int
    ball_radius: float  # [m]
    ball_mass: tuple[float, float]  # [kg]
    throw_interval: float  # time between two throws [s]
    throw_speed: tuple[float, float]  # [m/s]
    throw_distance: tuple[float, float]  # of the origins from the avatar's place [m]
    throw_angle: float  # greatest azimuth of the origins from the front [rad]
    aim_spread: float  # greatest error of the aim along each axis [m]


@wp.struct
class Throws:
    """Constants of the throws. Ranges are a lower and an upper bound."""

    num_balls: int  # they are props 0 ... num_balls - 1
    interval: int  # control steps between two throws
    place: wp.vec3  # of the avatar: x, y [m] and yaw [rad]
    distance: wp.vec2  # of the origins from there [m]
    height: wp.vec2  # of the origins [m]
    angle: float  # greatest azimuth of the origins from the front [rad]
    speed: wp.vec2  # distance to the aim over the time of flight [m/s]
    aim: wp.vec2i  # joints; balls are thrown at the line between them
    spread: float  # greatest distance of the aim from that line, along each axis [m]
    gravity: float  # [m/s^2]
    mass: wp.vec2  # [kg]
    log_mass: int  # 1 if masses are drawn uniformly in their logarithm
    volume: float  # of a ball [m^3]
    reach: float  # distance from the place beyond which balls are caught [m]
    rest: wp.array(dtype=wp.vec3)  # (num_balls,) waiting places [m]


def catching_distance(config: ThrowConfig) -> float:
    """Return the distance from the avatar's place beyond which a ball that flies on is caught [m]."""
    return config.throw_distance[1] + 0.1


def thrown_speed(config: ThrowConfig) -> float:
    """Return the greatest speed of any part of a thrown ball [m/s]; slow throws start upwards, to reach as far."""
    way = math.hypot(max(config.throw_distance[1], REACH) + math.sqrt(3.0) * config.aim_spread, HEIGHT[1])
    rising = (speed + 0.5 * config.physics.gravity * way / speed for speed in config.throw_speed)
    return max(rising) + math.sqrt(3.0) * MAX_SPIN * config.ball_radius


def waiting_places(place: Sequence[float], config: ThrowConfig) -> np.ndarray:
    """Return the waiting places, on the floor behind the avatar, side by side, shape ``(num_balls, 3)`` [m].

    Args:
        place: of the avatar, x, y [m] and yaw [rad].
        config: number, size and catching distance of the balls.
    """
    distance = catching_distance(config) + 0.1
    index = np.arange(config.num_balls) - 0.5 * (config.num_balls - 1)
    angle = place[2] + 3.0 * config.ball_radius / distance * index
    away = distance * np.stack([-np.sin(angle), np.cos(angle), np.zeros_like(angle)], axis=1)
    return away + np.array([place[0], place[1], config.ball_radius])


def throwing_domain(config: ThrowConfig, place: Sequence[float]) -> Domain:
    """Return the box in which balls wait, and fly past the waiting ones before they are caught."""
    x, y, _ = place
    out = catching_distance(config) + config.ball_radius
    out += 0.1 + 1.5 * config.throw_speed[1] * config.physics.control_dt
    return Domain().around([place]).including((x - out, y - out, 0.0), (x + out, y + out, 0.0))


def make_throws(
    config: ThrowConfig,
    place: Sequence[float],
    waiting: np.ndarray,
    env: EpisodeArrays,
    aim: tuple[str, str] = ("spine3", "head"),
    log_mass: bool = False,
) -> Throws:
    """Return the constants of the throws; the balls are the first props of ``env``.

    Args:
        config: number, size, mass, origins and speeds of the balls.
        place: of the avatar, x, y [m] and yaw [rad].
        waiting: places of waiting balls [m], shape ``(num_balls, 3)``.
        env: the batch.
        aim: joints; balls are thrown at the line between them.
        log_mass: whether masses are drawn uniformly in their logarithm.
    """
    return fill(
        Throws(),
        num_balls=config.num_balls,
        interval=max(1, round(config.throw_interval / config.physics.control_dt)),
        place=wp.vec3(*place),
        distance=wp.vec2(*config.throw_distance),
        height=wp.vec2(*HEIGHT),
        angle=config.throw_angle,
        speed=wp.vec2(*config.throw_speed),
        aim=wp.vec2i(*map(joint_index, aim)),
        spread=config.aim_spread,
        gravity=config.physics.gravity,
        mass=wp.vec2(*config.ball_mass),
        log_mass=int(log_mass),
        volume=float(env.simulation.props.volume[0]),
        reach=catching_distance(config),
        rest=wp.array(waiting.astype(np.float32), dtype=wp.vec3, device=env.device),
    )


@wp.func
def launch_velocity(start: wp.vec3, aim: wp.vec3, speed: float, gravity: float):
    """Return the velocity [m/s] of a free body from ``start`` to ``aim`` in the time of a straight way at ``speed``."""
    way = aim - start
    time = wp.length(way) / speed
    return way / time + wp.vec3(0.0, 0.0, 0.5 * gravity * time)


@wp.func
def out_of_the_body(joints: wp.array2d(dtype=wp.vec3), e: int, start: wp.vec3, outwards: wp.vec3):
    """Return ``start``, moved along the unit vector ``outwards`` beyond the reach of every limb."""
    further = float(0.0)
    for b in range(joints.shape[1]):
        way = joints[e, b] - start
        along = wp.dot(way, outwards)
        inside = CLEARANCE * CLEARANCE - wp.length_sq(way - along * outwards)
        if inside > 0.0:
            further = wp.max(further, along + wp.sqrt(inside))
    return start + further * outwards


@wp.func
def draw_throw(throws: Throws, random: wp.uint32, e: int, joints: wp.array2d(dtype=wp.vec3)):
    """Draw a throw that meets the body at its present place: origin [m], velocity [m/s] and spin [rad/s]."""
    turn = quat_exp(wp.vec3(0.0, 0.0, throws.place[2] + wp.randf(random, -throws.angle, throws.angle)))
    away = wp.quat_rotate(turn, wp.vec3(0.0, -1.0, 0.0))
    start = wp.vec3(throws.place[0], throws.place[1], wp.randf(random, throws.height[0], throws.height[1]))
    start += wp.randf(random, throws.distance[0], throws.distance[1]) * away
    start = out_of_the_body(joints, e, start, away)
    aim = wp.lerp(joints[e, throws.aim[0]], joints[e, throws.aim[1]], wp.randf(random))
    aim += 2.0 * throws.spread * wp.sample_unit_cube(random)
    speed = wp.randf(random, throws.speed[0], throws.speed[1])
    spin = 2.0 * MAX_SPIN * wp.sample_unit_cube(random)
    return start, launch_velocity(start, aim, speed, throws.gravity), spin


@wp.func
def flies_on(throws: Throws, position: wp.vec3, velocity: wp.vec3):
    """Return whether a ball moves outwards beyond the catching radius."""
    out = position - wp.vec3(throws.place[0], throws.place[1], 0.0)
    out[2] = 0.0
    distance = wp.length(out)
    return distance > throws.reach and wp.dot(velocity, out) > OUTWARDS * distance


@wp.func
def rest_ball(throws: Throws, e: int, ball: int, first: Props):
    """Put a ball at its waiting place, at rest."""
    first.position[e, ball] = throws.rest[ball]
    first.velocity[e, ball] = wp.vec3(0.0)
    first.spin[e, ball] = wp.vec3(0.0)


@wp.func
def throw_or_catch(
    throws: Throws, due: bool, random: wp.uint32, e: int, ball: int, bones: Bones, props: Props, first: Props
):
    """Place a ball anew, thrown if it is due and caught if it flies on; return whether it is placed.

    Writes its motion into ``first``.
    """
    if due:
        at, way, turning = draw_throw(throws, random, e, bones.position)
        first.position[e, ball] = at
        first.velocity[e, ball] = way
        first.spin[e, ball] = turning
        return True
    if flies_on(throws, props.position[e, ball], props.velocity[e, ball]):
        rest_ball(throws, e, ball, first)
        return True
    return False


@wp.kernel
def draw_balls(
    episodes: Episodes,
    throws: Throws,
    # out
    first: Props,
):
    """Draw the mass of every ball and put it at its waiting place."""
    e, ball = wp.tid()
    if not episodes.mask[e]:
        return
    random = random_of(episodes, e, STREAM_BALL, MASSES + ball)
    mass = wp.randf(random, throws.mass[0], throws.mass[1])
    if throws.log_mass != 0:
        share = (mass - throws.mass[0]) / wp.max(throws.mass[1] - throws.mass[0], 1.0e-9)
        mass = throws.mass[0] * wp.pow(throws.mass[1] / throws.mass[0], share)
    first.density[e, ball] = mass / throws.volume
    rest_ball(throws, e, ball, first)


def record_balls(env: EpisodeArrays, graph: LaunchGraph, throws: Throws) -> None:
    """Append, at a reset: draw the mass of every ball and put it at its waiting place."""
    graph.launch(draw_balls, (env.num_envs, throws.num_balls), [env.episodes, throws], [env.first_props])
