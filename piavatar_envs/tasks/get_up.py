"""GetUp: stand up from lying on the ground, face down or face up."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import warp as wp
from pydantic import Field

from piavatar_envs.avatar.body.skeleton import JOINT_NAMES, NUM_JOINTS, joint_index
from piavatar_envs.avatar.rotation import quat_exp
from piavatar_envs.config import ControlConfig, EnvConfig, TorqueControlConfig
from piavatar_envs.core.rng import STREAM_POSE, STREAM_TASK
from piavatar_envs.core.structs import fill
from piavatar_envs.envs.episodes import Bones, Episodes, Outcome, random_of, rest_joint
from piavatar_envs.envs.task import Metric, Task, TaskArray, Term
from piavatar_envs.sim.randomize import Parameter
from piavatar_envs.sim.scene import Domain
from piavatar_envs.tasks.common.ranges import Margin, Weight
from piavatar_envs.tasks.common.rewards import CONTROL, mean_square_action, tolerance
from piavatar_envs.tasks.common.spawn import Grounding
from piavatar_envs.tasks.common.upright import (
    STANDING_DOC,
    STANDING_METRICS,
    UPRIGHT_TERMS,
    Still,
    StillConfig,
    Upright,
    UprightConfig,
    pose_error,
    posture_of,
    record_observe_upright,
    restfulness,
    stillness,
    write_standing,
)

wp.set_module_options({"enable_backward": False})

_HALF = wp.constant(np.pi)
_LEFT, _RIGHT = wp.constant(joint_index("left_ankle")), wp.constant(joint_index("right_ankle"))
_FEET_BOUND = wp.constant(0.25)
#: Lead of the assisted pelvis' target: upwards [m] and towards upright [rad].
LEAD, LEAD_TURN = wp.constant(0.15), wp.constant(0.3)
#: Room to each side before a wall, besides that of a held body: bodies that have got up seldom stand still at once [m].
ASIDE = 4.2

#: Turns about x from the rest pose [rad], of left and right joints alike; of the pelvis from upright.
_Pose = Mapping[str, float]
#: The arms lie beside the chest. Face down, the toes are pointed and the head is raised off the nose; face up, the
#: heels touch the ground.
_FACE_DOWN: _Pose = {"pelvis": 0.5 * np.pi, "shoulder": 0.4, "ankle": 0.8, "neck": -0.2, "head": -0.2}
_FACE_UP: _Pose = {"pelvis": -0.5 * np.pi, "shoulder": 0.4, "hip": 0.09}
_ON_ALL_FOURS: _Pose = {"pelvis": 1.4, "hip": -1.48, "knee": 1.66, "ankle": 0.79, "shoulder": -1.4}
_ON_A_KNEE: _Pose = {
    "left_hip": -1.57, "left_knee": 1.57, "right_knee": 1.57, "right_ankle": -0.35,
}  # fmt: skip
_SITTING: _Pose = {"pelvis": -0.61, "hip": -1.83, "knee": 1.92, "spine1": 0.35, "spine2": 0.35, "shoulder": -0.35}
_SQUATTING: _Pose = {
    "pelvis": 0.35, "hip": -2.0, "knee": 2.18, "ankle": -0.35, "spine1": 0.17, "spine2": 0.17, "shoulder": -1.0,
}  # fmt: skip
_HALF_UP: _Pose = {"pelvis": 0.35, "hip": -1.31, "knee": 1.4, "ankle": -0.35, "spine1": 0.09, "shoulder": -0.7}
#: From face down and from face up: lying, and poses on the way to standing.
_WAYS = ((_FACE_DOWN, _ON_ALL_FOURS, _ON_A_KNEE, _HALF_UP), (_FACE_UP, _SITTING, _SQUATTING, _HALF_UP))


class GetUpConfig(EnvConfig):
    """Settings of GetUp."""

    control: ControlConfig = Field(default_factory=TorqueControlConfig, description="how actions move the body")
    upright: UprightConfig = Field(default_factory=UprightConfig, description="limit and margins of being upright")
    still: StillConfig = Field(default_factory=StillConfig, description="margins of the rewards of standing still")
    episode_seconds: float = Field(10.0, gt=0.0, le=3600.0, description="simulated time until truncation [s]")
    hold_seconds: Margin = Field(1.0, description="time to stand for a success [s]")
    face_up: float = Field(0.5, ge=0.0, le=1.0, description="share of episodes that begin face up [-]")
    halfway: float = Field(
        0.0, ge=0.0, le=1.0, description="share of episodes that begin on the way up, as a curriculum [-]"
    )
    feet_margin: Margin = Field(
        0.6,
        description="horizontal distance of the feet from the pelvis, beyond a quarter, with a reward of 0.1 [heights]",
    )
    control_cost: Weight = Field(0.05, description="weight of the mean squared action [-]")
    pose_noise: float = Field(0.05, ge=0.0, le=0.5, description="greatest joint angle off the lying pose [rad]")


@wp.struct
class Lying:
    """Constants of the first poses."""

    face_up: float  # share of face up
    halfway: float  # share of those on the way up
    pose_noise: float  # greatest joint angle off the pose [rad]


def first_poses(device: str) -> wp.array:
    """Return rotation vectors [rad] from face down and face up, ``(2, poses, bones)``; the first of each lies."""
    turns = np.zeros((len(_WAYS), len(_WAYS[0]), NUM_JOINTS, 3), np.float32)
    for side, way in enumerate(_WAYS):
        for index, pose in enumerate(way):
            for joint, name in enumerate(JOINT_NAMES):
                turns[side, index, joint, 0] = pose.get(name, pose.get(name.partition("_")[2], 0.0))
    return wp.array(turns, dtype=wp.vec3, device=device)


@wp.kernel
def spawn_lying(
    episodes: Episodes,
    rule: Lying,
    lower: wp.array(dtype=wp.vec3),
    upper: wp.array(dtype=wp.vec3),
    poses: wp.array3d(dtype=wp.vec3),
    place: wp.vec3,
    # out
    command_rotation: wp.array2d(dtype=wp.quat),
    command_root: wp.array(dtype=wp.vec3),
    lies_up: wp.array(dtype=float),
):
    """Draw one of :func:`first_poses`, over ``place`` (x, y [m]), turned about the vertical; over ``(E, bones)``."""
    e, b = wp.tid()
    if not episodes.mask[e]:
        return
    random = random_of(episodes, e, STREAM_TASK, 0)
    side = wp.where(wp.randf(random) < rule.face_up, 1, 0)
    turn = wp.randf(random, -_HALF, _HALF)
    pose = int(0)
    if wp.randf(random) < rule.halfway:
        pose = wp.randi(random, 1, poses.shape[1])
    v = poses[side, pose, b]
    if b == 0:
        command_rotation[e, b] = quat_exp(wp.vec3(0.0, 0.0, turn)) * quat_exp(v)
        command_root[e] = wp.vec3(place[0], place[1], 0.0)
        lies_up[e] = float(side)
        return
    random = random_of(episodes, e, STREAM_POSE, b)
    v += rule.pose_noise * wp.vec3(
        wp.randf(random, -1.0, 1.0), wp.randf(random, -1.0, 1.0), wp.randf(random, -1.0, 1.0)
    )
    command_rotation[e, b] = quat_exp(wp.max(lower[b], wp.min(v, upper[b])))


@wp.kernel
def lead_up(
    bones: Bones,
    # in and out
    reference_rotation: wp.array2d(dtype=wp.quat),
    reference_root: wp.array(dtype=wp.vec3),
):
    """Lead the assisted pelvis from its place upwards and towards upright; over ``(E, bones)``.

    The target is no higher than the pelvis in the rest pose, which is the reference of the joints.
    """
    e, b = wp.tid()
    if b > 0:
        reference_rotation[e, b] = wp.quat_identity()
        return
    at = bones.position[e, 0]
    height = rest_joint(bones.body, e, 0)[2]
    reference_root[e] = wp.vec3(at[0], at[1], wp.min(at[2] + LEAD, height))
    q = bones.rotation[e, 0]
    up = wp.quat_rotate(q, wp.vec3(0.0, 0.0, 1.0))
    axis = wp.cross(up, wp.vec3(0.0, 0.0, 1.0))
    angle = wp.atan2(wp.length(axis), up[2])
    turn = wp.min(angle, LEAD_TURN) / wp.max(wp.length(axis), 1.0e-6)
    reference_rotation[e, 0] = wp.normalize(quat_exp(turn * axis) * q)


@wp.func
def feet_off(bones: Bones, e: int):
    """Return the mean horizontal distance of the ankles from the pelvis, over its height in the rest pose."""
    at = bones.position[e, 0]
    left, right = bones.position[e, _LEFT] - at, bones.position[e, _RIGHT] - at
    apart = 0.5 * (wp.length(wp.vec2(left[0], left[1])) + wp.length(wp.vec2(right[0], right[1])))
    return apart / rest_joint(bones.body, e, 0)[2]


@wp.kernel
def judge_rising(
    rule: Upright,
    still: Still,
    feet_margin: float,
    bones: Bones,
    action: wp.array3d(dtype=float),
    # out
    outcome: Outcome,
):
    """Reward getting up and standing still, wherever that is.

    The height of the head alone misleads: it is greater in the splits than in a squat, and would have to fall on the
    way up. So the heights of head and pelvis count, and feet under the pelvis. Pose and stillness count only where the
    body stands, or bending the knees would cost more than it gains.
    """
    e = wp.tid()
    now = posture_of(rule, bones, e)
    speed = wp.length(bones.velocity[e, 0])
    angle = pose_error(bones, e)
    stands = now.high * now.straight
    high = wp.sqrt(wp.clamp(now.head, 0.0, 1.0) * wp.clamp(now.pelvis, 0.0, 1.0))
    outcome.terms[e, 0, GetUpTask.rewards.height] = 0.5 * high
    outcome.terms[e, 0, GetUpTask.rewards.feet] = 0.2 * tolerance(feet_off(bones, e), _FEET_BOUND, feet_margin)
    outcome.terms[e, 0, GetUpTask.rewards.still] = 0.15 * stands * stillness(still, speed)
    outcome.terms[e, 0, GetUpTask.rewards.pose] = 0.15 * stands * restfulness(still, angle)
    outcome.terms[e, 0, GetUpTask.rewards.control] = -rule.control_cost * mean_square_action(action, e, 0)
    write_standing(rule, now, speed, e, outcome)


@wp.kernel
def judge_hold(
    steps: int,
    control_dt: float,
    episodes: Episodes,
    # in and out: success is standing, and becomes having stood long enough
    held: wp.array(dtype=int),
    outcome: Outcome,
):
    """Count the control steps for which the avatar has been standing without a break."""
    e = wp.tid()
    if episodes.failure[e] == 0:
        held[e] = wp.where(outcome.success[e, 0], held[e] + 1, 0)
    outcome.success[e, 0] = held[e] >= steps
    outcome.metrics[e, 0, GetUpTask.metrics.held_seconds] = control_dt * float(held[e])


_STANDING = (
    "times a share of standing: 1 while the head is no lower than 0.95 of its height in the rest pose and the chest "
    "tilts by at most 0.1 rad; beyond them Gaussians that have fallen to 0.1 after another `upright.height_margin` of "
    "that height and after another `upright.tilt_margin`"
)


class GetUpTask(Task):
    """Stand up."""

    Config = GetUpConfig
    description = "get up from the ground, from lying face down or face up"
    observation_terms = UPRIGHT_TERMS
    rewards = (
        Term(
            "height",
            "0.5 times the geometric mean of the heights of head and pelvis over those in the rest pose, each at most "
            "1",
        ),
        Term(
            "feet",
            "0.2 while both ankles are, on average and horizontally, within 0.25 of the pelvis' height in the rest "
            "pose from the pelvis; beyond it a Gaussian that has fallen to 0.02 after another `feet_margin` of it",
        ),
        Term(
            "still",
            "0.15 while the pelvis is no faster than 0.05 m/s; beyond it a Gaussian that has fallen to 0.015 after "
            f"another `still.speed_margin`; all {_STANDING}",
        ),
        Term(
            "pose",
            "0.15 while the mean angle from the rest pose is at most 0.05 rad, of all joints and of the trunk's three; "
            "beyond it, by the greater one, a Gaussian that has fallen to 0.015 after another `still.pose_margin`; all "
            "as `still`",
        ),
        CONTROL,
    )
    metrics = (*STANDING_METRICS, Metric("held_seconds", "s", "time of standing without a break"))
    state_arrays = (TaskArray("held", int, cleared=True),)  # control steps of standing without a break
    scratch_arrays = (
        TaskArray(
            "lies_up",
            drawn=(Parameter("face_up", "-", 0.0, 1.0, "1 if the episode began face up or on the way up from there"),),
        ),
        TaskArray("reference_rotation", wp.quat, (NUM_JOINTS,)),
        TaskArray("reference_root", wp.vec3),
    )

    camera_direction = (2.4, -3.6, 0.82)

    summary = """The avatar lies on the ground, face down or face up (`face_up`), turned about the vertical at random,
its arms beside it, its joints up to `pose_noise` off that pose. A share of episodes, `halfway`, begins on the way up
instead, as a curriculum: on all fours or on a knee, sitting or squatting, or half up. The avatar must stand up to the
rest pose by the strength of its joints, and stay there for `hold_seconds`. Only the clock ends an episode; a fall costs
time. The place where it stands in the end does not matter; smooth walls are six metres away. Here `root_assist` leads
the pelvis upwards and towards upright, from wherever it is. With `control="pose"` the root wrench keeps the pelvis
where it lies, and there is nothing to learn."""
    success_doc = f"for `hold_seconds` without a break {STANDING_DOC}"
    picture_seconds = 1.0
    picture_actions = "zero"

    config: GetUpConfig

    def domain(self) -> Domain:
        places = [avatar.position for avatar in self.scene.avatars]
        room = Domain().around([(x + way, y + way) for x, y, *_ in places for way in (-ASIDE, ASIDE)])
        return replace(room, fenced=True)  # there is no way out of the episode by crawling

    def allocate(self, env) -> None:
        config = self.config
        self.rule, self.still = fill(Upright(), config.upright, config), fill(Still(), config.still)
        self.lying, self.poses = fill(Lying(), config), first_poses(env.device)
        self.grounding = Grounding(env)
        self.steps = max(1, round(config.hold_seconds / config.physics.control_dt))

    def record_reset(self, env, graph) -> None:
        state, limits = env.simulation.avatar.state, env.action_map
        place = wp.vec3(*self.scene.avatars[0].position, 0.0)
        graph.launch(
            spawn_lying,
            (env.num_envs, NUM_JOINTS),
            [env.episodes, self.lying, limits.lower, limits.upper, self.poses, place],
            [state.command_rotation, state.command_root, self.lies_up],
        )
        self.grounding.record_reset(env, graph)

    def record_references(self, env, graph) -> list[tuple[wp.array, wp.array]]:
        if env.control == "pose":
            return super().record_references(env, graph)
        reference = self.reference_rotation, self.reference_root
        graph.launch(lead_up, (env.num_envs, NUM_JOINTS), [env.bones[0]], list(reference))
        return [reference]

    def record_outcome(self, env, graph) -> None:
        inputs = [self.rule, self.still, self.config.feet_margin, env.bones[0], env.action]
        graph.launch(judge_rising, env.num_envs, inputs, [env.outcome])
        inputs = [self.steps, self.config.physics.control_dt, env.episodes]
        graph.launch(judge_hold, env.num_envs, inputs, [self.held, env.outcome])

    def record_observe(self, env, graph, agent: int, start: int) -> None:
        record_observe_upright(env, graph, agent, start)


TASK = GetUpTask
