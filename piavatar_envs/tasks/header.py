"""Header: head a falling ball through a gate that hangs in front."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import ClassVar

import warp as wp
from pydantic import Field

from piavatar_envs.avatar.body.skeleton import joint_index
from piavatar_envs.config import ConfigError, ControlConfig, PoseControlConfig, SceneConfig
from piavatar_envs.config.schema import Place
from piavatar_envs.core.rng import STREAM_BALL
from piavatar_envs.core.structs import fill
from piavatar_envs.envs.episodes import Bones, Episodes, Props, random_of, write_in_root
from piavatar_envs.envs.observations import ObservationTerm
from piavatar_envs.envs.task import TaskArray
from piavatar_envs.tasks.common.ball_goal import GATE_TERMS, Ball, GateConfig, GateTask, turn_and_weigh
from piavatar_envs.tasks.common.hands import flesh_middle
from piavatar_envs.tasks.common.ranges import DistanceRange, MassRange, check_ranges

wp.set_module_options({"enable_backward": False})

#: Joints that act by default.
HEADING = ("left_hip", "right_hip", "spine1", "left_knee", "right_knee", "spine2", "spine3", "neck", "head")
#: Height of the ball's centre when it touches the head of a standing mean body [m].
TOUCH_HEIGHT = 1.75
#: Radius of the sphere that approximates a head [m].
HEAD_RADIUS = wp.constant(0.1)

_HEAD = wp.constant(joint_index("head"))


class HeaderConfig(GateConfig):
    """Settings of Header."""

    control: ControlConfig = Field(
        default_factory=lambda: PoseControlConfig(joint_speed_limit=5.0), description="how actions move the body"
    )
    episode_seconds: float = Field(2.0, gt=0.0, le=3600.0, description="simulated time until truncation [s]")
    joints: tuple[str, ...] | None = Field(HEADING, description="joints that act; null for all 21")
    ball_mass: MassRange = Field((0.2, 0.6), description="range of the ball's mass, uniform in its log [kg]")
    ball_height: DistanceRange = Field((2.5, 2.7), description="range of the height it falls from [m]")
    ball_place: tuple[Place, Place] = Field(
        (0.0, -0.1), description="middle of the places where it comes down to the head, x and y [m]"
    )
    ball_speed: float = Field(0.3, ge=0.0, le=2.0, description="greatest speed of the ball along x and y [m/s]")
    target_distance: DistanceRange = Field((1.5, 2.2), description="range of the gate's distance from the ball [m]")
    target_angle: float = Field(0.3, ge=0.0, le=1.0, description="its greatest angle from straight ahead [rad]")
    target_height: float = Field(1.0, ge=0.0, le=2.0, description="height of the gate's centre [m]")
    target_radius: float = Field(0.5, gt=0.0, le=1.0, description="radius of the gate's opening [m]")


@wp.struct
class Fall:
    """Constants of the ball's fall to its place."""

    speed: float  # greatest along x and y [m/s]
    low: float  # range of its first height [m]
    high: float
    gravity: float  # downward [m/s^2]


@wp.func
def falling_time(height: float, gravity: float):
    """Return the time [s] to fall a height [m] from rest; at most a second, where gravity is low or zero."""
    return wp.min(wp.sqrt(2.0 * wp.max(height, 0.0) / wp.max(gravity, 0.1)), 1.0)


@wp.kernel
def throw_ball(
    episodes: Episodes,
    ball: Ball,
    fall: Fall,
    # out
    first: Props,
):
    """Draw a ball that comes down to its place with a small speed to the side, in the masked environments."""
    e = wp.tid()
    if not episodes.mask[e]:
        return
    random = random_of(episodes, e, STREAM_BALL, 0)
    offset = wp.vec3(wp.randf(random, -1.0, 1.0), wp.randf(random, -1.0, 1.0), 0.0)
    drift = fall.speed * wp.vec3(wp.randf(random, -1.0, 1.0), wp.randf(random, -1.0, 1.0), 0.0)
    height = wp.randf(random, fall.low, fall.high)
    time = falling_time(height - ball.place[2], fall.gravity)
    start = ball.place + ball.jitter * offset - time * drift
    start[2] = height
    first.position[e, ball.prop] = start
    first.velocity[e, ball.prop] = drift
    turn_and_weigh(random, e, ball, first)


@wp.kernel
def find_head(
    bones: Bones,
    ball: wp.array(dtype=wp.vec3),
    ball_radius: float,
    # out
    head: wp.array(dtype=wp.vec3),
    gap: wp.array(dtype=float),
):
    """Find the middle of the head, and the distance of the ball's surface from the head's [m]."""
    e = wp.tid()
    middle = flesh_middle(bones, e, _HEAD)
    head[e] = middle
    gap[e] = wp.length(ball[e] - middle) - ball_radius - HEAD_RADIUS


@wp.kernel
def observe_head(
    bones: Bones,
    head: wp.array(dtype=wp.vec3),
    ball: wp.array(dtype=wp.vec3),
    agent: int,
    start: int,
    # out
    observation: wp.array3d(dtype=float),
):
    """Write the ball from the head from component ``start``."""
    e = wp.tid()
    write_in_root(observation, e, agent, start, bones, ball[e] - head[e])


class HeaderTask(GateTask):
    """Head the ball through the gate."""

    Config = HeaderConfig
    description = "head a falling ball through a gate in front"
    observation_terms = (
        *GATE_TERMS,
        ObservationTerm("ball_from_head", 3, "m", "root", "the ball from the middle of the head"),
    )
    scratch_arrays = (*GateTask.scratch_arrays, TaskArray("head", wp.vec3))

    camera_direction = (-3.6, 2.2, 0.8)

    summary = """A soft ball, its mass drawn from `ball_mass`, falls from a height in the range `ball_height`, with a
speed of up to `ball_speed` to the side, and comes down within about `ball_jitter` of `ball_place`: on the forehead of
an avatar that stands upright, its joints slightly bent at random (`pose_noise`), its root held in place. A gate hangs
in front, at a `target_distance` from the ball's start and up to `target_angle` to either side. Left alone, the ball
drops off the head. A good agent leans back and to the side, lets trunk and neck snap forward when the ball arrives, and
meets it off its centre to steer it.

The shaping terms pay only for improvements on the best of the episode, so all terms but the control cost add up to at
most 1, half of it for the goal."""
    picture_seconds = 0.43
    picture_actions: ClassVar[Mapping[str, float]] = {"spine2.x": -0.05, "neck.x": -0.1, "head.x": -0.1}

    config: HeaderConfig

    def __init__(self, config: HeaderConfig) -> None:
        check_ranges(config, "ball_height")
        super().__init__(config)

    @property
    def heights(self) -> tuple[float, ...]:
        return self.config.ball_height

    def build_scene(self) -> SceneConfig:
        return self.ball_scene(math.sqrt(2.0) * self.config.ball_speed)

    def prop_places(self) -> Mapping[str, Sequence[Sequence[float]]]:
        config = self.config
        time = falling_time(config.ball_height[1] - TOUCH_HEIGHT, config.physics.gravity)
        return self.ball_places(drift=config.ball_speed * time)

    def allocate(self, env) -> None:
        config, (low, high) = self.config, self.config.ball_height
        tall = env.simulation.flesh[0].height
        if low < tall + config.ball_radius:
            raise ConfigError(
                f"ball_height={list(config.ball_height)} m begins in the head of a body of {tall:.2f} m; use at least "
                f"{tall + config.ball_radius + 0.3:.2f} m"
            )
        super().allocate(env, TOUCH_HEIGHT)
        self.fall = fill(Fall(), config.physics, speed=config.ball_speed, low=low, high=high)

    def record_ball(self, env, graph) -> None:
        graph.launch(throw_ball, env.num_envs, [env.episodes, self.ball, self.fall], [env.first_props])

    def record_gap(self, env, graph) -> None:
        inputs = [env.bones[0], self.ball_column(env, "position"), self.config.ball_radius]
        graph.launch(find_head, env.num_envs, inputs, [self.head, self.gap])

    def record_observe(self, env, graph, agent: int, start: int) -> None:
        start = self.record_gate_terms(env, graph, agent, start)
        self.record_gap(env, graph)
        inputs = [env.bones[agent], self.head, self.ball_column(env, "position"), agent, start]
        graph.launch(observe_head, env.num_envs, inputs, [env.observation])


TASK = HeaderTask
