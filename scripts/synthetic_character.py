"""Write a dressed character with a Mixamo rig as GLB, made from the embedded body (MakeHuman, CC0).

It serves tests, training runs and a first try without a file of one's own: a stout man of 1.7 m in shirt, kilt and
tights with a thick cap of hair. Lengths are centimetres, and the axes of the bones point anywhere, as in files of other
programs::

    python -m scripts.synthetic_character hero.glb
"""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import tyro
from scipy.spatial import cKDTree

from piavatar_envs.avatar.body.asset import AvatarAsset, dense_weights
from piavatar_envs.avatar.body.skeleton import JOINT_NAMES, joint_index
from piavatar_envs.avatar.body.sources import load_asset
from scripts.bake_body import BODY_BONES
from scripts.gltf_files import Part, Writer, rig_of

#: Shape of the character by the embedded body's parameters.
SHAPE = {"sex": 1.0, "height": -0.3, "weight": 0.5, "belly": 0.4}
#: Linear colours of the skin by the joint that moves it most; all others have the first.
COLORS = {
    "": (0.62, 0.33, 0.22),
    "shirt": (0.10, 0.35, 0.20),
    "tights": (0.05, 0.05, 0.06),
}
SHIRT = (
    "pelvis",
    "spine1",
    "spine2",
    "spine3",
    *(f"{s}_{j}" for s in ("left", "right") for j in ("collar", "shoulder")),
)
TIGHTS = tuple(f"{s}_{j}" for s in ("left", "right") for j in ("hip", "knee", "ankle", "foot"))
HAIR, CLOTH = (0.12, 0.06, 0.03), (0.10, 0.20, 0.50)


def character(thick: bool = False) -> Writer:
    """Return the file of the character; ``thick`` gives it a closed skirt of 4 cm, which is body."""
    asset = load_asset("embedded")
    body = asset.shape([SHAPE.get(name, 0.0) for name in asset.shape_names])
    empty = {"shape_deltas": asset.shape_deltas[:0], "shape_joints": asset.shape_joints[:0]}
    person = dataclasses.replace(asset, vertices=body.vertices, joints=body.joints, shape_names=(), **empty)
    kinds = ["shirt" if n in SHIRT else "tights" if n in TIGHTS else "" for n in JOINT_NAMES]
    palette = np.array([COLORS[kind] for kind in kinds], "<f4")
    colors = {"COLOR_0": (palette[person.skin_joints[:, 0]], "VEC3")}
    names = [f"mixamorig:{bone}" for bone in BODY_BONES]
    parts = dressed(person) if thick else (hair_of(person), thin_skirt_of(person))
    return rig_of(person, names, parts=parts, attributes=colors, unit=100.0, turns=7).write()


def dressed(asset: AvatarAsset) -> tuple[Part, Part]:
    """Return a cap of hair, 3 to 5 cm thick, and a skirt of 4 cm, as closed meshes about the body of an asset."""
    top = asset.mean_body().vertices[:, 2].max()
    waist, hem = 0.60 * top, 0.44 * top
    section = np.array([[0.10, waist], [0.17, waist], [0.25, hem], [0.21, hem]])
    corner, share = np.divmod(np.arange(48), 12)
    outline = section[corner] + (share / 12.0)[:, None] * (section[(corner + 1) % 4] - section[corner])
    return hair_of(asset), _skirt(asset, outline, closed=True)


def hair_of(asset: AvatarAsset) -> Part:
    """Return a cap of hair, 3 to 5 cm thick, as a closed mesh about the head of an asset."""
    body = asset.mean_body()
    top = body.vertices[body.vertices[:, 2].argmax()].astype(np.float64)
    round_, faces = _ring(np.linspace(0.0, np.pi, 20), 32, closed=False)
    profile = np.stack([np.sin(round_[:, 0]), np.cos(round_[:, 0])], axis=1)
    around = np.stack([np.cos(round_[:, 1]), np.sin(round_[:, 1])], axis=1)
    hair = np.column_stack([profile[:, :1] * around, profile[:, 1]]) * [0.105, 0.12, 0.10]
    corners = hair[faces]
    faces = faces[np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) > 1e-9]
    hair += top + [0.0, 0.035, -0.055]
    of_head = np.zeros((len(hair), len(JOINT_NAMES)))
    of_head[:, joint_index("head")] = 1.0
    return Part("Hair", "hair", hair, faces, of_head, _painted(HAIR, len(hair)))


def thin_skirt_of(asset: AvatarAsset) -> Part:
    """Return a skirt that is one sheet, open above and below, which is worn and no part of the body."""
    top = asset.mean_body().vertices[:, 2].max()
    share = np.linspace(0.0, 1.0, 24)
    outline = np.column_stack([0.19 + 0.08 * share, (0.61 - 0.18 * share) * top])
    return _skirt(asset, outline, closed=False)


def _skirt(asset: AvatarAsset, outline: np.ndarray, closed: bool) -> Part:
    """Return a surface of revolution, four fifths as deep as wide, that moves with the nearest skin.

    Args:
        asset: of the body.
        outline: radius and height along the profile [m], shape ``(P, 2)``.
        closed: whether the profile ends where it begins.
    """
    round_, faces = _ring(np.arange(len(outline)), 40, closed)
    radius, height = outline[round_[:, 0].astype(int)].T
    skirt = np.column_stack([radius * np.cos(round_[:, 1]), 0.8 * radius * np.sin(round_[:, 1]), height])
    nearest = cKDTree(asset.mean_body().vertices).query(skirt, k=24)[1]
    weights = dense_weights(asset.skin_joints, asset.skin_weights)[nearest].mean(axis=1)
    return Part("Skirt", "cloth", skirt, faces, weights, _painted(CLOTH, len(skirt)))


def _painted(color: tuple[float, float, float], count: int) -> dict[str, tuple[np.ndarray, str]]:
    """Return the attribute of vertices of one colour."""
    return {"COLOR_0": (np.tile(np.array([color], "<f4"), (count, 1)), "VEC3")}


def _ring(along: np.ndarray, sectors: int, closed: bool) -> tuple[np.ndarray, np.ndarray]:
    """Return places along a profile and angles about z of a surface of revolution, and its outward triangles."""
    count = len(along)
    i, j = np.meshgrid(np.arange(count if closed else count - 1), np.arange(sectors), indexing="ij")
    a, b = i * sectors + j, ((i + 1) % count) * sectors + j
    c, d = i * sectors + (j + 1) % sectors, ((i + 1) % count) * sectors + (j + 1) % sectors
    faces = np.concatenate([np.stack([a, b, d], -1), np.stack([a, d, c], -1)]).reshape(-1, 3)
    angles = np.tile(2.0 * np.pi * np.arange(sectors) / sectors, count)
    return np.column_stack([np.repeat(along, sectors), angles]), faces


def main(path: tyro.conf.Positional[Path], thick: bool = False) -> None:
    """Write the character.

    Args:
        path: a .glb file.
        thick: give it a skirt of 4 cm, which is body, as regions of flesh need it.
    """
    character(thick).save(path)
    print(f"{path}: a character of 22 bones, {path.stat().st_size / 1e6:.1f} MB")


if __name__ == "__main__":
    tyro.cli(main)
