"""PushRecovery: keep one's balance while soft balls, light and heavy, push from anywhere at any moment."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, ClassVar

from pydantic import Field

from piavatar_envs.config import ControlConfig, EnvConfig, PropConfig, SceneConfig, TorqueControlConfig, replace
from piavatar_envs.envs.observations import ObservationTerm
from piavatar_envs.envs.parameters import Drawn
from piavatar_envs.envs.task import Task
from piavatar_envs.sim.randomize import Parameter
from piavatar_envs.sim.scene import Domain
from piavatar_envs.tasks.common.fall import FallConfig
from piavatar_envs.tasks.common.ground import Grounding
from piavatar_envs.tasks.common.pushes import Pushes
from piavatar_envs.tasks.common.ranges import DistanceRange, MassRange, SpeedRange, Weight, check_ranges
from piavatar_envs.tasks.common.throws import make_throws, throwing_domain, thrown_speed, waiting_places
from piavatar_envs.tasks.common.upright import (
    FALL_DOC,
    METRIC_DOCS,
    METRICS,
    REWARD_DOCS,
    REWARD_TERMS,
    STANDING_DOC,
    UPRIGHT_TERMS,
    StillConfig,
    UprightConfig,
    record_fall,
    record_observe_upright,
    record_standing_outcome,
    still_rule,
    upright_rule,
)

BALL = "ball"


class PushRecoveryConfig(EnvConfig):
    """Settings of PushRecovery."""

    control: ControlConfig = Field(default_factory=TorqueControlConfig, description="how actions move the body")
    upright: UprightConfig = Field(default_factory=UprightConfig, description="what counts as standing")
    still: StillConfig = Field(default_factory=StillConfig, description="where rewards of standing still end")
    fall: FallConfig = Field(default_factory=FallConfig, description="what counts as a fall")
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
        """Balls that are thrown: always the same one."""
        return 1


class PushRecoveryTask(Task):
    """Stand still in the rest pose, whatever pushes."""

    Config = PushRecoveryConfig
    description = "keep one's balance while soft balls of 0.5 to 8 kg push from anywhere"
    observation_terms = (
        *UPRIGHT_TERMS,
        ObservationTerm("ball_position", 3, "m", "root", "the ball, from its throw until it is caught; else zeros"),
        ObservationTerm("ball_velocity", 3, "m/s", "root", "its velocity relative to the pelvis, likewise"),
    )
    reward_terms = REWARD_TERMS
    metrics = (*METRICS, "impulse", "push_impulse", "strongest_push")

    summary = """The avatar stands by the strength of its own joints, as in Stand, and once in every `throw_interval`,
at a random moment of its first half, a soft ball is thrown at its trunk, between pelvis and chest, from a random
direction and `throw_distance` away. A ball weighs the same for an episode, anything in the range `ball_mass`, which is
drawn uniformly in its logarithm; the heaviest at the greatest speed carries 40 N s, which would set the whole body in
motion by half a metre a second. The ball is seen while it flies, its mass is not. It pushes by contact like anything
else, and may come to lie before the feet; one that has flown past is caught and waits. `info["strongest_push"]` is the
greatest impulse of the episode so far: of all episodes, the share that lasts may be told by it."""
    reward_docs: ClassVar[Mapping[str, str]] = REWARD_DOCS
    metric_docs: ClassVar[Mapping[str, str]] = {
        **METRIC_DOCS,
        "impulse": "size of the ball's impulse on the body in this step [N s]",
        "push_impulse": "size of its impulse since it was thrown last [N s]",
        "strongest_push": "greatest `push_impulse` of the episode so far [N s]",
    }
    success_doc = f"{STANDING_DOC}, and a throw has pushed with at least `hit_impulse`"
    termination_doc = FALL_DOC
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
        return (Drawn(env.simulation.props.density[:, 0], self.pushes.throws.volume),)

    def domain(self) -> Domain:
        return throwing_domain(self.config, self.place)

    def allocate(self, env) -> None:
        self.rule = upright_rule(self.config.upright, self.config.control_cost)
        self.still = still_rule(self.config.still)
        self.grounding = Grounding(env)
        throws = make_throws(self.config, self.place, self.waiting, env, aim=("pelvis", "spine3"), log_mass=True)
        self.pushes = Pushes(env, throws)

    def arrays(self) -> dict:
        return self.pushes.arrays()

    def record_reset(self, env, graph) -> None:
        self.grounding.record_standing(env, graph, self.config.pose_noise)
        self.pushes.record_reset(env, graph)

    def record_references(self, env, graph) -> list:
        self.pushes.record_throw(env, graph)
        return super().record_references(env, graph)

    def record_outcome(self, env, graph) -> None:
        record_standing_outcome(env, graph, self.rule, self.still)
        self.pushes.record_outcome(env, graph, len(METRICS), self.config.hit_impulse)
        record_fall(env, graph, self.config.fall)

    def record_observe(self, env, graph, agent: int, start: int) -> None:
        self.pushes.record_observe(env, graph, agent, record_observe_upright(env, graph, agent, start))


TASK = PushRecoveryTask
