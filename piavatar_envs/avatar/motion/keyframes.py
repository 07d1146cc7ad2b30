"""Clips made by hand: key poses of a standing figure, joined by smooth steps.

A key says where the feet are, how the pelvis moves, where the arms point and how the trunk bends; the legs follow by
inverse kinematics. Between keys every quantity moves on a quintic smooth step, at rest in each key, so clips are smooth
to the second derivative. Lengths are in leg lengths, so a clip fits every shape of body.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import Rotation

from piavatar_envs.avatar.body.skeleton import NUM_JOINTS, joint_index
from piavatar_envs.avatar.motion.motion import Motion, ease, slerp
from piavatar_envs.avatar.motion.retarget import leg_length

FPS = 30.0  # [1/s]
MAX_REACH = 0.999  # of the straight leg: a knee is never locked
_LATERAL = np.array([1.0, 0.0, 0.0])  # knees bend about it; flexion is positive
_SIDES = ("left", "right")


@dataclass(frozen=True)
class Foot:
    """Position of a foot relative to its place in the rest pose.

    Attributes:
        offset: of the ankle, in leg lengths, shape ``(3,)``.
        pitch: toes down [deg].
    """

    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    pitch: float = 0.0


@dataclass(frozen=True)
class Arm:
    """Direction of the left arm in the axes of the chest (left +x, facing -y, up +z).

    The right arm takes the mirror image. The two directions must not be parallel: the elbow bends in their plane.

    Attributes:
        upper: shoulder to elbow, shape ``(3,)``.
        fore: elbow to wrist, shape ``(3,)``.
    """

    upper: tuple[float, float, float]
    fore: tuple[float, float, float]


@dataclass(frozen=True)
class Key:
    """A key pose; what is left out is as in the rest pose.

    Attributes:
        time: [s].
        pelvis: offset of the pelvis joint, in leg lengths, shape ``(3,)``.
        turns: rotation vectors [deg] of ``pelvis`` (in the world), spine, neck, head and collar joints, by name. About
            +x bends forward, about +y bends to the left, about +z turns to the left.
        left_foot, right_foot: the feet.
        left_arm, right_arm: the arms, ``None`` in the rest pose.
    """

    time: float
    pelvis: tuple[float, float, float] = (0.0, 0.0, 0.0)
    turns: Mapping[str, tuple[float, float, float]] = field(default_factory=dict)
    left_foot: Foot = Foot()
    right_foot: Foot = Foot()
    left_arm: Arm | None = None
    right_arm: Arm | None = None


def animate(name: str, keys: Sequence[Key], rest_joints: np.ndarray) -> Motion:
    """Build the clip that goes through the keys, ending as it starts (a loop).

    Args:
        name: of the clip.
        keys: at rising times, the first at 0; the last is the first pose again.
        rest_joints: joints of the body it shall move [m], shape ``(22, 3)``.

    Raises:
        ValueError: times that do not rise from 0.
    """
    times = np.array([key.time for key in keys])
    if len(keys) < 2 or times[0] != 0.0 or np.diff(times).min() <= 0.0:
        raise ValueError(f"clip {name!r}: key times {times.tolist()} s must rise from 0, at least two of them")
    rest = np.asarray(rest_joints, dtype=np.float64)
    # A whole number of frames: the whole clip is stretched by half a frame at most.
    time = np.linspace(0.0, times[-1], round(times[-1] * FPS) + 1)
    segment = np.clip(np.searchsorted(times, time, side="right") - 1, 0, len(keys) - 2)
    blend = ease((time - times[segment]) / (times[segment + 1] - times[segment]))

    def between(values: Sequence[object]) -> np.ndarray:
        array = np.array(values, dtype=np.float64)
        return array[segment] + (blend * (array[segment + 1] - array[segment]).T).T

    rotations = np.stack([_upper_body(key, rest) for key in keys])
    rotations = slerp(rotations[segment], rotations[segment + 1], blend[:, None])
    leg = leg_length(rest)
    root = rest[0] + leg * between([key.pelvis for key in keys])
    for side in _SIDES:
        feet = [getattr(key, f"{side}_foot") for key in keys]
        ankle = rest[joint_index(f"{side}_ankle")] + leg * between([foot.offset for foot in feet])
        pitch = Rotation.from_rotvec(between([foot.pitch for foot in feet])[:, None] * _LATERAL, degrees=True)
        solve_leg(side, rotations, root, ankle, pitch, rest)
    return Motion(name, FPS, rotations, root, loop=True, source="procedural")


def solve_leg(
    side: str, rotations: np.ndarray, root: np.ndarray, ankle: np.ndarray, foot: Rotation, rest: np.ndarray
) -> None:
    """Solve the inverse kinematics of one leg analytically: write hip, knee and ankle of ``rotations``.

    The knee bends about the lateral axis of the rest pose until hip and ankle are as far apart as asked; the hip then
    turns the leg onto its target with the knee kept pointing forward.

    Args:
        side: ``"left"`` or ``"right"``.
        rotations: wxyz, shape ``(num_frames, 22, 4)``, changed in place; the root's are read.
        root: pelvis positions [m], shape ``(num_frames, 3)``.
        ankle: wanted ankle positions [m], shape ``(num_frames, 3)``; too far a target is brought within reach.
        foot: wanted world rotations of the foot, ``num_frames`` of them.
        rest: joints of the rest pose [m], shape ``(22, 3)``.
    """
    hip_index, knee_index, ankle_index = (joint_index(f"{side}_{name}") for name in ("hip", "knee", "ankle"))
    thigh, shin = rest[knee_index] - rest[hip_index], rest[ankle_index] - rest[knee_index]
    pelvis = Rotation.from_quat(rotations[:, 0], scalar_first=True)
    target = pelvis.inv().apply(ankle - root) - (rest[hip_index] - rest[0])
    reach = MAX_REACH * (np.linalg.norm(thigh) + np.linalg.norm(shin))
    distance = np.minimum(np.linalg.norm(target, axis=1), reach)
    # |thigh + R_x(b) shin| = distance, with the angle b0 between the two in the sagittal plane at rest
    along = thigh[0] * shin[0]
    across = np.hypot(*thigh[1:]) * np.hypot(*shin[1:])
    b0 = np.arctan2(thigh[1] * shin[2] - thigh[2] * shin[1], thigh[1:] @ shin[1:])
    cosine = (0.5 * (distance**2 - thigh @ thigh - shin @ shin) - along) / across
    knee = Rotation.from_rotvec((np.arccos(np.clip(cosine, -1.0, 1.0)) - b0)[:, None] * _LATERAL)
    hip = two_vector_rotation(thigh + knee.apply(shin), _LATERAL, target, _LATERAL)
    local_foot = (pelvis * hip * knee).inv() * foot
    for joint, rotation in ((hip_index, hip), (knee_index, knee), (ankle_index, local_foot)):
        rotations[:, joint] = rotation.as_quat(scalar_first=True)


def two_vector_rotation(start: np.ndarray, start_hint: np.ndarray, end: np.ndarray, end_hint: np.ndarray) -> Rotation:
    """Return rotations that take ``start`` to ``end``, and ``start_hint`` as near to ``end_hint`` as possible.

    All of shape ``(..., 3)`` that broadcast; hints must not be parallel to their vectors.
    """

    def frame(vector: np.ndarray, hint: np.ndarray) -> np.ndarray:
        a = vector / np.linalg.norm(vector, axis=-1, keepdims=True)
        c = np.cross(a, hint)
        c = c / np.linalg.norm(c, axis=-1, keepdims=True)
        return np.stack([a, np.cross(c, a), c], axis=-1)

    return Rotation.from_matrix(frame(end, end_hint) @ np.swapaxes(frame(start, start_hint), -1, -2))


def _upper_body(key: Key, rest: np.ndarray) -> np.ndarray:
    """Return the local rotations of a key, legs at rest, wxyz ``(22, 4)``."""
    rotations = np.zeros((NUM_JOINTS, 4))
    rotations[:, 0] = 1.0
    for name, turn in key.turns.items():
        rotations[joint_index(name)] = Rotation.from_rotvec(turn, degrees=True).as_quat(scalar_first=True)
    for side in _SIDES:
        arm = getattr(key, f"{side}_arm")
        if arm is not None:
            shoulder, elbow = _pointing(side, arm, rest)
            rotations[joint_index(f"{side}_shoulder")] = shoulder.as_quat(scalar_first=True)
            rotations[joint_index(f"{side}_elbow")] = elbow.as_quat(scalar_first=True)
    return rotations


def _pointing(side: str, arm: Arm, rest: np.ndarray) -> tuple[Rotation, Rotation]:
    """Return rotations that point an arm: the elbow turns about its own hinge, the shoulder does the rest."""
    mirror = np.array([1.0 if side == "left" else -1.0, 1.0, 1.0])
    upper, fore = (mirror * direction for direction in (arm.upper, arm.fore))
    shoulder, elbow, wrist = (rest[joint_index(f"{side}_{name}")] for name in ("shoulder", "elbow", "wrist"))
    rest_upper, rest_fore = elbow - shoulder, wrist - elbow
    hinge = np.cross(rest_upper, rest_fore)
    turn = two_vector_rotation(rest_upper, hinge, upper, np.cross(upper, fore))
    return turn, two_vector_rotation(rest_fore, hinge, turn.inv().apply(fore), hinge)
