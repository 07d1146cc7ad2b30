"""Gait clock: feet bear the body in turn and step past each other, arms swing, joints stay within a gait's posture.

Without a clock, hopping on both feet gets ahead as well (Siekmann, Godse, Fern & Hurst, "Sim-to-Real Learning of All
Common Bipedal Gaits via Periodic Reward Composition", ICRA 2021). At phase 0 the left foot has just come down in front;
it bears while the right one swings, and from half a stride on the right one bears. Meanwhile the other foot passes it
and comes down a step's length in front, which a body that drags the other foot behind never does. In the mirror image
the clock is half a stride ahead.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
import warp as wp
from pydantic import BaseModel, Field

from piavatar_envs.avatar.body.asset import dense_weights
from piavatar_envs.avatar.body.skeleton import Bounds, joint_index
from piavatar_envs.avatar.rotation import quat_exp, quat_log
from piavatar_envs.avatar.torque_control.joint_tissue import beyond
from piavatar_envs.avatar.types import Body
from piavatar_envs.config import FROZEN, ConfigError
from piavatar_envs.core.structs import fill
from piavatar_envs.envs.episodes import Bones, Episodes
from piavatar_envs.envs.observations import ObservationTerm
from piavatar_envs.envs.task import Term
from piavatar_envs.mpm.types import Sensors, row
from piavatar_envs.tasks.common.rewards import tolerance
from piavatar_envs.tasks.common.upright import left_foot_share

if TYPE_CHECKING:
    from piavatar_envs.avatar.body.device import BodyPoints

wp.set_module_options({"enable_backward": False})

GAIT_TERM = ObservationTerm(
    "gait_phase", 2, "-", "-", "sine and cosine of the gait clock: while the sine is positive the left foot bears"
)
#: Error of the left foot's share of the load without a loss of reward, and the further error that leaves a tenth [-].
_LOAD_BOUND, _LOAD_MARGIN = 0.2, 0.4
#: The same for its lead on the right foot, in lengths of a step [-].
_LEAD_BOUND, _LEAD_MARGIN = 0.2, 0.6
#: Greatest distance between the ankles of an adult [m].
_REACH = 1.2
#: Share of a stride in which the load goes from one foot to the other: adults have 0.1, twice a stride (Perry &
#: Burnfield, "Gait Analysis", 2010).
_HANDOVER = 0.1
#: Control steps that a stride has at least: with fewer the clock shows no order of the feet.
_LEAST_STEPS = 6.0
GAIT_REWARD = Term(
    "gait",
    f"`gait.weight` while the left foot's share of the ground's load is within {_LOAD_BOUND} of the clock's: 1 in the "
    f"first half of every `gait.stride_seconds`, 0 in the second, with {_HANDOVER} of a stride for each transition; "
    f"beyond it a Gaussian that has fallen to a tenth after another {_LOAD_MARGIN}; nothing while neither foot bears. "
    "Half of the reward is for the load alone. The other half is multiplied by a factor that is 1 while the left "
    f"ankle's lead on the right one is within {_LEAD_BOUND} of a step's length, `target_speed * gait.stride_seconds / "
    "2`, of that length times the cosine of the clock's phase; beyond it a Gaussian that has fallen to a tenth after "
    f"another {_LEAD_MARGIN}. All times `height` / 0.1, and less where the pelvis tilts, as `upright` is where the "
    "chest does",
)

_TRUNK: Bounds = ((-5.0, 5.0), (-5.0, 5.0), (-5.0, 5.0))
#: Ranges of rotation vectors from the rest pose, about axes as in :mod:`piavatar_envs.avatar.body.skeleton` [deg]:
#: those of adults at 1 to 1.5 m/s (Perry & Burnfield), some degrees wider.
_WALKING: dict[str, Bounds] = {
    "hip": ((-40.0, 20.0), (-15.0, 15.0), (-15.0, 15.0)),
    "knee": ((-3.0, 75.0), (-5.0, 5.0), (-10.0, 10.0)),
    "ankle": ((-20.0, 25.0), (-20.0, 20.0), (-20.0, 20.0)),
}
#: The same by the names of the joints.
GAIT_POSTURE: dict[str, Bounds] = {
    f"{side}_{name}": _WALKING[name] for name in _WALKING for side in ("left", "right")
} | {f"spine{n}": _TRUNK for n in (1, 2, 3)}


def _ranges() -> str:
    ranges = {f"{name}s": _WALKING[name] for name in _WALKING} | {"the spine": _TRUNK}
    axes = {name: ", ".join(f"{low:g} to {high:g}" for low, high in bounds) for name, bounds in ranges.items()}
    return "; ".join(f"{name} {text}" for name, text in axes.items()) + " degrees about x, y and z"


POSTURE_COST = Term(
    "posture",
    "`-posture_cost` times the mean square of the joints' excess over the ranges of human gait [rad^2], over the axes "
    f"of hips, knees, ankles and the three joints of the spine: {_ranges()}",
)

_STEEPNESS = wp.constant(0.5 / math.sin(math.pi * _HANDOVER))
_LEFT_ANKLE, _RIGHT_ANKLE = (wp.constant(joint_index(f"{side}_ankle")) for side in ("left", "right"))
_LEFT_SHOULDER, _RIGHT_SHOULDER = (wp.constant(joint_index(f"{side}_shoulder")) for side in ("left", "right"))
_LEFT_ELBOW, _RIGHT_ELBOW = (wp.constant(joint_index(f"{side}_elbow")) for side in ("left", "right"))
#: From the rest pose, in which arms are lowered by some 45 degrees and elbows bent by as much, to arms that hang [rad].
_LOWERED, _STRETCHED = wp.constant(0.6), wp.constant(0.5)
#: A foot is off the ground if its sole is higher than in the rest pose by this [m].
_CLEAR = wp.constant(0.03)
#: Particles of a foot within this height above its lowest are its sole [m].
_SOLE = 0.03
#: Stands for the left foot's share where nothing bears.
NO_LOAD = wp.constant(-1.0)


class GaitConfig(BaseModel):
    """Gait and its clock."""

    model_config = FROZEN

    weight: float = Field(
        0.35, ge=0.0, le=0.7, description="reward for feet in turn, taken from that of speed; 0: no clock [-]"
    )
    stride_seconds: float = Field(1.0, ge=0.2, le=5.0, description="time of two steps, one of each foot [s]")
    arm_swing: float = Field(
        0.3, ge=0.0, le=0.6, description="greatest swing of the shoulders to the front and to the back [rad]"
    )


@wp.struct
class Gait:
    """Constants of a gait."""

    weight: float  # reward
    stride: float  # [control steps]
    step_length: float  # [m]
    arm_swing: float  # [rad]
    soles: wp.array2d(dtype=int)  # (2, n) particles of the left and of the right one; some may be there twice
    posture_cost: float  # of a mean square of 1 rad^2
    joint: wp.array(dtype=int)  # joints of GAIT_POSTURE
    lower: wp.array(dtype=wp.vec3)  # [rad]
    upper: wp.array(dtype=wp.vec3)  # [rad]


def make_gait(
    config: GaitConfig, speed: float, posture_cost: float, control_dt: float, points: BodyPoints, device: str
) -> Gait:
    """Return the constants of a gait at a ``speed`` [m/s], for a body whose particles are ``points``."""
    soles = [_sole(points, side) for side in ("left", "right")]
    most = max(map(len, soles))
    ends = np.radians(np.array(list(GAIT_POSTURE.values()), dtype=np.float32))
    lower, upper = (wp.array(ends[..., end], dtype=wp.vec3, device=device) for end in (0, 1))
    return fill(
        Gait(),
        config,
        stride=config.stride_seconds / control_dt,
        step_length=_step_length(config, speed),
        soles=wp.array(np.stack([np.resize(sole, most) for sole in soles]), dtype=int, device=device),
        posture_cost=posture_cost,
        joint=wp.array([joint_index(name) for name in GAIT_POSTURE], dtype=int, device=device),
        lower=lower,
        upper=upper,
    )


def _step_length(config: GaitConfig, speed: float) -> float:
    return 0.5 * speed * config.stride_seconds


def check_gait(config: GaitConfig, speed: float, control_dt: float) -> None:
    """Refuse a gait that no body can walk.

    Raises:
        ConfigError: a stride has too few control steps, or steps would be longer than legs.
    """
    if config.weight == 0.0:
        return
    if _step_length(config, speed) > _REACH:
        raise ConfigError(
            f"target_speed={speed} and gait.stride_seconds={config.stride_seconds} make steps of "
            f"{_step_length(config, speed):.3g} m, and legs reach {_REACH} m; use a stride of at most "
            f"{2.0 * _REACH / speed:.3g} s, a lower speed, or gait.weight=0 for no gait"
        )
    if config.stride_seconds < (_LEAST_STEPS - 0.01) * control_dt:
        raise ConfigError(
            f"gait.stride_seconds={config.stride_seconds} is less than {_LEAST_STEPS:.0f} control steps of "
            f"{control_dt:.3g} s; use at least {_LEAST_STEPS * control_dt:.3g}, a shorter physics.control_dt, or "
            "gait.weight=0 for no gait"
        )


def _sole(points: BodyPoints, side: str) -> np.ndarray:
    """Find the lowest particles of a foot."""
    bones = [joint_index(f"{side}_ankle"), joint_index(f"{side}_foot")]
    share = dense_weights(points.skin_joints, points.skin_weights)[:, bones].sum(1)
    foot, height = np.flatnonzero(share > 0.5), points.rest[0][:, 2]
    return foot[height[foot] < height[foot].min() + _SOLE].astype(np.int32)


@wp.func
def phase_of(gait: Gait, steps: float):
    """Return the phase after a number of control steps [rad], from 0 to 2 pi."""
    strides = steps / gait.stride
    return 2.0 * wp.pi * (strides - wp.floor(strides))


@wp.func
def load_reward(gait: Gait, step: int, left: float):
    """Return the reward, from 0 to 1, of the left foot's share of the load, or 0 for :data:`NO_LOAD`.

    By the clock in the middle of the control step in progress (`step_count` is incremented after the outcome).
    """
    if left == NO_LOAD:
        return 0.0
    due = wp.clamp(0.5 + _STEEPNESS * wp.sin(phase_of(gait, float(step) + 0.5)), 0.0, 1.0)
    return tolerance(wp.abs(left - due), _LOAD_BOUND, _LOAD_MARGIN)


@wp.func
def step_reward(gait: Gait, step: int, bones: Bones, e: int, ahead: wp.vec3):
    """Return the reward, from 0 to 1, of the left ankle's lead on the right one along the unit vector ``ahead``.

    By the clock at the end of the control step in progress (`step_count` is incremented after the outcome). At phase 0
    the left foot is down in front by the length of a step, half a stride later the right one.
    """
    lead = wp.dot(bones.position[e, _LEFT_ANKLE] - bones.position[e, _RIGHT_ANKLE], ahead)
    due = gait.step_length * wp.cos(phase_of(gait, float(step) + 1.0))
    return tolerance(wp.abs(lead - due), _LEAD_BOUND * gait.step_length, _LEAD_MARGIN * gait.step_length)


@wp.func
def lift_of(gait: Gait, body: Body, x: wp.array2d(dtype=wp.vec3), e: int, foot: int):
    """Return the least height of a sole's particles over that in the rest pose [m]."""
    r = row(e, body.rest.shape[0])
    lift = float(1.0e6)
    for n in range(gait.soles.shape[1]):
        p = gait.soles[foot, n]
        lift = wp.min(lift, x[e, body.first + p][2] - body.rest[r, p][2])
    return lift


@wp.func
def left_load_share(gait: Gait, bones: Bones, sensors: Sensors, x: wp.array2d(dtype=wp.vec3), e: int):
    """Return the left foot's share of the ground's load, or :data:`NO_LOAD`.

    The levers between the ankles ignore the length of the soles: on the toes of the rear foot, they give some of its
    load to the foot in front. A foot in the air has none.
    """
    if sensors.boundary_impulse[e, 0][2] <= 0.0:
        return NO_LOAD
    left_off = lift_of(gait, bones.body, x, e, 0) > _CLEAR
    right_off = lift_of(gait, bones.body, x, e, 1) > _CLEAR
    if left_off == right_off:
        return left_foot_share(bones, sensors, e, 0)
    return wp.where(left_off, 0.0, 1.0)


@wp.func
def posture_excess(gait: Gait, bones: Bones, e: int):
    """Return the mean square of the joints' excess over the ranges :data:`GAIT_POSTURE` [rad^2]."""
    count = gait.joint.shape[0]
    total = float(0.0)
    for n in range(count):
        total += wp.length_sq(beyond(quat_log(bones.local[e, gait.joint[n]]), gait.lower[n], gait.upper[n]))
    return total / float(3 * count)


@wp.func
def arm_pose(gait: Gait, phase: float, b: int):
    """Return a joint's rotation relative to its parent: arms hang and swing against the legs, others are at rest."""
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
    gait: Gait,
    episodes: Episodes,
    # in and out
    command_rotation: wp.array2d(dtype=wp.quat),
):
    """Turn the arms of the first poses to the beginning of a stride, in the masked environments."""
    e, b = wp.tid()
    if episodes.mask[e] and b > 0:
        command_rotation[e, b] = arm_pose(gait, 0.0, b) * command_rotation[e, b]


@wp.kernel
def swing_arms(
    gait: Gait,
    episodes: Episodes,
    command_rotation: wp.array2d(dtype=wp.quat),
    # out
    reference_rotation: wp.array2d(dtype=wp.quat),
):
    """Write the pose at the end of the control step in progress (`step_count` is incremented after the outcome).

    The pelvis' rotation is the commanded one.
    """
    e, b = wp.tid()
    q = command_rotation[e, b]
    if b > 0:
        q = arm_pose(gait, phase_of(gait, float(episodes.step_count[e] + 1)), b)
    reference_rotation[e, b] = q
