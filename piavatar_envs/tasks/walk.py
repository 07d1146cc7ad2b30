"""Walk: go straight ahead at a given speed, by the strength of the joints, one foot after the other."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import numpy as np
import warp as wp
from pydantic import Field

from piavatar_envs.avatar.body.skeleton import NUM_JOINTS
from piavatar_envs.config import ControlConfig, EnvConfig, TorqueControlConfig
from piavatar_envs.core.structs import fill
from piavatar_envs.envs.episodes import Bones, Episodes, Outcome
from piavatar_envs.envs.observations import ObservationTerm, write_vector
from piavatar_envs.envs.task import Metric, Task, TaskArray, Term
from piavatar_envs.mpm.types import Sensors
from piavatar_envs.sim.scene import Domain
from piavatar_envs.tasks.common.fall import FallConfig, is_down
from piavatar_envs.tasks.common.gait import (
    GAIT_REWARD,
    GAIT_TERM,
    POSTURE_COST,
    Gait,
    GaitConfig,
    check_gait,
    hang_arms,
    left_load_share,
    load_reward,
    make_gait,
    phase_of,
    posture_excess,
    step_reward,
    swing_arms,
)
from piavatar_envs.tasks.common.ranges import Margin, Weight
from piavatar_envs.tasks.common.rewards import CONTROL, mean_square_action, tolerance
from piavatar_envs.tasks.common.spawn import Grounding, forward_of, pelvis_at, record_standing
from piavatar_envs.tasks.common.upright import (
    FALL_DOC,
    POSTURE_METRICS,
    UPRIGHT_TERMS,
    Upright,
    UprightConfig,
    posture_of,
    record_observe_upright,
    tilt_of,
    upright_rewards,
    write_posture,
)

wp.set_module_options({"enable_backward": False})

#: Mean speed over the target's that no walker exceeds: the domain ends there.
FASTEST = 1.5
#: Pace: share of the target speed that success requires.
_PACE = wp.constant(0.9)


class WalkConfig(EnvConfig):
    """Settings of Walk."""

    control: ControlConfig = Field(default_factory=TorqueControlConfig, description="how actions move the body")
    upright: UprightConfig = Field(default_factory=UprightConfig, description="limit and margins of being upright")
    gait: GaitConfig = Field(default_factory=GaitConfig, description="feet that bear the body in turn, by a clock")
    fall: FallConfig = Field(default_factory=FallConfig, description="limits of a fall")
    episode_seconds: float = Field(10.0, gt=0.0, le=3600.0, description="simulated time until truncation [s]")
    target_speed: float = Field(1.0, gt=0.0, le=5.0, description="speed ahead [m/s]")
    lane: float = Field(1.0, gt=0.0, le=2.0, description="distance from the path at which the episode ends [m]")
    max_lag: float | None = Field(
        1.5,
        gt=0.0,
        le=1000.0,
        description="distance behind the pace at which the episode ends; None: there is no pace [m]",
    )
    heading_margin: Margin = Field(0.8, description="angle from the path at which the reward is 0.1 [rad]")
    control_cost: Weight = Field(0.05, description="weight of the mean squared action [-]")
    posture_cost: Weight = Field(0.0, description="weight of the joints' excess over a human gait's [1/rad^2]")
    pose_noise: float = Field(0.05, ge=0.0, le=0.5, description="greatest joint angle of the first pose [rad]")


@wp.struct
class Path:
    """Constants of the path, and of a fall on it."""

    start: wp.vec3  # x, y [m] and yaw [rad]
    target_speed: float  # [m/s]
    lane: float  # [m]
    max_lag: float  # [m]
    length: float  # [m]
    heading_margin: float  # [rad]
    control_dt: float  # [s]
    least: wp.vec2  # shares of head and pelvis below which it has fallen
    upright: Upright
    gait: Gait


@wp.func
def distance_along_path(path: Path, bones: Bones, e: int):
    """Return the distances of the pelvis along the path and to the left of it [m]."""
    off = bones.position[e, 0] - pelvis_at(path.start, bones.body, e)
    ahead = forward_of(path.start[2])
    left = wp.cross(wp.vec3(0.0, 0.0, 1.0), ahead)
    return wp.dot(off, ahead), wp.dot(off, left)


@wp.kernel
def judge_walk(
    path: Path,
    bones: Bones,
    episodes: Episodes,
    sensors: Sensors,
    x: wp.array2d(dtype=wp.vec3),
    action: wp.array3d(dtype=float),
    # out
    outcome: Outcome,
):
    """Reward going ahead upright and foot by foot. `step_count` is incremented after the outcome."""
    e = wp.tid()
    upright = path.upright
    now = posture_of(upright, bones, e)
    ahead = forward_of(path.start[2])
    speed = wp.dot(bones.velocity[e, 0], ahead)
    facing = wp.quat_rotate(bones.rotation[e, 0], wp.vec3(0.0, -1.0, 0.0))
    facing[2] = 0.0
    heading_error = wp.acos(wp.clamp(wp.dot(wp.normalize(facing), ahead), -1.0, 1.0))
    distance, aside = distance_along_path(path, bones, e)
    time = path.control_dt * float(episodes.step_count[e] + 1)
    mean_speed = distance / time
    stride = float(0.0)
    if path.gait.weight > 0.0:
        load_score = load_reward(path.gait, episodes.step_count[e], left_load_share(path.gait, bones, sensors, x, e))
        stride = load_score * (0.5 + 0.5 * step_reward(path.gait, episodes.step_count[e], bones, e, ahead))
    hips_straight = tolerance(tilt_of(bones.rotation[e, 0]), 0.1, upright.tilt_margin)
    fast = now.high * tolerance(wp.abs(speed - path.target_speed), 0.1 * path.target_speed, path.target_speed)
    outcome.terms[e, 0, WalkTask.rewards.speed] = (0.7 - path.gait.weight) * fast
    outcome.terms[e, 0, WalkTask.rewards.gait] = path.gait.weight * now.high * stride * hips_straight
    outcome.terms[e, 0, WalkTask.rewards.heading] = 0.1 * now.high * tolerance(heading_error, 0.1, path.heading_margin)
    outcome.terms[e, 0, WalkTask.rewards.height] = 0.1 * now.high
    outcome.terms[e, 0, WalkTask.rewards.upright] = 0.1 * now.straight
    outcome.terms[e, 0, WalkTask.rewards.control] = -upright.control_cost * mean_square_action(action, e, 0)
    if path.gait.posture_cost > 0.0:
        outcome.terms[e, 0, WalkTask.rewards.posture] = -path.gait.posture_cost * posture_excess(path.gait, bones, e)
    write_posture(now, e, outcome)
    outcome.metrics[e, 0, WalkTask.metrics.speed] = speed
    outcome.metrics[e, 0, WalkTask.metrics.mean_speed] = mean_speed
    outcome.metrics[e, 0, WalkTask.metrics.distance] = distance
    standing = now.head >= upright.stand_head
    outcome.success[e, 0] = standing and mean_speed >= _PACE * path.target_speed and distance >= path.target_speed
    fallen = is_down(wp.vec2(now.head, now.pelvis), path.least)
    behind = _PACE * path.target_speed * time - distance > path.max_lag
    outcome.terminated[e, 0] = fallen or behind or wp.abs(aside) > path.lane or wp.abs(distance) > path.length


@wp.kernel
def observe_walk(
    path: Path,
    bones: Bones,
    episodes: Episodes,
    agent: int,
    start: int,
    # out
    observation: wp.array3d(dtype=float),
):
    """Write the path's direction, the distance from it and, with a clock, its phase from component ``start``."""
    e = wp.tid()
    write_vector(observation, e, agent, start, wp.quat_rotate_inv(bones.rotation[e, 0], forward_of(path.start[2])))
    _distance, aside = distance_along_path(path, bones, e)
    observation[e, agent, start + 3] = aside
    if path.gait.weight > 0.0:
        phase = phase_of(path.gait, float(episodes.step_count[e]))
        observation[e, agent, start + 4] = wp.sin(phase)
        observation[e, agent, start + 5] = wp.cos(phase)


class WalkTask(Task):
    """Walk straight ahead."""

    Config = WalkConfig
    description = "walk straight ahead at a given speed with joint torques alone"
    observation_terms = (
        *UPRIGHT_TERMS,
        ObservationTerm("path_direction", 3, "-", "root", "direction of the path: a unit vector"),
        ObservationTerm("path_offset", 1, "m", "world", "distance of the pelvis from the path, to the left"),
    )
    rewards = (
        Term(
            "speed",
            "0.7 - `gait.weight` while the pelvis moves ahead at `target_speed` within a tenth of it; beyond that a "
            "Gaussian that has fallen to a tenth after another `target_speed`; all times `height` / 0.1",
        ),
        GAIT_REWARD,
        Term(
            "heading",
            "0.1 while the pelvis faces along the path within 0.1 rad; beyond it a Gaussian that has fallen to 0.01 "
            "after another `heading_margin`; all times `height` / 0.1",
        ),
        *upright_rewards(0.1),
        CONTROL,
        POSTURE_COST,
    )
    metrics = (
        *POSTURE_METRICS,
        Metric("speed", "m/s", "speed of the pelvis ahead"),
        Metric("mean_speed", "m/s", "distance over the time of the episode so far"),
        Metric("distance", "m", "distance that the pelvis has come ahead"),
    )
    scratch_arrays = (TaskArray("reference_rotation", wp.quat, (NUM_JOINTS,)),)

    summary = """The avatar stands on the ground with its joints slightly bent at random (`pose_noise`) and must walk
straight ahead at `target_speed`, in its first heading; only its joints hold it up. Faster is no better than slower, and
an avatar that falls behind a pace of 0.9 of the target by `max_lag` is out. The path is as long as an episode at 1.5
times the target; `lane` bounds it to either side. (With `control="pose"` nothing moves the pelvis: that is for poses,
not for walking.)

Feet are rewarded for bearing the body in turn and passing each other, in time with a clock that starts with the
episode. It is observed as two numbers, `gait_phase`: its sine, positive while the left foot should bear the load, and
its cosine. With the clock,
arms that do not act hang and swing against the legs; under `control="pd"` so does the reference pose of action 0
(upper arms 34 degrees lower than at rest, elbows stretched by 29, although actions reach only 20). With
`gait.weight=0` there is no clock, and any way to get ahead counts, such as hopping on both feet."""
    success_doc = (
        f"`mean_speed` is at least {_PACE} `target_speed`, over at least the distance of one second at the target, and "
        "the head is no lower than `upright.stand_head` of its height in the rest pose"
    )
    termination_doc = (
        f"{FALL_DOC};\n- the pelvis is more than `lane` to the side of the path, or beyond its end;\n- the pelvis is "
        f"more than `max_lag` behind a pace of {_PACE} `target_speed`, unless that is None"
    )
    picture_seconds = 0.3
    picture_actions: ClassVar[Mapping[str, float]] = {
        "left_hip.x": 0.4, "left_knee.x": 0.1, "right_hip.x": -0.22, "right_knee.x": 0.15, "left_shoulder.x": -0.2,
        "right_shoulder.x": 0.3,
    }  # fmt: skip

    config: WalkConfig

    def __init__(self, config: WalkConfig) -> None:
        super().__init__(config)
        self.clocked = config.gait.weight > 0.0
        self.targets_about_reference = self.clocked and config.control.mode != "pose"
        check_gait(config.gait, config.target_speed, config.physics.control_dt)

    def terms(self) -> tuple[ObservationTerm, ...]:
        return (*self.observation_terms, GAIT_TERM) if self.clocked else self.observation_terms

    def domain(self) -> Domain:
        """Include the whole path and its sides."""
        x, y, yaw = self._place()
        ahead = np.array([np.sin(yaw), -np.cos(yaw)]) * self._length()
        return Domain().around([(x, y), (x + ahead[0], y + ahead[1])])

    def _place(self) -> tuple[float, float, float]:
        avatar = self.scene.avatars[0]
        return (*avatar.position, avatar.yaw)

    def _length(self) -> float:
        return FASTEST * self.config.target_speed * self.config.episode_seconds

    def allocate(self, env) -> None:
        config, dt, points = self.config, self.config.physics.control_dt, env.simulation.flesh[0].points
        self.grounding = Grounding(env)
        self.path = fill(
            Path(),
            config,
            config.fall,
            start=wp.vec3(*self._place()),
            max_lag=np.inf if config.max_lag is None else config.max_lag,
            length=self._length(),
            control_dt=dt,
            upright=fill(Upright(), config.upright, config),
            gait=make_gait(config.gait, config.target_speed, config.posture_cost, dt, points, env.device),
        )

    def record_reset(self, env, graph) -> None:
        command = env.simulation.avatar.state.command_rotation
        record_standing(env, graph, self.config.pose_noise)
        if self.targets_about_reference:
            graph.launch(hang_arms, command.shape, [self.path.gait, env.episodes], [command])
        self.grounding.record_reset(env, graph)

    def record_references(self, env, graph) -> list[tuple[wp.array, wp.array]]:
        if not self.targets_about_reference:
            return super().record_references(env, graph)
        state, reference = env.simulation.avatar.state, self.reference_rotation
        inputs = [self.path.gait, env.episodes, state.command_rotation]
        graph.launch(swing_arms, reference.shape, inputs, [reference])
        return [(reference, state.command_root)]

    def record_outcome(self, env, graph) -> None:
        sim = env.simulation
        inputs = [self.path, env.bones[0], env.episodes, sim.sensors, sim.state.x, env.action]
        graph.launch(judge_walk, env.num_envs, inputs, [env.outcome])

    def record_observe(self, env, graph, agent: int, start: int) -> None:
        start = record_observe_upright(env, graph, agent, start)
        inputs = [self.path, env.bones[agent], env.episodes, agent, start]
        graph.launch(observe_walk, env.num_envs, inputs, [env.observation])


TASK = WalkTask
