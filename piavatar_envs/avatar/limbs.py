"""Limb groups: the parts of a body that move through the grid apart, so that an arm can touch the belly."""

from __future__ import annotations

import numpy as np

from piavatar_envs.avatar.asset import dense_weights
from piavatar_envs.avatar.skeleton import BODY_PARTS, NUM_JOINTS, joint_index

#: The torso, which head, neck and collars belong to, and the limbs that grow out of it.
LIMB_GROUPS: tuple[str, ...] = ("torso", "left_arm", "right_arm", "left_leg", "right_leg")

#: Skinning weight that each of two groups must have in a particle for it to lie in the seam between them.
SEAM_WEIGHT = 0.05


def limb_group_of_joint() -> np.ndarray:
    """Index into :data:`LIMB_GROUPS` of every joint, shape ``(22,)`` int32."""
    group = np.zeros(NUM_JOINTS, dtype=np.int32)
    for index, name in enumerate(LIMB_GROUPS[1:], start=1):
        group[[joint_index(joint) for joint in BODY_PARTS[name]]] = index
    return group


def limb_groups(skin_joints: np.ndarray, skin_weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The group of every particle, and where two groups grow together.

    Args:
        skin_joints: joints that move each particle, shape ``(P, K)`` int.
        skin_weights: their weights, rows sum to one, shape ``(P, K)``.

    Returns:
        Index into :data:`LIMB_GROUPS` of the group with the largest summed weight (of equals the first), shape
        ``(P,)`` int32, and the seam, 1 where two groups have :data:`SEAM_WEIGHT` each and else 0, shape ``(P,)``
        float32.
    """
    share = dense_weights(skin_joints, skin_weights) @ np.eye(len(LIMB_GROUPS))[limb_group_of_joint()]
    second = np.sort(share, axis=1)[:, -2]
    return share.argmax(axis=1).astype(np.int32), (second >= SEAM_WEIGHT).astype(np.float32)
