"""First poses on the ground: lying face down or face up, or already on the way up from there."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import warp as wp

from piavatar_envs.avatar.body.skeleton import JOINT_NAMES, NUM_JOINTS
from piavatar_envs.avatar.rotation import quat_exp
from piavatar_envs.core.rng import STREAM_POSE, STREAM_TASK, generator

wp.set_module_options({"enable_backward": False})

_HALF = wp.constant(np.pi)
#: Turns about x from the rest pose [rad], of the left and the right joint of a name alike, of the pelvis from upright.
_Pose = Mapping[str, float]
#: The arms beside the chest; face down the toes are pointed and the head is raised off the nose, face up the heels come
#: down to the ground.
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
#: Face down and face up: lying, and the poses through which people get up from there.
_WAYS = ((_FACE_DOWN, _ON_ALL_FOURS, _ON_A_KNEE, _HALF_UP), (_FACE_UP, _SITTING, _SQUATTING, _HALF_UP))


@wp.struct
class Lying:
    """How first poses are drawn."""

    face_up: float  # share of face up
    halfway: float  # share of those on the way up
    noise: float  # greatest joint angle off the pose [rad]


def lying_rule(face_up: float, halfway: float, noise: float) -> Lying:
    """Kernel argument."""
    rule = Lying()
    rule.face_up, rule.halfway, rule.noise = face_up, halfway, noise
    return rule


def first_poses(device: str) -> wp.array:
    """Rotation vectors of first poses [rad], face down and face up, ``(2, poses, bones)``; the first of each lies."""
    turns = np.zeros((len(_WAYS), len(_WAYS[0]), NUM_JOINTS, 3), np.float32)
    for side, way in enumerate(_WAYS):
        for index, pose in enumerate(way):
            for joint, name in enumerate(JOINT_NAMES):
                turns[side, index, joint, 0] = pose.get(name, pose.get(name.partition("_")[2], 0.0))
    return wp.array(turns, dtype=wp.vec3, device=device)


@wp.kernel
def spawn_lying(
    mask: wp.array(dtype=wp.bool),
    seed: wp.array(dtype=int),
    episode: wp.array(dtype=int),
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
    """With the pelvis over ``place`` (x, y [m]), turned at random about the vertical; over ``(E, bones)``.

    ``poses`` are those of :func:`first_poses`.
    """
    e, b = wp.tid()
    if not mask[e]:
        return
    random = generator(seed[e], episode[e], STREAM_TASK, 0)
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
    random = generator(seed[e], episode[e], STREAM_POSE, b)
    v += rule.noise * wp.vec3(wp.randf(random, -1.0, 1.0), wp.randf(random, -1.0, 1.0), wp.randf(random, -1.0, 1.0))
    command_rotation[e, b] = quat_exp(wp.max(lower[b], wp.min(v, upper[b])))
