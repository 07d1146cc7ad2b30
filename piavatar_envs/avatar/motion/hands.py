"""Hands that lie on the ground where a clip leans on them.

DeepMimic's arms end at the wrist, which its characters push themselves up with. Our hand goes on for 18 cm and would
bore into the ground there, or lift the whole body off it.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation

from piavatar_envs.avatar.body.skeleton import joint_index
from piavatar_envs.avatar.motion.ground import ground_level, lowest_heights, padded

if TYPE_CHECKING:
    from piavatar_envs.avatar.body.asset import AvatarAsset, ShapedBody
    from piavatar_envs.avatar.motion.motion import Motion

MAX_BEND = np.radians(85.0)  # of a wrist
CLEARANCE = 0.03  # [m] of the hand's middle line above the ground: half its thickness
_SMOOTHING = 0.08  # [s] reach of the average over time


def lay_hands_on_ground(motion: Motion, asset: AvatarAsset, body: ShapedBody | None, window: float) -> Motion:
    """Bend the wrists, towards the back of the hand where it can be chosen, until the fingers are above the ground.

    Args:
        motion: a clip; its wrists must be where the ground is meant to be, hands apart.
        asset: the avatar.
        body: one of its shapes; without it the mean shape.
        window: of the ground level, as in :meth:`Motion.on_ground` [s].
    """
    wrists = (joint_index("left_wrist"), joint_index("right_wrist"))
    level = ground_level(lowest_heights(motion, asset, body, ignored=wrists), motion.fps, window, motion.loop)
    shape = asset if body is None else body
    rest = np.asarray(shape.joints, dtype=np.float64)
    quaternions = motion.local_rotations.copy()
    turns, positions = motion.joint_frames(rest)
    for wrist in wrists:
        middle, back = _hand(shape.vertices, asset, rest, wrist)
        length = np.linalg.norm(middle)
        along, across = turns[:, wrist, 2] @ (middle / length), turns[:, wrist, 2] @ back
        wanted = np.clip((CLEARANCE - (positions[:, wrist, 2] - level)) / length, -1.0, 1.0)
        angle = _smoothed(_bend(along, across, wanted), motion.fps, motion.loop)
        axis = np.cross(middle / length, back)
        bent = Rotation.from_quat(quaternions[:, wrist], scalar_first=True) * Rotation.from_rotvec(
            angle[:, None] * axis
        )
        quaternions[:, wrist] = bent.as_quat(scalar_first=True)
    return replace(motion, local_rotations=quaternions)


def _bend(along: np.ndarray, across: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Return the smallest angle [rad] that makes the fingers' rise ``along cos + across sin`` at least ``wanted``.

    Args:
        along: rise of the fingers' direction, shape ``(num_frames,)``.
        across: rise of the back of the hand.
        wanted: the least rise.
    """
    swing = np.hypot(along, across)
    # The angle at which the fingers point highest; a hand that hangs straight down bends to its back.
    highest = np.arctan2(across, along)
    highest = np.where(highest < -0.8 * np.pi, highest + 2.0 * np.pi, highest)
    reached = np.arccos(np.clip(wanted / np.maximum(swing, 1e-9), -1.0, 1.0))
    angle = np.sign(highest) * np.maximum(np.abs(highest) - reached, 0.0)
    return np.clip(np.where(along >= wanted, 0.0, angle), -MAX_BEND, MAX_BEND)


def _hand(vertices: np.ndarray, asset: AvatarAsset, rest: np.ndarray, wrist: int) -> tuple[np.ndarray, np.ndarray]:
    """Return wrist to middle fingertip [m] and the unit normal of the back of the hand, at rest, each ``(3,)``."""
    weight = np.where(asset.skin_joints == wrist, asset.skin_weights, 0.0).sum(axis=1)
    offsets = np.asarray(vertices, dtype=np.float64)[weight > 0.9] - rest[wrist]
    centre = offsets.mean(axis=0)
    middle = centre / np.linalg.norm(centre) * (offsets @ centre).max() / np.linalg.norm(centre)
    # A hand is flat: its thinnest direction is the normal. At rest palms look down and inwards.
    normal = np.linalg.svd(offsets - centre, full_matrices=False)[2][2]
    normal = normal - (normal @ middle) / (middle @ middle) * middle
    return middle, normal / np.linalg.norm(normal) * np.sign(normal[2])


def _smoothed(values: np.ndarray, fps: float, loop: bool) -> np.ndarray:
    radius = int(np.ceil(_SMOOTHING * fps))
    kernel = np.hanning(2 * radius + 3)[1:-1]
    return np.convolve(padded(values, radius, loop), kernel / kernel.sum(), mode="valid")
