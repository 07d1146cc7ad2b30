"""A ball and the gate that it shall pass: how they are drawn, whether it went through, what its flight promises.

Sending a ball through a gate: settings, documentation and launches that such tasks share.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Protocol

import warp as wp

from piavatar_envs.config import PropConfig, SceneConfig
from piavatar_envs.core.rng import STREAM_TASK, generator
from piavatar_envs.envs.observations import ObservationTerm, write_vector
from piavatar_envs.envs.parameters import Drawn, component
from piavatar_envs.mpm.types import Sensors
from piavatar_envs.sim.randomize import Parameter
from piavatar_envs.sim.scene import Domain
from piavatar_envs.tasks.common.rewards import mean_square_action, tolerance

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


if TYPE_CHECKING:
    from piavatar_envs.core.launch_graph import LaunchGraph
    from piavatar_envs.envs.batch_env import BatchEnv
    from piavatar_envs.render.scene import Ring

BALL = "ball"
#: Of the ball on the ground; a rough soft ball loses much of its speed to rolling.
BALL_FRICTION = 0.2
#: Room behind a gate and above a ball; aside of and above the ground below a body whose root and arms do not act [m].
BEHIND, ASIDE, ABOVE = 0.3, 1.25, 2.3

REWARD_DOCS: Mapping[str, str] = {
    "approach": "0.1 times what the approach has gained on the best of the episode: 1 in touch with the ball, falling "
    "as a Gaussian to 0.1 at 0.4 m",
    "aim": "0.4 times what the ball's promise has gained on the best of the episode: 1 if it will pass the gate's "
    "centre within half of `target_radius` in the next second, falling to 0 at the distance it started from; drag and "
    "bounces are not foreseen",
    "goal": "0.5 in the step in which the ball passes the gate",
    "control": "`-control_cost` times the mean of the squared action components",
}
METRIC_DOCS: Mapping[str, str] = {
    "ball_speed": "speed of the ball [m/s]",
    "distance_to_target": "from the ball to the centre of the gate [m]",
    "ball_mass": "mass of the ball [kg]",
    "contact_impulse": "size of the impulse between ball and body in this step [N s]",
}
SUCCESS_DOC = "the ball's centre has passed the gate within `target_radius` of its centre, away from where it started"
TERMINATION_DOC = "the ball has passed the gate"


class BallConfig(Protocol):
    """Settings of a ball."""

    ball_radius: float
    ball_mass: tuple[float, float]


class GateConfig(BallConfig, Protocol):
    """Settings that tasks with a gate have in common."""

    joints: tuple[str, ...] | None
    ball_place: tuple[float, float]
    ball_jitter: float
    target_distance: tuple[float, float]
    target_angle: float
    target_height: float
    target_radius: float
    control_cost: float


def ball_config(config: BallConfig, position: Sequence[float], top_speed: float = 0.0) -> PropConfig:
    """The ball in the scene, of middling mass; episodes weigh it anew, and make any part of it so fast [m/s]."""
    mass = math.sqrt(math.prod(config.ball_mass))
    return PropConfig(
        name=BALL,
        size=(config.ball_radius,),
        mass=mass,
        position=tuple(position),
        top_speed=top_speed,
        friction=BALL_FRICTION,
    )


def gate_domain(config: GateConfig, scene: SceneConfig, top: float) -> Domain:
    """Room for balls to start at the height ``top`` [m] and to pass any gate, no larger than it must be.

    Memory goes with the volume. Arms that do not act and a root that stays need less than a body that moves freely.
    """
    x, y = config.ball_place
    way = config.target_distance[1] + config.ball_jitter + BEHIND
    aside = abs(x) + config.ball_jitter + config.target_distance[1] * math.sin(config.target_angle) + BEHIND
    body = Domain().around([avatar.position for avatar in scene.avatars])
    if config.joints is not None:
        at = scene.avatars[0].position
        body = Domain((at[0] - ASIDE, at[1] - ASIDE, body.lower[2]), (at[0] + ASIDE, at[1] + ASIDE, ABOVE))
    return body.including((-aside, y - way, 0.0), (aside, 0.0, top + BEHIND))


def ball_places(config: GateConfig, *heights: float, drift: float = 0.0) -> Mapping[str, Sequence[Sequence[float]]]:
    """Corners of where the ball may begin, for :meth:`Task.prop_places`.

    Args:
        config: the task's settings.
        heights: the least and the greatest, or all there is [m].
        drift: how much farther aside than its jitter it may begin [m].
    """
    (x, y), aside = config.ball_place, config.ball_jitter + drift
    return {BALL: [(x + i * aside, y + j * aside, z) for i in (-1, 1) for j in (-1, 1) for z in heights]}


def drawn_goal(config: GateConfig) -> tuple[Parameter, ...]:
    """What episodes draw of ball and gate."""
    side = math.sin(config.target_angle)
    return (
        Parameter("ball_mass", "kg", *config.ball_mass, "mass of the ball", log=True),
        Parameter("target_distance", "m", *config.target_distance, "of the gate from where the ball started"),
        Parameter("target_side", "-", -side, side, "x of the way to the gate, a unit vector: the sine of its angle"),
    )


class Goal:
    """Ball and gate of every environment, and what tasks record about them.

    Attributes:
        index: of the ball among the props.
        gate: constants.
        course: the gates and what the balls have done.
        ball: constants of how it is drawn, by the task.
        gap: from the striking bone to the ball's surface [m], written by the task.
    """

    def __init__(self, env: BatchEnv, config: GateConfig, height: float) -> None:
        """Allocate.

        Args:
            env: the batch.
            config: its task's settings.
            height: of the middle of the ball's places [m].
        """
        n, device, simulation = env.num_envs, env.device, env.simulation
        self.env = env
        self.index = simulation.props.index(BALL)
        gate, course, ball = Gate(), Course(), Ball()
        gate.radius, gate.height, gate.spread = config.target_radius, config.target_height, config.target_angle
        gate.near, gate.far = config.target_distance
        gate.ball_radius, gate.control_cost = config.ball_radius, config.control_cost
        gate.gravity = env.config.physics.gravity
        gate.ball_volume = float(simulation.props.points[self.index].volume.sum())
        for name, dtype in (("center", wp.vec3), ("forward", wp.vec3), ("length", float), ("last", wp.vec3)):
            setattr(course, name, wp.zeros(n, dtype=dtype, device=device))
        course.best = wp.zeros(n, dtype=wp.vec2, device=device)
        ball.prop, ball.jitter, ball.place = self.index, config.ball_jitter, wp.vec3(*config.ball_place, height)
        ball.light, ball.heavy = (math.log(mass / gate.ball_volume) for mass in config.ball_mass)
        self.gate, self.course, self.ball = gate, course, ball
        self.gap = wp.zeros(n, dtype=float, device=device)

    def column(self, name: str) -> wp.array:
        """The ball's column of the tracked props' array ``name``."""
        return getattr(self.env.simulation.props.state, name)[:, self.index]

    def arrays(self) -> dict[str, wp.array]:
        """Arrays of a checkpoint."""
        return {name: getattr(self.course, name) for name in ("center", "forward", "length", "last", "best")}

    def drawn_values(self) -> tuple[Drawn, ...]:
        """Where the parameters of :func:`drawn_goal` are."""
        density = self.env.simulation.props.density[:, self.index]
        side = component(self.course.forward, 0)
        return Drawn(density, self.gate.ball_volume), Drawn(self.course.length), Drawn(side)

    def record_reset(self, graph: LaunchGraph) -> None:
        """Append: gates before the balls that ``props.spawn`` has in the masked environments."""
        env = self.env
        start = env.simulation.props.spawn.position[:, self.index]
        graph.launch(draw_gate, env.num_envs, [env.mask, env.seed, env.episode, self.gate, start], [self.course])

    def record_outcome(self, graph: LaunchGraph) -> None:
        """Append: reward, metrics, success and termination."""
        env, simulation = self.env, self.env.simulation
        position, velocity = self.column("position"), self.column("velocity")
        graph.launch(
            judge_ball,
            env.num_envs,
            [self.gate, position, velocity, self.gap, env.action],
            [self.course, env.terms, env.success, env.terminated],
        )
        pair = simulation.subjects.names.index(BALL)  # of the first subject, the avatar, with the ball
        density = simulation.props.density[:, self.index]
        graph.launch(
            measure_ball,
            env.num_envs,
            [self.gate, self.course, position, velocity, density, simulation.sensors, pair],
            [env.metrics],
        )

    def record_observe(self, graph: LaunchGraph, agent: int, start: int) -> None:
        """Append: the terms :data:`GATE_TERMS`."""
        env, simulation = self.env, self.env.simulation
        tracked = simulation.avatars[agent].tracked
        density = simulation.props.density[:, self.index]
        graph.launch(
            observe_gate,
            env.num_envs,
            [
                self.gate, self.course, agent, start, tracked.rotation, tracked.position, self.column("position"),
                density,
            ],
            [env.observation],
        )  # fmt: skip

    def markers(self, index: int) -> list[Ring]:
        """The gate of environment ``index`` as a ring, the part of it that is above the ground."""
        from piavatar_envs.render.scene import Ring

        center, forward = (getattr(self.course, name).numpy()[index].copy() for name in ("center", "forward"))
        return [Ring(center, forward, self.gate.radius)]
