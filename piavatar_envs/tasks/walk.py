"""Walk: go straight ahead at a given speed, on one's own feet, one after the other."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import numpy as np
import warp as wp
from pydantic import Field

from piavatar_envs.avatar.body.skeleton import NUM_JOINTS
from piavatar_envs.avatar.types import Body
from piavatar_envs.config import ControlConfig, EnvConfig, TorqueControlConfig
from piavatar_envs.envs.observations import ObservationTerm, write_vector
from piavatar_envs.envs.task import Task
from piavatar_envs.sim.scene import Domain
from piavatar_envs.tasks.common.ease import EASE_DOC, ease_rule, record_ease
from piavatar_envs.tasks.common.fall import FallConfig, is_down
from piavatar_envs.tasks.common.gait import (
    GAIT_DOC,
    GAIT_TERM,
    Gait,
    GaitConfig,
    check_gait,
    gait_rule,
    hang_arms,
    record_observe_gait,
    stepped,
    swing_arms,
    turn_taken,
    weigh_feet,
)
from piavatar_envs.tasks.common.ground import Grounding, forward_of
from piavatar_envs.tasks.common.place import PlaceRule, home
from piavatar_envs.tasks.common.ranges import Margin, Weight
from piavatar_envs.tasks.common.rewards import mean_square_action, tolerance
from piavatar_envs.tasks.common.spawn import record_standing
from piavatar_envs.tasks.common.upright import (
    FALL_DOC,
    METRIC_DOCS,
    UPRIGHT_TERMS,
    Upright,
    UprightConfig,
    lead_of_left_foot,
    posture_of,
    record_observe_upright,
    tilt_of,
    upright_rule,
    write_posture,
)

wp.set_module_options({"enable_backward": False})

#: Mean speed over the target's that no walker shall exceed: the domain ends there.
FASTEST = 1.5
#: Mean speed over the target's that is asked for: the pace, and what succeeds.
_PACE = wp.constant(0.9)
#: Components of what is observed of the way.
_WAY_SIZE = 4


class WalkConfig(EnvConfig):
    """Settings of Walk."""

    control: ControlConfig = Field(default_factory=TorqueControlConfig, description="how actions move the body")
    upright: UprightConfig = Field(default_factory=UprightConfig, description="what counts as standing")
    gait: GaitConfig = Field(default_factory=GaitConfig, description="feet that bear the body in turn")
    fall: FallConfig = Field(default_factory=FallConfig, description="what counts as a fall")
    episode_seconds: float = Field(10.0, gt=0.0, le=3600.0, description="simulated time until truncation [s]")
    target_speed: float = Field(1.0, gt=0.0, le=5.0, description="how fast to go [m/s]")
    lane: float = Field(1.0, gt=0.0, le=2.0, description="distance aside of the way at which the episode ends [m]")
    most_behind: float | None = Field(
        1.5,
        gt=0.0,
        le=1000.0,
        description="distance behind the pace at which the episode ends; None: there is no pace [m]",
    )
    heading_margin: Margin = Field(0.8, description="angle off the way at which the reward is 0.1 [rad]")
    control_cost: Weight = Field(0.05, description="weight of the mean squared action [-]")
    ease_cost: Weight = Field(0.0, description="weight of how far joints are bent beyond what people do [1/rad^2]")
    pose_noise: float = Field(0.05, ge=0.0, le=0.5, description="greatest joint angle of the first pose [rad]")


@wp.struct
class Way:
    """Constants of the way, and of falling on it."""

    start: PlaceRule  # where it begins: only its place is used
    speed: float  # [m/s]
    lane: float  # [m]
    most_behind: float  # [m]
    length: float  # [m]
    heading_margin: float  # [rad]
    control_dt: float  # [s]
    least: wp.vec2  # shares of head and pelvis below which it has fallen
    upright: Upright
    gait: Gait


@wp.func
def way_gone(way: Way, body: Body, e: int, pelvis: wp.vec3):
    """How far along the way and how far to its left a pelvis is [m]."""
    off = pelvis - home(way.start, body, e)
    ahead = forward_of(way.start.place[2])
    left = wp.cross(wp.vec3(0.0, 0.0, 1.0), ahead)
    return wp.vec2(wp.dot(off, ahead), wp.dot(off, left))


@wp.kernel
def judge_walk(
    way: Way,
    body: Body,
    rotation: wp.array2d(dtype=wp.quat),
    position: wp.array2d(dtype=wp.vec3),
    velocity: wp.array2d(dtype=wp.vec3),
    step_count: wp.array(dtype=int),
    action: wp.array3d(dtype=float),
    left_load: wp.array(dtype=float),
    # out
    terms: wp.array3d(dtype=float),
    metrics: wp.array3d(dtype=float),
    success: wp.array2d(dtype=wp.bool),
    terminated: wp.array2d(dtype=wp.bool),
):
    """Reward of going ahead upright and foot by foot, and its cost. The step counter has not moved yet."""
    e = wp.tid()
    rule = way.upright
    now = posture_of(rule, body, e, rotation, position)
    ahead = forward_of(way.start.place[2])
    speed = wp.dot(velocity[e, 0], ahead)
    facing = wp.quat_rotate(rotation[e, 0], wp.vec3(0.0, -1.0, 0.0))
    facing[2] = 0.0
    off_way = wp.acos(wp.clamp(wp.dot(wp.normalize(facing), ahead), -1.0, 1.0))
    gone = way_gone(way, body, e, position[e, 0])
    time = way.control_dt * float(step_count[e] + 1)
    mean_speed = gone[0] / time
    in_turn = turn_taken(way.gait, step_count[e], left_load[e])
    lead = lead_of_left_foot(position, e, ahead)
    stride = in_turn * (0.5 + 0.5 * stepped(way.gait, step_count[e], lead))
    hips_straight = tolerance(tilt_of(rotation[e, 0]), 0.1, rule.tilt_margin)
    fast = now.high * tolerance(wp.abs(speed - way.speed), 0.1 * way.speed, way.speed)
    terms[e, 0, 0] = (0.7 - way.gait.worth) * fast
    terms[e, 0, 1] = way.gait.worth * now.high * stride * hips_straight
    terms[e, 0, 2] = 0.1 * now.high * tolerance(off_way, 0.1, way.heading_margin)
    terms[e, 0, 3] = 0.1 * now.high
    terms[e, 0, 4] = 0.1 * now.straight
    terms[e, 0, 5] = -rule.control_cost * mean_square_action(action, e, 0)
    write_posture(now, e, metrics)
    metrics[e, 0, 3] = speed
    metrics[e, 0, 4] = mean_speed
    metrics[e, 0, 5] = gone[0]
    standing = now.head >= rule.stand_head
    success[e, 0] = standing and mean_speed >= _PACE * way.speed and gone[0] >= way.speed
    fallen = is_down(wp.vec2(now.head, now.pelvis), way.least)
    behind = _PACE * way.speed * time - gone[0] > way.most_behind
    terminated[e, 0] = fallen or behind or wp.abs(gone[1]) > way.lane or wp.abs(gone[0]) > way.length


@wp.kernel
def observe_walk(
    way: Way,
    body: Body,
    agent: int,
    start: int,
    rotation: wp.array2d(dtype=wp.quat),
    position: wp.array2d(dtype=wp.vec3),
    # out
    observation: wp.array3d(dtype=float),
):
    """The way's direction and the distance from it, from component ``start``."""
    e = wp.tid()
    write_vector(observation, e, agent, start, wp.quat_rotate_inv(rotation[e, 0], forward_of(way.start.place[2])))
    observation[e, agent, start + 3] = way_gone(way, body, e, position[e, 0])[1]


class WalkTask(Task):
    """Walk straight ahead."""

    Config = WalkConfig
    description = "walk straight ahead at 1 m/s by the strength of one's own joints"
    observation_terms = (
        *UPRIGHT_TERMS,
        ObservationTerm("way_direction", 3, "-", "root", "where to go: a unit vector"),
        ObservationTerm("way_offset", 1, "m", "world", "distance of the pelvis from the way, to the left"),
    )
    reward_terms = ("speed", "gait", "heading", "height", "upright", "control", "ease")
    metrics = ("head_height", "pelvis_height", "tilt_deg", "speed", "mean_speed", "distance")

    summary = """The avatar stands on the ground with its joints a little bent at random (`pose_noise`) and shall walk
straight ahead at `target_speed`, where it faces at first; nothing holds it but what its joints can do. Faster is no
better than slower, and who falls behind a pace of 0.9 of the target, by `most_behind`, is out. The way is as long as
one comes in an episode at 1.5 times the target; it ends at `lane` to either side. (With `control="pose"` nothing moves
the pelvis: that is for poses, not for walking.)

Feet shall bear the body in turn and pass each other, by a clock that begins with the episode. The avatar sees it in
two numbers, `gait_phase`: its sine, positive while the left foot bears, and its cosine. With it arms hang, and swing
against the legs: those that do not act, and under `control="pd"` the pose that is asked for at action 0 (upper arms 34
degrees lower than at rest, elbows stretched by 29, though actions reach but 20). With `gait.worth=0` there is no
clock, and how it gets ahead is its own affair: hopping on both feet does."""
    reward_docs: ClassVar[Mapping[str, str]] = {
        "speed": "0.7 - `gait.worth` while the pelvis moves ahead at `target_speed` give or take a tenth; "
        "beyond it a Gaussian that has fallen to a tenth after another `target_speed`; all times `height` / 0.1",
        "gait": f"`gait.worth` {GAIT_DOC}; all times `height` / 0.1, and less where the pelvis tilts, as `upright` is "
        "where the chest does",
        "heading": "0.1 while the pelvis faces the way within 0.1 rad; beyond it a Gaussian that has fallen to 0.01 "
        "after another `heading_margin`; all times `height` / 0.1",
        "height": "0.1 while the head is no lower than 0.95 of its height in the rest pose; below it a Gaussian that "
        "has fallen to 0.01 after another `upright.height_margin` of that height",
        "upright": "0.1 while the chest tilts by at most 0.1 rad; beyond it a Gaussian that has fallen to 0.01 after "
        "another `upright.tilt_margin`",
        "control": "`-control_cost` times the mean of the squared action components",
        "ease": EASE_DOC,
    }
    metric_docs: ClassVar[Mapping[str, str]] = {
        **METRIC_DOCS,
        "speed": "of the pelvis ahead [m/s]",
        "mean_speed": "distance over the time of the episode so far [m/s]",
        "distance": "that the pelvis has come ahead [m]",
    }
    success_doc = (
        f"`mean_speed` is at least {_PACE} `target_speed`, over at least as many metres as the target goes in a "
        "second, and the head is no lower than `upright.stand_head` of its height in the rest pose"
    )
    termination_doc = (
        f"{FALL_DOC};\n- the pelvis is more than `lane` aside of the way, or beyond its end;\n- the pelvis is "
        f"more than `most_behind` behind a pace of {_PACE} `target_speed`, unless that is None"
    )
    picture_seconds = 0.3
    picture_actions: ClassVar[Mapping[str, float]] = {
        "left_hip.x": 0.4, "left_knee.x": 0.1, "right_hip.x": -0.22, "right_knee.x": 0.15, "left_shoulder.x": -0.2,
        "right_shoulder.x": 0.3,
    }  # fmt: skip

    config: WalkConfig

    def __init__(self, config: WalkConfig) -> None:
        super().__init__(config)
        #: whether there is a clock
        self.clocked = config.gait.worth > 0.0
        self.targets_about_reference = self.clocked and config.control.mode != "pose"
        check_gait(config.gait, config.target_speed, config.physics.control_dt)

    def terms(self) -> tuple[ObservationTerm, ...]:
        return (*self.observation_terms, GAIT_TERM) if self.clocked else self.observation_terms

    def domain(self) -> Domain:
        """Room on the whole way and beside it."""
        x, y, yaw = self._place()
        ahead = np.array([np.sin(yaw), -np.cos(yaw)]) * self._length()
        return Domain().around([(x, y), (x + ahead[0], y + ahead[1])])

    def _place(self) -> tuple[float, float, float]:
        avatar = self.scene.avatars[0]
        return (*avatar.position, avatar.yaw)

    def _length(self) -> float:
        return FASTEST * self.config.target_speed * self.config.episode_seconds

    def allocate(self, env) -> None:
        config, way, start = self.config, Way(), PlaceRule()
        self.grounding = Grounding(env)
        self.reference_rotation = wp.zeros((env.num_envs, NUM_JOINTS), dtype=wp.quat, device=env.device)
        start.place = wp.vec3(*self._place())
        way.start, way.speed, way.lane, way.length = start, config.target_speed, config.lane, self._length()
        way.most_behind = np.inf if config.most_behind is None else config.most_behind
        way.heading_margin, way.control_dt = config.heading_margin, config.physics.control_dt
        way.least, way.upright = config.fall.least, upright_rule(config.upright, config.control_cost)
        points = env.simulation.flesh[0].points
        way.gait = gait_rule(config.gait, config.target_speed, config.physics.control_dt, points, env.device)
        self.left_load = wp.zeros(env.num_envs, dtype=float, device=env.device)
        self.way, self.ease = way, ease_rule(config.ease_cost, env.device)

    def record_reset(self, env, graph) -> None:
        record_standing(env, graph, self.config.pose_noise)
        if self.targets_about_reference:
            command = env.simulation.avatar.state.command_rotation
            graph.launch(hang_arms, command.shape, [env.mask, self.way.gait], [command])
        self.grounding.record_reset(env, graph)

    def record_references(self, env, graph) -> list[tuple[wp.array, wp.array]]:
        if not self.targets_about_reference:
            return super().record_references(env, graph)
        state, reference = env.simulation.avatar.state, self.reference_rotation
        inputs = [self.way.gait, env.step_count, state.command_rotation]
        graph.launch(swing_arms, reference.shape, inputs, [reference])
        return [(reference, state.command_root)]

    def record_outcome(self, env, graph) -> None:
        avatar = env.simulation.avatar
        t, sim = avatar.tracked, env.simulation
        if self.clocked:
            inputs = [self.way.gait, avatar.body, t.position, sim.sensors, sim.state.x]
            graph.launch(weigh_feet, env.num_envs, inputs, [self.left_load])
        graph.launch(
            judge_walk,
            env.num_envs,
            [
                self.way, avatar.body, t.rotation, t.position, t.velocity, env.step_count, env.action,
                self.left_load,
            ],
            [env.terms, env.metrics, env.success, env.terminated],
        )  # fmt: skip
        if self.config.ease_cost > 0.0:
            record_ease(env, graph, self.ease, self.reward_terms.index("ease"))

    def record_observe(self, env, graph, agent: int, start: int) -> None:
        avatar = env.simulation.avatars[agent]
        at = record_observe_upright(env, graph, agent, start)
        graph.launch(
            observe_walk,
            env.num_envs,
            [self.way, avatar.body, agent, at, avatar.tracked.rotation, avatar.tracked.position],
            [env.observation],
        )
        if self.clocked:
            record_observe_gait(env, graph, self.way.gait, agent, at + _WAY_SIZE)


TASK = WalkTask
