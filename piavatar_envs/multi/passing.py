"""Kernels of PassBall: how the ball is served, whose turn it is, what is a pass."""

from __future__ import annotations

import warp as wp

from piavatar_envs.envs.draws import STREAM_BALL, generator
from piavatar_envs.envs.observations import write_vector
from piavatar_envs.mpm.types import Sensors
from piavatar_envs.tasks.leash import held_back
from piavatar_envs.tasks.rewards import mean_square_action

wp.set_module_options({"enable_backward": False})

#: Impulse of ball and body in a control step above which they have touched [N s].
TOUCH = wp.constant(1.0e-3)


@wp.struct
class Serve:
    """Constants of how the ball comes into play, from the middle of the circle."""

    prop: int
    radius: float  # of the ball [m]
    slow: float  # least speed [m/s]
    fast: float  # greatest speed [m/s]
    spread: float  # greatest angle off the way to the first passer [rad]
    light: float  # natural logarithm of the least density in kg/m^3
    heavy: float  # and of the greatest


@wp.struct
class PassRule:
    """Constants of the game."""

    subject: int  # the ball among the subjects of the world
    ball_volume: float  # [m^3]
    reach: float  # distance from a pelvis at which the ball has arrived [m]
    sent: float  # how far it must have come from where the passer touched it last [m]
    fetch: float  # and at which a slow ball can still be fetched [m]
    rim: float  # distance from the origin at which the ball is out [m]
    dead_speed: float  # [m/s]
    goal_passes: int
    progress_weight: float
    pass_bonus: float
    control_cost: float


@wp.struct
class Play:
    """How the game stands in every environment; all of it belongs into a checkpoint."""

    passer: wp.array(dtype=int)  # (num_envs,) whose turn it is
    touched: wp.array(dtype=int)  # (num_envs,) whether they have touched the ball in this turn
    passes: wp.array(dtype=int)  # (num_envs,) completed
    left: wp.array(dtype=wp.vec3)  # (num_envs,) where the ball was when they touched it last [m], if they have
    gap: wp.array(dtype=float)  # (num_envs,) from the ball to where it shall go [m]; negative: not yet known
    contact: wp.array2d(dtype=int)  # (num_envs, num_agents) whether one touched the ball in the last step
    touches: wp.array2d(dtype=int)  # (num_envs, num_agents) so far


@wp.kernel
def serve_ball(
    mask: wp.array(dtype=wp.bool),
    seed: wp.array(dtype=int),
    episode: wp.array(dtype=int),
    serve: Serve,
    places: wp.array(dtype=wp.vec3),
    # out
    position: wp.array2d(dtype=wp.vec3),
    velocity: wp.array2d(dtype=wp.vec3),
    spin: wp.array2d(dtype=wp.vec3),
    density: wp.array2d(dtype=float),
    play: Play,
):
    """A ball that rolls from the middle of ``places`` towards one of them, in the masked environments."""
    e = wp.tid()
    if not mask[e]:
        return
    random = generator(seed[e], episode[e], STREAM_BALL, 0)
    agents = places.shape[0]
    first = wp.randi(random, 0, agents)
    speed = wp.randf(random, serve.slow, serve.fast)
    angle = wp.randf(random, -serve.spread, serve.spread)
    middle = wp.vec3()
    for agent in range(agents):
        middle += places[agent] / float(agents)
    up = wp.vec3(0.0, 0.0, 1.0)
    way = wp.quat_rotate(wp.quat_from_axis_angle(up, angle), wp.normalize(places[first] - middle))
    position[e, serve.prop] = middle + serve.radius * up
    velocity[e, serve.prop] = speed * way
    spin[e, serve.prop] = (speed / serve.radius) * wp.cross(up, way)
    density[e, serve.prop] = wp.exp(wp.randf(random, serve.light, serve.heavy))
    play.passer[e] = first
    play.touched[e] = 0
    play.passes[e] = 0
    play.left[e] = wp.vec3()
    play.gap[e] = -1.0
    for agent in range(agents):
        play.contact[e, agent] = 0
        play.touches[e, agent] = 0


@wp.kernel
def keep_near(
    place: wp.vec3,
    reach: float,
    command_root: wp.array(dtype=wp.vec3),
    # out
    reference_root: wp.array(dtype=wp.vec3),
):
    """The commanded root, no farther from its place than it may be before it acts."""
    e = wp.tid()
    reference_root[e] = held_back(command_root[e], place, reach)


@wp.func
def flat_distance(a: wp.vec3, b: wp.vec3):
    """Length of the horizontal part of ``a - b``."""
    return wp.length(wp.vec2(a[0] - b[0], a[1] - b[1]))


@wp.func
def goes_to(play: Play, e: int, agents: int):
    """Who shall have the ball next: the passer until they have touched it, then the one after them."""
    return (play.passer[e] + play.touched[e]) % agents


@wp.func
def way_come(play: Play, e: int, ball: wp.vec3):
    """How far the ball has come from where the passer touched it last [m]; 0 before they have."""
    return wp.where(play.touched[e] == 1, flat_distance(ball, play.left[e]), 0.0)


@wp.func
def update_touches(rule: PassRule, sensors: Sensors, e: int, play: Play):
    """Book who touches the ball; a touch counts when it begins."""
    for agent in range(play.contact.shape[1]):
        impulse = sensors.pair_impulse[e, agent * sensors.boundary_impulse.shape[1] + rule.subject]
        touching = wp.where(wp.length(impulse) > TOUCH, 1, 0)
        if touching == 1 and play.contact[e, agent] == 0:
            play.touches[e, agent] += 1
        play.contact[e, agent] = touching


@wp.kernel
def judge(
    rule: PassRule,
    ball: wp.array(dtype=wp.vec3),
    velocity: wp.array(dtype=wp.vec3),
    pelvis: wp.array2d(dtype=wp.vec3),
    sensors: Sensors,
    action: wp.array3d(dtype=float),
    # in and out
    play: Play,
    # out
    terms: wp.array3d(dtype=float),
    metrics: wp.array3d(dtype=float),
    success: wp.array2d(dtype=wp.bool),
    terminated: wp.array2d(dtype=wp.bool),
):
    """Follow the game: a step's progress, passes, and a ball that nobody can play any more."""
    e = wp.tid()
    agents = pelvis.shape[1]
    update_touches(rule, sensors, e, play)
    gap = flat_distance(ball[e], pelvis[e, goes_to(play, e, agents)])
    progress = wp.where(play.gap[e] < 0.0, 0.0, play.gap[e] - gap)
    passer = play.passer[e]
    receiver = (passer + 1) % agents
    if play.contact[e, passer] == 1:
        play.touched[e] = 1
        play.left[e] = ball[e]
    arrived = flat_distance(ball[e], pelvis[e, receiver]) <= rule.reach or play.contact[e, receiver] == 1
    # feet that meet around a ball, and tap or hold it, send it nowhere
    passed = play.touched[e] == 1 and arrived and way_come(play, e, ball[e]) >= rule.sent
    if passed:
        play.passes[e] += 1
        play.passer[e] = receiver
        play.touched[e] = play.contact[e, receiver]
        play.left[e] = ball[e]
    play.gap[e] = flat_distance(ball[e], pelvis[e, goes_to(play, e, agents)])
    nearest = float(1.0e6)
    for agent in range(agents):
        nearest = wp.min(nearest, flat_distance(ball[e], pelvis[e, agent]))
    slow = flat_distance(velocity[e], wp.vec3()) < rule.dead_speed
    over = (slow and nearest > rule.fetch) or flat_distance(ball[e], wp.vec3()) > rule.rim
    for agent in range(agents):
        terms[e, agent, 0] = rule.progress_weight * progress
        terms[e, agent, 1] = wp.where(passed, rule.pass_bonus, 0.0)
        terms[e, agent, 2] = -rule.control_cost * mean_square_action(action, e, agent)
        metrics[e, agent, 0] = float(play.passes[e])
        metrics[e, agent, 1] = float(play.touches[e, agent])
        metrics[e, agent, 2] = play.gap[e]
        metrics[e, agent, 3] = wp.length(velocity[e])
        success[e, agent] = play.passes[e] >= rule.goal_passes
        if over:
            terminated[e, agent] = True


@wp.kernel
def observe_game(
    rule: PassRule,
    agent: int,
    start: int,
    rotation: wp.array2d(dtype=wp.quat),
    pelvis: wp.array2d(dtype=wp.vec3),
    ball: wp.array(dtype=wp.vec3),
    density: wp.array(dtype=float),
    place: wp.vec3,
    play: Play,
    # out
    observation: wp.array3d(dtype=float),
):
    """How the game stands, from component ``start``; agents are counted on from oneself."""
    e = wp.tid()
    agents = pelvis.shape[1]
    to_root = wp.quat_inverse(rotation[e, 0])
    own = pelvis[e, agent]
    to = pelvis[e, goes_to(play, e, agents)]
    home = wp.vec3(place[0] - own[0], place[1] - own[1], 0.0)
    write_vector(observation, e, agent, start, wp.quat_rotate(to_root, to - own))
    write_vector(observation, e, agent, start + 3, wp.quat_rotate(to_root, to - ball[e]))
    write_vector(observation, e, agent, start + 6, wp.quat_rotate(to_root, home))
    # a tenth and ten times the mass differ as much: what a kick does to them does, too
    observation[e, agent, start + 9] = wp.log10(density[e] * rule.ball_volume)
    observation[e, agent, start + 10] = float(play.touched[e])
    observation[e, agent, start + 11] = way_come(play, e, ball[e])
    for n in range(agents):
        turn = play.passer[e] == (agent + n) % agents
        observation[e, agent, start + 12 + n] = wp.where(turn, 1.0, 0.0)
