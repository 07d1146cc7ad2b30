"""A person of Gaussian splats: a body is fitted to them, its particles move, and the splats are drawn."""

from __future__ import annotations

import json
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from piavatar_envs.avatar.body import registration, splat_registration, splats
from piavatar_envs.avatar.body.asset import AvatarAsset, Look, SurfacePoints, top_weights
from piavatar_envs.avatar.body.registration import POSES
from piavatar_envs.avatar.body.skeleton import JOINT_NAMES, NUM_JOINTS, joint_index
from piavatar_envs.avatar.body.smpl_file import FIRST_HAND_JOINT, MODELS
from piavatar_envs.avatar.body.sources import load_asset
from piavatar_envs.avatar.body.sources.mesh import UPS, check_up, in_metres, nearest_fit, usual_ups
from piavatar_envs.avatar.body.splat_files import read_splats
from piavatar_envs.avatar.body.splat_registration import (
    OPAQUE,
    FittedBody,
    at_rest,
    nearest_weights,
    opaque_box,
    register_splats,
)
from piavatar_envs.avatar.body.splats import SkinnedSplats, SplatCloud, mean_colors
from piavatar_envs.core.reading import numbers, reading
from piavatar_envs.core.result_cache import digest_of, kept

#: Endings of files that only this source reads.
SUFFIXES = (".spz",)
#: Greatest mean distance between the splats and the fitted body, over the height; clothes are loose.
MOST_RESIDUAL = 0.02
#: Greatest distance of a splat from the body, and greatest standard deviation, over the body's height.
MOST_DISTANCE, MOST_SCALE = 10.0, 1.0
#: Splats whose mean colour a vertex of the body takes.
_COLOR_SPLATS = 8


def build(
    path: str,
    pose: str | None = None,
    weights: str | None = None,
    up: str | None = None,
    height: float | None = None,
    body: Mapping[str, Any] | None = None,
    as_particles: bool = False,
) -> AvatarAsset:
    """Return the body of a person of splats, with the splats as its look.

    Args:
        path: of a file of splats, see :mod:`piavatar_envs.avatar.body.splat_files`.
        pose: ``"A"``, ``"T"``, or a JSON file of rotation vectors [rad] by joint, relative to their parents and to the
            pose in which bodies of this package rest; A or T by default.
        weights: an ``.npz`` with the skinning ``weights`` of the splats, shape ``(S, J)``, for our 22 joints or those
            of SMPL, SMPL-H or SMPL-X; by default those of the nearest point of the body's skin.
        up: axis that points up, of :data:`.mesh.UPS`; found by proportions if not given.
        height: of the person [m]; by default the file's own, in metres, centimetres or millimetres.
        body: settings of another source, whose body is fitted, such as ``{"source": "smplx", "path": ...}``; its shape
            parameters are fitted, too.
        as_particles: whether the splats are particles of the body's surface, too.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: a file cannot be read, has no person's height, or the body does not fit to it.
    """
    check_up(up)
    asset = load_asset(**(body or {}))
    cloud = read_splats(path)
    _check_extent(cloud, Path(path).name)
    rotations = None if pose in (None, *POSES) else _read_pose(Path(pose))
    starts = (pose,) if pose in POSES else (POSES if pose is None else ("A",))

    def fit(axis: str) -> tuple[FittedBody, SplatCloud]:
        placed = _in_metres(Path(path).name, cloud.placed(UPS[axis], 1.0, np.zeros(3)), height)
        return _fitted(asset, placed, starts, rotations, Path(path).name), placed

    size = np.ptp(opaque_box(cloud), axis=0)
    usual = usual_ups(("z", "y", "-z", "-y"), Path(path), size)
    fitted, placed = fit(up) if up else nearest_fit(fit, usual, size, MOST_RESIDUAL)
    tall = float(np.ptp(fitted.posed[:, 2]))
    if fitted.residual > MOST_RESIDUAL:
        raise ValueError(
            f"{path}: the body does not fit to the splats, which are {100.0 * fitted.residual * tall:.1f} cm away from "
            f"it on average, more than {100.0 * MOST_RESIDUAL * tall:.1f}; use one standing person, name the pose and "
            f"the axis that points up ({', '.join(UPS)}), and remove the background"
        )
    dense = (
        nearest_weights(asset, fitted, placed.means) if weights is None else _read_weights(Path(weights), len(cloud))
    )
    rest = at_rest(placed, dense, fitted)
    skinned = SkinnedSplats(rest, *top_weights(dense))
    return _asset(Path(path).name, asset, fitted, placed, skinned, as_particles)


def _asset(
    name: str, asset: AvatarAsset, fitted: FittedBody, placed: SplatCloud, skinned: SkinnedSplats, as_particles: bool
) -> AvatarAsset:
    """Return the fitted body at rest, and the splats as its look."""
    vertices = fitted.vertices.astype(np.float32)
    look = Look(
        vertices=vertices,
        faces=asset.faces,
        skin_joints=asset.skin_joints,
        skin_weights=asset.skin_weights,
        colors=_colors(placed, fitted.posed),
        shape_deltas=np.zeros((0, 2, len(vertices), 3), np.float32),
        splats=skinned,
    )
    points = SurfacePoints(skinned.cloud.means, skinned.skin_joints, skinned.skin_weights) if as_particles else None
    return AvatarAsset(
        name=name,
        vertices=vertices,
        faces=asset.faces,
        joints=fitted.joints.astype(np.float32),
        skin_joints=asset.skin_joints,
        skin_weights=asset.skin_weights,
        shape_names=(),
        shape_deltas=np.zeros((0, 2, len(vertices), 3), np.float32),
        shape_joints=np.zeros((0, 2, NUM_JOINTS, 3), np.float32),
        look=look,
        groups=asset.groups,
        surface_points=points,
    )


def _check_extent(cloud: SplatCloud, name: str) -> None:
    """Refuse splats that are far away or large, in comparison with the longest side of the body's box."""
    low, high = opaque_box(cloud)
    height = float((high - low).max())
    away = np.maximum(low - cloud.means, cloud.means - high).max(axis=1)
    for count, what, most in (
        (int((away > MOST_DISTANCE * height).sum()), "farther away from the body than", MOST_DISTANCE),
        (int((cloud.scales.max(axis=1) > MOST_SCALE * height).sum()), "larger than", MOST_SCALE),
    ):
        if count:
            raise ValueError(
                f"{name}: {count} splats are {what} {most * height:.4g} in the file's unit, {most:g} times the body's "
                "height; delete them, as in SuperSplat"
            )


def _in_metres(name: str, cloud: SplatCloud, height: float | None) -> SplatCloud:
    """Return upright splats in metres, standing on z = 0.

    Raises:
        ValueError: the height given, or the splats', is none of a person.
    """
    low, high = opaque_box(cloud)
    scaled, _ = in_metres(name, np.stack([low, high]), height)
    size = float(np.ptp(scaled[:, 2]) / (high[2] - low[2]))
    middle = 0.5 * (low + high)
    return cloud.placed(np.eye(3), size, -size * np.array([middle[0], middle[1], low[2]]))


def _fitted(
    asset: AvatarAsset, cloud: SplatCloud, starts: tuple[str, ...], pose: np.ndarray | None, name: str
) -> FittedBody:
    """Fit the body, or read the result of a former time."""

    def compute() -> dict[str, np.ndarray]:
        return {key: np.asarray(value) for key, value in vars(register_splats(asset, cloud, starts, pose)).items()}

    of_body = [asset.vertices, asset.faces, asset.joints, asset.skin_joints, asset.skin_weights, asset.shape_deltas]
    of_splats = [cloud.means, cloud.scales, cloud.rotations, cloud.opacities]
    digest = digest_of([*of_body, *of_splats, list(starts), pose], [splat_registration, registration, splats])
    arrays = kept("splats", digest, compute, f"fitting the body to {name}")
    return FittedBody(**{key: float(value) if value.ndim == 0 else value for key, value in arrays.items()})


def _read_pose(path: Path) -> np.ndarray:
    """Return local rotations ``(22, 3, 3)`` from a JSON file of rotation vectors by the names of joints."""
    if path.suffix.lower() != ".json":
        raise ValueError(f"pose={str(path)!r} is none of {', '.join(POSES)} and no .json file of rotation vectors")
    rotations = np.tile(np.eye(3), (NUM_JOINTS, 1, 1))
    with reading(path, "a JSON file of rotation vectors by the names of joints"):
        given = json.loads(path.read_bytes()[: 1 << 20])
        for name, vector in given.items():
            if name not in JOINT_NAMES:
                raise ValueError(f"it has the joint {name!r:.40}; use those of {', '.join(JOINT_NAMES)}")
            vector = np.asarray(vector, np.float64)
            if vector.shape != (3,) or not np.isfinite(vector).all():
                raise ValueError(f"the rotation vector of {name} is {vector.tolist()!r:.60}, not three finite numbers")
            rotations[joint_index(name)] = Rotation.from_rotvec(vector).as_matrix()
    return rotations


def _read_weights(path: Path, count: int) -> np.ndarray:
    """Return skinning weights of our joints from a file, shape ``(S, 22)``."""
    with reading(path, "an .npz file of skinning weights"), zipfile.ZipFile(path) as archive:
        promised = sum(entry.file_size for entry in archive.infolist())
        if promised > 8 * count * max(MODELS) + (1 << 16):
            raise ValueError(f"it unpacks to {promised} bytes, more than the weights of {count} splats")
        with np.load(path, allow_pickle=False) as file:
            weights = numbers(file, "weights").astype(np.float64)
        joints = weights.shape[1] if weights.ndim == 2 else 0
        if joints not in (NUM_JOINTS, *MODELS) or len(weights) != count:
            known = ", ".join(map(str, (NUM_JOINTS, *MODELS)))
            raise ValueError(f"weights have shape {weights.shape}, not ({count}, J) with J one of {known}")
        if not (np.isfinite(weights).all() and weights.min() >= 0.0 and weights.sum(axis=1).min() > 1e-6):
            raise ValueError("weights must be finite and not negative, and no row may be zero")
    body = weights[:, :NUM_JOINTS].copy()
    for joint in range(NUM_JOINTS, joints):
        body[:, _owner(joint, joints)] += weights[:, joint]
    return body / body.sum(axis=1, keepdims=True)


def _owner(joint: int, joints: int) -> int:
    """Return our joint that a hand's, the jaw's or an eye's of a SMPL model moves with."""
    first = FIRST_HAND_JOINT.get(joints, NUM_JOINTS)
    if joint < first:
        return joint_index("head")
    return joint_index("left_wrist" if joint - first < (joints - first) // 2 else "right_wrist")


def _colors(cloud: SplatCloud, points: np.ndarray) -> np.ndarray:
    """Return sRGB of the opaque splats around points, shape ``(V, 3)`` uint8."""
    own = cloud.chosen(cloud.opacities > OPAQUE)
    plain = np.clip(mean_colors(own.sh), 0.0, 1.0)
    near = cKDTree(own.means).query(points, k=min(_COLOR_SPLATS, len(own)))[1].reshape(len(points), -1)
    return np.rint(255.0 * plain[near].mean(axis=1)).astype(np.uint8)
