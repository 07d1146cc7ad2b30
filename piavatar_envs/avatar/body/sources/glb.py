"""A character of a glTF, GLB or VRM file with a skin: any human rig, in any unit and axes.

The file's joints become the 22 of this package (:mod:`piavatar_envs.avatar.body.rigs`), its surfaces a closed body and
a look (:func:`piavatar_envs.avatar.body.character.body_of`). Meshes on a bone without skinning of their own are held
things and never body; morph targets are left out.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from piavatar_envs.avatar.body.asset import AvatarAsset
from piavatar_envs.avatar.body.character import HEIGHTS, Character, Surface, body_of, with_skeleton
from piavatar_envs.avatar.body.rigs import (
    JointMap,
    axes_of,
    joints_of,
    map_joints,
    of_rig,
    owner_of_nodes,
    read_mapping,
)
from piavatar_envs.avatar.body.skeleton import NUM_JOINTS
from piavatar_envs.avatar.body.textures import Textures, joined
from piavatar_envs.avatar.gltf import Gltf, read_gltf
from piavatar_envs.avatar.gltf_surfaces import Surfaces, read_surfaces

SUFFIXES = (".glb", ".gltf", ".vrm")
#: Units of files that say metres and mean others.
UNITS = {"centimetres": 0.01, "inches": 0.0254, "feet": 0.3048, "millimetres": 0.001, "hectometres": 100.0}
#: Heights that a unit other than metres must give, so that a doll or a giant in metres is not rescaled [m].
LIKELY_HEIGHTS = (1.0, 2.4)


def build(
    path: str, height: float | None = None, mapping: str | None = None, skeleton: str | None = None
) -> AvatarAsset:
    """Return the body of a skinned character.

    Args:
        path: of a ``.glb``, ``.gltf`` or ``.vrm`` file.
        height: that the character, from its soles to the top of its hair, is scaled to [m]; as the file has it if None.
        mapping: of a JSON file from our joints to names of the file's nodes, for rigs whose names say nothing.
        skeleton: mesh of a skeleton, or a folder of its parts, in the file's rest pose and coordinates.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it cannot be read, its rig lacks a joint, or its height is not a person's.
    """
    character = read_character(path, height, mapping)
    return with_skeleton(body_of(character), character, skeleton)


def read_character(path: str | Path, height: float | None = None, mapping: str | Path | None = None) -> Character:
    """Return the character of a file in its rest pose, in our axes and metres.

    Args:
        path: of the file.
        height: to scale it to [m].
        mapping: of a mapping file.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it cannot be read, its rig lacks a joint, or its height is not a person's.
    """
    gltf = read_gltf(path)
    surfaces = read_surfaces(gltf)
    if not any(piece.skin is not None for piece in surfaces.pieces):
        raise ValueError(f'{path} has no skinned mesh; for a surface without a skeleton use the source "mesh"')
    rest = surfaces.world[:, :3, 3]
    joint_map = _rig(gltf, rest, mapping)
    owners = owner_of_nodes(joint_map, gltf.parents)
    hanging, own = _hanging(gltf, surfaces), of_rig(joint_map, gltf.parents, rest)
    kept = [i for i in hanging if own[surfaces.pieces[i].nodes[surfaces.pieces[i].weights > 0.0]].any()]
    notes = [*surfaces.notes, *joint_map.notes]
    for some, left, why in (
        (range(len(surfaces.pieces)), hanging, "they hang on no bone"),
        (hanging, kept, "they belong to another skeleton"),
    ):
        if names := {surfaces.pieces[i].name for i in some if i not in left}:
            notes.append(f"left out, for {why}: {', '.join(sorted(names))[:200]}")
    if not any(surfaces.pieces[i].skin is not None for i in kept):
        pelvis = gltf.names[joint_map.nodes["pelvis"]]
        raise ValueError(f"{path}: no mesh is skinned to the skeleton of {pelvis!r}; export one figure with its own")
    places = np.concatenate([surfaces.places[index] for index in kept])
    weights = np.concatenate([_weights(surfaces, index, owners) for index in kept])
    skinned = np.concatenate([np.full(len(surfaces.places[i]), surfaces.pieces[i].skin is not None) for i in kept])
    with _of_file(path):
        axes, mirrors = axes_of(joint_map, rest, _foot_tips(joint_map, rest, places, weights))
    notes += _axis_notes(axes, mirrors)
    places, rest = places @ axes.T, rest @ axes.T
    scale, unit = scale_of(float(np.ptp(places[skinned, 2])), height, str(path))
    notes += unit
    places, rest = scale * places, scale * rest
    joints = joints_of(joint_map, rest)
    origin = np.array([joints[0, 0], joints[0, 1], places[skinned, 2].min()])
    places, joints = places - origin, joints - origin
    faces, parts = _faces(surfaces, kept, mirrors)
    return Character(
        name=Path(path).name,
        vertices=places,
        faces=faces,
        weights=weights,
        joints=joints,
        colors=np.concatenate([surfaces.pieces[index].colors for index in kept]),
        surfaces=parts,
        shape_names=(),
        shape_deltas=np.zeros((0, 2, len(places), 3)),
        shape_joints=np.zeros((0, 2, NUM_JOINTS, 3)),
        notes=tuple(notes),
        placement=(scale * axes, origin),
        groups=_painted(surfaces, kept),
        textures=_textures(surfaces, kept),
    )


def joint_names(path: str | Path, mapping: str | Path | None = None) -> dict[str, str]:
    """Return the names of the file's nodes that are our joints, by joint; those that it lacks are not in it.

    Args:
        path: of the file.
        mapping: of a mapping file.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it cannot be read, or its rig lacks a joint.
    """
    gltf = read_gltf(path)
    rest = read_surfaces(gltf).world[:, :3, 3]
    return {joint: gltf.names[node] for joint, node in _rig(gltf, rest, mapping).nodes.items()}


def scale_of(size: float, height: float | None, path: str) -> tuple[float, list[str]]:
    """Return the factor that makes metres of a file's unit, and a note where that is a guess.

    Args:
        size: height of the character in the file's unit.
        height: that it shall have [m]; None for its own.
        path: for the error.

    Raises:
        ValueError: the character has no height, or one that is not a person's.
    """
    if not (np.isfinite(size) and size > 0.0):
        raise ValueError(f"{path}: the character is {size:g} tall")
    if height is not None:
        if not HEIGHTS[0] <= height <= HEIGHTS[1]:
            raise ValueError(f"height={height:g} is outside [{HEIGHTS[0]:g}, {HEIGHTS[1]:g}] m; keep it inside")
        return height / size, []
    if HEIGHTS[0] <= size <= HEIGHTS[1]:
        return 1.0, []
    likely = {unit: f for unit, f in UNITS.items() if LIKELY_HEIGHTS[0] <= f * size <= LIKELY_HEIGHTS[1]}
    if not likely:
        raise ValueError(
            f"{path}: the character is {size:.4g} m tall, outside [{HEIGHTS[0]:g}, {HEIGHTS[1]:g}] m, and in no other "
            "unit a person; give its height in metres, such as height=1.75"
        )
    unit = min(likely, key=lambda name: abs(np.log(likely[name] * size / 1.7)))
    return likely[unit], [f"it is {size:.4g} tall, which is taken for {unit}: {likely[unit] * size:.3f} m"]


def _rig(gltf: Gltf, rest: np.ndarray, mapping: str | Path | None) -> JointMap:
    """Return our joints among the nodes of a file; its meshes are not candidates, though they be named as joints.

    Args:
        gltf: the file.
        rest: positions of its nodes, shape ``(N, 3)``.
        mapping: of a mapping file.

    Raises:
        ValueError: of the rig, with the path.
    """
    by_hand = None if mapping is None else read_mapping(mapping)
    joints = np.zeros(len(gltf.parents), bool)
    for skin in gltf.skins:
        joints[skin.joints] = True
    meshes = np.array(["mesh" in node for node in gltf.items("nodes")], bool)
    names = [name if own or not mesh else "" for name, own, mesh in zip(gltf.names, joints, meshes, strict=True)]
    with _of_file(gltf.path):
        return map_joints(names, gltf.parents, rest, gltf.humanoid, by_hand)


@contextmanager
def _of_file(path: str | Path) -> Iterator[None]:
    """Name the file in errors of its rig."""
    try:
        yield
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None


def _hanging(gltf: Gltf, surfaces: Surfaces) -> list[int]:
    """Return indices of the pieces that are skinned or hang on a bone."""
    bones = {int(joint) for skin in gltf.skins for joint in skin.joints}
    on_bone = np.zeros(len(gltf.parents), bool)
    for node in gltf.order:
        parent = gltf.parents[node]
        on_bone[node] = int(node) in bones or (parent >= 0 and on_bone[parent])
    return [i for i, piece in enumerate(surfaces.pieces) if piece.skin is not None or on_bone[piece.node]]


def _weights(surfaces: Surfaces, index: int, owners: np.ndarray) -> np.ndarray:
    """Return the weights of our joints for a piece, shape ``(V, 22)``."""
    piece = surfaces.pieces[index]
    weights = np.zeros((len(piece.points), NUM_JOINTS))
    np.add.at(weights, (np.arange(len(weights))[:, None], owners[piece.nodes]), piece.weights)
    return weights


def _textures(surfaces: Surfaces, kept: list[int]) -> Textures | None:
    """Return the textures of some pieces laid one after the other; None where none has any."""
    pieces = [surfaces.pieces[index] for index in kept]
    return joined([(piece.textures, piece.colors, len(piece.faces)) for piece in pieces])


def _painted(surfaces: Surfaces, kept: list[int]) -> dict[str, np.ndarray]:
    """Return the painted groups of all pieces, each shape ``(V,)``; a piece without one is not in it."""
    pieces = [surfaces.pieces[index] for index in kept]
    names = dict.fromkeys(name for piece in pieces for name in piece.painted)
    return {
        name: np.concatenate([piece.painted.get(name, np.zeros(len(piece.points))) for piece in pieces])
        for name in names
    }


def _foot_tips(joint_map: JointMap, rest: np.ndarray, places: np.ndarray, weights: np.ndarray) -> np.ndarray | None:
    """Return the middles of the flesh of both feet, shape ``(2, 3)``; None where a foot has none, or toes tell."""
    if not {"left_foot", "right_foot"} & set(joint_map.missing):
        return None
    tips = []
    for ankle in (7, 8):
        foot = weights[:, ankle] > 0.5
        if not foot.any():
            return None
        tips.append(places[foot].mean(axis=0))
    return np.stack(tips)


def _axis_notes(axes: np.ndarray, mirrors: bool) -> list[str]:
    """Return notes on axes that are not those of glTF (y up, facing +z), and on a file that is mirrored."""
    notes = []
    letters = "xyz"

    def named(row: np.ndarray) -> str:
        axis = int(np.abs(row).argmax())
        return ("-" if row[axis] < 0.0 else "+") + letters[axis]

    up, ahead = named(axes[2]), named(-axes[1])
    if up != "+y" or ahead != "+z":
        notes.append(f"it stands along {up} and faces {ahead}: turned upright")
    if mirrors:
        notes.append("its left and right are exchanged, as in files of left-handed programs: mirrored back")
    return notes


def _faces(surfaces: Surfaces, kept: list[int], mirrors: bool) -> tuple[np.ndarray, tuple[Surface, ...]]:
    """Return the triangles of all pieces, outwards, and the parts that the pieces are."""
    faces, parts = [], []
    first = start = 0
    for index in kept:
        piece, own = surfaces.pieces[index], surfaces.faces[index]
        faces.append(start + (own[:, ::-1] if mirrors else own))
        parts.append(Surface(piece.name, first, first + len(own), piece.material, piece.skin is None))
        first += len(own)
        start += len(piece.points)
    return np.concatenate(faces).astype(np.int32), tuple(parts)
