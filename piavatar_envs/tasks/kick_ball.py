"""KickBall: kick a ball of unknown direction and mass, light or heavy, through a gate on the ground."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import warp as wp
from pydantic import Field

from piavatar_envs.avatar.body.skeleton import joint_index
from piavatar_envs.config import ControlConfig, PoseControlConfig
from piavatar_envs.config.schema import Place
from piavatar_envs.core.rng import STREAM_BALL
from piavatar_envs.envs.episodes import Bones, Episodes, Outcome, Props, random_of
from piavatar_envs.envs.task import Metric, Term
from piavatar_envs.mpm.types import row
from piavatar_envs.tasks.common.ball_goal import (
    FEET_TERMS,
    GATE_TERMS,
    Ball,
    GateConfig,
    GateTask,
    observe_feet,
    turn_and_weigh,
)
from piavatar_envs.tasks.common.ranges import DistanceRange, MassRange, Weight

wp.set_module_options({"enable_backward": False})

LEGS = ("hip", "knee", "ankle")
#: Joints that act by default.
KICKING = (*(f"{side}_{joint}" for joint in LEGS for side in ("left", "right")), "spine1", "spine2", "spine3")

_LEFT_FOOT, _RIGHT_FOOT = wp.constant(joint_index("left_foot")), wp.constant(joint_index("right_foot"))
_LEFT_ANKLE, _RIGHT_ANKLE = wp.constant(joint_index("left_ankle")), wp.constant(joint_index("right_ankle"))
#: Height of the standing foot above its place at rest without a cost, and the further height at the full cost [m].
STANCE_BOUND, STANCE_MARGIN = wp.constant(0.02), wp.constant(0.1)


class KickBallConfig(GateConfig):
    """Settings of KickBall."""

    control: ControlConfig = Field(
        default_factory=lambda: PoseControlConfig(joint_speed_limit=7.0, bound_motion=True),
        description="how actions move the body",
    )
    episode_seconds: float = Field(3.0, gt=0.0, le=3600.0, description="simulated time until truncation [s]")
    joints: tuple[str, ...] | None = Field(KICKING, description="joints that act; null for all 21")
    ball_mass: MassRange = Field((0.2, 8.0), description="range of the ball's mass, uniform in its log [kg]")
    ball_place: tuple[Place, Place] = Field((-0.17, -0.47), description="middle of the ball's places, x and y [m]")
    target_distance: DistanceRange = Field((1.2, 1.8), description="range of the gate's distance from the ball [m]")
    target_angle: float = Field(0.35, ge=0.0, le=1.0, description="its greatest angle from straight ahead [rad]")
    target_height: float = Field(0.25, ge=0.0, le=2.0, description="height of the gate's centre [m]")
    target_radius: float = Field(0.4, gt=0.0, le=1.0, description="radius of the gate's opening [m]")
    stance_cost: Weight = Field(0.01, description="weight of the height of the standing foot [-]")


@wp.kernel
def draw_ball(
    episodes: Episodes,
    ball: Ball,
    # out
    first: Props,
):
    """Draw a ball at rest in the masked environments."""
    e = wp.tid()
    if not episodes.mask[e]:
        return
    random = random_of(episodes, e, STREAM_BALL, 0)
    offset = wp.vec3(wp.randf(random, -1.0, 1.0), wp.randf(random, -1.0, 1.0), 0.0)
    first.position[e, ball.prop] = ball.place + ball.jitter * offset
    turn_and_weigh(random, e, ball, first)


@wp.kernel
def find_feet(
    bones: Bones,
    ball: wp.array(dtype=wp.vec3),
    ball_radius: float,
    # out
    gap: wp.array(dtype=float),
):
    """Find the distance of the nearer foot from the ball's surface [m]."""
    e = wp.tid()
    left = wp.length(ball[e] - bones.position[e, _LEFT_FOOT])
    right = wp.length(ball[e] - bones.position[e, _RIGHT_FOOT])
    gap[e] = wp.min(left, right) - ball_radius


@wp.func
def lift_of(bones: Bones, e: int, ankle: int, foot: int):
    """Return how far the higher of ankle and ball of a foot is above its height at rest [m]."""
    rest = row(e, bones.body.rest_joint.shape[0])
    heel = bones.position[e, ankle][2] - bones.body.rest_joint[rest, ankle][2]
    ball = bones.position[e, foot][2] - bones.body.rest_joint[rest, foot][2]
    return wp.max(heel, ball)


@wp.kernel
def judge_stance(
    bones: Bones,
    stance_cost: float,
    # out
    outcome: Outcome,
):
    """Take off reward while neither foot is on the ground; write the height of the lower one."""
    e = wp.tid()
    lift = wp.min(lift_of(bones, e, _LEFT_ANKLE, _LEFT_FOOT), lift_of(bones, e, _RIGHT_ANKLE, _RIGHT_FOOT))
    share = wp.clamp((lift - STANCE_BOUND) / STANCE_MARGIN, 0.0, 1.0)
    outcome.terms[e, 0, KickBallTask.rewards.stance] = -stance_cost * share
    outcome.metrics[e, 0, KickBallTask.metrics.lift] = lift


class KickBallTask(GateTask):
    """Kick the ball through the gate."""

    Config = KickBallConfig
    description = "kick a soft ball through a gate on the ground"
    observation_terms = (*GATE_TERMS, *FEET_TERMS)
    rewards = (
        *GateTask.rewards,
        Term(
            "stance",
            f"minus `stance_cost` times the height of the lower foot above its height at rest, beyond "
            f"{float(STANCE_BOUND):g} m and over {float(STANCE_MARGIN):g} m, at most 1: one foot stays on the ground",
        ),
    )
    metrics = (*GateTask.metrics, Metric("lift", "m", "height of the lower foot above its height at rest"))

    camera_direction = (-3.0, 2.4, 1.0)

    summary = """A soft ball lies on the ground in front of the right foot, within `ball_jitter` of `ball_place`. Its
mass is drawn from `ball_mass`, uniformly in its logarithm, and observed. A gate stands at a `target_distance` from the
ball and up to `target_angle` to either side. The avatar stands with its joints slightly bent at random (`pose_noise`),
its root held in place, and has one shot: its legs and spine act (`joints`), faster than by default
(`joint_speed_limit`). A good agent swings the leg back, lifts the foot off the ground, strikes the ball off its centre
or with an oblique swing when the gate is to the side, and hits heavy balls harder. A ball that has missed rolls on
until time is up.

The shaping terms pay only for improvements on the best of the episode, so all terms but the costs of control and
stance add up to at most 1, half of it for the goal."""
    picture_seconds = 0.17
    picture_actions: ClassVar[Mapping[str, float]] = {"right_hip.x": -0.8, "right_ankle.x": 0.2}

    config: KickBallConfig

    @property
    def heights(self) -> tuple[float, ...]:
        return (self.config.ball_radius,)

    def record_ball(self, env, graph) -> None:
        graph.launch(draw_ball, env.num_envs, [env.episodes, self.ball], [env.first_props])

    def record_gap(self, env, graph) -> None:
        inputs = [env.bones[0], self.ball_column(env, "position"), self.config.ball_radius]
        graph.launch(find_feet, env.num_envs, inputs, [self.gap])

    def record_outcome(self, env, graph) -> None:
        super().record_outcome(env, graph)
        graph.launch(judge_stance, env.num_envs, [env.bones[0], self.config.stance_cost], [env.outcome])

    def record_observe(self, env, graph, agent: int, start: int) -> None:
        start = self.record_gate_terms(env, graph, agent, start)
        inputs = [env.bones[agent], self.ball_column(env, "position"), agent, start]
        graph.launch(observe_feet, env.num_envs, inputs, [env.observation])


TASK = KickBallTask
