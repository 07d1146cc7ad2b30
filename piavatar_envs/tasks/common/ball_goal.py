"""Sending a ball through a gate: the gate's draw, the ball's promise, and the base of tasks with a gate."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Protocol

import warp as wp
from pydantic import Field

from piavatar_envs.avatar.body.skeleton import joint_index
from piavatar_envs.config import EnvConfig, PropConfig, SceneConfig, replace
from piavatar_envs.config.schema import Place
from piavatar_envs.core.rng import STREAM_TASK
from piavatar_envs.core.structs import fill
from piavatar_envs.envs.episodes import Bones, Episodes, Outcome, Props, random_of, write_in_root
from piavatar_envs.envs.framing import Sphere
from piavatar_envs.envs.observations import ObservationTerm
from piavatar_envs.envs.parameters import Drawn, component
from piavatar_envs.envs.task import Metric, Task, TaskArray, Term
from piavatar_envs.mpm.types import Sensors
from piavatar_envs.sim.markers import WIRE, Markers, MarkerSpec, turn_to
from piavatar_envs.sim.randomize import Parameter
from piavatar_envs.sim.scene import Domain
from piavatar_envs.tasks.common.ranges import DistanceRange, MassRange, Weight, check_ranges
from piavatar_envs.tasks.common.rewards import CONTROL, mean_square_action, tolerance
from piavatar_envs.tasks.common.spawn import record_standing

wp.set_module_options({"enable_backward": False})

BALL = "ball"
#: Friction of the ball on the ground; a rough soft ball loses much of its speed to rolling.
BALL_FRICTION = 0.2
#: Room behind a gate and above a ball; to the side of and above the ground below a body whose root and arms do not act
#: [m].
BEHIND, ASIDE, ABOVE = 0.3, 1.25, 2.3
#: Greatest sums of an episode's rewards: for coming near the ball, for the promise of its flight, for the goal.
APPROACH, AIM, GOAL = wp.constant(0.1), wp.constant(0.4), wp.constant(0.5)
#: Time for which a flight is followed [s]: a ball that arrives later promises less.
HORIZON = wp.constant(1.0)
#: Distance between striking bone and ball's surface at which the approach counts a tenth [m].
APPROACH_MARGIN = wp.constant(0.4)
_LEFT_FOOT, _RIGHT_FOOT = wp.constant(joint_index("left_foot")), wp.constant(joint_index("right_foot"))


class BallConfig(Protocol):
    """Settings of a ball."""

    ball_radius: float
    ball_mass: tuple[float, float]


def ball_config(config: BallConfig, position: Sequence[float], top_speed: float = 0.0) -> PropConfig:
    """Return the ball for the scene, of middling mass; episodes draw its mass, and bound its speed by ``top_speed``."""
    mass = math.sqrt(math.prod(config.ball_mass))
    size, position = (config.ball_radius,), tuple(position)
    return PropConfig(name=BALL, size=size, mass=mass, position=position, top_speed=top_speed, friction=BALL_FRICTION)


@wp.struct
class Ball:
    """Constants of the ball's first place and its mass."""

    prop: int
    place: wp.vec3  # middle of its places [m]
    jitter: float  # along x and y [m]
    light: float  # natural logarithm of the least density in kg/m^3
    heavy: float  # and of the greatest


@wp.struct
class Gate:
    """Constants of a gate."""

    target_radius: float  # of the opening [m]
    target_height: float  # of its centre [m]
    target_angle: float  # greatest angle from straight ahead, which is -y [rad]
    near: float  # horizontal distance from the ball's start, at least [m]
    far: float  # and at most [m]
    ball_radius: float  # [m]
    ball_volume: float  # [m^3]
    gravity: float  # downward [m/s^2]
    control_cost: float


#: The gate of every environment and the record of its ball, as in :class:`Course`.
COURSE_ARRAYS = (
    TaskArray("center", wp.vec3),
    TaskArray("forward", wp.vec3),
    TaskArray("length"),
    TaskArray("last", wp.vec3),
    TaskArray("best", wp.vec2),
)


@wp.struct
class Course:
    """Arrays of the gate and of the ball's record, over ``(num_envs,)``."""

    center: wp.array(dtype=wp.vec3)  # of the gate [m]
    forward: wp.array(dtype=wp.vec3)  # unit normal of its plane, along which the ball must pass
    length: wp.array(dtype=float)  # from the ball's start, along the ground [m]
    last: wp.array(dtype=wp.vec3)  # place of the ball a control step ago [m]
    best: wp.array(dtype=wp.vec2)  # best approach and best promise of the episode; negative: not yet known


@wp.func
def turn_and_weigh(random: wp.uint32, e: int, ball: Ball, first: Props):
    """Draw a ball's rotation, and its mass, uniform in its logarithm; no draw of its kernel may follow."""
    axis = wp.sample_unit_sphere_surface(random)
    first.rotation[e, ball.prop] = wp.quat_from_axis_angle(axis, wp.randf(random, 0.0, 3.0))
    first.density[e, ball.prop] = wp.exp(wp.randf(random, ball.light, ball.heavy))


@wp.kernel
def draw_gate(
    gate: Gate,
    episodes: Episodes,
    start: wp.array(dtype=wp.vec3),
    # out
    course: Course,
):
    """Draw a gate in front of the ball's start and clear the record, in the masked environments."""
    e = wp.tid()
    if not episodes.mask[e]:
        return
    random = random_of(episodes, e, STREAM_TASK, 0)
    distance = wp.randf(random, gate.near, gate.far)
    angle = wp.randf(random, -gate.target_angle, gate.target_angle)
    forward = wp.vec3(wp.sin(angle), -wp.cos(angle), 0.0)
    center = start[e] + distance * forward
    center[2] = gate.target_height
    course.center[e] = center
    course.forward[e] = forward
    course.length[e] = distance
    course.last[e] = start[e]
    course.best[e] = wp.vec2(-1.0, -1.0)


@wp.func
def passes(center: wp.vec3, forward: wp.vec3, radius: float, before: wp.vec3, after: wp.vec3):
    """Return whether the way from ``before`` to ``after`` leads through the disc, in the direction of ``forward``."""
    behind = wp.dot(before - center, forward)
    beyond = wp.dot(after - center, forward)
    if behind >= 0.0 or beyond < 0.0:
        return False
    crossing = before + (behind / (behind - beyond)) * (after - before)
    return wp.length(crossing - center) <= radius


@wp.func
def closest_pass(center: wp.vec3, x: wp.vec3, v: wp.vec3, gravity: float, lowest: float):
    """Return the distance [m] of a ball's flight from ``center`` where, seen from above, it is nearest.

    The flight is followed for :data:`HORIZON`, without drag: a parabola that ends on the ground, where the ball rolls
    at the height ``lowest`` [m].
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
    outcome: Outcome,
):
    """Reward improvements on the best of the episode; a ball in the gate ends it.

    ``gap`` is the distance from the striking bone to the ball's surface [m].
    """
    e = wp.tid()
    center = course.center[e]
    best = course.best[e]
    approach = tolerance(gap[e], 0.0, APPROACH_MARGIN)
    # half the opening is near enough
    spare = 0.5 * gate.target_radius
    miss = closest_pass(center, position[e], velocity[e], gate.gravity, gate.ball_radius)
    promise = 1.0 - wp.clamp((miss - spare) / wp.max(course.length[e] - spare, 1.0e-3), 0.0, 1.0)
    known = best[0] >= 0.0
    outcome.terms[e, 0, GateTask.rewards.approach] = wp.where(known, APPROACH * wp.max(approach - best[0], 0.0), 0.0)
    outcome.terms[e, 0, GateTask.rewards.aim] = wp.where(known, AIM * wp.max(promise - best[1], 0.0), 0.0)
    course.best[e] = wp.vec2(wp.max(approach, best[0]), wp.max(promise, best[1]))
    outcome.terms[e, 0, GateTask.rewards.goal] = 0.0
    if passes(center, course.forward[e], gate.target_radius, course.last[e], position[e]):
        if not outcome.success[e, 0]:
            outcome.terms[e, 0, GateTask.rewards.goal] = GOAL
        outcome.success[e, 0] = True
        outcome.terminated[e, 0] = True
    outcome.terms[e, 0, GateTask.rewards.control] = -gate.control_cost * mean_square_action(action, e, 0)
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
    outcome: Outcome,
):
    """Write ``GateTask.metrics``; ``pair`` is the sensor of the ball on the avatar."""
    e = wp.tid()
    outcome.metrics[e, 0, GateTask.metrics.ball_speed] = wp.length(velocity[e])
    outcome.metrics[e, 0, GateTask.metrics.distance_to_target] = wp.length(course.center[e] - position[e])
    outcome.metrics[e, 0, GateTask.metrics.ball_mass] = density[e] * gate.ball_volume
    outcome.metrics[e, 0, GateTask.metrics.contact_impulse] = wp.length(sensors.pair_impulse[e, pair])


@wp.kernel
def observe_gate(
    gate: Gate,
    course: Course,
    bones: Bones,
    ball: wp.array(dtype=wp.vec3),
    density: wp.array(dtype=float),
    agent: int,
    start: int,
    # out
    observation: wp.array3d(dtype=float),
):
    """Write :data:`GATE_TERMS` from component ``start``."""
    e = wp.tid()
    write_in_root(observation, e, agent, start, bones, course.center[e] - bones.position[e, 0])
    write_in_root(observation, e, agent, start + 3, bones, course.center[e] - ball[e])
    # a tenth and ten times the mass differ by as much, as the effects of a kick do
    observation[e, agent, start + 6] = wp.log10(density[e] * gate.ball_volume)
    observation[e, agent, start + 7] = wp.max(course.best[e][0], 0.0)
    observation[e, agent, start + 8] = wp.max(course.best[e][1], 0.0)


@wp.kernel
def observe_feet(
    bones: Bones,
    ball: wp.array(dtype=wp.vec3),
    agent: int,
    start: int,
    # out
    observation: wp.array3d(dtype=float),
):
    """Write the terms :data:`FEET_TERMS` from component ``start``."""
    e = wp.tid()
    write_in_root(observation, e, agent, start, bones, ball[e] - bones.position[e, _LEFT_FOOT])
    write_in_root(observation, e, agent, start + 3, bones, ball[e] - bones.position[e, _RIGHT_FOOT])


#: Observed by agents that kick.
FEET_TERMS = (
    ObservationTerm("ball_from_left_foot", 3, "m", "root", "the ball from the ball of the left foot"),
    ObservationTerm("ball_from_right_foot", 3, "m", "root", "the ball from the ball of the right foot"),
)
#: Observed by tasks with a gate, before their own terms.
GATE_TERMS = (
    ObservationTerm("target_position", 3, "m", "root", "centre of the gate from the pelvis"),
    ObservationTerm("target_from_ball", 3, "m", "root", "centre of the gate from the ball"),
    ObservationTerm("ball_mass", 1, "-", "-", "decimal logarithm of the ball's mass in kg"),
    ObservationTerm("progress", 2, "-", "-", "best approach and best promise of the episode, each 0 to 1"),
)
_OWN_TERMS = sum(term.size for term in GATE_TERMS)


class GateConfig(EnvConfig):
    """Settings of all tasks with a gate; a task gives those that have no default."""

    joints: tuple[str, ...] | None = Field(None, description="joints that act; null for all 21")
    ball_radius: float = Field(0.11, ge=0.06, le=0.3, description="radius of the ball [m]")
    ball_mass: MassRange
    ball_place: tuple[Place, Place]
    ball_jitter: float = Field(0.05, ge=0.0, le=0.2, description="greatest offset from there along x and y [m]")
    target_distance: DistanceRange
    target_angle: float
    target_height: float
    target_radius: float
    control_cost: Weight = Field(0.002, description="weight of the mean squared action [-]")
    pose_noise: float = Field(0.05, ge=0.0, le=0.5, description="greatest joint angle of the first pose [rad]")


@wp.kernel
def place_gate(
    course: Course,
    # out
    markers: Markers,
):
    """Place the marker of the gate."""
    e = wp.tid()
    markers.position[e, 0] = course.center[e]
    markers.rotation[e, 0] = turn_to(course.forward[e])


class GateTask(Task):
    """Base of tasks that send a ball through a gate.

    Attributes:
        index: of the ball among the props.
        gate, ball: constants.
        course: arrays of the gate and of the ball's record.
    """

    rewards = (
        Term(
            "approach",
            "0.1 times the gain of the approach on the best of the episode: 1 in touch with the ball, falling as a "
            "Gaussian to 0.1 at 0.4 m",
        ),
        Term(
            "aim",
            "0.4 times the gain of the ball's promise on the best of the episode: 1 if it will pass the gate's centre "
            "within half of `target_radius` in the next second, falling to 0 at the distance it started from; drag and "
            "bounces are not foreseen",
        ),
        Term("goal", "0.5 in the step in which the ball passes the gate"),
        CONTROL,
    )
    metrics = (
        Metric("ball_speed", "m/s", "speed of the ball"),
        Metric("distance_to_target", "m", "from the ball to the centre of the gate"),
        Metric("ball_mass", "kg", "mass of the ball"),
        Metric("contact_impulse", "N s", "size of the impulse between ball and body in this step"),
    )
    state_arrays = COURSE_ARRAYS
    scratch_arrays = (TaskArray("gap"),)  # from the striking bone to the ball's surface [m]
    camera_follows = False
    success_doc = "the ball's centre has passed the gate within `target_radius` of its centre, away from its start"
    termination_doc = "the ball has passed the gate"

    config: GateConfig

    def __init__(self, config: GateConfig) -> None:
        check_ranges(config, "target_distance", "ball_mass")
        super().__init__(config)

    @property
    def heights(self) -> tuple[float, ...]:
        """Least and greatest height at which the ball begins, or the only one [m]."""
        raise NotImplementedError

    def ball_scene(self, top_speed: float = 0.0) -> SceneConfig:
        """Return the scene with the ball at its greatest height, of at most ``top_speed`` [m/s]."""
        scene, config = super().build_scene(), self.config
        return replace(
            scene, props=[ball_config(config, (*config.ball_place, self.heights[-1]), top_speed), *scene.props]
        )

    def build_scene(self) -> SceneConfig:
        return self.ball_scene()

    def ball_places(self, drift: float = 0.0) -> Mapping[str, Sequence[Sequence[float]]]:
        """Return corners of the ball's first places, for :meth:`prop_places`, ``drift`` beyond its jitter [m]."""
        (x, y), aside = self.config.ball_place, self.config.ball_jitter + drift
        return {BALL: [(x + i * aside, y + j * aside, z) for i in (-1, 1) for j in (-1, 1) for z in self.heights]}

    def prop_places(self) -> Mapping[str, Sequence[Sequence[float]]]:
        return self.ball_places()

    def drawn(self) -> tuple[Parameter, ...]:
        config, side = self.config, math.sin(self.config.target_angle)
        return (
            Parameter("ball_mass", "kg", *config.ball_mass, "mass of the ball", log=True),
            Parameter("target_distance", "m", *config.target_distance, "of the gate from the ball's start"),
            Parameter("target_side", "-", -side, side, "sine of the gate's angle: x of the way to it, a unit vector"),
        )

    def drawn_values(self, env) -> tuple[Drawn, ...]:
        density = self.ball_column(env, "density")
        return Drawn(density, self.gate.ball_volume), Drawn(self.length), Drawn(component(self.forward, 0))

    def shown(self) -> list[Sphere]:
        """Return avatar, ball, and the gate at its places."""
        config, (x, y), spread = self.config, self.config.ball_place, self.config.target_angle
        gates = [
            (x + way * math.sin(angle), y - way * math.cos(angle), config.target_height, config.target_radius)
            for way in config.target_distance
            for angle in (-spread, 0.0, spread)
        ]
        return super().shown() + gates

    def domain(self) -> Domain:
        """Include the ball's first places and the ways through any gate, and no more, because memory grows with it.

        Arms that do not act and a root that stays need less room than a body that moves freely.
        """
        config, (x, y) = self.config, self.config.ball_place
        way = config.target_distance[1] + config.ball_jitter + BEHIND
        aside = abs(x) + config.ball_jitter + config.target_distance[1] * math.sin(config.target_angle) + BEHIND
        body = Domain().around([avatar.position for avatar in self.scene.avatars])
        if config.joints is not None:
            at = self.scene.avatars[0].position
            body = Domain((at[0] - ASIDE, at[1] - ASIDE, body.lower[2]), (at[0] + ASIDE, at[1] + ASIDE, ABOVE))
        return body.including((-aside, y - way, 0.0), (aside, 0.0, self.heights[-1] + BEHIND))

    def allocate(self, env, height: float | None = None) -> None:
        """Create the constants; ``height`` is that of the middle of the ball's places [m], by default the greatest."""
        config, props = self.config, env.simulation.props
        self.index = props.index(BALL)
        volume = float(props.points[self.index].volume.sum())
        near, far = config.target_distance
        self.gate = fill(Gate(), config, config.physics, near=near, far=far, ball_volume=volume)
        light, heavy = (math.log(mass / volume) for mass in config.ball_mass)
        place = wp.vec3(*config.ball_place, self.heights[-1] if height is None else height)
        self.ball = fill(Ball(), prop=self.index, jitter=config.ball_jitter, place=place, light=light, heavy=heavy)
        self.course = fill(Course(), self)

    def ball_column(self, env, name: str) -> wp.array:
        """Return the ball's column of the tracked props' array ``name``."""
        return getattr(env.props, name)[:, self.index]

    def record_ball(self, env, graph) -> None:
        """Append, at a reset: draw the ball's place, velocity and mass into ``env.first_props``."""
        raise NotImplementedError

    def record_gap(self, env, graph) -> None:
        """Append: write :attr:`gap`."""
        raise NotImplementedError

    def record_reset(self, env, graph) -> None:
        record_standing(env, graph, self.config.pose_noise)
        self.record_ball(env, graph)
        start = env.first_props.position[:, self.index]
        graph.launch(draw_gate, env.num_envs, [self.gate, env.episodes, start], [self.course])

    def record_outcome(self, env, graph) -> None:
        self.record_gap(env, graph)
        sim, ball = env.simulation, [self.ball_column(env, "position"), self.ball_column(env, "velocity")]
        outputs = [self.course, env.outcome]
        graph.launch(judge_ball, env.num_envs, [self.gate, *ball, self.gap, env.action], outputs)
        pair = sim.subjects.names.index(BALL)  # of the first subject, the avatar, with the ball
        inputs = [self.gate, self.course, *ball, self.ball_column(env, "density"), sim.sensors, pair]
        graph.launch(measure_ball, env.num_envs, inputs, [env.outcome])

    def record_gate_terms(self, env, graph, agent: int, start: int) -> int:
        """Append: write :data:`GATE_TERMS` from component ``start``; return the component after them."""
        ball = [self.ball_column(env, "position"), self.ball_column(env, "density")]
        inputs = [self.gate, self.course, env.bones[agent], *ball, agent, start]
        graph.launch(observe_gate, env.num_envs, inputs, [env.observation])
        return start + _OWN_TERMS

    def marker_specs(self) -> tuple[MarkerSpec, ...]:
        """Return the gate as a ring; pictures show the part above the ground."""
        return (MarkerSpec("ring", (self.config.target_radius, WIRE)),)

    def record_markers(self, env, graph, markers) -> None:
        graph.launch(place_gate, env.num_envs, [self.course], [markers])
