"""A ball and the gate that it shall pass: how they are drawn, whether it went through, what its flight promises."""

from __future__ import annotations

import warp as wp

from piavatar_envs.envs.draws import STREAM_TASK, generator
from piavatar_envs.envs.observations import ObservationTerm, write_vector
from piavatar_envs.mpm.types import Sensors
from piavatar_envs.tasks.rewards import mean_square_action, tolerance

wp.set_module_options({"enable_backward": False})

#: What an episode can earn in all: by coming near the ball, by the promise of its flight, by the goal.
APPROACH, AIM, GOAL = wp.constant(0.1), wp.constant(0.4), wp.constant(0.5)
#: A flight is followed so far ahead [s]: what is slower than to arrive in this time promises less.
HORIZON = wp.constant(1.0)
#: Distance between striking bone and ball's surface at which the approach counts a tenth [m].
APPROACH_MARGIN = wp.constant(0.4)


@wp.struct
class Ball:
    """Constants of where the ball starts, and how heavy it is."""

    prop: int
    place: wp.vec3  # middle of its places [m]
    jitter: float  # along x and y [m]
    light: float  # natural logarithm of the least density in kg/m^3
    heavy: float  # and of the greatest


@wp.struct
class Gate:
    """Constants of a gate."""

    radius: float  # of the opening [m]
    height: float  # of its centre [m]
    near: float  # horizontal distance from the ball's start, at least [m]
    far: float  # and at most [m]
    spread: float  # greatest angle from straight ahead, which is -y [rad]
    ball_radius: float  # [m]
    ball_volume: float  # [m^3]
    gravity: float  # downward [m/s^2]
    control_cost: float


@wp.struct
class Course:
    """The gate of every environment and what the ball has done; all of it belongs into a checkpoint."""

    center: wp.array(dtype=wp.vec3)  # of the gate [m]
    forward: wp.array(dtype=wp.vec3)  # unit normal of its plane, along which the ball shall pass
    length: wp.array(dtype=float)  # from the ball's start, along the ground [m]
    last: wp.array(dtype=wp.vec3)  # where the ball was a control step ago [m]
    best: wp.array(dtype=wp.vec2)  # best approach and best promise of the episode; negative: not yet known


@wp.func
def turn_and_weigh(
    random: wp.uint32,
    e: int,
    ball: Ball,
    # out
    rotation: wp.array2d(dtype=wp.quat),
    density: wp.array2d(dtype=float),
):
    """Draw how a ball is turned, and its mass, uniform in its logarithm: the last that its kernel draws."""
    axis = wp.sample_unit_sphere_surface(random)
    rotation[e, ball.prop] = wp.quat_from_axis_angle(axis, wp.randf(random, 0.0, 3.0))
    density[e, ball.prop] = wp.exp(wp.randf(random, ball.light, ball.heavy))


@wp.kernel
def draw_gate(
    mask: wp.array(dtype=wp.bool),
    seed: wp.array(dtype=int),
    episode: wp.array(dtype=int),
    gate: Gate,
    start: wp.array(dtype=wp.vec3),
    # out
    course: Course,
):
    """A gate before the ball's start in the masked environments, and a clean record."""
    e = wp.tid()
    if not mask[e]:
        return
    random = generator(seed[e], episode[e], STREAM_TASK, 0)
    distance = wp.randf(random, gate.near, gate.far)
    angle = wp.randf(random, -gate.spread, gate.spread)
    forward = wp.vec3(wp.sin(angle), -wp.cos(angle), 0.0)
    center = start[e] + distance * forward
    center[2] = gate.height
    course.center[e] = center
    course.forward[e] = forward
    course.length[e] = distance
    course.last[e] = start[e]
    course.best[e] = wp.vec2(-1.0, -1.0)


@wp.func
def passes(center: wp.vec3, forward: wp.vec3, radius: float, before: wp.vec3, after: wp.vec3):
    """Whether the way from ``before`` to ``after`` leads through the disc, in the direction of ``forward``."""
    behind = wp.dot(before - center, forward)
    beyond = wp.dot(after - center, forward)
    if behind >= 0.0 or beyond < 0.0:
        return False
    crossing = before + (behind / (behind - beyond)) * (after - before)
    return wp.length(crossing - center) <= radius


@wp.func
def closest_pass(center: wp.vec3, x: wp.vec3, v: wp.vec3, gravity: float, lowest: float):
    """Distance of a ball's flight from ``center`` where it is nearest from above, within :data:`HORIZON` [m].

    A parabola that ends on the ground, where the ball rolls on at the height ``lowest`` [m]; without drag.
    """
    way = center - x
    flat = wp.vec3(v[0], v[1], 0.0)
    time = wp.clamp(wp.dot(way, flat) / wp.max(wp.length_sq(flat), 1.0e-6), 0.0, HORIZON)
    height = wp.max(x[2] + v[2] * time - 0.5 * gravity * time * time, wp.min(lowest, x[2]))
    miss = way - time * flat
    miss[2] = center[2] - height
    return wp.length(miss)


@wp.kernel
def judge_ball(
    gate: Gate,
    position: wp.array(dtype=wp.vec3),
    velocity: wp.array(dtype=wp.vec3),
    gap: wp.array(dtype=float),
    action: wp.array3d(dtype=float),
    # in and out
    course: Course,
    # out
    terms: wp.array3d(dtype=float),
    success: wp.array2d(dtype=wp.bool),
    terminated: wp.array2d(dtype=wp.bool),
):
    """Reward of what is better than ever before in the episode; the ball in the gate ends it.

    ``gap`` is the distance from the bone that shall strike to the ball's surface [m].
    """
    e = wp.tid()
    center = course.center[e]
    best = course.best[e]
    approach = tolerance(gap[e], 0.0, APPROACH_MARGIN)
    # half the opening is near enough
    spare = 0.5 * gate.radius
    miss = closest_pass(center, position[e], velocity[e], gate.gravity, gate.ball_radius)
    promise = 1.0 - wp.clamp((miss - spare) / wp.max(course.length[e] - spare, 1.0e-3), 0.0, 1.0)
    terms[e, 0, 0] = 0.0
    terms[e, 0, 1] = 0.0
    if best[0] >= 0.0:
        terms[e, 0, 0] = APPROACH * wp.max(approach - best[0], 0.0)
        terms[e, 0, 1] = AIM * wp.max(promise - best[1], 0.0)
    course.best[e] = wp.vec2(wp.max(approach, best[0]), wp.max(promise, best[1]))
    terms[e, 0, 2] = 0.0
    if passes(center, course.forward[e], gate.radius, course.last[e], position[e]):
        if not success[e, 0]:
            terms[e, 0, 2] = GOAL
        success[e, 0] = True
        terminated[e, 0] = True
    terms[e, 0, 3] = -gate.control_cost * mean_square_action(action, e, 0)
    course.last[e] = position[e]


@wp.kernel
def measure_ball(
    gate: Gate,
    course: Course,
    position: wp.array(dtype=wp.vec3),
    velocity: wp.array(dtype=wp.vec3),
    density: wp.array(dtype=float),
    sensors: Sensors,
    pair: int,
    # out
    metrics: wp.array3d(dtype=float),
):
    """The numbers :data:`METRICS`; ``pair`` is the sensor of the ball on the avatar."""
    e = wp.tid()
    metrics[e, 0, 0] = wp.length(velocity[e])
    metrics[e, 0, 1] = wp.length(course.center[e] - position[e])
    metrics[e, 0, 2] = density[e] * gate.ball_volume
    metrics[e, 0, 3] = wp.length(sensors.pair_impulse[e, pair])


@wp.kernel
def observe_gate(
    gate: Gate,
    course: Course,
    agent: int,
    start: int,
    rotation: wp.array2d(dtype=wp.quat),
    position: wp.array2d(dtype=wp.vec3),
    ball: wp.array(dtype=wp.vec3),
    density: wp.array(dtype=float),
    # out
    observation: wp.array3d(dtype=float),
):
    """The terms :data:`GATE_TERMS`, from component ``start``."""
    e = wp.tid()
    to_root = wp.quat_inverse(rotation[e, 0])
    write_vector(observation, e, agent, start, wp.quat_rotate(to_root, course.center[e] - position[e, 0]))
    write_vector(observation, e, agent, start + 3, wp.quat_rotate(to_root, course.center[e] - ball[e]))
    # a tenth and ten times the mass differ as much: what a kick does to them does, too
    observation[e, agent, start + 6] = wp.log10(density[e] * gate.ball_volume)
    observation[e, agent, start + 7] = wp.max(course.best[e][0], 0.0)
    observation[e, agent, start + 8] = wp.max(course.best[e][1], 0.0)


#: What tasks with a gate add to the observation, before what they add themselves.
GATE_TERMS: tuple[ObservationTerm, ...] = (
    ObservationTerm("target_position", 3, "m", "root", "centre of the gate from the pelvis"),
    ObservationTerm("target_from_ball", 3, "m", "root", "centre of the gate from the ball"),
    ObservationTerm("ball_mass", 1, "-", "-", "decimal logarithm of the ball's mass in kg"),
    ObservationTerm("progress", 2, "-", "-", "best approach and best promise of the episode, each 0 to 1"),
)
REWARD_TERMS = ("approach", "aim", "goal", "control")
METRICS = ("ball_speed", "distance_to_target", "ball_mass", "contact_impulse")
