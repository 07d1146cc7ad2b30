"""KickBall: kick a ball of unknown direction and mass, light or heavy, through a gate on the ground."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import ClassVar

import warp as wp
from pydantic import Field

from piavatar_envs.avatar.body.skeleton import joint_index
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
from piavatar_envs.tasks.common.ranges import DistanceRange, MassRange, Weight, check_ranges
from piavatar_envs.tasks.common.spawn import record_standing

wp.set_module_options({"enable_backward": False})

LEGS = ("hip", "knee", "ankle")
#: Joints that act by default.
KICKING = (*(f"{side}_{joint}" for joint in LEGS for side in ("left", "right")), "spine1", "spine2", "spine3")

_LEFT_FOOT = wp.constant(joint_index("left_foot"))
_RIGHT_FOOT = wp.constant(joint_index("right_foot"))


class KickBallConfig(EnvConfig):
    """Settings of KickBall."""

    control: ControlConfig = Field(
        default_factory=lambda: PoseControlConfig(joint_speed_limit=7.0), description="how actions move the body"
    )
    episode_seconds: float = Field(3.0, gt=0.0, le=3600.0, description="simulated time until truncation [s]")
    joints: tuple[str, ...] | None = Field(KICKING, description="joints that act; null for all 21")
    ball_mass: MassRange = Field((0.2, 8.0), description="range of the ball's mass, uniform in its log [kg]")
    ball_radius: float = Field(0.11, ge=0.06, le=0.3, description="radius of the ball [m]")
    ball_place: tuple[Place, Place] = Field((-0.17, -0.47), description="middle of where the ball lies, x and y [m]")
    ball_jitter: float = Field(0.05, ge=0.0, le=0.2, description="greatest offset from there along x and y [m]")
    target_distance: DistanceRange = Field((1.2, 1.8), description="range of its distance from the ball [m]")
    target_angle: float = Field(0.35, ge=0.0, le=1.0, description="its greatest angle from straight ahead [rad]")
    target_height: float = Field(0.25, ge=0.0, le=2.0, description="height of the gate's centre [m]")
    target_radius: float = Field(0.4, gt=0.0, le=1.0, description="radius of the gate's opening [m]")
    control_cost: Weight = Field(0.002, description="weight of the mean squared action [-]")
    pose_noise: float = Field(0.05, ge=0.0, le=0.5, description="greatest joint angle of the first pose [rad]")


@wp.kernel
def draw_ball(
    mask: wp.array(dtype=wp.bool),
    seed: wp.array(dtype=int),
    episode: wp.array(dtype=int),
    ball: Ball,
    # out
    position: wp.array2d(dtype=wp.vec3),
    rotation: wp.array2d(dtype=wp.quat),
    density: wp.array2d(dtype=float),
):
    """A ball at rest, of a mass that is uniform in its logarithm, in the masked environments."""
    e = wp.tid()
    if not mask[e]:
        return
    random = generator(seed[e], episode[e], STREAM_BALL, 0)
    offset = wp.vec3(wp.randf(random, -1.0, 1.0), wp.randf(random, -1.0, 1.0), 0.0)
    position[e, ball.prop] = ball.place + ball.jitter * offset
    turn_and_weigh(random, e, ball, rotation, density)


@wp.kernel
def find_feet(
    position: wp.array2d(dtype=wp.vec3),
    ball: wp.array(dtype=wp.vec3),
    ball_radius: float,
    # out
    gap: wp.array(dtype=float),
):
    """Distance of the nearer foot's ball from the ball's surface [m]."""
    e = wp.tid()
    left = wp.length(ball[e] - position[e, _LEFT_FOOT])
    right = wp.length(ball[e] - position[e, _RIGHT_FOOT])
    gap[e] = wp.min(left, right) - ball_radius


@wp.kernel
def observe_feet(
    agent: int,
    start: int,
    rotation: wp.array2d(dtype=wp.quat),
    position: wp.array2d(dtype=wp.vec3),
    ball: wp.array(dtype=wp.vec3),
    # out
    observation: wp.array3d(dtype=float),
):
    """The ball from both feet, from component ``start``."""
    e = wp.tid()
    to_root = wp.quat_inverse(rotation[e, 0])
    write_vector(observation, e, agent, start, wp.quat_rotate(to_root, ball[e] - position[e, _LEFT_FOOT]))
    write_vector(observation, e, agent, start + 3, wp.quat_rotate(to_root, ball[e] - position[e, _RIGHT_FOOT]))


class KickBallTask(Task):
    """Kick the ball through the gate."""

    Config = KickBallConfig
    description = "kick a ball of 0.2 to 8 kg through a gate on the ground"
    observation_terms = (
        *GATE_TERMS,
        ObservationTerm("ball_from_left_foot", 3, "m", "root", "the ball from the left foot's ball"),
        ObservationTerm("ball_from_right_foot", 3, "m", "root", "the ball from the right foot's ball"),
    )
    reward_terms = REWARD_TERMS
    metrics = METRICS

    camera_position = (-3.6, 0.9, 1.5)
    camera_target = (0.1, -0.85, 0.65)
    camera_follows = False

    summary = """A soft ball lies on the ground before the right foot, at `ball_place` give or take `ball_jitter`, and
may weigh anything in the range `ball_mass`, which is drawn uniformly in its logarithm and observed. A gate stands on
the ground at a `target_distance` from the ball and up to `target_angle` to either side. The avatar stands with its
joints a little bent at random (`pose_noise`), its root held where it is, and has one shot: its legs and spine act
(`joints`), faster than by default (`joint_speed_limit`). A good agent swings the leg back, lifts the foot off the
ground, strikes the ball off its centre or with an oblique swing when the gate is aside, and hits heavy balls harder.
A ball that has missed rolls on until time is up.

What can be earned by shaping is earned once: the terms pay only for being better than ever before in the episode, so
that all of them but the control cost add up to at most 1, half of it for the goal."""
    reward_docs: ClassVar[Mapping[str, str]] = REWARD_DOCS
    metric_docs: ClassVar[Mapping[str, str]] = METRIC_DOCS
    success_doc = SUCCESS_DOC
    termination_doc = TERMINATION_DOC
    picture_seconds = 0.17
    picture_actions: ClassVar[Mapping[str, float]] = {"right_hip.x": -0.8, "right_ankle.x": 0.2}

    config: KickBallConfig

    def __init__(self, config: KickBallConfig) -> None:
        check_ranges(config, "target_distance", "ball_mass")
        super().__init__(config)

    def build_scene(self) -> SceneConfig:
        scene = super().build_scene()
        ball = ball_config(self.config, (*self.config.ball_place, self.config.ball_radius))
        return replace(scene, props=[ball, *scene.props])

    def prop_places(self) -> Mapping[str, Sequence[Sequence[float]]]:
        return ball_places(self.config, self.config.ball_radius)

    def drawn(self) -> tuple[Parameter, ...]:
        return drawn_goal(self.config)

    def drawn_values(self, env) -> tuple[Drawn, ...]:
        return self.goal.drawn_values()

    def domain(self) -> Domain:
        return gate_domain(self.config, self.scene, self.config.ball_radius)

    def allocate(self, env) -> None:
        self.goal = Goal(env, self.config, self.config.ball_radius)

    def arrays(self) -> dict[str, wp.array]:
        return self.goal.arrays()

    def record_reset(self, env, graph) -> None:
        record_standing(env, graph, self.config.pose_noise)
        props = env.simulation.props
        graph.launch(
            draw_ball,
            env.num_envs,
            [env.mask, env.seed, env.episode, self.goal.ball],
            [props.spawn.position, props.spawn.rotation, props.density],
        )
        self.goal.record_reset(graph)

    def record_outcome(self, env, graph) -> None:
        graph.launch(
            find_feet,
            env.num_envs,
            [env.simulation.avatar.tracked.position, self.goal.column("position"), self.config.ball_radius],
            [self.goal.gap],
        )
        self.goal.record_outcome(graph)

    def record_observe(self, env, graph, agent: int, start: int) -> None:
        self.goal.record_observe(graph, agent, start)
        tracked = env.simulation.avatars[agent].tracked
        at = start + sum(term.size for term in GATE_TERMS)
        graph.launch(
            observe_feet,
            env.num_envs,
            [agent, at, tracked.rotation, tracked.position, self.goal.column("position")],
            [env.observation],
        )

    def markers(self, env, index: int) -> list:
        return self.goal.markers(index)


TASK = KickBallTask
