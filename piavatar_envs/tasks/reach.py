"""Reach: bring either hand to a target that moves on a sphere around the body."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import numpy as np
import warp as wp
from pydantic import Field

from piavatar_envs.avatar.body.skeleton import JOINT_NAMES
from piavatar_envs.avatar.types import Body
from piavatar_envs.config import EnvConfig
from piavatar_envs.core.rng import STREAM_TASK, generator
from piavatar_envs.envs.observations import ObservationTerm, write_vector
from piavatar_envs.envs.parameters import Drawn, component
from piavatar_envs.envs.task import Task
from piavatar_envs.mpm.types import row
from piavatar_envs.sim.randomize import Parameter
from piavatar_envs.tasks.common.hands import write_hands
from piavatar_envs.tasks.common.ranges import Margin, Weight
from piavatar_envs.tasks.common.rewards import mean_square_action, tolerance
from piavatar_envs.tasks.common.spawn import record_standing

wp.set_module_options({"enable_backward": False})

#: Middles of the target's swing: azimuth to either side, elevation from and to; its pace from; a whole turn [rad].
SIDE, BELOW, ABOVE = wp.constant(1.6), wp.constant(-0.7), wp.constant(0.9)
SLOWEST, TURN = wp.constant(0.3), wp.constant(6.2831853)


class ReachConfig(EnvConfig):
    """Settings of Reach."""

    radius: float = Field(0.45, gt=0.0, le=1.0, description="radius of the target's sphere about the chest [m]")
    target_speed: float = Field(
        0.3, ge=0.0, le=5.0, description="bound of the target's speed, of which it has 0.7 at most [m/s]"
    )
    target_radius: float = Field(0.08, gt=0.0, le=0.5, description="distance that counts as reached [m]")
    margin: Margin = Field(0.4, description="distance beyond it at which the reward has fallen to 0.1 [m]")
    control_cost: Weight = Field(0.05, description="weight of the mean squared action [-]")
    pose_noise: float = Field(0.1, ge=0.0, le=0.5, description="greatest joint angle of the first pose [rad]")


@wp.struct
class Target:
    """Constants of the target's motion."""

    radius: float
    speed: float
    reached: float
    margin: float
    control_cost: float
    control_dt: float
    center: int  # joint at the sphere's centre in the rest pose


@wp.kernel
def draw_target(
    mask: wp.array(dtype=wp.bool),
    seed: wp.array(dtype=int),
    episode: wp.array(dtype=int),
    # out
    course: wp.array(dtype=wp.vec4),
    phase: wp.array(dtype=wp.vec2),
):
    """A course on the sphere: azimuth from the front, elevation, and how fast and where each of them swings."""
    e = wp.tid()
    if not mask[e]:
        return
    random = generator(seed[e], episode[e], STREAM_TASK, 0)
    azimuth = wp.randf(random, -SIDE, SIDE)
    elevation = wp.randf(random, BELOW, ABOVE)
    pace = wp.randf(random, SLOWEST, 1.0)
    tilt = wp.randf(random, 0.0, TURN)
    course[e] = wp.vec4(azimuth, elevation, pace, tilt)
    phase[e] = wp.vec2(wp.randf(random, 0.0, TURN), wp.randf(random, 0.0, TURN))


@wp.func
def target_position(target: Target, center: wp.vec3, course: wp.vec4, phase: wp.vec2, time: float):
    """Position of the target: both angles swing by 0.35 rad about the course's, slowly enough for the speed limit."""
    swing = 0.35
    rate = target.speed * course[2] / (swing * target.radius * 1.4143)
    azimuth = course[0] + swing * wp.cos(course[3]) * wp.sin(rate * time + phase[0])
    elevation = course[1] + swing * wp.sin(course[3]) * wp.sin(rate * time + phase[1])
    out = wp.vec3(wp.sin(azimuth) * wp.cos(elevation), -wp.cos(azimuth) * wp.cos(elevation), wp.sin(elevation))
    return center + target.radius * out


@wp.kernel
def locate(
    target: Target,
    body: Body,
    rotation: wp.array2d(dtype=wp.quat),
    position: wp.array2d(dtype=wp.vec3),
    step_count: wp.array(dtype=int),
    course: wp.array(dtype=wp.vec4),
    phase: wp.array(dtype=wp.vec2),
    steps_ahead: int,
    # out
    goal: wp.array(dtype=wp.vec3),
    goal_velocity: wp.array(dtype=wp.vec3),
    hands: wp.array2d(dtype=wp.vec3),
):
    """Target and hands in the world, ``steps_ahead`` of the step counter."""
    e = wp.tid()
    time = target.control_dt * float(step_count[e] + steps_ahead)
    center = body.rest_joint[row(e, body.rest_joint.shape[0]), target.center]
    here = target_position(target, center, course[e], phase[e], time)
    goal[e] = here
    next = target_position(target, center, course[e], phase[e], time + target.control_dt)
    goal_velocity[e] = (next - here) / target.control_dt
    write_hands(body, e, rotation, position, hands)


@wp.kernel
def judge(
    target: Target,
    goal: wp.array(dtype=wp.vec3),
    hands: wp.array2d(dtype=wp.vec3),
    action: wp.array3d(dtype=float),
    # out
    terms: wp.array3d(dtype=float),
    metrics: wp.array3d(dtype=float),
    success: wp.array2d(dtype=wp.bool),
):
    """Reward of being near with either hand, and its cost."""
    e = wp.tid()
    left = wp.length(hands[e, 0] - goal[e])
    right = wp.length(hands[e, 1] - goal[e])
    distance = wp.min(left, right)
    terms[e, 0, 0] = tolerance(distance, target.reached, target.margin)
    terms[e, 0, 1] = -target.control_cost * mean_square_action(action, e, 0)
    metrics[e, 0, 0] = distance
    metrics[e, 0, 1] = left
    metrics[e, 0, 2] = right
    success[e, 0] = distance <= target.reached


@wp.kernel
def observe(
    agent: int,
    start: int,
    rotation: wp.array2d(dtype=wp.quat),
    position: wp.array2d(dtype=wp.vec3),
    goal: wp.array(dtype=wp.vec3),
    goal_velocity: wp.array(dtype=wp.vec3),
    hands: wp.array2d(dtype=wp.vec3),
    # out
    observation: wp.array3d(dtype=float),
):
    """Terms of ``ReachTask.observation_terms``."""
    e = wp.tid()
    to_root = wp.quat_inverse(rotation[e, 0])
    write_vector(observation, e, agent, start, wp.quat_rotate(to_root, goal[e] - position[e, 0]))
    write_vector(observation, e, agent, start + 3, wp.quat_rotate(to_root, goal_velocity[e]))
    write_vector(observation, e, agent, start + 6, wp.quat_rotate(to_root, goal[e] - hands[e, 0]))
    write_vector(observation, e, agent, start + 9, wp.quat_rotate(to_root, goal[e] - hands[e, 1]))


class ReachTask(Task):
    """Bring either hand to the target and stay with it."""

    Config = ReachConfig
    description = "either hand to a target that moves on a sphere around the body"
    observation_terms = (
        ObservationTerm("target_position", 3, "m", "root", "the target from the pelvis"),
        ObservationTerm("target_velocity", 3, "m/s", "root", "velocity of the target"),
        ObservationTerm("target_from_left_hand", 3, "m", "root", "the target from the left hand"),
        ObservationTerm("target_from_right_hand", 3, "m", "root", "the target from the right hand"),
    )
    reward_terms = ("reach", "control")
    metrics = ("distance", "left_distance", "right_distance")

    summary = """A target hovers at `radius` from the chest, in front of the body or beside it, and swings there at up
to `target_speed`. The avatar stands upright, its joints a little bent at random (`pose_noise`), and shall bring the
middle of either hand to the target and stay with it."""
    reward_docs: ClassVar[Mapping[str, str]] = {
        "reach": "1 while the nearer hand is within `target_radius` of the target; beyond it a Gaussian that has "
        "fallen to 0.1 at `target_radius + margin`",
        "control": "`-control_cost` times the mean of the squared action components",
    }
    metric_docs: ClassVar[Mapping[str, str]] = {
        "distance": "from the middle of the nearer hand to the target [m]",
        "left_distance": "from the middle of the left hand to the target [m]",
        "right_distance": "from the middle of the right hand to the target [m]",
    }
    success_doc = "the nearer hand is within `target_radius` of the target"
    picture_seconds = 1.0
    picture_actions: ClassVar[Mapping[str, float]] = {
        "left_shoulder.z": -0.3, "left_elbow.x": -0.4, "left_elbow.z": 0.3, "spine3.z": -0.3,
    }  # fmt: skip

    config: ReachConfig

    def drawn(self) -> tuple[Parameter, ...]:
        return (
            Parameter("target_azimuth", "rad", -SIDE, SIDE, "middle of the target's swing, from the front"),
            Parameter("target_elevation", "rad", BELOW, ABOVE, "the same upwards"),
            Parameter(
                "target_pace", "-", SLOWEST, 1.0, "how fast the target swings: bound of its speed over target_speed"
            ),
            Parameter("target_tilt", "rad", 0.0, TURN, "direction of the swing: its parts in azimuth and elevation"),
            Parameter("target_phase_azimuth", "rad", 0.0, TURN, "where the swing in azimuth begins"),
            Parameter("target_phase_elevation", "rad", 0.0, TURN, "where the swing in elevation begins"),
        )

    def drawn_values(self, env) -> tuple[Drawn, ...]:
        course = [component(self.course, n) for n in range(4)]
        return tuple(Drawn(values) for values in (*course, component(self.phase, 0), component(self.phase, 1)))

    def allocate(self, env) -> None:
        n, device = env.num_envs, env.device
        config, target = self.config, Target()
        target.radius, target.speed, target.reached = config.radius, config.target_speed, config.target_radius
        target.margin, target.control_cost = config.margin, config.control_cost
        target.control_dt, target.center = config.physics.control_dt, JOINT_NAMES.index("spine3")
        self.target = target
        self.course = wp.zeros(n, dtype=wp.vec4, device=device)
        self.phase = wp.zeros(n, dtype=wp.vec2, device=device)
        self.goal, self.goal_velocity = (wp.zeros(n, dtype=wp.vec3, device=device) for _ in range(2))
        self.hands = wp.zeros((n, 2), dtype=wp.vec3, device=device)

    def arrays(self) -> dict[str, wp.array]:
        return {"course": self.course, "phase": self.phase}

    def record_reset(self, env, graph) -> None:
        record_standing(env, graph, self.config.pose_noise)
        graph.launch(draw_target, env.num_envs, [env.mask, env.seed, env.episode], [self.course, self.phase])

    def _record_locate(self, env, graph, steps_ahead: int) -> None:
        avatar = env.simulation.avatar
        graph.launch(
            locate,
            env.num_envs,
            [
                self.target, avatar.body, avatar.tracked.rotation, avatar.tracked.position, env.step_count,
                self.course, self.phase, steps_ahead,
            ],
            [self.goal, self.goal_velocity, self.hands],
        )  # fmt: skip

    def record_outcome(self, env, graph) -> None:
        # the step counter has not moved yet: the state that is judged is one step ahead of it
        self._record_locate(env, graph, 1)
        graph.launch(
            judge,
            env.num_envs,
            [self.target, self.goal, self.hands, env.action],
            [env.terms, env.metrics, env.success],
        )

    def record_observe(self, env, graph, agent: int, start: int) -> None:
        self._record_locate(env, graph, 0)
        tracked = env.simulation.avatar.tracked
        graph.launch(
            observe,
            env.num_envs,
            [agent, start, tracked.rotation, tracked.position, self.goal, self.goal_velocity, self.hands],
            [env.observation],
        )

    def markers(self, env, index: int) -> list[tuple[np.ndarray, float, tuple[float, float, float]]]:
        return [(env.task.goal.numpy()[index].copy(), self.config.target_radius, (0.95, 0.35, 0.2))]


TASK = ReachTask
