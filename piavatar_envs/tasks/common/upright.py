"""Standing upright by one's own strength: what is seen of it, and what it is worth."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import warp as wp
from pydantic import BaseModel, Field

from piavatar_envs.avatar.body.skeleton import joint_index
from piavatar_envs.avatar.rotation import quat_log
from piavatar_envs.avatar.types import Body
from piavatar_envs.config import FROZEN
from piavatar_envs.envs.observations import ObservationTerm, write_vector
from piavatar_envs.mpm.types import Sensors
from piavatar_envs.tasks.common.fall import FALLEN_DOC, FallConfig, heights_of, is_down
from piavatar_envs.tasks.common.ranges import Margin
from piavatar_envs.tasks.common.rewards import mean_square_action, tolerance

if TYPE_CHECKING:
    from piavatar_envs.core.launch_graph import LaunchGraph
    from piavatar_envs.envs.batch_env import BatchEnv

wp.set_module_options({"enable_backward": False})

_CHEST = wp.constant(joint_index("spine3"))
_LEFT, _RIGHT = wp.constant(joint_index("left_ankle")), wp.constant(joint_index("right_ankle"))

UPRIGHT_TERMS = (
    ObservationTerm("gravity_direction", 3, "-", "root", "where down is: a unit vector"),
    ObservationTerm(
        "foot_impulses",
        2,
        "N s",
        "-",
        "what left and right foot bear of the ground's upward impulse in the last step",
    ),
)
REWARD_TERMS = ("height", "upright", "still", "pose", "control")
REWARD_DOCS: Mapping[str, str] = {
    "height": "0.3 while the head is no lower than 0.95 of its height in the rest pose; below it a Gaussian that has "
    "fallen to 0.03 after another `upright.height_margin` of that height",
    "upright": "0.3 while the chest tilts by at most 0.1 rad; beyond it a Gaussian that has fallen to 0.03 after "
    "another `upright.tilt_margin`",
    "still": "0.2 while the pelvis is no faster than 0.05 m/s; beyond it a Gaussian that has fallen to 0.02 after "
    "another `still.speed_margin`; all times `height` / 0.3",
    "pose": "0.2 while the mean angle of the joints from the rest pose is at most 0.05 rad; beyond it a Gaussian that "
    "has fallen to 0.02 after another `still.pose_margin`; all times `height` / 0.3",
    "control": "`-control_cost` times the mean of the squared action components",
}
METRICS = ("head_height", "pelvis_height", "tilt_deg", "speed")
METRIC_DOCS: Mapping[str, str] = {
    "head_height": "height of the head joint over that in the rest pose [-]",
    "pelvis_height": "height of the pelvis joint over that in the rest pose [-]",
    "tilt_deg": "angle of the chest from the vertical, as it is in the rest pose [deg]",
    "speed": "speed of the pelvis [m/s]",
}
STANDING_DOC = "the head is no lower than `upright.stand_head` of its height in the rest pose"
FALL_DOC = f"the avatar falls: {FALLEN_DOC}"


class UprightConfig(BaseModel):
    """What counts as standing, and where the rewards of height and tilt end."""

    model_config = FROZEN

    stand_head: float = Field(0.85, gt=0.0, le=1.0, description="head height that counts as standing, a share [-]")
    height_margin: Margin = Field(0.25, description="missing height at which a reward is a tenth, likewise [-]")
    tilt_margin: Margin = Field(0.6, description="tilt at which it is, likewise [rad]")


class StillConfig(BaseModel):
    """Where the rewards of standing still in the rest pose end."""

    model_config = FROZEN

    speed_margin: Margin = Field(1.0, description="speed at which a reward is a tenth [m/s]")
    pose_margin: Margin = Field(0.4, description="mean joint angle at which it is, likewise [rad]")


@wp.struct
class Upright:
    """Constants of being upright; heights are shares of those in the rest pose."""

    stand_head: float
    height_margin: float
    tilt_margin: float  # [rad]
    control_cost: float


@wp.struct
class Still:
    """Constants of standing still."""

    speed_margin: float  # [m/s]
    pose_margin: float  # [rad]


@wp.struct
class Posture:
    """How a body stands now."""

    head: float  # height over that in the rest pose
    pelvis: float  # likewise
    tilt: float  # of the chest [rad]
    high: float  # reward of height, in [0, 1]
    straight: float  # reward of the tilt, in [0, 1]


def upright_rule(config: UprightConfig, control_cost: float) -> Upright:
    """Kernel argument."""
    rule = Upright()
    rule.stand_head, rule.height_margin, rule.tilt_margin = config.stand_head, config.height_margin, config.tilt_margin
    rule.control_cost = control_cost
    return rule


def still_rule(config: StillConfig) -> Still:
    """Kernel argument."""
    rule = Still()
    rule.speed_margin, rule.pose_margin = config.speed_margin, config.pose_margin
    return rule


@wp.func
def tilt_of(rotation: wp.quat):
    """Angle of a bone from the vertical, as it is in the rest pose [rad]."""
    up = wp.quat_rotate(rotation, wp.vec3(0.0, 0.0, 1.0))
    return wp.acos(wp.clamp(up[2], -1.0, 1.0))


@wp.func
def posture_of(
    rule: Upright, body: Body, e: int, rotation: wp.array2d(dtype=wp.quat), position: wp.array2d(dtype=wp.vec3)
):
    """Heights and tilt of a body, and what they are worth."""
    now = Posture()
    heights = heights_of(body, e, position)
    now.head = heights[0]
    now.pelvis = heights[1]
    now.tilt = tilt_of(rotation[e, _CHEST])
    now.high = tolerance(1.0 - now.head, 0.05, rule.height_margin)
    now.straight = tolerance(now.tilt, 0.1, rule.tilt_margin)
    return now


@wp.func
def mean_angle(local: wp.array2d(dtype=wp.quat), e: int):
    """Of all joints but the pelvis, from the rest pose [rad]."""
    total = float(0.0)
    for b in range(1, local.shape[1]):
        total += wp.length(quat_log(local[e, b]))
    return total / float(local.shape[1] - 1)


@wp.func
def write_posture(now: Posture, e: int, metrics: wp.array3d(dtype=float)):
    """The first three of :data:`METRICS`."""
    metrics[e, 0, 0] = now.head
    metrics[e, 0, 1] = now.pelvis
    metrics[e, 0, 2] = wp.degrees(now.tilt)


@wp.func
def stillness(still: Still, speed: float):
    """1 while the pelvis hardly moves [m/s], and less the faster it is."""
    return tolerance(speed, 0.05, still.speed_margin)


@wp.func
def restfulness(still: Still, angle: float):
    """1 while the joints are hardly off the rest pose on average [rad], and less the more they are."""
    return tolerance(angle, 0.05, still.pose_margin)


@wp.func
def write_standing(
    rule: Upright,
    now: Posture,
    speed: float,
    e: int,
    action: wp.array3d(dtype=float),
    # out
    terms: wp.array3d(dtype=float),
    metrics: wp.array3d(dtype=float),
    success: wp.array2d(dtype=wp.bool),
):
    """All of :data:`METRICS`, whether it stands, and the last reward term, what acting costs."""
    terms[e, 0, 4] = -rule.control_cost * mean_square_action(action, e, 0)
    write_posture(now, e, metrics)
    metrics[e, 0, 3] = speed
    success[e, 0] = now.head >= rule.stand_head


@wp.kernel
def judge_standing(
    rule: Upright,
    still: Still,
    body: Body,
    rotation: wp.array2d(dtype=wp.quat),
    position: wp.array2d(dtype=wp.vec3),
    velocity: wp.array2d(dtype=wp.vec3),
    local: wp.array2d(dtype=wp.quat),
    action: wp.array3d(dtype=float),
    # out
    terms: wp.array3d(dtype=float),
    metrics: wp.array3d(dtype=float),
    success: wp.array2d(dtype=wp.bool),
):
    """Reward of standing still in the rest pose, wherever, and its cost."""
    e = wp.tid()
    now = posture_of(rule, body, e, rotation, position)
    speed = wp.length(velocity[e, 0])
    angle = mean_angle(local, e)
    terms[e, 0, 0] = 0.3 * now.high
    terms[e, 0, 1] = 0.3 * now.straight
    terms[e, 0, 2] = 0.2 * now.high * stillness(still, speed)
    terms[e, 0, 3] = 0.2 * now.high * restfulness(still, angle)
    write_standing(rule, now, speed, e, action, terms, metrics, success)


@wp.kernel
def find_fall(
    least: wp.vec2,
    body: Body,
    position: wp.array2d(dtype=wp.vec3),
    # out
    terminated: wp.array2d(dtype=wp.bool),
):
    """Terminate whose head or pelvis are lower than ``least``."""
    e = wp.tid()
    terminated[e, 0] = is_down(heights_of(body, e, position), least)


@wp.func
def foot_share(left: wp.vec3, right: wp.vec3, impulse: wp.vec3, moment: wp.vec3):
    """Share of the left foot, from 0 to 1, of an upward impulse whose moment about the origin is given [N m s].

    Where only two points bear, levers share the load: the centre of pressure ``(-M_y, M_x) / J_z`` lies between them.
    """
    if impulse[2] < 1.0e-6:
        return 0.5
    apart = wp.vec2(left[0] - right[0], left[1] - right[1])
    center = wp.vec2(-moment[1] / impulse[2] - right[0], moment[0] / impulse[2] - right[1])
    return wp.clamp(wp.dot(center, apart) / wp.max(wp.length_sq(apart), 1.0e-6), 0.0, 1.0)


@wp.func
def left_foot_share(position: wp.array2d(dtype=wp.vec3), sensors: Sensors, e: int, agent: int):
    """What the left foot bears of the ground's upward impulse in the last step, from 0 to 1."""
    moment = sensors.boundary_moment[e, agent]
    return foot_share(position[e, _LEFT], position[e, _RIGHT], sensors.boundary_impulse[e, agent], moment)


@wp.func
def lead_of_left_foot(position: wp.array2d(dtype=wp.vec3), e: int, ahead: wp.vec3):
    """How far ahead of the right ankle the left one is [m]."""
    return wp.dot(position[e, _LEFT] - position[e, _RIGHT], ahead)


@wp.kernel
def observe_upright(
    agent: int,
    start: int,
    rotation: wp.array2d(dtype=wp.quat),
    position: wp.array2d(dtype=wp.vec3),
    sensors: Sensors,
    # out
    observation: wp.array3d(dtype=float),
):
    """Terms of :data:`UPRIGHT_TERMS`, from component ``start``."""
    e = wp.tid()
    write_vector(observation, e, agent, start, wp.quat_rotate_inv(rotation[e, 0], wp.vec3(0.0, 0.0, -1.0)))
    upward = sensors.boundary_impulse[e, agent][2]
    share = left_foot_share(position, sensors, e, agent)
    observation[e, agent, start + 3] = share * upward
    observation[e, agent, start + 4] = (1.0 - share) * upward


def record_standing_outcome(env: BatchEnv, graph: LaunchGraph, rule: Upright, still: Still) -> None:
    """Append: terms, metrics and success of standing."""
    avatar = env.simulation.avatar
    t = avatar.tracked
    graph.launch(
        judge_standing,
        env.num_envs,
        [rule, still, avatar.body, t.rotation, t.position, t.velocity, t.local, env.action],
        [env.terms, env.metrics, env.success],
    )


def record_fall(env: BatchEnv, graph: LaunchGraph, config: FallConfig) -> None:
    """Append: terminate environments whose avatar has fallen."""
    avatar = env.simulation.avatar
    graph.launch(find_fall, env.num_envs, [config.least, avatar.body, avatar.tracked.position], [env.terminated])


def record_observe_upright(env: BatchEnv, graph: LaunchGraph, agent: int, start: int) -> int:
    """Append: write :data:`UPRIGHT_TERMS` from component ``start``; returns the one after them."""
    tracked = env.simulation.avatars[agent].tracked
    graph.launch(
        observe_upright,
        env.num_envs,
        [agent, start, tracked.rotation, tracked.position, env.simulation.sensors],
        [env.observation],
    )
    return start + sum(term.size for term in UPRIGHT_TERMS)
