"""Rising from the ground: what it is worth to be on the way to one's feet.

The height of the head alone leads astray: in the splits it is higher than in a squat, and would have to be lowered to
get up. So the heights of head *and* pelvis count, and that the feet are under the pelvis; how the joints are and how
still it is counts where it stands, or bending the knees would cost more than it gains.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import warp as wp

from piavatar_envs.avatar.body.skeleton import joint_index
from piavatar_envs.avatar.types import Body
from piavatar_envs.mpm.types import row
from piavatar_envs.tasks.common.rewards import tolerance
from piavatar_envs.tasks.common.upright import (
    Still,
    Upright,
    mean_angle,
    posture_of,
    restfulness,
    stillness,
    write_standing,
)

if TYPE_CHECKING:
    from piavatar_envs.core.launch_graph import LaunchGraph
    from piavatar_envs.envs.batch_env import BatchEnv

wp.set_module_options({"enable_backward": False})

_LEFT, _RIGHT = wp.constant(joint_index("left_ankle")), wp.constant(joint_index("right_ankle"))
RISING_TERMS = ("height", "feet", "still", "pose", "control")
_FEET_BOUND = wp.constant(0.25)
_STANDING = (
    "times how much it stands: 1 while the head is no lower than 0.95 of its height in the rest pose and the chest "
    "tilts by at most 0.1 rad, beyond them Gaussians that have fallen to 0.1 after another `upright.height_margin` of "
    "that height and after another `upright.tilt_margin`"
)
RISING_DOCS: Mapping[str, str] = {
    "height": "0.5 times the geometric mean of the heights of head and pelvis over those in the rest pose, each at "
    "most 1",
    "feet": "0.2 while both ankles are, on average and in the plane of the ground, within 0.25 of the pelvis' height "
    "in the rest pose from the pelvis; beyond it a Gaussian that has fallen to 0.02 after another `feet_margin` of it",
    "still": "0.15 while the pelvis is no faster than 0.05 m/s; beyond it a Gaussian that has fallen to 0.015 after "
    f"another `still.speed_margin`; all {_STANDING}",
    "pose": "0.15 while the mean angle of the joints from the rest pose is at most 0.05 rad; beyond it a Gaussian that "
    "has fallen to 0.015 after another `still.pose_margin`; all as `still`",
    "control": "`-control_cost` times the mean of the squared action components",
}


@wp.func
def feet_off(body: Body, e: int, position: wp.array2d(dtype=wp.vec3)):
    """Mean distance of the ankles from the pelvis in the plane of the ground, over its height in the rest pose."""
    at = position[e, 0]
    left, right = position[e, _LEFT] - at, position[e, _RIGHT] - at
    apart = 0.5 * (wp.length(wp.vec2(left[0], left[1])) + wp.length(wp.vec2(right[0], right[1])))
    return apart / body.rest_joint[row(e, body.rest_joint.shape[0]), 0][2]


@wp.kernel
def judge_rising(
    rule: Upright,
    still: Still,
    feet_margin: float,
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
    """Reward of getting up and of standing still, wherever, and its cost."""
    e = wp.tid()
    now = posture_of(rule, body, e, rotation, position)
    speed = wp.length(velocity[e, 0])
    angle = mean_angle(local, e)
    stands = now.high * now.straight
    high = wp.sqrt(wp.clamp(now.head, 0.0, 1.0) * wp.clamp(now.pelvis, 0.0, 1.0))
    terms[e, 0, 0] = 0.5 * high
    terms[e, 0, 1] = 0.2 * tolerance(feet_off(body, e, position), _FEET_BOUND, feet_margin)
    terms[e, 0, 2] = 0.15 * stands * stillness(still, speed)
    terms[e, 0, 3] = 0.15 * stands * restfulness(still, angle)
    write_standing(rule, now, speed, e, action, terms, metrics, success)


def record_rising_outcome(env: BatchEnv, graph: LaunchGraph, rule: Upright, still: Still, feet_margin: float) -> None:
    """Append: terms, metrics and success of standing up."""
    avatar = env.simulation.avatar
    t = avatar.tracked
    graph.launch(
        judge_rising,
        env.num_envs,
        [rule, still, feet_margin, avatar.body, t.rotation, t.position, t.velocity, t.local, env.action],
        [env.terms, env.metrics, env.success],
    )
