"""Dodge: balls are thrown at the avatar; a good one stands as it was told, and still is not hit."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import ClassVar

import numpy as np
import warp as wp
from pydantic import Field

from piavatar_envs.config import EnvConfig, PropConfig, SceneConfig, replace
from piavatar_envs.envs.actions import ActionSpec, speed_within
from piavatar_envs.envs.observations import ObservationTerm
from piavatar_envs.envs.parameters import Drawn
from piavatar_envs.envs.task import Task
from piavatar_envs.sim.randomize import Parameter
from piavatar_envs.sim.scene import Domain
from piavatar_envs.tasks.common.hits import Hits
from piavatar_envs.tasks.common.place import PlaceRule, judge_pose, keep_place, observe_home
from piavatar_envs.tasks.common.ranges import DistanceRange, Margin, MassRange, SpeedRange, Weight, check_ranges
from piavatar_envs.tasks.common.spawn import record_standing
from piavatar_envs.tasks.common.throws import make_throws, record_balls, throwing_domain, thrown_speed, waiting_places
from piavatar_envs.tasks.common.turns import observe_throws, throw_balls

#: Speed of the root at action 1 [m/s].
ROOT_SPEED = 1.5


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


class DodgeTask(Task):
    """Stand in one's place, and get out of the way of balls."""

    Config = DodgeConfig
    description = "stand still, and get out of the way of balls that are thrown at chest and head"
    reward_terms = ("pose", "place", "control")
    cost_terms = ("impulse", "stress")
    metrics = ("rotation_error_deg", "root_error", "impulse", "stress", "hits")

    summary = """Every `throw_interval` one of `num_balls` soft balls is thrown at the avatar's chest or head, from
somewhere before it: `throw_distance` away and up to `throw_angle` off the front. In the first half of the first
interval the first one comes; a ball that has flown past is caught and waits behind the avatar for its turn. The reward
is for standing still in the rest pose; being hit takes nothing off it, but has a `cost` of its own, as in constrained
(safe) reinforcement learning: of all that are hardly hit, a good agent is the one that stands best. Doing nothing earns
all the reward, and every ball hits. The root can be steered up to `root_range` from its place."""
    reward_docs: ClassVar[Mapping[str, str]] = {
        "pose": "0.6 while the mean angle of the joints from the rest pose is at most 0.05 rad; beyond it a Gaussian "
        "that has fallen to 0.06 after another `pose_margin`",
        "place": "0.4 while the pelvis is within 0.02 m of its place; beyond it a Gaussian that has fallen to 0.04 "
        "after another `place_margin`",
        "control": "`-control_cost` times the mean of the squared action components",
    }
    metric_docs: ClassVar[Mapping[str, str]] = {
        "rotation_error_deg": "mean angle of the joints from the rest pose [deg]",
        "root_error": "horizontal distance of the pelvis from its place [m]",
        "impulse": "impulse of the balls on the body in this step, magnitudes summed over the balls [N s]",
        "stress": "peak von Mises stress in head, trunk and arms [young_modulus]",
        "hits": "throws that have hit in this episode [-]",
    }
    cost_docs: ClassVar[Mapping[str, str]] = {
        "impulse": "the metric `impulse` over `impulse_scale`",
        "stress": "how far the metric `stress` exceeds `stress_limit`, over `stress_limit`",
    }
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
            ObservationTerm("time_to_throw", balls, "s", "-", "time until each ball is thrown next"),
            ObservationTerm("ball_mass", balls, "kg", "-", "mass of each ball"),
            ObservationTerm("place_position", 3, "m", "root", "where the pelvis belongs, from where it is"),
        )

    def drawn(self) -> tuple[Parameter, ...]:
        mass = self.config.ball_mass
        return tuple(
            Parameter(f"ball_{index}_mass", "kg", *mass, f"mass of ball {index}")
            for index in range(self.config.num_balls)
        )

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
        n, device, config = env.num_envs, env.device, self.config
        self.throws, self.rule = make_throws(config, self.place, self.waiting, env), PlaceRule()
        rule = self.rule
        # the action comes on top of what is kept within the range
        step = self.action_spec().greatest_speed * config.physics.control_dt
        rule.place, rule.range = wp.vec3(*self.place), config.root_range - step
        rule.pose_margin, rule.place_margin = config.pose_margin, config.place_margin
        rule.control_cost = config.control_cost
        self.reference_root = wp.zeros(n, dtype=wp.vec3, device=device)
        self.placed = wp.zeros((n, config.num_balls), dtype=wp.bool, device=device)
        self.hits = Hits(env, self.throws)

    def arrays(self) -> dict[str, wp.array]:
        return self.hits.arrays()

    def record_reset(self, env, graph) -> None:
        record_standing(env, graph, self.config.pose_noise)
        record_balls(env, graph, self.throws)
        self.hits.record_reset(env, graph)

    def record_references(self, env, graph) -> list[tuple[wp.array, wp.array]]:
        avatar, props = env.simulation.avatar, env.simulation.props
        graph.launch(
            keep_place,
            env.num_envs,
            [self.rule, avatar.body, avatar.state.command_root],
            [self.reference_root],
        )
        graph.launch(
            throw_balls,
            self.placed.shape,
            [
                self.throws, env.seed, env.episode, env.step_count, env.failure, avatar.tracked.position,
                props.state.position, props.state.velocity,
            ],
            [self.placed, props.spawn.position, props.spawn.velocity, props.spawn.spin],
        )  # fmt: skip
        for ball in range(self.config.num_balls):
            props.record_place(graph, env.simulation.state, self.placed[:, ball], ball)
        return [(avatar.state.command_rotation, self.reference_root)]

    def record_outcome(self, env, graph) -> None:
        avatar = env.simulation.avatar
        graph.launch(
            judge_pose,
            env.num_envs,
            [self.rule, avatar.body, avatar.tracked.local, avatar.tracked.position, env.action],
            [env.terms, env.metrics],
        )
        self.hits.record_outcome(env, graph)

    def record_observe(self, env, graph, agent: int, start: int) -> None:
        avatar, balls = env.simulation.avatar, self.config.num_balls
        graph.launch(
            observe_throws,
            self.placed.shape,
            [
                self.throws, env.seed, env.episode, env.step_count, env.simulation.props.density,
                self.config.physics.control_dt, agent, start,
            ],
            [env.observation],
        )  # fmt: skip
        graph.launch(
            observe_home,
            env.num_envs,
            [self.rule, avatar.body, agent, start + 2 * balls, avatar.tracked.rotation, avatar.tracked.position],
            [env.observation],
        )


TASK = DodgeTask
