"""Falls: a head or a pelvis that is too low. Heights are shares of those in the body's own rest pose."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import warp as wp
from pydantic import BaseModel, Field

from piavatar_envs.avatar.body.skeleton import joint_index
from piavatar_envs.config import FROZEN, EnvConfig
from piavatar_envs.envs.episodes import Bones, Outcome, rest_joint

if TYPE_CHECKING:
    from piavatar_envs.core.launch_graph import LaunchGraph
    from piavatar_envs.envs.episodes import EpisodeArrays

wp.set_module_options({"enable_backward": False})

_HEAD = wp.constant(joint_index("head"))


class FallConfig(BaseModel):
    """Heights below which an avatar has fallen."""

    model_config = FROZEN

    fall_head: float = Field(0.7, ge=0.0, lt=1.0, description="head height below which it has fallen, a share [-]")
    fall_pelvis: float = Field(0.6, ge=0.0, lt=1.0, description="pelvis height below which it has, likewise [-]")

    @property
    def least(self) -> wp.vec2:
        """The least shares of head and pelvis."""
        return wp.vec2(self.fall_head, self.fall_pelvis)


#: The condition of a fall, by the settings of a section ``fall``.
FALLEN_DOC = (
    "its head is lower than `fall.fall_head`, or its pelvis lower than `fall.fall_pelvis`, of its height in the rest "
    "pose (of the mean body 1.46 and 0.91 m)"
)
#: The condition under torques, by :func:`least_heights`.
UNDER_TORQUES_DOC = f'under `control="pd"` or `"torque"` an avatar falls: {FALLEN_DOC}'


def least_heights(config: EnvConfig, fall: FallConfig) -> wp.vec2:
    """Return the least shares of head and pelvis; minus infinity where a wrench holds the root until it is released."""
    if config.control.mode == "pose":
        return wp.vec2(-math.inf, -math.inf)
    return fall.least


@wp.func
def heights_of(bones: Bones, e: int):
    """Return the heights of head and pelvis over those in the rest pose."""
    head = bones.position[e, _HEAD][2] / rest_joint(bones.body, e, _HEAD)[2]
    return wp.vec2(head, bones.position[e, 0][2] / rest_joint(bones.body, e, 0)[2])


@wp.func
def is_down(heights: wp.vec2, least: wp.vec2):
    """Return whether head or pelvis are too low."""
    return heights[0] < least[0] or heights[1] < least[1]


@wp.kernel
def find_fall(
    least: wp.vec2,
    bones: Bones,
    # out
    outcome: Outcome,
):
    """Terminate environments whose head or pelvis are lower than ``least``."""
    e = wp.tid()
    outcome.terminated[e, 0] = is_down(heights_of(bones, e), least)


def record_fall(env: EpisodeArrays, graph: LaunchGraph, config: FallConfig) -> None:
    """Append: terminate environments whose only avatar has fallen."""
    graph.launch(find_fall, env.num_envs, [config.least, env.bones[0]], [env.outcome])
