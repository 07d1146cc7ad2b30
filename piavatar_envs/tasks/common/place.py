"""Standing still in one's place, in kernels: where that is, how far one may be steered from it, what it is worth."""

from __future__ import annotations

import warp as wp

from piavatar_envs.avatar.rotation import quat_exp, quat_log
from piavatar_envs.avatar.types import Body
from piavatar_envs.envs.observations import write_vector
from piavatar_envs.mpm.types import row
from piavatar_envs.tasks.common.rewards import mean_square_action, tolerance

wp.set_module_options({"enable_backward": False})


@wp.struct
class PlaceRule:
    """Constants of where the avatar belongs, and what it is worth to be there."""

    place: wp.vec3  # x, y [m] and yaw [rad]
    range: float  # of the commanded root about there [m]
    pose_margin: float  # [rad]
    place_margin: float  # [m]
    control_cost: float


@wp.func
def home(rule: PlaceRule, body: Body, e: int):
    """Where the pelvis is when the avatar stands in its place [m]."""
    rest = body.rest_joint[row(e, body.rest_joint.shape[0]), 0]
    turned = wp.quat_rotate(quat_exp(wp.vec3(0.0, 0.0, rule.place[2])), rest)
    return turned + wp.vec3(rule.place[0], rule.place[1], 0.0)


@wp.kernel
def keep_place(
    rule: PlaceRule,
    body: Body,
    command_root: wp.array(dtype=wp.vec3),
    # out
    reference_root: wp.array(dtype=wp.vec3),
):
    """The commanded root, no farther from its place than it may be steered."""
    e = wp.tid()
    center = home(rule, body, e)
    out = command_root[e] - center
    out[2] = 0.0
    distance = wp.length(out)
    excess = wp.max(distance - rule.range, 0.0) / wp.max(distance, 1.0e-6)
    reference_root[e] = command_root[e] - excess * out


@wp.kernel
def judge_pose(
    rule: PlaceRule,
    body: Body,
    local: wp.array2d(dtype=wp.quat),
    position: wp.array2d(dtype=wp.vec3),
    action: wp.array3d(dtype=float),
    # out
    terms: wp.array3d(dtype=float),
    metrics: wp.array3d(dtype=float),
):
    """Reward of standing as in the rest pose, in one's place, and its cost."""
    e = wp.tid()
    bones = local.shape[1]
    angle = wp.length(quat_log(wp.quat_inverse(quat_exp(wp.vec3(0.0, 0.0, rule.place[2]))) * local[e, 0]))
    for b in range(1, bones):
        angle += wp.length(quat_log(local[e, b]))
    angle /= float(bones)
    off = position[e, 0] - home(rule, body, e)
    distance = wp.length(wp.vec2(off[0], off[1]))
    terms[e, 0, 0] = 0.6 * tolerance(angle, 0.05, rule.pose_margin)
    terms[e, 0, 1] = 0.4 * tolerance(distance, 0.02, rule.place_margin)
    terms[e, 0, 2] = -rule.control_cost * mean_square_action(action, e, 0)
    metrics[e, 0, 0] = wp.degrees(angle)
    metrics[e, 0, 1] = distance


@wp.kernel
def observe_home(
    rule: PlaceRule,
    body: Body,
    agent: int,
    start: int,
    rotation: wp.array2d(dtype=wp.quat),
    position: wp.array2d(dtype=wp.vec3),
    # out
    observation: wp.array3d(dtype=float),
):
    """The place from the pelvis."""
    e = wp.tid()
    way = home(rule, body, e) - position[e, 0]
    write_vector(observation, e, agent, start, wp.quat_rotate(wp.quat_inverse(rotation[e, 0]), way))
