"""Dodge: stand still in the rest pose, and avoid thrown balls."""

from __future__ import annotations

import math

import numpy as np
import warp as wp
from pydantic import Field

from piavatar_envs.avatar.body.skeleton import BODY_PARTS
from piavatar_envs.avatar.rotation import quat_exp, quat_log
from piavatar_envs.avatar.types import Body
from piavatar_envs.config import EnvConfig, PropConfig, SceneConfig, replace
from piavatar_envs.core.rng import STREAM_BALL
from piavatar_envs.core.structs import fill
from piavatar_envs.envs.actions import ActionSpec, speed_within
from piavatar_envs.envs.episodes import Bones, Episodes, Outcome, Props, random_of, write_in_root
from piavatar_envs.envs.observations import ObservationTerm
from piavatar_envs.envs.observer import clear_stress, observe_stress
from piavatar_envs.envs.parameters import Drawn
from piavatar_envs.envs.task import Metric, Task, TaskArray, Term
from piavatar_envs.mpm.types import Sensors
from piavatar_envs.sim.randomize import Parameter
from piavatar_envs.sim.scene import Domain
from piavatar_envs.tasks.common.ranges import DistanceRange, Margin, MassRange, SpeedRange, Weight, check_ranges
from piavatar_envs.tasks.common.rewards import CONTROL, mean_square_action, tolerance
from piavatar_envs.tasks.common.spawn import pelvis_at, record_standing
from piavatar_envs.tasks.common.thrown_balls import (
    MASSES,
    Throws,
    make_throws,
    record_balls,
    throw_or_catch,
    throwing_domain,
    thrown_speed,
    waiting_places,
)

wp.set_module_options({"enable_backward": False})

#: Speed of the root at action 1 [m/s].
ROOT_SPEED = 1.5
#: Index of the first throw's time in the stream of the balls, before their masses; the throws come after those.
_TIME = wp.constant(0)
#: Body parts whose stress counts, the first of ``BODY_PARTS``: all but the legs, whose soles the floor strains.
_ABOVE_LEGS = wp.constant(list(BODY_PARTS).index("left_leg"))


class DodgeConfig(EnvConfig):
    """Settings of Dodge."""

    num_balls: int = Field(2, ge=1, le=4, description="balls that are thrown in turn [-]")
    ball_radius: float = Field(0.1, ge=0.06, le=0.2, description="their radius [m]")
    ball_mass: MassRange = Field((0.3, 1.5), description="range that their masses are drawn from [kg]")
    throw_interval: float = Field(0.6, ge=0.1, le=3600.0, description="time between two throws [s]")
    throw_speed: SpeedRange = Field((4.0, 8.0), description="range of a throw's mean speed [m/s]")
    throw_distance: DistanceRange = Field((1.3, 1.5), description="range of the distance thrown from [m]")
    throw_angle: float = Field(
        1.0, ge=0.0, le=math.pi / 2, description="greatest angle of a throw's origin from the front [rad]"
    )
    aim_spread: float = Field(0.1, ge=0.0, le=1.0, description="greatest error of the aim along each axis [m]")
    root_range: float = Field(0.25, ge=0.0, le=0.5, description="how far the root may be steered from its place [m]")
    pose_margin: Margin = Field(0.3, description="mean joint angle at which the reward has fallen to 0.1 [rad]")
    place_margin: Margin = Field(0.3, description="distance from the place at which it has, likewise [m]")
    hit_impulse: float = Field(0.3, ge=0.0, le=1.0e4, description="impulse in one step that counts as a hit [N s]")
    impulse_scale: Margin = Field(5.0, description="impulse that costs 1 [N s]")
    stress_limit: Margin = Field(
        0.3, description="von Mises stress that costs nothing; twice that costs 1 [young_modulus]"
    )
    control_cost: Weight = Field(0.05, description="weight of the mean squared action [-]")
    pose_noise: float = Field(0.05, ge=0.0, le=0.5, description="greatest joint angle of the first pose [rad]")


@wp.struct
class Rule:
    """Constants of the place to keep, of its reward, and of hits and their costs."""

    place: wp.vec3  # x, y [m] and yaw [rad]
    range: float  # of the commanded root about the place [m]
    pose_margin: float  # [rad]
    place_margin: float  # [m]
    control_cost: float
    first_ball: int  # subject of the first ball; the avatar is subject 0
    hit_impulse: float  # [N s]
    impulse_scale: float  # [N s]
    stress_limit: float  # [young_modulus]


@wp.kernel
def keep_place(
    rule: Rule,
    body: Body,
    command_root: wp.array(dtype=wp.vec3),
    # out
    reference_root: wp.array(dtype=wp.vec3),
):
    """Clamp the commanded root to its range about the place."""
    e = wp.tid()
    center = pelvis_at(rule.place, body, e)
    out = command_root[e] - center
    out[2] = 0.0
    distance = wp.length(out)
    excess = wp.max(distance - rule.range, 0.0) / wp.max(distance, 1.0e-6)
    reference_root[e] = command_root[e] - excess * out


@wp.func
def first_throw(throws: Throws, episodes: Episodes, e: int):
    """Return the control step of an episode's first throw, in the first half of an interval."""
    random = random_of(episodes, e, STREAM_BALL, _TIME)
    return wp.randi(random, 1, throws.interval // 2 + 2)


@wp.func
def steps_to_throw(throws: Throws, first: int, step: int, ball: int):
    """Return the control steps from ``step`` to the next throw of a ball; 0 if it is thrown in this one."""
    period = throws.interval * throws.num_balls
    wait = (first + ball * throws.interval - step) % period
    return wp.where(wait < 0, wait + period, wait)


@wp.kernel
def throw_balls(
    throws: Throws,
    episodes: Episodes,
    bones: Bones,
    props: Props,
    # out
    placed: wp.array2d(dtype=wp.bool),
    first: Props,
):
    """Flag the balls that are placed before this step, over ``(E, num_balls)``.

    A ball whose time has come is thrown from the front at the present place of chest and head. A ball that has flown
    past is caught, and waits.
    """
    e, ball = wp.tid()
    placed[e, ball] = False
    if episodes.failure[e] != 0:
        return
    begin = first_throw(throws, episodes, e)
    due = steps_to_throw(throws, begin, episodes.step_count[e], ball) == 0
    number = (episodes.step_count[e] - begin) // throws.interval
    random = random_of(episodes, e, STREAM_BALL, MASSES + throws.num_balls + number)
    placed[e, ball] = throw_or_catch(throws, due, random, e, ball, bones, props, first)


@wp.kernel
def judge_pose(
    rule: Rule,
    bones: Bones,
    action: wp.array3d(dtype=float),
    # out
    outcome: Outcome,
):
    """Reward standing in the rest pose and in the place."""
    e = wp.tid()
    count = bones.local.shape[1]
    angle = wp.length(quat_log(wp.quat_inverse(quat_exp(wp.vec3(0.0, 0.0, rule.place[2]))) * bones.local[e, 0]))
    for b in range(1, count):
        angle += wp.length(quat_log(bones.local[e, b]))
    angle /= float(count)
    off = bones.position[e, 0] - pelvis_at(rule.place, bones.body, e)
    distance = wp.length(wp.vec2(off[0], off[1]))
    outcome.terms[e, 0, DodgeTask.rewards.pose] = 0.6 * tolerance(angle, 0.05, rule.pose_margin)
    outcome.terms[e, 0, DodgeTask.rewards.place] = 0.4 * tolerance(distance, 0.02, rule.place_margin)
    outcome.terms[e, 0, DodgeTask.rewards.control] = -rule.control_cost * mean_square_action(action, e, 0)
    outcome.metrics[e, 0, DodgeTask.metrics.rotation_error_deg] = wp.degrees(angle)
    outcome.metrics[e, 0, DodgeTask.metrics.root_error] = distance


@wp.kernel
def judge_hits(
    rule: Rule,
    throws: Throws,
    episodes: Episodes,
    sensors: Sensors,
    stress: wp.array3d(dtype=float),
    # in and out
    struck: wp.array2d(dtype=int),
    hits: wp.array(dtype=int),
    # out
    outcome: Outcome,
):
    """Count and cost hits, each ball once a throw. The step counter is still the one of the throw."""
    e = wp.tid()
    first = first_throw(throws, episodes, e)
    total = float(0.0)
    missed = bool(True)
    for ball in range(throws.num_balls):
        size = wp.length(sensors.pair_impulse[e, rule.first_ball + ball])
        total += size
        if steps_to_throw(throws, first, episodes.step_count[e], ball) == 0:
            struck[e, ball] = 0
        if struck[e, ball] == 0 and size > rule.hit_impulse:
            struck[e, ball] = 1
            hits[e] = hits[e] + 1
        missed = missed and struck[e, ball] == 0
    peak = float(0.0)
    for part in range(_ABOVE_LEGS):
        peak = wp.max(peak, stress[e, 0, part])
    outcome.cost_terms[e, 0, DodgeTask.costs.impulse] = total / rule.impulse_scale
    outcome.cost_terms[e, 0, DodgeTask.costs.stress] = wp.max(peak / rule.stress_limit - 1.0, 0.0)
    outcome.metrics[e, 0, DodgeTask.metrics.impulse] = total
    outcome.metrics[e, 0, DodgeTask.metrics.stress] = peak
    outcome.metrics[e, 0, DodgeTask.metrics.hits] = float(hits[e])
    outcome.success[e, 0] = missed


@wp.kernel
def observe_throws(
    throws: Throws,
    episodes: Episodes,
    props: Props,
    control_dt: float,
    agent: int,
    start: int,
    # out
    observation: wp.array3d(dtype=float),
):
    """Write the time to the next throw of every ball [s], then their masses [kg]; over ``(E, num_balls)``."""
    e, ball = wp.tid()
    first = first_throw(throws, episodes, e)
    steps = steps_to_throw(throws, first, episodes.step_count[e], ball)
    observation[e, agent, start + ball] = control_dt * float(steps)
    observation[e, agent, start + throws.num_balls + ball] = throws.volume * props.density[e, ball]


@wp.kernel
def observe_place(
    rule: Rule,
    bones: Bones,
    agent: int,
    start: int,
    # out
    observation: wp.array3d(dtype=float),
):
    """Write the place from the pelvis."""
    e = wp.tid()
    way = pelvis_at(rule.place, bones.body, e) - bones.position[e, 0]
    write_in_root(observation, e, agent, start, bones, way)


class DodgeTask(Task):
    """Stand still in the rest pose, and avoid the balls."""

    Config = DodgeConfig
    description = "stand still, and avoid balls that are thrown at chest and head"
    rewards = (
        Term(
            "pose",
            "0.6 while the mean angle of the joints from the rest pose is at most 0.05 rad; beyond it a Gaussian that "
            "has fallen to 0.06 after another `pose_margin`",
        ),
        Term(
            "place",
            "0.4 while the pelvis is within 0.02 m of its place; beyond it a Gaussian that has fallen to 0.04 after "
            "another `place_margin`",
        ),
        CONTROL,
    )
    costs = (
        Term("impulse", "the metric `impulse` over `impulse_scale`"),
        Term("stress", "excess of the metric `stress` over `stress_limit`, divided by `stress_limit`"),
    )
    metrics = (
        Metric("rotation_error_deg", "deg", "mean angle of the joints from the rest pose"),
        Metric("root_error", "m", "horizontal distance of the pelvis from its place"),
        Metric("impulse", "N s", "impulse of the balls on the body in this step, magnitudes summed over the balls"),
        Metric("stress", "young_modulus", "peak von Mises stress in head, trunk and arms"),
        Metric("hits", "-", "throws that have hit in this episode"),
    )
    state_arrays = (
        TaskArray("struck", int, ("num_balls",), cleared=True),  # 1 for a ball that has hit since it was thrown
        TaskArray("hits", int, cleared=True),
    )
    scratch_arrays = (
        TaskArray("reference_root", wp.vec3),
        TaskArray("placed", wp.bool, ("num_balls",)),
        TaskArray("stress", float, (1, len(BODY_PARTS))),
    )

    summary = """Every `throw_interval` one of `num_balls` soft balls is thrown at the avatar's chest or head, from
`throw_distance` away and up to `throw_angle` off the front. The first throw comes in the first half of the first
interval; a ball that has flown past is caught and waits behind the avatar for its next throw. The reward is for
standing still in the rest pose. A hit takes nothing off the reward, but has a `cost` of its own, as in constrained
(safe) reinforcement learning: among agents that are rarely hit, a good one stands best. An agent that does nothing
earns all the reward, and every ball hits it. The root can be steered up to `root_range` from its place."""
    success_doc = "no ball has hit since it was thrown, with more than `hit_impulse` in one step"
    picture_seconds = 0.9
    picture_actions = "zero"

    config: DodgeConfig

    def __init__(self, config: DodgeConfig) -> None:
        check_ranges(config, "ball_mass", "throw_speed", "throw_distance")
        super().__init__(config)

    def build_scene(self) -> SceneConfig:
        scene, config = super().build_scene(), self.config
        avatar = scene.avatars[0]
        self.place = (*avatar.position, avatar.yaw)
        self.waiting = waiting_places(self.place, config)
        size, mass = (config.ball_radius,), float(np.mean(config.ball_mass))
        balls = [
            PropConfig(name=f"ball_{index}", size=size, mass=mass, position=tuple(at), top_speed=thrown_speed(config))
            for index, at in enumerate(self.waiting.tolist())
        ]
        return replace(scene, props=[*balls, *scene.props])

    def terms(self) -> tuple[ObservationTerm, ...]:
        balls = self.config.num_balls
        return (
            ObservationTerm("time_to_throw", balls, "s", "-", "time until the next throw of each ball"),
            ObservationTerm("ball_mass", balls, "kg", "-", "mass of each ball"),
            ObservationTerm("place_position", 3, "m", "root", "the pelvis' place in the rest pose, from the pelvis"),
        )

    def drawn(self) -> tuple[Parameter, ...]:
        mass, balls = self.config.ball_mass, range(self.config.num_balls)
        return tuple(Parameter(f"ball_{index}_mass", "kg", *mass, f"mass of ball {index}") for index in balls)

    def drawn_values(self, env) -> tuple[Drawn, ...]:
        density = env.simulation.props.density
        return tuple(Drawn(density[:, index], self.throws.volume) for index in range(self.config.num_balls))

    def action_spec(self) -> ActionSpec:
        config = self.config
        speed = speed_within(config.root_range, ROOT_SPEED, config.physics.control_dt)
        return ActionSpec(self.joints, root=True, joint_speed=config.control.joint_speed_limit, root_speed=speed)

    def domain(self) -> Domain:
        return throwing_domain(self.config, self.place)

    def allocate(self, env) -> None:
        config = self.config
        self.throws = make_throws(config, self.place, self.waiting, env)
        # the action comes on top of the clamped root
        reach = config.root_range - self.action_spec().greatest_speed * config.physics.control_dt
        self.rule = fill(Rule(), config, place=wp.vec3(*self.place), range=reach, first_ball=env.num_agents)
        self.part = wp.array(env.simulation.flesh[0].part, dtype=int, device=env.device)

    def record_reset(self, env, graph) -> None:
        record_standing(env, graph, self.config.pose_noise)
        record_balls(env, graph, self.throws)

    def record_references(self, env, graph) -> list[tuple[wp.array, wp.array]]:
        avatar, props = env.simulation.avatar, env.simulation.props
        inputs = [self.rule, avatar.body, avatar.state.command_root]
        graph.launch(keep_place, env.num_envs, inputs, [self.reference_root])
        inputs = [self.throws, env.episodes, env.bones[0], env.props]
        graph.launch(throw_balls, self.placed.shape, inputs, [self.placed, env.first_props])
        for ball in range(self.config.num_balls):
            props.record_place(graph, env.simulation.state, self.placed[:, ball], ball)
        return [(avatar.state.command_rotation, self.reference_root)]

    def record_outcome(self, env, graph) -> None:
        sim, avatar = env.simulation, env.simulation.avatar
        graph.launch(judge_pose, env.num_envs, [self.rule, env.bones[0], env.action], [env.outcome])
        graph.launch(clear_stress, (env.num_envs, len(BODY_PARTS)), [env.observer.all_envs, 0, 0], [self.stress])
        per_modulus = 1.0 / sim.flesh[0].physics.young_modulus
        inputs = [env.observer.all_envs, avatar.body, sim.model.particles, sim.state.F, self.part, 0, 0, per_modulus]
        graph.launch(observe_stress, env.num_envs * avatar.num_points, inputs, [self.stress])
        inputs = [self.rule, self.throws, env.episodes, sim.sensors, self.stress]
        graph.launch(judge_hits, env.num_envs, inputs, [self.struck, self.hits, env.outcome])

    def record_observe(self, env, graph, agent: int, start: int) -> None:
        inputs = [self.throws, env.episodes, env.props, self.config.physics.control_dt, agent, start]
        graph.launch(observe_throws, self.placed.shape, inputs, [env.observation])
        start += 2 * self.config.num_balls
        graph.launch(observe_place, env.num_envs, [self.rule, env.bones[agent], agent, start], [env.observation])


TASK = DodgeTask
