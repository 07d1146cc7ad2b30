"""What counts as a fall where nothing holds the root: head or pelvis too low.

Heights are shares of those in the rest pose of the body at hand, so that they mean the same for small and tall ones.
"""

from __future__ import annotations

import math

import warp as wp
from pydantic import BaseModel, Field

from piavatar_envs.avatar.body.skeleton import joint_index
from piavatar_envs.avatar.types import Body
from piavatar_envs.config import FROZEN, EnvConfig
from piavatar_envs.mpm.types import row

wp.set_module_options({"enable_backward": False})

_HEAD = wp.constant(joint_index("head"))


class FallConfig(BaseModel):
    """How low is too low."""

    model_config = FROZEN

    fall_head: float = Field(0.7, ge=0.0, lt=1.0, description="head height below which it has fallen, a share [-]")
    fall_pelvis: float = Field(0.6, ge=0.0, lt=1.0, description="pelvis height below which it has, likewise [-]")

    @property
    def least(self) -> wp.vec2:
        """Shares of head and pelvis below which somebody has fallen."""
        return wp.vec2(self.fall_head, self.fall_pelvis)


#: When somebody has fallen, by the settings of a section ``fall``.
FALLEN_DOC = (
    "its head is lower than `fall.fall_head`, or its pelvis lower than `fall.fall_pelvis`, of its height in the rest "
    "pose (of the mean body 1.46 and 0.91 m)"
)
#: What ends episodes, or the part of an agent in them, where :func:`least_heights` are asked of it.
UNDER_TORQUES_DOC = f'under `control="pd"` or `"torque"` an avatar falls: {FALLEN_DOC}'


def least_heights(config: EnvConfig, fall: FallConfig) -> wp.vec2:
    """Shares of head and pelvis below which somebody has fallen, who moves the joints by torques.

    Where a wrench holds the root, its letting go is the fall, and no posture is.
    """
    if config.control.mode == "pose":
        return wp.vec2(-math.inf, -math.inf)
    return fall.least


@wp.func
def heights_of(body: Body, e: int, position: wp.array2d(dtype=wp.vec3)):
    """Heights of head and pelvis over those in the rest pose."""
    r = row(e, body.rest_joint.shape[0])
    head = position[e, _HEAD][2] / body.rest_joint[r, _HEAD][2]
    return wp.vec2(head, position[e, 0][2] / body.rest_joint[r, 0][2])


@wp.func
def is_down(heights: wp.vec2, least: wp.vec2):
    """Whether head or pelvis are too low."""
    return heights[0] < least[0] or heights[1] < least[1]
