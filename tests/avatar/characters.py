"""Characters made from the embedded body."""

from __future__ import annotations

import dataclasses

import numpy as np
from scipy.spatial import cKDTree

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


def in_a_skirt(character: Character, points: np.ndarray, faces: np.ndarray, color: tuple[int, int, int]) -> Character:
    """Return a character of the body of an asset that wears a surface as files have it, skinned with the nearest skin.

    Args:
        character: the body, as its only surface.
        points: of the surface, in the character's coordinates and pose [m], shape ``(W, 3)``.
        faces: its triangles.
        color: of its vertices, sRGB.
    """
    count, parameters = len(character.vertices), len(character.shape_names)
    nearest = cKDTree(character.vertices).query(points)[1]
    surfaces = (*character.surfaces, Surface("Skirt", len(character.faces), len(character.faces) + len(faces), "Cloth"))
    return dataclasses.replace(
        character,
        vertices=np.concatenate([character.vertices, points]),
        faces=np.concatenate([character.faces, faces + count]).astype(np.int32),
        weights=np.concatenate([character.weights, character.weights[nearest]]),
        colors=np.concatenate([character.colors, np.tile(np.array(color, np.uint8), (len(points), 1))]),
        surfaces=surfaces,
        shape_deltas=np.concatenate([character.shape_deltas, np.zeros((parameters, 2, len(points), 3))], axis=2),
    )
