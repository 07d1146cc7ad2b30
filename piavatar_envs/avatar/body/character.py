"""Characters as read from files, and the bodies that they become.

A :class:`Character` is a skinned soup of surfaces in the rest pose of its file. :func:`body_of` poses it as the body of
this package rests, closes its skin, and keeps its own surfaces as the look of the body.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy import sparse

from piavatar_envs.avatar.body import closed_skin, sampling
from piavatar_envs.avatar.body.asset import (
    AvatarAsset,
    Look,
    PoseDisplacements,
    WornSurface,
    area_vectors,
    top_weights,
)
from piavatar_envs.avatar.body.closed_skin import CELL, ClosedSkin, close_skin, distinct, read_soup, unique_rows
from piavatar_envs.avatar.body.groups import on_skin
from piavatar_envs.avatar.body.rigs import spread_weights
from piavatar_envs.avatar.body.skeleton import (
    NUM_JOINTS,
    blended_maps,
    bone_maps,
    forward_kinematics,
    joint_index,
    local_rotations,
)
from piavatar_envs.avatar.body.skeleton_mesh import moved, read_skeleton
from piavatar_envs.avatar.body.textures import Textures
from piavatar_envs.avatar.motion.retarget import LIMB_ENDS, align_limbs
from piavatar_envs.core.result_cache import digest_of, kept

#: Standing heights that are taken for those of a person [m].
HEIGHTS = (0.3, 3.0)
#: Triangles of the body, those that are worn, and those without area or with the same corners as another one.
_BODY, _WORN, _NONE = 0, 1, 2
#: Triangles of a look, about; finer surfaces are drawn with fewer.
MOST_DRAWN = 200_000


@dataclass(frozen=True)
class Surface:
    """Some triangles of a character.

    Attributes:
        name: in the file.
        first: its first triangle.
        last: the triangle after its last one.
        material: name of its material, empty without one.
        held: whether it is a thing on a bone, without skinning of its own, which is never body.
    """

    name: str
    first: int
    last: int
    material: str = ""
    held: bool = False


@dataclass(frozen=True, eq=False)
class Character:
    """A skinned character as read from a file, in its own rest pose. Metres, z up, facing -y, its left is +x.

    Attributes:
        name: for messages and metadata.
        vertices: of all surfaces [m], shape ``(V, 3)`` float64.
        faces: triangles of all surfaces, shape ``(T, 3)`` int32.
        weights: of the joints, rows sum to one, shape ``(V, 22)`` float64.
        joints: joint positions [m], shape ``(22, 3)`` float64.
        colors: sRGB of the vertices, shape ``(V, 3)`` uint8, or None for the one colour of the avatar.
        surfaces: parts of ``faces``, in order.
        shape_names: names of the ``S`` shape parameters.
        shape_deltas: vertex displacements at -1 and at +1 of each parameter [m], shape ``(S, 2, V, 3)``.
        shape_joints: joint displacements, the same way [m], shape ``(S, 2, 22, 3)``.
        notes: what was guessed in reading it, such as the unit.
        pose: displacements of the vertices that depend on the pose, for the look; only of a character that rests in
            the reference pose already.
        placement: matrix ``(3, 3)`` and origin ``(3,)`` [m] of our coordinates: ``vertex = matrix file - origin``.
        groups: weights in [0, 1] of the vertices in painted groups, each shape ``(V,)``.
        textures: of the base colour, for the look; ``colors`` are those at the vertices.
    """

    name: str
    vertices: np.ndarray
    faces: np.ndarray
    weights: np.ndarray
    joints: np.ndarray
    colors: np.ndarray | None
    surfaces: tuple[Surface, ...]
    shape_names: tuple[str, ...]
    shape_deltas: np.ndarray
    shape_joints: np.ndarray
    notes: tuple[str, ...] = ()
    pose: PoseDisplacements | None = None
    placement: tuple[np.ndarray, np.ndarray] | None = None
    groups: Mapping[str, np.ndarray] = field(default_factory=dict)
    textures: Textures | None = None

    @property
    def held(self) -> np.ndarray:
        """Whether each triangle is of a thing that is held, shape ``(T,)`` bool."""
        held = np.zeros(len(self.faces), bool)
        for surface in self.surfaces:
            held[surface.first : surface.last] = surface.held
        return held


def body_of(character: Character, cell: float = CELL) -> AvatarAsset:
    """Return the body of a character, and its surfaces as the look.

    Args:
        character: in any pose from which its limbs can be turned as those of the embedded body.
        cell: spacing of the grid on which the skin is closed [m].

    Raises:
        ValueError: its height is outside :data:`HEIGHTS`, nothing encloses a volume, or arrays do not fit together.
    """
    _check(character)
    posed = to_reference_pose(with_all_joints(character))
    skin, flipped, part = _closed(character, posed.vertices, cell)
    skin_joints, skin_weights = top_weights(np.maximum(skin.anchors @ posed.weights, 0.0))
    count = len(posed.shape_names)
    deltas = np.zeros((count, 2, len(skin.vertices), 3), np.float32)
    for parameter, half in np.ndindex(count, 2):
        deltas[parameter, half] = skin.anchors @ posed.shape_deltas[parameter, half]
    look, drawn = _look(posed, flipped, part)
    return AvatarAsset(
        name=character.name,
        vertices=skin.vertices.astype(np.float32),
        faces=skin.faces,
        joints=posed.joints.astype(np.float32),
        skin_joints=skin_joints,
        skin_weights=skin_weights,
        shape_names=posed.shape_names,
        shape_deltas=deltas,
        shape_joints=np.asarray(posed.shape_joints, np.float32).reshape(count, 2, NUM_JOINTS, 3),
        look=look,
        groups=on_skin({**_named(posed), **posed.groups}, skin.anchors),
        worn=_worn(posed, part, drawn),
    )


def _closed(character: Character, posed: np.ndarray, cell: float) -> tuple[ClosedSkin, np.ndarray, np.ndarray]:
    """Return the closed skin in the posed vertices, and of each triangle whether to turn it round, and what it is."""

    def compute() -> dict[str, np.ndarray]:
        soup = read_soup(character.vertices, character.faces, character.held, cell)
        skin = close_skin(soup, posed, cell)
        part = np.full(len(character.faces), _NONE, np.int8)
        for shell in soup.shells:
            part[shell.rows] = _BODY if shell.body else _WORN
        anchors = {name: getattr(skin.anchors, name) for name in ("data", "indices", "indptr")}
        return {"vertices": skin.vertices, "faces": skin.faces, "flipped": soup.flipped, "part": part, **anchors}

    digest = digest_of(
        [character.vertices, character.faces, character.held, posed, cell],
        [sys.modules[__name__], closed_skin, sampling],
    )
    found = kept("skin", digest, compute, f"closing the skin of {character.name}")
    shape = (len(found["vertices"]), len(character.vertices))
    anchors = sparse.csr_array((found["data"], found["indices"], found["indptr"]), shape=shape)
    return ClosedSkin(found["vertices"], found["faces"], anchors), found["flipped"], found["part"]


def with_skeleton(asset: AvatarAsset, character: Character, path: str | None) -> AvatarAsset:
    """Return the body of a character with the points of a skeleton that is in its file's rest pose and coordinates.

    Args:
        asset: of :func:`body_of`.
        character: in its rest pose.
        path: one mesh, or a folder of meshes, see :mod:`piavatar_envs.avatar.body.skeleton_mesh`; None for none.

    Raises:
        FileNotFoundError: there is no such file or folder.
        ValueError: no mesh is found, one cannot be read, or they are far from the body or of another size.
    """
    if path is None:
        return asset
    found = read_skeleton(path, character.joints, *(character.placement or ()))
    places = asset.joints.astype(np.float64)
    return replace(asset, skeleton=moved(found, character.joints, reference_rotations(character.joints), places))


def to_reference_pose(character: Character) -> Character:
    """Return the character with its limbs turned as those of the embedded body rest, by linear blend skinning.

    Joint ranges, poses of agents and motions count from that pose. Down each limb the added rotation is the shortest;
    feet stay as they are. Other shapes are turned by the same rotations.

    Raises:
        ValueError: a limb points opposite to that of the embedded body.
    """
    rotations = reference_rotations(character.joints)
    matrix = _turn(character.joints, rotations)
    vertices = _blend(character.weights, matrix, character.vertices)
    joints = _moved_joints(character.joints, rotations)
    count = len(character.shape_names)
    deltas = np.zeros((count, 2, len(vertices), 3), np.float32)
    shape_joints = np.zeros((count, 2, NUM_JOINTS, 3))
    for parameter, half in np.ndindex(count, 2):
        shaped = character.joints + character.shape_joints[parameter, half]
        points = character.vertices + character.shape_deltas[parameter, half]
        deltas[parameter, half] = _blend(character.weights, _turn(shaped, rotations), points) - vertices
        shape_joints[parameter, half] = _moved_joints(shaped, rotations) - joints
    return replace(character, vertices=vertices, joints=joints, shape_deltas=deltas, shape_joints=shape_joints)


def with_all_joints(character: Character) -> Character:
    """Return the character with flesh on every joint: one that no vertex follows takes a share of its parent's."""
    return replace(character, weights=spread_weights(character.weights, character.vertices, character.joints))


def reference_rotations(joints: np.ndarray) -> np.ndarray:
    """Return world rotations of the bones into the reference pose, shape ``(22, 3, 3)``."""
    from piavatar_envs.avatar.body.sources.embedded import build  # which is a source, as those that need this

    reference = build().joints.astype(np.float64)
    ends = {name: reference[joint_index(end)] - reference[joint_index(name)] for name, end in LIMB_ENDS.items()}
    level = {"left_ankle": None, "right_ankle": None}
    return align_limbs(joints, {**ends, **level}).as_matrix()


def _moved_joints(joints: np.ndarray, rotations: np.ndarray) -> np.ndarray:
    """Return joints ``(22, 3)`` after world rotations of the bones, the pelvis in its place."""
    return forward_kinematics(local_rotations(rotations), joints[0], joints)[1]


def _turn(joints: np.ndarray, rotations: np.ndarray) -> np.ndarray:
    """Return the affine maps of the bones, shape ``(22, 3, 4)``."""
    return bone_maps(rotations, _moved_joints(joints, rotations), joints)


def _blend(weights: np.ndarray, matrix: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Apply linear blend skinning of all joints to points, shape ``(V, 3)`` float64."""
    blended = blended_maps(weights, matrix)
    return np.einsum("vij,vj->vi", blended[:, :, :3], points) + blended[:, :, 3]


def _named(character: Character) -> dict[str, np.ndarray]:
    """Return the vertices of each surface and of each material by name, shape ``(V,)``; equal names are one group."""
    groups: dict[str, np.ndarray] = {}
    for surface in character.surfaces:
        for name in (surface.name, surface.material):
            if name:
                own = character.faces[surface.first : surface.last]
                groups.setdefault(name, np.zeros(len(character.vertices)))[own] = 1.0
    return groups


def _worn(posed: Character, part: np.ndarray, drawn: np.ndarray) -> dict[str, WornSurface]:
    """Return the surfaces of a posed character that are worn, by name; equal names are one.

    Args:
        posed: the character.
        part: what each of its triangles is, shape ``(T,)``.
        drawn: its triangle that each one of the look is, shape ``(U,)``.
    """
    rows: dict[str, list[np.ndarray]] = {}
    for surface in posed.surfaces:
        own = surface.first + np.flatnonzero(part[surface.first : surface.last] == _WORN)
        for name in {surface.name, surface.material} - {""}:
            if len(own) and not surface.held:
                rows.setdefault(name, []).append(own)
    found = {}
    for name, pieces in sorted(rows.items()):
        own = np.unique(np.concatenate(pieces))
        used, faces = np.unique(posed.faces[own], return_inverse=True)
        found[name] = WornSurface(
            posed.vertices[used].astype(np.float32),
            faces.reshape(-1, 3).astype(np.int32),
            None if posed.colors is None else np.ascontiguousarray(posed.colors[used], np.uint8),
            np.flatnonzero(np.isin(drawn, own)).astype(np.int32),
        )
    return found


def _look(posed: Character, flipped: np.ndarray, part: np.ndarray) -> tuple[Look, np.ndarray]:
    """Return the surfaces of a posed character, and the triangle of the character that each one of the look is.

    Those that are worn are drawn from both sides.
    """
    faces = np.array(posed.faces, np.int32)
    faces[flipped] = faces[flipped, ::-1]
    shown = np.flatnonzero(part != _NONE)
    # across cells of a grid, triangles with few vertices would smear their textures over the seams
    textures = posed.textures if len(shown) <= MOST_DRAWN else None
    faces, rows = _coarser(posed.vertices, faces[shown], part[shown])
    shown = shown[rows]
    worn = part[shown] == _WORN
    outer, once = np.unique(faces, return_inverse=True)
    inner, again = np.unique(faces[worn], return_inverse=True)
    chosen, drawn = np.concatenate([outer, inner]), np.concatenate([shown, shown[worn]])
    skin_joints, skin_weights = top_weights(np.maximum(posed.weights, 0.0)[chosen])
    look = Look(
        vertices=posed.vertices[chosen].astype(np.float32),
        faces=np.concatenate([once.reshape(-1, 3), again.reshape(-1, 3)[:, ::-1] + len(outer)]).astype(np.int32),
        skin_joints=skin_joints,
        skin_weights=skin_weights,
        colors=None if posed.colors is None else np.ascontiguousarray(posed.colors[chosen], np.uint8),
        shape_deltas=np.asarray(posed.shape_deltas, np.float32).reshape(-1, 2, len(posed.vertices), 3)[:, :, chosen],
        pose=None if posed.pose is None else PoseDisplacements(posed.pose.directions[chosen], posed.pose.reference),
        textures=None if textures is None else textures.chosen(chosen, drawn),
    )
    return look, drawn


def _coarser(vertices: np.ndarray, faces: np.ndarray, part: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return triangles between fewer vertices where there are more than can be drawn swiftly, and which ones they were.

    Of the vertices in a cell of a grid the one nearest to their mean stands for all (Rossignac & Borrel,
    "Multi-resolution 3D approximations for rendering complex scenes", 1993).
    """
    if len(faces) <= MOST_DRAWN:
        return faces, np.arange(len(faces))
    area = np.linalg.norm(area_vectors(vertices, faces), axis=1).sum()
    used = np.unique(faces)
    place = np.floor(vertices[used] / np.sqrt(2.0 * area / MOST_DRAWN)).astype(np.int64)
    # clothes and the body beneath them have cells of their own
    place[:, 0] = 2 * place[:, 0] + np.isin(used, faces[part == _WORN])
    _, cell = unique_rows(place)
    count = np.bincount(cell)
    mean = np.stack([np.bincount(cell, vertices[used, axis]) for axis in range(3)], axis=1) / count[:, None]
    apart = np.linalg.norm(vertices[used] - mean[cell], axis=1)
    order = np.lexsort((used, apart, cell))
    nearest = used[order[np.searchsorted(cell[order], np.arange(len(count)))]]
    stand = np.zeros(len(vertices), np.int32)
    stand[used] = nearest[cell]
    rows = distinct(stand[faces])
    return stand[faces[rows]], rows


def _check(character: Character) -> None:
    """Refuse arrays that do not fit together, and a body that is not a person's size.

    Raises:
        ValueError: arrays do not fit together, or no person has that size.
    """
    count = len(character.vertices)
    shapes: Sequence[tuple[str, np.ndarray, tuple[int, ...]]] = (
        ("vertices", character.vertices, (count, 3)),
        ("weights", character.weights, (count, NUM_JOINTS)),
        ("joints", character.joints, (NUM_JOINTS, 3)),
        ("colors", np.zeros((count, 3)) if character.colors is None else character.colors, (count, 3)),
    )
    for name, array, shape in shapes:
        if np.shape(array) != shape:
            raise ValueError(f"{character.name}: {name} have shape {np.shape(array)}, not {shape}")
        if not np.isfinite(array).all():
            raise ValueError(f"{character.name}: {name} are not all finite")
    if len(character.faces) and not 0 <= character.faces.min() <= character.faces.max() < count:
        raise ValueError(f"{character.name}: a triangle names a vertex outside [0, {count})")
    textures = character.textures
    if textures is not None and (len(textures.uv), len(textures.image)) != (count, len(character.faces)):
        raise ValueError(
            f"{character.name}: textures of {len(textures.uv)} vertices and {len(textures.image)} triangles, it has "
            f"{count} and {len(character.faces)}"
        )
    height = float(np.ptp(character.vertices[:, 2])) if count else 0.0
    if not HEIGHTS[0] <= height <= HEIGHTS[1]:
        low, high = HEIGHTS
        raise ValueError(
            f"{character.name} is {height:.3g} m tall, outside [{low:g}, {high:g}] m; give its height in metres"
        )
