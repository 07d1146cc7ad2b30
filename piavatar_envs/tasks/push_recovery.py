"""PushRecovery: keep balance while soft balls, light and heavy, push from any side at any moment."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, ClassVar

import warp as wp
from pydantic import Field

from piavatar_envs.config import ControlConfig, EnvConfig, PropConfig, SceneConfig, TorqueControlConfig, replace
from piavatar_envs.core.rng import STREAM_BALL, STREAM_DISTURBANCE
from piavatar_envs.envs.episodes import Bones, Episodes, Outcome, Props, random_of
from piavatar_envs.envs.observations import ObservationTerm, write_vector
from piavatar_envs.envs.parameters import Drawn
from piavatar_envs.envs.task import Metric, TaskArray
from piavatar_envs.mpm.types import Sensors
from piavatar_envs.sim.randomize import Parameter
from piavatar_envs.sim.scene import Domain
from piavatar_envs.tasks.common.fall import FallConfig
from piavatar_envs.tasks.common.ranges import DistanceRange, MassRange, SpeedRange, Weight, check_ranges
from piavatar_envs.tasks.common.thrown_balls import (
    Throws,
    make_throws,
    record_balls,
    throw_or_catch,
    throwing_domain,
    thrown_speed,
    waiting_places,
)
from piavatar_envs.tasks.common.upright import (
    STANDING_DOC,
    STANDING_METRICS,
    UPRIGHT_TERMS,
    StandingTask,
    StillConfig,
    UprightConfig,
    record_observe_upright,
)

wp.set_module_options({"enable_backward": False})

BALL = "ball"
#: The ball is the only one: prop 0, and the subject after the avatar.
_BALL, _SUBJECT = wp.constant(0), wp.constant(1)
#: Index of the first throw in the stream of the ball, after the draw of its mass.
_THROWS = wp.constant(2)


class PushRecoveryConfig(EnvConfig):
    """Settings of PushRecovery."""

    control: ControlConfig = Field(default_factory=TorqueControlConfig, description="how actions move the body")
    upright: UprightConfig = Field(default_factory=UprightConfig, description="limit and margins of being upright")
    still: StillConfig = Field(default_factory=StillConfig, description="margins of the rewards of standing still")
    fall: FallConfig = Field(default_factory=FallConfig, description="limits of a fall")
    episode_seconds: float = Field(10.0, gt=0.0, le=3600.0, description="simulated time until truncation [s]")
    ball_radius: float = Field(0.1, ge=0.06, le=0.2, description="radius of the ball [m]")
    ball_mass: MassRange = Field((0.5, 8.0), description="range of its mass, uniform in its log [kg]")
    throw_interval: float = Field(2.0, ge=0.2, le=3600.0, description="time in which there is one push [s]")
    throw_speed: SpeedRange = Field((2.0, 5.0), description="range of a throw's mean speed [m/s]")
    throw_distance: DistanceRange = Field((1.0, 1.5), description="range of the distance thrown from [m]")
    throw_angle: float = Field(
        math.pi, ge=0.0, le=math.pi, description="greatest angle of a throw's origin from the front [rad]"
    )
    aim_spread: float = Field(0.05, ge=0.0, le=1.0, description="greatest error of the aim along each axis [m]")
    hit_impulse: float = Field(0.3, ge=0.0, le=1.0e4, description="impulse of a throw that counts as a push [N s]")
    control_cost: Weight = Field(0.05, description="weight of the mean squared action [-]")
    pose_noise: float = Field(0.05, ge=0.0, le=0.5, description="greatest joint angle of the first pose [rad]")

    @property
    def num_balls(self) -> int:
        """Number of balls: every throw is of the same one."""
        return 1


@wp.func
def moment_of(throws: Throws, episodes: Episodes, e: int, number: int):
    """Return the control step of a push: one in the first half of every interval, never in its first step."""
    random = random_of(episodes, e, STREAM_DISTURBANCE, number)
    return number * throws.interval + wp.randi(random, 1, throws.interval // 2 + 2)


@wp.kernel
def throw_push(
    throws: Throws,
    episodes: Episodes,
    bones: Bones,
    props: Props,
    # out
    placed: wp.array(dtype=wp.bool),
    first: Props,
):
    """Flag whether the ball is placed before this step: thrown if its moment has come, caught if it flies on."""
    e = wp.tid()
    placed[e] = False
    if episodes.failure[e] != 0:
        return
    number = episodes.step_count[e] // throws.interval
    due = episodes.step_count[e] == moment_of(throws, episodes, e, number)
    random = random_of(episodes, e, STREAM_BALL, _THROWS + number)
    placed[e] = throw_or_catch(throws, due, random, e, _BALL, bones, props, first)


@wp.kernel
def begin_push(
    placed: wp.array(dtype=wp.bool),
    first: Props,
    # in and out
    flying: wp.array(dtype=int),
    push: wp.array(dtype=wp.vec3),
):
    """Set a ball that has just been placed to flying, with no impulse yet, if it was thrown; to waiting if caught."""
    e = wp.tid()
    if placed[e]:
        flying[e] = 0
        if wp.length_sq(first.velocity[e, _BALL]) > 0.0:
            flying[e] = 1
            push[e] = wp.vec3(0.0)


@wp.kernel
def judge_push(
    least: float,
    sensors: Sensors,
    # in and out
    push: wp.array(dtype=wp.vec3),
    strongest: wp.array(dtype=float),
    outcome: Outcome,
):
    """Sum the impulses of the last throw, write the metrics, and require a push of ``least`` [N s] for success."""
    e = wp.tid()
    impulse = sensors.pair_impulse[e, _SUBJECT]
    push[e] = push[e] + impulse
    strongest[e] = wp.max(strongest[e], wp.length(push[e]))
    outcome.metrics[e, 0, PushRecoveryTask.metrics.impulse] = wp.length(impulse)
    outcome.metrics[e, 0, PushRecoveryTask.metrics.push_impulse] = wp.length(push[e])
    outcome.metrics[e, 0, PushRecoveryTask.metrics.strongest_push] = strongest[e]
    outcome.success[e, 0] = outcome.success[e, 0] and strongest[e] >= least


@wp.kernel
def observe_push(
    bones: Bones,
    flying: wp.array(dtype=int),
    props: Props,
    agent: int,
    start: int,
    # out
    observation: wp.array3d(dtype=float),
):
    """Write the ball's position and velocity relative to the pelvis while it flies; else zeros."""
    e = wp.tid()
    way = wp.vec3(0.0)
    speed = wp.vec3(0.0)
    if flying[e] != 0:
        way = wp.quat_rotate_inv(bones.rotation[e, 0], props.position[e, _BALL] - bones.position[e, 0])
        speed = wp.quat_rotate_inv(bones.rotation[e, 0], props.velocity[e, _BALL] - bones.velocity[e, 0])
    write_vector(observation, e, agent, start, way)
    write_vector(observation, e, agent, start + 3, speed)


class PushRecoveryTask(StandingTask):
    """Stand still in the rest pose under pushes."""

    Config = PushRecoveryConfig
    description = "keep balance while thrown soft balls push from any side"
    observation_terms = (
        *UPRIGHT_TERMS,
        ObservationTerm("ball_position", 3, "m", "root", "the ball, from its throw until it is caught; else zeros"),
        ObservationTerm("ball_velocity", 3, "m/s", "root", "its velocity relative to the pelvis, likewise"),
    )
    metrics = (
        *STANDING_METRICS,
        Metric("impulse", "N s", "size of the ball's impulse on the body in this step"),
        Metric("push_impulse", "N s", "size of its impulse since it was last thrown"),
        Metric("strongest_push", "N s", "greatest `push_impulse` of the episode so far"),
    )
    state_arrays = (
        TaskArray("flying", int, cleared=True),  # 1 from a throw until the ball is caught
        TaskArray("push", wp.vec3, cleared=True),  # impulse on the body since the last throw [N s]
        TaskArray("strongest", cleared=True),  # greatest size of that in the episode [N s]
    )
    scratch_arrays = (TaskArray("placed", wp.bool),)

    summary = """The avatar stands by the strength of its own joints, as in Stand. Once in every `throw_interval`, at a
random moment of its first half, a soft ball is thrown at its trunk, between pelvis and chest, from a random direction
and `throw_distance` away. The ball keeps its mass for an episode; it is drawn from `ball_mass`, uniformly in its
logarithm. By default, the heaviest ball at the greatest speed carries 40 N s, which would set the whole body in motion
at half a metre a second. The ball is observed while it flies, its mass is not. It pushes by contact like anything else
and may come to lie in front of the feet; a ball that has flown past is caught and waits. `info["strongest_push"]` is
the greatest impulse of the episode so far: sorted by it, episodes show which pushes the avatar survives."""
    success_doc = f"{STANDING_DOC}, and a throw has pushed with at least `hit_impulse`"
    picture_seconds = 0.47
    picture_actions = "zero"
    picture_settings: ClassVar[Mapping[str, Any]] = {"throw_interval": 0.8, "root_assist": 0.1}

    config: PushRecoveryConfig

    def __init__(self, config: PushRecoveryConfig) -> None:
        check_ranges(config, "ball_mass", "throw_speed", "throw_distance")
        super().__init__(config)

    def build_scene(self) -> SceneConfig:
        scene, config = super().build_scene(), self.config
        avatar = scene.avatars[0]
        self.place = (*avatar.position, avatar.yaw)
        self.waiting = waiting_places(self.place, config)
        mass = math.sqrt(math.prod(config.ball_mass))
        at = tuple(self.waiting[0].tolist())
        ball = PropConfig(name=BALL, size=(config.ball_radius,), mass=mass, position=at, top_speed=thrown_speed(config))
        return replace(scene, props=[ball, *scene.props])

    def observed_props(self) -> tuple[str, ...]:
        return tuple(prop.name for prop in self.scene.props if prop.name != BALL)

    def drawn(self) -> tuple[Parameter, ...]:
        return (Parameter("ball_mass", "kg", *self.config.ball_mass, "mass of the ball", log=True),)

    def drawn_values(self, env) -> tuple[Drawn, ...]:
        return (Drawn(env.simulation.props.density[:, 0], self.throws.volume),)

    def domain(self) -> Domain:
        return throwing_domain(self.config, self.place)

    def allocate(self, env) -> None:
        super().allocate(env)
        self.throws = make_throws(self.config, self.place, self.waiting, env, aim=("pelvis", "spine3"), log_mass=True)

    def record_reset(self, env, graph) -> None:
        super().record_reset(env, graph)
        record_balls(env, graph, self.throws)

    def record_references(self, env, graph) -> list[tuple[wp.array, wp.array]]:
        inputs = [self.throws, env.episodes, env.bones[0], env.props]
        graph.launch(throw_push, env.num_envs, inputs, [self.placed, env.first_props])
        graph.launch(begin_push, env.num_envs, [self.placed, env.first_props], [self.flying, self.push])
        env.simulation.props.record_place(graph, env.simulation.state, self.placed, 0)
        return super().record_references(env, graph)

    def record_outcome(self, env, graph) -> None:
        super().record_outcome(env, graph)
        inputs = [self.config.hit_impulse, env.simulation.sensors]
        graph.launch(judge_push, env.num_envs, inputs, [self.push, self.strongest, env.outcome])

    def record_observe(self, env, graph, agent: int, start: int) -> None:
        start = record_observe_upright(env, graph, agent, start)
        inputs = [env.bones[agent], self.flying, env.props, agent, start]
        graph.launch(observe_push, env.num_envs, inputs, [env.observation])


TASK = PushRecoveryTask
