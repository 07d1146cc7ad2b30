"""Stand: keep one's balance under gravity, by the strength of one's own joints."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

from pydantic import Field

from piavatar_envs.config import ControlConfig, EnvConfig, TorqueControlConfig
from piavatar_envs.envs.task import Task
from piavatar_envs.tasks.common.fall import FallConfig
from piavatar_envs.tasks.common.ground import Grounding
from piavatar_envs.tasks.common.ranges import Weight
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


class StandConfig(EnvConfig):
    """Settings of Stand."""

    control: ControlConfig = Field(default_factory=TorqueControlConfig, description="how actions move the body")
    upright: UprightConfig = Field(default_factory=UprightConfig, description="what counts as standing")
    still: StillConfig = Field(default_factory=StillConfig, description="where rewards of standing still end")
    fall: FallConfig = Field(default_factory=FallConfig, description="what counts as a fall")
    episode_seconds: float = Field(10.0, gt=0.0, le=3600.0, description="simulated time until truncation [s]")
    control_cost: Weight = Field(0.05, description="weight of the mean squared action [-]")
    pose_noise: float = Field(0.05, ge=0.0, le=0.5, description="greatest joint angle of the first pose [rad]")


class StandTask(Task):
    """Stand still in the rest pose."""

    Config = StandConfig
    description = "keep one's balance by the strength of one's own joints"
    observation_terms = UPRIGHT_TERMS
    reward_terms = REWARD_TERMS
    metrics = METRICS

    summary = """The avatar stands on the ground with its joints a little bent at random (`pose_noise`), and nothing
holds it but what its joints can do: actions are joint targets (`control="pd"`) or torques, and `root_assist` is 0. A
rest pose that is merely asked for tips over within two seconds: ankles must press with the balls of the feet or with
the heels, and hips must give way, before the body's weight has left the soles. Where it stands does not matter."""
    reward_docs: ClassVar[Mapping[str, str]] = REWARD_DOCS
    metric_docs: ClassVar[Mapping[str, str]] = METRIC_DOCS
    success_doc = STANDING_DOC
    termination_doc = FALL_DOC
    picture_seconds = 0.5
    picture_actions = "zero"

    config: StandConfig

    def allocate(self, env) -> None:
        self.rule = upright_rule(self.config.upright, self.config.control_cost)
        self.still = still_rule(self.config.still)
        self.grounding = Grounding(env)

    def record_reset(self, env, graph) -> None:
        self.grounding.record_standing(env, graph, self.config.pose_noise)

    def record_outcome(self, env, graph) -> None:
        record_standing_outcome(env, graph, self.rule, self.still)
        record_fall(env, graph, self.config.fall)

    def record_observe(self, env, graph, agent: int, start: int) -> None:
        record_observe_upright(env, graph, agent, start)


TASK = StandTask
