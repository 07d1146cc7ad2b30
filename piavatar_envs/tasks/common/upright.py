"""Standing upright by the strength of the joints: its observation, its rewards, and the base of tasks that stand."""

from __future__ import annotations

from typing import TYPE_CHECKING

import warp as wp
from pydantic import BaseModel, Field

from piavatar_envs.avatar.body.skeleton import joint_index
from piavatar_envs.avatar.rotation import quat_log
from piavatar_envs.config import FROZEN
from piavatar_envs.core.structs import fill
from piavatar_envs.envs.episodes import Bones, Outcome
from piavatar_envs.envs.observations import ObservationTerm, write_vector
from piavatar_envs.envs.task import Metric, Task, Term
from piavatar_envs.mpm.types import Sensors
from piavatar_envs.tasks.common.fall import FALLEN_DOC, heights_of, record_fall
from piavatar_envs.tasks.common.ranges import Margin
from piavatar_envs.tasks.common.rewards import CONTROL, mean_square_action, tolerance
from piavatar_envs.tasks.common.spawn import Grounding

if TYPE_CHECKING:
    from piavatar_envs.core.launch_graph import LaunchGraph
    from piavatar_envs.envs.episodes import EpisodeArrays

wp.set_module_options({"enable_backward": False})

_CHEST = wp.constant(joint_index("spine3"))
_TRUNK = wp.constant(wp.vec3i(*(joint_index(name) for name in ("spine1", "spine2", "spine3"))))
_LEFT, _RIGHT = wp.constant(joint_index("left_ankle")), wp.constant(joint_index("right_ankle"))

UPRIGHT_TERMS = (
    ObservationTerm("gravity_direction", 3, "-", "root", "direction of gravity: a unit vector"),
    ObservationTerm(
        "foot_impulses", 2, "N s", "-", "shares of left and right foot in the ground's upward impulse of the last step"
    ),
)


def upright_rewards(weight: float) -> tuple[Term, Term]:
    """Return the terms of :func:`posture_of`, height and tilt, each worth ``weight`` at most."""
    fallen = f"a Gaussian that has fallen to {0.1 * weight:g} after another"
    return (
        Term(
            "height",
            f"{weight} while the head is no lower than 0.95 of its height in the rest pose; below it {fallen} "
            "`upright.height_margin` of that height",
        ),
        Term("upright", f"{weight} while the chest tilts by at most 0.1 rad; beyond it {fallen} `upright.tilt_margin`"),
    )


STANDING_REWARDS = (
    *upright_rewards(0.3),
    Term(
        "still",
        "0.2 while the pelvis is no faster than 0.05 m/s; beyond it a Gaussian that has fallen to 0.02 after another "
        "`still.speed_margin`; all times `height` / 0.3",
    ),
    Term(
        "pose",
        "0.2 while the mean angle from the rest pose is at most 0.05 rad, of all joints and of the trunk's three; "
        "beyond it, by the greater one, a Gaussian that has fallen to 0.02 after another `still.pose_margin`; all "
        "times `height` / 0.3",
    ),
    CONTROL,
)
#: Metrics of :func:`write_posture`; other metrics of a task follow them.
POSTURE_METRICS = (
    Metric("head_height", "-", "height of the head joint over that in the rest pose"),
    Metric("pelvis_height", "-", "height of the pelvis joint over that in the rest pose"),
    Metric("tilt_deg", "deg", "angle of the chest from the vertical, relative to the rest pose"),
)
#: Metrics of :func:`write_standing`, likewise.
STANDING_METRICS = (*POSTURE_METRICS, Metric("speed", "m/s", "speed of the pelvis"))
STANDING_DOC = "the head is no lower than `upright.stand_head` of its height in the rest pose"
FALL_DOC = f"the avatar falls: {FALLEN_DOC}"


class UprightConfig(BaseModel):
    """Limit of standing, and margins of the rewards of height and tilt."""

    model_config = FROZEN

    stand_head: float = Field(0.85, gt=0.0, le=1.0, description="head height that counts as standing, a share [-]")
    height_margin: Margin = Field(0.25, description="share of height lost at which a reward is a tenth [-]")
    tilt_margin: Margin = Field(0.6, description="tilt at which a reward is a tenth [rad]")


class StillConfig(BaseModel):
    """Margins of the rewards of standing still in the rest pose."""

    model_config = FROZEN

    speed_margin: Margin = Field(1.0, description="speed at which a reward is a tenth [m/s]")
    pose_margin: Margin = Field(0.4, description="mean joint angle at which a reward is a tenth [rad]")


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
    """Heights and tilt of a body."""

    head: float  # height over that in the rest pose
    pelvis: float  # likewise
    tilt: float  # of the chest [rad]
    high: float  # reward of height, in [0, 1]
    straight: float  # reward of the tilt, in [0, 1]


@wp.func
def tilt_of(rotation: wp.quat):
    """Return the angle of a bone from the vertical, relative to the rest pose [rad]."""
    up = wp.quat_rotate(rotation, wp.vec3(0.0, 0.0, 1.0))
    return wp.acos(wp.clamp(up[2], -1.0, 1.0))


@wp.func
def posture_of(rule: Upright, bones: Bones, e: int):
    """Return heights and tilt of a body, and their rewards."""
    now = Posture()
    heights = heights_of(bones, e)
    now.head = heights[0]
    now.pelvis = heights[1]
    now.tilt = tilt_of(bones.rotation[e, _CHEST])
    now.high = tolerance(1.0 - now.head, 0.05, rule.height_margin)
    now.straight = tolerance(now.tilt, 0.1, rule.tilt_margin)
    return now


@wp.func
def pose_error(bones: Bones, e: int):
    """Return the mean angle from the rest pose of all joints but the pelvis, or of the trunk's three if greater [rad].

    Among 21 joints, a trunk that hangs in its ligaments would hardly count.
    """
    total = float(0.0)
    for b in range(1, bones.local.shape[1]):
        total += wp.length(quat_log(bones.local[e, b]))
    trunk = float(0.0)
    for k in range(3):
        trunk += wp.length(quat_log(bones.local[e, _TRUNK[k]]))
    return wp.max(total / float(bones.local.shape[1] - 1), trunk / float(3))


@wp.func
def write_posture(now: Posture, e: int, outcome: Outcome):
    """Write :data:`POSTURE_METRICS`."""
    outcome.metrics[e, 0, StandingTask.metrics.head_height] = now.head
    outcome.metrics[e, 0, StandingTask.metrics.pelvis_height] = now.pelvis
    outcome.metrics[e, 0, StandingTask.metrics.tilt_deg] = wp.degrees(now.tilt)


@wp.func
def stillness(still: Still, speed: float):
    """Return 1 while the pelvis hardly moves [m/s], less the faster it is."""
    return tolerance(speed, 0.05, still.speed_margin)


@wp.func
def restfulness(still: Still, angle: float):
    """Return 1 while :func:`pose_error` [rad] is small, less the greater it is."""
    return tolerance(angle, 0.05, still.pose_margin)


@wp.func
def write_standing(rule: Upright, now: Posture, speed: float, e: int, outcome: Outcome):
    """Write :data:`STANDING_METRICS` and success."""
    write_posture(now, e, outcome)
    outcome.metrics[e, 0, StandingTask.metrics.speed] = speed
    outcome.success[e, 0] = now.head >= rule.stand_head


@wp.kernel
def judge_standing(
    rule: Upright,
    still: Still,
    bones: Bones,
    action: wp.array3d(dtype=float),
    # out
    outcome: Outcome,
):
    """Reward standing still in the rest pose, wherever that is."""
    e = wp.tid()
    now = posture_of(rule, bones, e)
    speed = wp.length(bones.velocity[e, 0])
    angle = pose_error(bones, e)
    outcome.terms[e, 0, StandingTask.rewards.height] = 0.3 * now.high
    outcome.terms[e, 0, StandingTask.rewards.upright] = 0.3 * now.straight
    outcome.terms[e, 0, StandingTask.rewards.still] = 0.2 * now.high * stillness(still, speed)
    outcome.terms[e, 0, StandingTask.rewards.pose] = 0.2 * now.high * restfulness(still, angle)
    outcome.terms[e, 0, StandingTask.rewards.control] = -rule.control_cost * mean_square_action(action, e, 0)
    write_standing(rule, now, speed, e, outcome)


@wp.func
def foot_share(left: wp.vec3, right: wp.vec3, impulse: wp.vec3, moment: wp.vec3):
    """Return the left foot's share, from 0 to 1, of an upward impulse with a given moment about the origin [N m s].

    Two points bear by their levers: the centre of pressure ``(-M_y, M_x) / J_z`` lies between them.
    """
    if impulse[2] < 1.0e-6:
        return 0.5
    apart = wp.vec2(left[0] - right[0], left[1] - right[1])
    center = wp.vec2(-moment[1] / impulse[2] - right[0], moment[0] / impulse[2] - right[1])
    return wp.clamp(wp.dot(center, apart) / wp.max(wp.length_sq(apart), 1.0e-6), 0.0, 1.0)


@wp.func
def left_foot_share(bones: Bones, sensors: Sensors, e: int, agent: int):
    """Return the left foot's share in the ground's upward impulse of the last step, from 0 to 1."""
    moment = sensors.boundary_moment[e, agent]
    return foot_share(bones.position[e, _LEFT], bones.position[e, _RIGHT], sensors.boundary_impulse[e, agent], moment)


@wp.kernel
def observe_upright(
    bones: Bones,
    sensors: Sensors,
    agent: int,
    start: int,
    # out
    observation: wp.array3d(dtype=float),
):
    """Write :data:`UPRIGHT_TERMS` from component ``start``."""
    e = wp.tid()
    write_vector(observation, e, agent, start, wp.quat_rotate_inv(bones.rotation[e, 0], wp.vec3(0.0, 0.0, -1.0)))
    upward = sensors.boundary_impulse[e, agent][2]
    share = left_foot_share(bones, sensors, e, agent)
    observation[e, agent, start + 3] = share * upward
    observation[e, agent, start + 4] = (1.0 - share) * upward


def record_observe_upright(env: EpisodeArrays, graph: LaunchGraph, agent: int, start: int) -> int:
    """Append: write :data:`UPRIGHT_TERMS` from component ``start``; return the component after them."""
    inputs = [env.bones[agent], env.simulation.sensors, agent, start]
    graph.launch(observe_upright, env.num_envs, inputs, [env.observation])
    return start + sum(term.size for term in UPRIGHT_TERMS)


class StandingTask(Task):
    """Base of tasks that stand still in the rest pose; settings have sections ``upright``, ``still`` and ``fall``."""

    observation_terms = UPRIGHT_TERMS
    rewards = STANDING_REWARDS
    metrics = STANDING_METRICS
    success_doc = STANDING_DOC
    termination_doc = FALL_DOC

    def allocate(self, env) -> None:
        self.rule = fill(Upright(), self.config.upright, self.config)
        self.still = fill(Still(), self.config.still)
        self.grounding = Grounding(env)

    def record_reset(self, env, graph) -> None:
        self.grounding.record_standing(env, graph, self.config.pose_noise)

    def record_outcome(self, env, graph) -> None:
        inputs = [self.rule, self.still, env.bones[0], env.action]
        graph.launch(judge_standing, env.num_envs, inputs, [env.outcome])
        record_fall(env, graph, self.config.fall)

    def record_observe(self, env, graph, agent: int, start: int) -> None:
        record_observe_upright(env, graph, agent, start)
