"""Header: head a falling ball through a gate that hangs in front."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import ClassVar

import warp as wp
from pydantic import Field

from piavatar_envs.avatar.body.skeleton import joint_index
from piavatar_envs.avatar.types import Body
from piavatar_envs.config import ControlConfig, EnvConfig, PoseControlConfig, SceneConfig, replace
from piavatar_envs.config.schema import Place
from piavatar_envs.core.rng import STREAM_BALL, generator
from piavatar_envs.envs.observations import ObservationTerm, write_vector
from piavatar_envs.envs.parameters import Drawn
from piavatar_envs.envs.task import Task
from piavatar_envs.sim.randomize import Parameter
from piavatar_envs.sim.scene import Domain
from piavatar_envs.tasks.common.ball_goal import (
    GATE_TERMS,
    METRIC_DOCS,
    METRICS,
    REWARD_DOCS,
    REWARD_TERMS,
    SUCCESS_DOC,
    TERMINATION_DOC,
    Ball,
    Goal,
    ball_config,
    ball_places,
    drawn_goal,
    gate_domain,
    turn_and_weigh,
)
from piavatar_envs.tasks.common.hands import flesh_middle
from piavatar_envs.tasks.common.ranges import DistanceRange, MassRange, Weight, check_ranges
from piavatar_envs.tasks.common.spawn import record_standing

wp.set_module_options({"enable_backward": False})

#: Joints that act by default.
HEADING = ("left_hip", "right_hip", "spine1", "left_knee", "right_knee", "spine2", "spine3", "neck", "head")
#: Height of the ball's centre when it touches the head of a standing mean body [m].
TOUCH_HEIGHT = 1.75
#: Of the sphere that a head nearly is [m].
HEAD_RADIUS = wp.constant(0.1)

_HEAD = wp.constant(joint_index("head"))


class HeaderConfig(EnvConfig):
    """Settings of Header."""

    control: ControlConfig = Field(
        default_factory=lambda: PoseControlConfig(joint_speed_limit=5.0), description="how actions move the body"
    )
    episode_seconds: float = Field(2.0, gt=0.0, le=3600.0, description="simulated time until truncation [s]")
    joints: tuple[str, ...] | None = Field(HEADING, description="joints that act; null for all 21")
    ball_mass: MassRange = Field((0.2, 0.6), description="range of the ball's mass, uniform in its log [kg]")
    ball_radius: float = Field(0.11, ge=0.06, le=0.3, description="radius of the ball [m]")
    ball_height: DistanceRange = Field((2.5, 2.7), description="range of the height it falls from [m]")
    ball_place: tuple[Place, Place] = Field(
        (0.0, -0.1), description="middle of where it comes down to the head, x and y [m]"
    )
    ball_jitter: float = Field(0.05, ge=0.0, le=0.2, description="greatest offset from there along x and y [m]")
    ball_speed: float = Field(0.3, ge=0.0, le=2.0, description="greatest speed of the ball along x and y [m/s]")
    target_distance: DistanceRange = Field((1.5, 2.2), description="range of its distance from the ball [m]")
    target_angle: float = Field(0.3, ge=0.0, le=1.0, description="its greatest angle from straight ahead [rad]")
    target_height: float = Field(1.0, ge=0.0, le=2.0, description="height of the gate's centre [m]")
    target_radius: float = Field(0.5, gt=0.0, le=1.0, description="radius of the gate's opening [m]")
    control_cost: Weight = Field(0.002, description="weight of the mean squared action [-]")
    pose_noise: float = Field(0.05, ge=0.0, le=0.5, description="greatest joint angle of the first pose [rad]")


@wp.struct
class Fall:
    """Constants of how the ball comes down to its place."""

    speed: float  # greatest along x and y [m/s]
    low: float  # range of its first height [m]
    high: float
    gravity: float  # downward [m/s^2]


@wp.func
def falling_time(height: float, gravity: float):
    """Time [s] to fall a height [m] from rest; at most a second, for want of gravity."""
    return wp.min(wp.sqrt(2.0 * wp.max(height, 0.0) / wp.max(gravity, 0.1)), 1.0)


@wp.kernel
def throw_ball(
    mask: wp.array(dtype=wp.bool),
    seed: wp.array(dtype=int),
    episode: wp.array(dtype=int),
    ball: Ball,
    fall: Fall,
    # out
    position: wp.array2d(dtype=wp.vec3),
    rotation: wp.array2d(dtype=wp.quat),
    velocity: wp.array2d(dtype=wp.vec3),
    density: wp.array2d(dtype=float),
):
    """A ball in the masked environments that comes down by its place with a little speed to the side."""
    e = wp.tid()
    if not mask[e]:
        return
    random = generator(seed[e], episode[e], STREAM_BALL, 0)
    offset = wp.vec3(wp.randf(random, -1.0, 1.0), wp.randf(random, -1.0, 1.0), 0.0)
    drift = fall.speed * wp.vec3(wp.randf(random, -1.0, 1.0), wp.randf(random, -1.0, 1.0), 0.0)
    height = wp.randf(random, fall.low, fall.high)
    time = falling_time(height - ball.place[2], fall.gravity)
    start = ball.place + ball.jitter * offset - time * drift
    start[2] = height
    position[e, ball.prop] = start
    velocity[e, ball.prop] = drift
    turn_and_weigh(random, e, ball, rotation, density)


@wp.kernel
def find_head(
    body: Body,
    rotation: wp.array2d(dtype=wp.quat),
    position: wp.array2d(dtype=wp.vec3),
    ball: wp.array(dtype=wp.vec3),
    ball_radius: float,
    # out
    head: wp.array(dtype=wp.vec3),
    gap: wp.array(dtype=float),
):
    """Middle of the head [m], and how far the ball's surface is from its [m]."""
    e = wp.tid()
    middle = flesh_middle(body, e, _HEAD, rotation, position)
    head[e] = middle
    gap[e] = wp.length(ball[e] - middle) - ball_radius - HEAD_RADIUS


@wp.kernel
def observe_head(
    agent: int,
    start: int,
    rotation: wp.array2d(dtype=wp.quat),
    head: wp.array(dtype=wp.vec3),
    ball: wp.array(dtype=wp.vec3),
    # out
    observation: wp.array3d(dtype=float),
):
    """The ball from the head, from component ``start``."""
    e = wp.tid()
    write_vector(observation, e, agent, start, wp.quat_rotate(wp.quat_inverse(rotation[e, 0]), ball[e] - head[e]))


class HeaderTask(Task):
    """Head the ball through the gate."""

    Config = HeaderConfig
    description = "head a falling ball through a gate in front"
    observation_terms = (
        *GATE_TERMS,
        ObservationTerm("ball_from_head", 3, "m", "root", "the ball from the middle of the head"),
    )
    reward_terms = REWARD_TERMS
    metrics = METRICS

    camera_position = (-4.7, 0.1, 2.0)
    camera_target = (0.0, -0.85, 1.05)
    camera_follows = False

    summary = """A soft ball of 0.2 to 0.6 kg falls from a height in the range `ball_height`, with a speed of up to
`ball_speed` to the side, and comes down about `ball_jitter` from `ball_place`: on the forehead of an avatar that
stands upright, its joints a little bent at random (`pose_noise`), its root held where it is. A gate hangs in front,
at a `target_distance` from where the ball began to fall and up to `target_angle` to either side. Left alone, the ball
drops off the head; a good agent leans back and aside, lets trunk and neck snap forward when the ball arrives, and
meets it off its centre to steer it.

What can be earned by shaping is earned once: the terms pay only for being better than ever before in the episode, so
that all of them but the control cost add up to at most 1, half of it for the goal."""
    reward_docs: ClassVar[Mapping[str, str]] = REWARD_DOCS
    metric_docs: ClassVar[Mapping[str, str]] = METRIC_DOCS
    success_doc = SUCCESS_DOC
    termination_doc = TERMINATION_DOC
    picture_seconds = 0.43
    picture_actions: ClassVar[Mapping[str, float]] = {"spine2.x": -0.05, "neck.x": -0.1, "head.x": -0.1}

    config: HeaderConfig

    def __init__(self, config: HeaderConfig) -> None:
        check_ranges(config, "ball_height", "target_distance", "ball_mass")
        super().__init__(config)

    def build_scene(self) -> SceneConfig:
        scene, config = super().build_scene(), self.config
        ball = ball_config(config, (*config.ball_place, config.ball_height[1]), math.sqrt(2.0) * config.ball_speed)
        return replace(scene, props=[ball, *scene.props])

    def prop_places(self) -> Mapping[str, Sequence[Sequence[float]]]:
        config = self.config
        time = falling_time(config.ball_height[1] - TOUCH_HEIGHT, config.physics.gravity)
        return ball_places(config, *config.ball_height, drift=config.ball_speed * time)

    def drawn(self) -> tuple[Parameter, ...]:
        return drawn_goal(self.config)

    def drawn_values(self, env) -> tuple[Drawn, ...]:
        return self.goal.drawn_values()

    def domain(self) -> Domain:
        return gate_domain(self.config, self.scene, self.config.ball_height[1])

    def allocate(self, env) -> None:
        config, fall = self.config, Fall()
        fall.speed, fall.gravity = config.ball_speed, config.physics.gravity
        fall.low, fall.high = config.ball_height
        self.goal, self.fall = Goal(env, config, TOUCH_HEIGHT), fall
        self.head = wp.zeros(env.num_envs, dtype=wp.vec3, device=env.device)

    def arrays(self) -> dict[str, wp.array]:
        return self.goal.arrays()

    def record_reset(self, env, graph) -> None:
        record_standing(env, graph, self.config.pose_noise)
        props = env.simulation.props
        graph.launch(
            throw_ball,
            env.num_envs,
            [env.mask, env.seed, env.episode, self.goal.ball, self.fall],
            [props.spawn.position, props.spawn.rotation, props.spawn.velocity, props.density],
        )
        self.goal.record_reset(graph)

    def _record_find(self, env, graph) -> None:
        avatar = env.simulation.avatar
        graph.launch(
            find_head,
            env.num_envs,
            [
                avatar.body, avatar.tracked.rotation, avatar.tracked.position, self.goal.column("position"),
                self.config.ball_radius,
            ],
            [self.head, self.goal.gap],
        )  # fmt: skip

    def record_outcome(self, env, graph) -> None:
        self._record_find(env, graph)
        self.goal.record_outcome(graph)

    def record_observe(self, env, graph, agent: int, start: int) -> None:
        self.goal.record_observe(graph, agent, start)
        self._record_find(env, graph)
        at = start + sum(term.size for term in GATE_TERMS)
        rotation = env.simulation.avatars[agent].tracked.rotation
        graph.launch(
            observe_head,
            env.num_envs,
            [agent, at, rotation, self.head, self.goal.column("position")],
            [env.observation],
        )

    def markers(self, env, index: int) -> list:
        return self.goal.markers(index)


TASK = HeaderTask
