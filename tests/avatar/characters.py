"""Characters made from the embedded body."""

from __future__ import annotations

import numpy as np

from piavatar_envs.avatar.body.asset import AvatarAsset, dense_weights
from piavatar_envs.avatar.body.character import Character, Surface
from piavatar_envs.avatar.body.skeleton import PARENTS, forward_kinematics, skin
from piavatar_envs.avatar.motion.retarget import align_limbs

SKIN_COLOR = (200, 150, 130)


def in_t_pose(asset: AvatarAsset) -> Character:
    """Return the body of an asset, its arms stretched to the sides, with its first two shape parameters."""
    side = {"left": np.array([1.0, 0.0, 0.0]), "right": np.array([-1.0, 0.0, 0.0])}
    straight = {f"{s}_{joint}": way for s, way in side.items() for joint in ("shoulder", "elbow")}
    joints = asset.joints.astype(np.float64)
    rotations = align_limbs(joints, straight).as_matrix()
    local = rotations.copy()
    for joint, parent in enumerate(PARENTS):
        if parent >= 0:
            local[joint] = rotations[parent].T @ rotations[joint]

    def posed(vertices, rest):
        world, moved = forward_kinematics(local, rest[0], rest)
        return skin(vertices, asset.skin_joints, asset.skin_weights, world, moved, rest), moved

    vertices, moved = posed(asset.vertices.astype(np.float64), joints)
    deltas, joint_deltas = np.zeros((2, 2, *vertices.shape)), np.zeros((2, 2, *joints.shape))
    for parameter, half in np.ndindex(2, 2):
        shaped = posed(
            asset.vertices + asset.shape_deltas[parameter, half], joints + asset.shape_joints[parameter, half]
        )
        deltas[parameter, half], joint_deltas[parameter, half] = shaped[0] - vertices, shaped[1] - moved
    return Character(
        name="t-pose",
        vertices=vertices,
        faces=asset.faces,
        weights=dense_weights(asset.skin_joints, asset.skin_weights),
        joints=moved,
        colors=np.tile(np.array(SKIN_COLOR, np.uint8), (len(vertices), 1)),
        surfaces=(Surface("body", 0, len(asset.faces)),),
        shape_names=asset.shape_names[:2],
        shape_deltas=deltas,
        shape_joints=joint_deltas,
    )
