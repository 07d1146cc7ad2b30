"""Characters made from the embedded body."""

from __future__ import annotations

import dataclasses

import numpy as np
from scipy.spatial import cKDTree

from piavatar_envs.avatar.body.asset import AvatarAsset, dense_weights
from piavatar_envs.avatar.body.character import Character, Surface
from piavatar_envs.avatar.body.skeleton import PARENTS, forward_kinematics, joint_index, skin
from piavatar_envs.avatar.motion.retarget import align_limbs
from tests.avatar.gltf_files import Part

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


def dressed(asset: AvatarAsset) -> tuple[Part, Part]:
    """Return a cap of hair, 3 to 5 cm thick, and a skirt of 4 cm, as closed meshes about the body of an asset."""
    body = asset.mean_body()
    weights = dense_weights(asset.skin_joints, asset.skin_weights)
    top = body.vertices[body.vertices[:, 2].argmax()].astype(np.float64)
    round_, faces = _ring(np.linspace(0.0, np.pi, 20), 32, closed=False)
    profile = np.stack([np.sin(round_[:, 0]), np.cos(round_[:, 0])], axis=1)
    around = np.stack([np.cos(round_[:, 1]), np.sin(round_[:, 1])], axis=1)
    hair = np.column_stack([profile[:, :1] * around, profile[:, 1]]) * [0.105, 0.12, 0.10]
    corners = hair[faces]
    faces = faces[np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) > 1e-9]
    hair += top + [0.0, 0.035, -0.055]
    of_head = np.zeros((len(hair), weights.shape[1]))
    of_head[:, joint_index("head")] = 1.0
    colour = {"COLOR_0": (np.tile(np.array([[0.12, 0.06, 0.03]], "<f4"), (len(hair), 1)), "VEC3")}
    cap = Part("Hair", "hair", hair, faces, of_head, colour)
    waist, hem = 0.60 * top[2], 0.44 * top[2]
    section = np.array([[0.10, waist], [0.17, waist], [0.25, hem], [0.21, hem]])
    corner, share = np.divmod(np.arange(48), 12)
    outline = section[corner] + (share / 12.0)[:, None] * (section[(corner + 1) % 4] - section[corner])
    round_, faces = _ring(np.arange(48), 40, closed=True)
    radius, height = outline[round_[:, 0].astype(int)].T
    skirt = np.column_stack([radius * np.cos(round_[:, 1]), 0.8 * radius * np.sin(round_[:, 1]), height])
    nearest = cKDTree(body.vertices).query(skirt, k=24)[1]
    colour = {"COLOR_0": (np.tile(np.array([[0.1, 0.2, 0.5]], "<f4"), (len(skirt), 1)), "VEC3")}
    return cap, Part("Skirt", "cloth", skirt, faces, weights[nearest].mean(axis=1), colour)


def _ring(along: np.ndarray, sectors: int, closed: bool) -> tuple[np.ndarray, np.ndarray]:
    """Return places along a profile and angles about z of a surface of revolution, and its outward triangles."""
    count = len(along)
    i, j = np.meshgrid(np.arange(count if closed else count - 1), np.arange(sectors), indexing="ij")
    a, b = i * sectors + j, ((i + 1) % count) * sectors + j
    c, d = i * sectors + (j + 1) % sectors, ((i + 1) % count) * sectors + (j + 1) % sectors
    faces = np.concatenate([np.stack([a, b, d], -1), np.stack([a, d, c], -1)]).reshape(-1, 3)
    angles = np.tile(2.0 * np.pi * np.arange(sectors) / sectors, count)
    return np.column_stack([np.repeat(along, sectors), angles]), faces


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
