"""Feet that bear the body in turn, by a clock, and arms that swing with them.

A clock makes a gait out of what gets ahead: without one, hopping on both feet does as well (Siekmann, Godse, Fern &
Hurst, "Sim-to-Real Learning of All Common Bipedal Gaits via Periodic Reward Composition", ICRA 2021). At phase 0 the
left foot has just come down in front; it bears while the right one swings, and from half a stride on the right one
bears. In the mirror the clock is half a stride on.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import warp as wp
from pydantic import BaseModel, Field

from piavatar_envs.avatar.rotation import quat_exp
from piavatar_envs.avatar.skeleton import joint_index
from piavatar_envs.envs.config import FROZEN
from piavatar_envs.envs.observations import ObservationTerm
from piavatar_envs.tasks.rewards import tolerance

if TYPE_CHECKING:
    from piavatar_envs.envs.batch_env import BatchEnv
    from piavatar_envs.mpm.program import Program

wp.set_module_options({"enable_backward": False})

GAIT_TERM = ObservationTerm(
    "gait_phase", 2, "-", "-", "sine and cosine of the gait's clock: while the sine is positive the left foot bears"
)
GAIT_DOC = (
    "(0 by default) while the left foot's share of what the ground bears is within 0.2 of the clock's: all of it in "
    "the first half of every `gait.stride_seconds`, none in the second, a tenth each to go over; beyond it a Gaussian "
    "that has fallen to a tenth after another 0.4; nothing while neither foot bears"
)

#: Share of a stride in which the load goes from one foot to the other: adults have 0.1, twice a stride (Perry &
#: Burnfield, "Gait Analysis", 2010).
_HANDOVER = 0.1
_STEEPNESS = wp.constant(0.5 / math.sin(math.pi * _HANDOVER))
_LEFT_SHOULDER, _RIGHT_SHOULDER = (wp.constant(joint_index(f"{side}_shoulder")) for side in ("left", "right"))
_LEFT_ELBOW, _RIGHT_ELBOW = (wp.constant(joint_index(f"{side}_elbow")) for side in ("left", "right"))
#: From the rest pose, in which arms are lowered by some 45 degrees, to arms that hang, and how far elbows are bent then
#: [rad].
_HANGING, _BENT = wp.constant(0.6), wp.constant(0.3)


class GaitConfig(BaseModel):
    """A gait, and the clock by which it goes."""

    model_config = FROZEN

    worth: float = Field(
        0.0, ge=0.0, le=0.7, description="reward for feet that bear in turn, out of that of speed; 0 for no clock [-]"
    )
    stride_seconds: float = Field(1.0, ge=0.2, le=5.0, description="time of two steps, one of each foot [s]")
    arm_swing: float = Field(
        0.3, ge=0.0, le=0.6, description="how far shoulders that do not act swing to the front and to the back [rad]"
    )


@wp.struct
class Gait:
    """Constants of a gait."""

    worth: float  # reward
    stride: float  # [control steps]
    arm_swing: float  # [rad]


def gait_rule(config: GaitConfig, control_dt: float) -> Gait:
    """Kernel argument."""
    rule = Gait()
    rule.worth = config.worth
    rule.stride, rule.arm_swing = config.stride_seconds / control_dt, config.arm_swing
    return rule


@wp.func
def phase_of(gait: Gait, steps: float):
    """Phase after so many control steps [rad], from 0 to 2 pi."""
    strides = steps / gait.stride
    return 2.0 * wp.pi * (strides - wp.floor(strides))


@wp.func
def left_share(phase: float):
    """What the left foot shall bear of the body, from 0 to 1."""
    return wp.clamp(0.5 + _STEEPNESS * wp.sin(phase), 0.0, 1.0)


@wp.func
def turn_taken(gait: Gait, step: int, share: float, impulse: float):
    """What it is worth, from 0 to 1, that the left foot has that ``share`` of the ground's upward ``impulse`` [N s].

    Of the step that the counter counts next, by the clock in its middle.
    """
    if impulse <= 0.0:
        return 0.0
    return tolerance(wp.abs(share - left_share(phase_of(gait, float(step) + 0.5))), 0.2, 0.4)


@wp.func
def arm_pose(gait: Gait, phase: float, b: int):
    """Rotation of a joint relative to its parent: arms hang and swing against the legs, the others are at rest."""
    side = float(0.0)
    if b == _LEFT_SHOULDER:
        side = 1.0
    if b == _RIGHT_SHOULDER:
        side = -1.0
    bent = float(0.0)
    if b == _LEFT_ELBOW:
        bent = _BENT
    if b == _RIGHT_ELBOW:
        bent = _BENT
    # the left arm is behind when the left foot is in front
    ahead = bent - side * gait.arm_swing * wp.cos(phase)
    return quat_exp(wp.vec3(-ahead, 0.0, 0.0)) * quat_exp(wp.vec3(0.0, side * _HANGING, 0.0))


@wp.kernel
def hang_arms(
    mask: wp.array(dtype=wp.bool),
    gait: Gait,
    # in and out
    command_rotation: wp.array2d(dtype=wp.quat),
):
    """First poses of the masked environments: arms as at the beginning of a stride, besides what they are turned."""
    e, b = wp.tid()
    if mask[e] and b > 0:
        command_rotation[e, b] = arm_pose(gait, 0.0, b) * command_rotation[e, b]


@wp.kernel
def swing_arms(
    gait: Gait,
    step_count: wp.array(dtype=int),
    command_rotation: wp.array2d(dtype=wp.quat),
    # out
    reference_rotation: wp.array2d(dtype=wp.quat),
):
    """Pose at the end of the step that the counter counts next; the pelvis' is what is commanded."""
    e, b = wp.tid()
    q = command_rotation[e, b]
    if b > 0:
        q = arm_pose(gait, phase_of(gait, float(step_count[e] + 1)), b)
    reference_rotation[e, b] = q


@wp.kernel
def observe_gait(
    gait: Gait,
    agent: int,
    start: int,
    step_count: wp.array(dtype=int),
    # out
    observation: wp.array3d(dtype=float),
):
    """:data:`GAIT_TERM`, from component ``start``."""
    e = wp.tid()
    phase = phase_of(gait, float(step_count[e]))
    observation[e, agent, start] = wp.sin(phase)
    observation[e, agent, start + 1] = wp.cos(phase)


def record_observe_gait(env: BatchEnv, program: Program, gait: Gait, agent: int, start: int) -> int:
    """Append: write :data:`GAIT_TERM` from component ``start``; returns the one after it."""
    program.launch(observe_gait, env.num_envs, [gait, agent, start, env.step_count], [env.observation])
    return start + GAIT_TERM.size
