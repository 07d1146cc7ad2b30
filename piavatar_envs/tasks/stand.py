"""Stand: keep balance under gravity by the strength of the joints."""

from __future__ import annotations

from pydantic import Field

from piavatar_envs.config import ControlConfig, EnvConfig, TorqueControlConfig
from piavatar_envs.tasks.common.fall import FallConfig
from piavatar_envs.tasks.common.ranges import Weight
from piavatar_envs.tasks.common.upright import StandingTask, StillConfig, UprightConfig


class StandConfig(EnvConfig):
    """Settings of Stand."""

    control: ControlConfig = Field(default_factory=TorqueControlConfig, description="how actions move the body")
    upright: UprightConfig = Field(default_factory=UprightConfig, description="limit and margins of being upright")
    still: StillConfig = Field(default_factory=StillConfig, description="margins of the rewards of standing still")
    fall: FallConfig = Field(default_factory=FallConfig, description="limits of a fall")
    episode_seconds: float = Field(10.0, gt=0.0, le=3600.0, description="simulated time until truncation [s]")
    control_cost: Weight = Field(0.05, description="weight of the mean squared action [-]")
    pose_noise: float = Field(0.05, ge=0.0, le=0.5, description="greatest joint angle of the first pose [rad]")


class StandTask(StandingTask):
    """Stand still in the rest pose."""

    Config = StandConfig
    description = "keep balance with joint torques alone"
    summary = """The avatar stands on the ground with its joints slightly bent at random (`pose_noise`). Only its joints
hold it up: actions are joint targets (`control="pd"`) or torques, and `root_assist` is 0. With the rest pose as a
constant target the body tips over within two seconds. A good agent presses the balls of the feet or the heels to the
ground and bends the hips before the body's weight has left the soles. The place where it stands does not matter."""
    picture_seconds = 0.5
    picture_actions = "zero"

    config: StandConfig


TASK = StandTask
