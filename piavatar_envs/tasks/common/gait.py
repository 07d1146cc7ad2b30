"""Feet that bear the body in turn, by a clock, and arms that swing with them.

A clock makes a gait out of what gets ahead: without one, hopping on both feet does as well (Siekmann, Godse, Fern &
Hurst, "Sim-to-Real Learning of All Common Bipedal Gaits via Periodic Reward Composition", ICRA 2021). At phase 0 the
left foot has just come down in front; it bears while the right one swings, and from half a stride on the right one
bears. Meanwhile the other foot passes it, and comes down a step's length in front: what a body that leads with one foot
and draws the other up to it never does. In the mirror the clock is half a stride on.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
import warp as wp
from pydantic import BaseModel, Field

from piavatar_envs.avatar.body.asset import dense_weights
from piavatar_envs.avatar.body.skeleton import joint_index
from piavatar_envs.avatar.rotation import quat_exp
from piavatar_envs.avatar.types import Body
from piavatar_envs.config import FROZEN, ConfigError
from piavatar_envs.envs.observations import ObservationTerm
from piavatar_envs.mpm.types import Sensors, row
from piavatar_envs.tasks.common.rewards import tolerance
from piavatar_envs.tasks.common.upright import left_foot_share

if TYPE_CHECKING:
    from piavatar_envs.avatar.body.device import BodyPoints
    from piavatar_envs.core.launch_graph import LaunchGraph
    from piavatar_envs.envs.batch_env import BatchEnv

wp.set_module_options({"enable_backward": False})

GAIT_TERM = ObservationTerm(
    "gait_phase", 2, "-", "-", "sine and cosine of the gait's clock: while the sine is positive the left foot bears"
)
#: Beyond the first a left foot's share of the load is off the clock's, and another second off a tenth is left [-].
_BOUND, _MARGIN = 0.2, 0.4
#: The same of how far it is ahead, in lengths of a step [-].
_SHORT, _SHORT_MARGIN = 0.2, 0.6
#: Ankles of an adult come no farther apart [m].
_REACH = 1.2
#: Share of a stride in which the load goes from one foot to the other: adults have 0.1, twice a stride (Perry &
#: Burnfield, "Gait Analysis", 2010).
_HANDOVER = 0.1
GAIT_DOC = (
    f"while the left foot's share of what the ground bears is within {_BOUND} of the clock's: all of it in the first "
    f"half of every `gait.stride_seconds`, none in the second, {_HANDOVER} of a stride each to go over; beyond it a "
    f"Gaussian that has fallen to a tenth after another {_MARGIN}; nothing while neither foot bears. Half of that is "
    "for the load alone, half times what is 1 while the left ankle is ahead of the right one by the cosine of the "
    f"clock's phase times a step's length, `target_speed * gait.stride_seconds / 2`, give or take {_SHORT} of it; "
    f"beyond it a Gaussian that has fallen to a tenth after another {_SHORT_MARGIN}"
)

_STEEPNESS = wp.constant(0.5 / math.sin(math.pi * _HANDOVER))
_LEFT_SHOULDER, _RIGHT_SHOULDER = (wp.constant(joint_index(f"{side}_shoulder")) for side in ("left", "right"))
_LEFT_ELBOW, _RIGHT_ELBOW = (wp.constant(joint_index(f"{side}_elbow")) for side in ("left", "right"))
#: From the rest pose, in which arms are lowered by some 45 degrees and elbows bent by as much, to arms that hang [rad].
_LOWERED, _STRETCHED = wp.constant(0.6), wp.constant(0.5)
#: A foot is off the ground whose sole is this much higher than in the rest pose [m].
_CLEAR = wp.constant(0.03)
#: Particles of a foot no higher than this above its lowest are its sole [m].
_SOLE = 0.03
#: Of a body that nothing bears, in place of a share.
NOTHING = wp.constant(-1.0)
#: Control steps that a stride has at least: with fewer the clock shows no order of the feet.
_LEAST_STEPS = 6.0


class GaitConfig(BaseModel):
    """A gait, and the clock by which it goes."""

    model_config = FROZEN

    worth: float = Field(
        0.35, ge=0.0, le=0.7, description="reward for feet in turn, out of that of speed; 0: no clock [-]"
    )
    stride_seconds: float = Field(1.0, ge=0.2, le=5.0, description="time of two steps, one of each foot [s]")
    arm_swing: float = Field(
        0.3, ge=0.0, le=0.6, description="how far shoulders swing to the front and to the back [rad]"
    )


@wp.struct
class Gait:
    """Constants of a gait."""

    worth: float  # reward
    stride: float  # [control steps]
    step_length: float  # [m]
    arm_swing: float  # [rad]
    soles: wp.array2d(dtype=int)  # (2, n) particles of the left and of the right one; some may be there twice


def gait_rule(config: GaitConfig, speed: float, control_dt: float, points: BodyPoints, device: str) -> Gait:
    """Kernel argument.

    Args:
        config: settings.
        speed: to go at [m/s].
        control_dt: a control step [s].
        points: of the body.
        device: where its soles are looked at.
    """
    rule = Gait()
    rule.worth = config.worth
    rule.stride, rule.arm_swing = config.stride_seconds / control_dt, config.arm_swing
    rule.step_length = step_length(config, speed)
    soles = [_sole(points, side) for side in ("left", "right")]
    most = max(map(len, soles))
    rule.soles = wp.array(np.stack([np.resize(sole, most) for sole in soles]), dtype=int, device=device)
    return rule


def step_length(config: GaitConfig, speed: float) -> float:
    """Of a foot, at a ``speed`` [m/s], in front of the other one [m]."""
    return 0.5 * speed * config.stride_seconds


def check_gait(config: GaitConfig, speed: float, control_dt: float) -> None:
    """Refuse a gait that cannot be.

    Raises:
        ConfigError: a stride has hardly any control steps, or steps would be longer than legs.
    """
    if config.worth == 0.0:
        return
    if step_length(config, speed) > _REACH:
        raise ConfigError(
            f"target_speed={speed} and gait.stride_seconds={config.stride_seconds} make steps of "
            f"{step_length(config, speed):.3g} m, and legs reach {_REACH} m; use a stride of at most "
            f"{2.0 * _REACH / speed:.3g} s, a lower speed, or gait.worth=0 for no gait"
        )
    if config.stride_seconds < (_LEAST_STEPS - 0.01) * control_dt:
        raise ConfigError(
            f"gait.stride_seconds={config.stride_seconds} is less than {_LEAST_STEPS:.0f} control steps of "
            f"{control_dt:.3g} s; use at least {_LEAST_STEPS * control_dt:.3g}, a shorter physics.control_dt, or "
            "gait.worth=0 for no gait"
        )


def _sole(points: BodyPoints, side: str) -> np.ndarray:
    """Lowest particles of a foot."""
    bones = [joint_index(f"{side}_ankle"), joint_index(f"{side}_foot")]
    share = dense_weights(points.skin_joints, points.skin_weights)[:, bones].sum(1)
    foot, height = np.flatnonzero(share > 0.5), points.rest[0][:, 2]
    return foot[height[foot] < height[foot].min() + _SOLE].astype(np.int32)


@wp.func
def phase_of(gait: Gait, steps: float):
    """Phase after so many control steps [rad], from 0 to 2 pi."""
    strides = steps / gait.stride
    return 2.0 * wp.pi * (strides - wp.floor(strides))


@wp.func
def due_share(phase: float):
    """What the left foot shall bear of the body, from 0 to 1."""
    return wp.clamp(0.5 + _STEEPNESS * wp.sin(phase), 0.0, 1.0)


@wp.func
def turn_taken(gait: Gait, step: int, left: float):
    """What it is worth, from 0 to 1, that the left foot bears such a share, or :data:`NOTHING`.

    Of the step that the counter counts next, by the clock in its middle.
    """
    if left == NOTHING:
        return 0.0
    return tolerance(wp.abs(left - due_share(phase_of(gait, float(step) + 0.5))), _BOUND, _MARGIN)


@wp.func
def stepped(gait: Gait, step: int, lead: float):
    """What it is worth, from 0 to 1, that the left ankle is so far ahead of the right one [m].

    At the end of the control step that the counter counts next. At phase 0 the left foot is down in front by the length
    of a step, half a stride later the right one.
    """
    due = gait.step_length * wp.cos(phase_of(gait, float(step) + 1.0))
    return tolerance(wp.abs(lead - due), _SHORT * gait.step_length, _SHORT_MARGIN * gait.step_length)


@wp.func
def lift_of(gait: Gait, body: Body, x: wp.array2d(dtype=wp.vec3), e: int, foot: int):
    """How much higher than in the rest pose the lowest of a sole is [m]."""
    r = row(e, body.rest.shape[0])
    lift = float(1.0e6)
    for n in range(gait.soles.shape[1]):
        p = gait.soles[foot, n]
        lift = wp.min(lift, x[e, body.first + p][2] - body.rest[r, p][2])
    return lift


@wp.kernel
def weigh_feet(
    gait: Gait,
    body: Body,
    position: wp.array2d(dtype=wp.vec3),
    sensors: Sensors,
    x: wp.array2d(dtype=wp.vec3),
    # out
    left: wp.array(dtype=float),
):
    """Share of the left foot in what the ground bears, or :data:`NOTHING`.

    Levers between the ankles know nothing of how long soles are: on the toes of a foot behind, they give some of the
    load to the one ahead. If that is in the air it has none.
    """
    e = wp.tid()
    if sensors.boundary_impulse[e, 0][2] <= 0.0:
        left[e] = NOTHING
        return
    left_off = lift_of(gait, body, x, e, 0) > _CLEAR
    right_off = lift_of(gait, body, x, e, 1) > _CLEAR
    if left_off == right_off:
        left[e] = left_foot_share(position, sensors, e, 0)
    elif left_off:
        left[e] = 0.0
    else:
        left[e] = 1.0


@wp.func
def arm_pose(gait: Gait, phase: float, b: int):
    """Rotation of a joint relative to its parent: arms hang and swing against the legs, the others are at rest."""
    side = float(0.0)
    if b == _LEFT_SHOULDER:
        side = 1.0
    if b == _RIGHT_SHOULDER:
        side = -1.0
    if side != 0.0:
        # the left arm is behind when the left foot is in front
        ahead = -side * gait.arm_swing * wp.cos(phase)
        return quat_exp(wp.vec3(-ahead, 0.0, 0.0)) * quat_exp(wp.vec3(0.0, side * _LOWERED, 0.0))
    if b == _LEFT_ELBOW:
        return quat_exp(wp.vec3(_STRETCHED, 0.0, 0.0))
    if b == _RIGHT_ELBOW:
        return quat_exp(wp.vec3(_STRETCHED, 0.0, 0.0))
    return wp.quat_identity()


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


def record_observe_gait(env: BatchEnv, graph: LaunchGraph, gait: Gait, agent: int, start: int) -> int:
    """Append: write :data:`GAIT_TERM` from component ``start``; returns the one after it."""
    graph.launch(observe_gait, env.num_envs, [gait, agent, start, env.step_count], [env.observation])
    return start + GAIT_TERM.size
