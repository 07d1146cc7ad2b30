"""Points of a skeleton's surface and the bone that each belongs to, from mesh files.

A folder has a mesh for every part of a skeleton, named by its bone: by a joint of this package (``left_knee.ply``) or
by its anatomy (``tibia_l.ply``). A part of another name goes to the bone that most of its points are nearest to, and
so does every point of a single file, one by one. The points are the source of bone particles, see
:mod:`piavatar_envs.avatar.body.sampling`; Keller et al. ("OSSO: Obtaining skeletal shape from outside", 2022) infer
such meshes from SMPL bodies.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from piavatar_envs.avatar.body.asset import SkeletonPoints
from piavatar_envs.avatar.body.skeleton import JOINT_NAMES, NUM_JOINTS, PARENTS, joint_index
from piavatar_envs.core.extras import missing
from piavatar_envs.core.reading import reading

SUFFIXES = (".ply", ".obj", ".stl", ".off")
MAX_BYTES, MAX_PARTS = 2**29, 1000
MAX_POINTS = 5_000_000
STEP = 0.005  # between points of a surface [m]; larger triangles get points inside, smaller ones share one
#: Bones without a child end beyond their joint, by so much of the bone before.
LEAF_LENGTH = 0.6
#: Anatomical names of parts, the first that is found in a file's name counts; ``side`` stands for left or right.
ANATOMY: tuple[tuple[str, str], ...] = (
    (r"femur|patella|thigh", "side_hip"),
    (r"tibia|fibula|shank|shin", "side_knee"),
    (r"metatars|talus|calc(an|n)|navicular|cuboid|cuneiform|heel|(?<!meta)tarsal", "side_ankle"),
    (r"toe|foot.*phal|phal.*foot", "side_foot"),
    (r"pelvis|sacrum|coccyx|ilium|ischium|pubis|innominate|hip_?bone|coxa", "pelvis"),
    (r"\bl[345]\b|lumbar_?[345]", "spine1"),
    (r"\bl[12]\b|\bt(9|10|11|12)\b|lumbar_?[12]|lumbar", "spine2"),
    (r"thora|\brib|stern|xipho|torso|\bt[1-8]\b", "spine3"),
    (r"cervic|\bc[1-7]\b|atlas|hyoid", "neck"),
    (r"skull|crani|mandib|jaw|maxill|teeth", "head"),
    (r"clavic|scapul", "side_collar"),
    (r"humer|upper_?arm", "side_shoulder"),
    (r"radius|ulna|forearm", "side_elbow"),
    (r"carp|hand|finger|thumb|phal|scaphoid|lunate|triquetr|pisiform|trapez|capitate|hamate", "side_wrist"),
)


def read_skeleton(
    path: str | Path, joints: np.ndarray, axes: np.ndarray | None = None, origin: np.ndarray | None = None
) -> SkeletonPoints:
    """Read the points of a skeleton in the pose of ``joints``.

    Args:
        path: one mesh, or a folder of meshes.
        joints: joints of the body in the same pose, in our axes [m], shape ``(22, 3)``.
        axes: matrix from the file's coordinates to ours, shape ``(3, 3)``; by default they are the same.
        origin: of our coordinates, in the file's axes turned by the matrix [m], shape ``(3,)``; zero by default.

    Returns:
        Points in our axes, at most one in a cube of :data:`STEP` of each bone.

    Raises:
        FileNotFoundError: there is no such file or folder.
        ValueError: no mesh is found, one cannot be read, or they are far from the body or of another size.
        MissingExtra: trimesh is not installed.
    """
    path = Path(path)
    axes = np.eye(3) if axes is None else np.asarray(axes)
    origin = np.zeros(3) if origin is None else np.asarray(origin)
    span = np.ptp(joints, axis=0).max()
    parts = {}
    for file in _files(path):
        corners, loose = _surface(file)
        parts[file] = corners @ axes.T - origin, loose @ axes.T - origin
    ends = np.concatenate([part.reshape(-1, 3) for pair in parts.values() for part in pair])
    distance, size = np.linalg.norm(ends - joints.mean(axis=0), axis=1).max(), np.ptp(ends, axis=0).max()
    if distance > 2.0 * span or size < 0.1 * span:
        raise ValueError(
            f"{path} has a skeleton of {size:.3g} m, up to {distance:.3g} m from the body, whose joints span "
            f"{span:.3g} m; give it in metres, in the pose and place of the body's file"
        )
    found = []
    for file, part in parts.items():
        points = _points(*part, path)
        own = thinned(SkeletonPoints(points, np.zeros(len(points), np.int32)), STEP).points
        name = bone_of_name(file.stem, own) if path.is_dir() else None
        bone = nearest_bones(own, joints) if name is None else np.full(len(own), joint_index(name))
        if path.is_dir():
            bone = np.full(len(own), np.bincount(bone).argmax())
        found.append(SkeletonPoints(own, bone.astype(np.int32)))
    return thinned(SkeletonPoints(*(np.concatenate([getattr(f, a) for f in found]) for a in ("points", "bone"))), STEP)


def bone_of_name(name: str, points: np.ndarray) -> str | None:
    """Return the joint that a part's name means, or None; left is where its points are, at positive x."""
    words = re.sub(r"[^a-z0-9]+", "_", re.sub(r"([a-z])([A-Z])", r"\1_\2", name).lower()).strip("_")
    if words in JOINT_NAMES:
        return words
    spaced = words.replace("_", " ")
    for pattern, joint in ANATOMY:
        if re.search(pattern, words) or re.search(pattern, spaced):
            return joint.replace("side", "left" if points[:, 0].mean() > 0.0 else "right")
    return None


def nearest_bones(points: np.ndarray, joints: np.ndarray) -> np.ndarray:
    """Return the bone whose axis is nearest to each point, shape ``(N,)``: from its joint to those of its children."""
    best, bone = np.full(len(points), np.inf), np.zeros(len(points), np.int32)
    children = set(PARENTS)
    for joint in range(1, NUM_JOINTS):
        ends = [(PARENTS[joint], joints[PARENTS[joint]], joints[joint])]
        if joint not in children:
            ends.append((joint, joints[joint], joints[joint] + LEAF_LENGTH * (joints[joint] - joints[PARENTS[joint]])))
        for owner, start, end in ends:
            axis = end - start
            share = np.clip((points - start) @ axis / max(float(axis @ axis), 1e-12), 0.0, 1.0)
            distance = np.linalg.norm(points - start - share[:, None] * axis, axis=1)
            closer = distance < best
            best[closer], bone[closer] = distance[closer], owner
    return bone


def thinned(skeleton: SkeletonPoints, size: float) -> SkeletonPoints:
    """Return at most one point of a bone in each cube of edge ``size`` [m]: the nearest to the mean of those there."""
    cell = np.concatenate([skeleton.bone[:, None], np.floor(skeleton.points / size)], axis=1).astype(np.int64)
    cell -= cell.min(axis=0, initial=0)
    key = np.ravel_multi_index(tuple(cell.T), cell.max(axis=0, initial=0) + 1)
    _, group, count = np.unique(key, return_inverse=True, return_counts=True)
    mean = np.stack([np.bincount(group, column) for column in skeleton.points.T], axis=1) / count[:, None]
    off = np.linalg.norm(skeleton.points - mean[group], axis=1)
    order = np.lexsort((off, group))
    first = order[np.append(0, np.cumsum(count)[:-1])]
    return SkeletonPoints(skeleton.points[first], skeleton.bone[first])


def moved(skeleton: SkeletonPoints, joints: np.ndarray, rotations: np.ndarray, places: np.ndarray) -> SkeletonPoints:
    """Return a skeleton in another pose: each bone moves rigidly from its joint ``(22, 3)`` to its new place."""
    offset = skeleton.points - joints[skeleton.bone]
    turned = np.einsum("kab,kb->ka", rotations[skeleton.bone], offset)
    return SkeletonPoints(turned + places[skeleton.bone], skeleton.bone)


def _files(path: Path) -> list[Path]:
    """Return the meshes at a path, in the order of their names."""
    if not path.exists():
        raise FileNotFoundError(f"no such file or folder: {path}")
    found = sorted(file for file in path.iterdir() if file.suffix.lower() in SUFFIXES) if path.is_dir() else [path]
    if not found or found[0].suffix.lower() not in SUFFIXES:
        raise ValueError(f"{path} has no mesh of a skeleton; use {', '.join(SUFFIXES)}")
    size = sum(file.stat().st_size for file in found)
    if size > MAX_BYTES or len(found) > MAX_PARTS:
        raise ValueError(f"{path} has {len(found)} meshes of {size} bytes; at most {MAX_PARTS} of {MAX_BYTES} are read")
    return found


def _surface(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Return a mesh's triangles ``(T, 3, 3)`` and vertices ``(V, 3)``."""
    try:
        import trimesh
    except ImportError:
        raise missing(f"the skeleton {path}", "trimesh", "props") from None
    with reading(path, "a mesh"):
        mesh = trimesh.load(path, file_type=path.suffix[1:].lower(), force="mesh", process=False)
        vertices, faces = np.asarray(mesh.vertices, dtype=np.float64), np.asarray(getattr(mesh, "faces", []))
        if len(vertices) == 0 or not np.isfinite(vertices).all():
            raise ValueError("it has no vertices, or some that are not finite")
        return vertices[faces.astype(np.int64)].reshape(-1, 3, 3), vertices


def _points(triangles: np.ndarray, vertices: np.ndarray, path: Path) -> np.ndarray:
    """Return points of a surface, ``(N, 3)``: its vertices, and more in triangles larger than a step."""
    points, total = [vertices], len(vertices)
    while len(triangles):  # halve longest edges
        edges = np.linalg.norm(np.roll(triangles, -1, axis=1) - triangles, axis=2)
        long = edges.max(axis=1) > STEP
        first = edges[long].argmax(axis=1)[:, None] + np.arange(3)
        a, b, c = np.take_along_axis(triangles[long], first[..., None] % 3, axis=1).swapaxes(0, 1)
        middle = 0.5 * (a + b)
        total += len(middle)
        if total > MAX_POINTS:
            raise ValueError(f"{path} needs over {MAX_POINTS} points, one every {STEP} m; simplify it")
        points.append(middle)
        triangles = np.concatenate([np.stack([a, middle, c], axis=1), np.stack([middle, b, c], axis=1)])
    return np.concatenate(points)
