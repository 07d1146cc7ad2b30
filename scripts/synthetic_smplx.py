"""Write a model with the layout of SMPL-X, SMPL-H or SMPL, made from the embedded body (MakeHuman, CC0).

It serves tests, benchmarks and a first try without a licence. It is not SMPL: shapes are the embedded body's, and
pose displacements are bulges of bent joints. Like SMPL-X it has 10,475 vertices, 9,383 of a skin with open eyes and
twice 546 of an eyeball::

    python -m scripts.synthetic_smplx synthetic_smplx.npz
"""

from __future__ import annotations

import heapq
from importlib import resources
from pathlib import Path

import numpy as np
import tyro

from piavatar_envs.avatar.body.asset import dense_weights
from piavatar_envs.avatar.body.skeleton import JOINT_NAMES, NUM_JOINTS, joint_index
from piavatar_envs.avatar.motion.retarget import align_limbs

SKIN_VERTICES, RINGS, SPOKES, EYE_RADIUS = 9383, 17, 32, 0.0125
#: Right and up of an eye from the head joint, as shares of the embedded body's height [m].
EYE_RIGHT, EYE_UP = 0.031, 0.090
SIGMAS = 2.5  # of a shape coefficient at the end of the embedded body's range
CURL = 0.2  # bend of each finger joint in the hands' mean pose [rad]
BULGE = 0.01  # of a joint bent by a right angle [m]
_LEFT, _DOWN = np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, -1.0])
_T_POSE = {
    **{f"left_{joint}": _LEFT for joint in ("shoulder", "elbow")},
    **{f"right_{joint}": -_LEFT for joint in ("shoulder", "elbow")},
    **{f"{side}_{joint}": _DOWN for side in ("left", "right") for joint in ("hip", "knee")},
    "left_ankle": None,
    "right_ankle": None,
}
#: SMPL's axes from ours: y up and facing +z, from z up and facing -y.
TO_SMPL = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])


def synthetic_model(joints: int = 55, columns: int = 20) -> dict[str, np.ndarray]:
    """Return the arrays of a model file.

    Args:
        joints: 55 for SMPL-X, 52 for SMPL-H, 24 for SMPL.
        columns: of shape and, for SMPL-X, expression.
    """
    with resources.files("piavatar_envs.data").joinpath("body.npz").open("rb") as stream, np.load(stream) as arrays:
        data = {key: arrays[key] for key in arrays.files}
    data["dense"] = dense_weights(data["skin_joints"], data["skin_weights"].astype(float), 52)
    data["dense"] /= data["dense"].sum(axis=1, keepdims=True)
    turns, centres = _t_pose(data)
    blended = np.einsum("vj,jab->vab", data["dense"], turns)
    vertices = np.einsum("vab,vb->va", blended, data["vertices"]) + data["dense"] @ centres
    places = np.einsum("jab,jb->ja", turns, data["joints"]) + centres
    deltas = data["shape_deltas"].reshape(-1, 2, *data["vertices"].shape) * float(data["shape_step"])
    shapes = np.einsum("vab,svb->vas", blended, 0.5 * (deltas[:, 1] - deltas[:, 0]) / SIGMAS)
    faces, weights = data["faces"].astype(np.int64), data["dense"]
    parents = data["parents"].astype(np.int64)
    if joints == 55:
        vertices, faces, weights, shapes, places, parents = _with_eyes(
            vertices, faces, weights, shapes, places, parents
        )
    elif joints == 24:
        places, parents, weights = _with_hands(places, parents, weights)
    return _arrays(vertices, faces, weights, shapes, places, parents, columns)


def _t_pose(data: dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Return rotations and translations of the 52 joints from the embedded rest pose to a T-pose."""
    rest, parents = data["joints"].astype(float), data["parents"]
    turns = np.concatenate([align_limbs(rest[:NUM_JOINTS], _T_POSE).as_matrix(), np.empty((30, 3, 3))])
    places = rest.copy()
    for joint in range(1, 52):
        parent = parents[joint]
        if joint >= NUM_JOINTS:
            turns[joint] = turns[parent]
        places[joint] = places[parent] + turns[parent] @ (rest[joint] - rest[parent])
    return turns, places - np.einsum("jab,jb->ja", turns, rest)


def _with_hands(places: np.ndarray, parents: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return joints, parents and weights of SMPL, which has one joint per hand, the middle finger's first."""
    merged = np.zeros((len(weights), 24))
    merged[:, :NUM_JOINTS] = weights[:, :NUM_JOINTS]
    merged[:, 22], merged[:, 23] = weights[:, 22:37].sum(axis=1), weights[:, 37:].sum(axis=1)
    return places[[*range(NUM_JOINTS), 25, 40]], np.append(parents[:NUM_JOINTS], [20, 21]), merged


def _with_eyes(
    vertices: np.ndarray,
    faces: np.ndarray,
    weights: np.ndarray,
    shapes: np.ndarray,
    places: np.ndarray,
    parents: np.ndarray,
) -> tuple[np.ndarray, ...]:
    """Return a skin of :data:`SKIN_VERTICES` with open eyes, two eyeballs, a jaw, and the joints of SMPL-X."""
    head = places[joint_index("head")]
    eyes = []
    for side in (1.0, -1.0):
        middle = vertices[faces].mean(axis=1)
        sideways = np.hypot(middle[:, 0] - side * EYE_RIGHT, middle[:, 2] - head[2] - EYE_UP)
        front = (sideways < 0.8 * EYE_RADIUS) & (middle[:, 1] < head[1] - 0.05)
        eyes.append(middle[front].mean(axis=0) + [0.0, 0.7 * EYE_RADIUS, 0.0])
        faces = faces[~front]
    used, faces = np.unique(faces, return_inverse=True)
    kept, faces = _collapsed(vertices[used], faces.reshape(-1, 3), SKIN_VERTICES)
    used = used[kept]
    jaw = head + [0.0, -0.02, 0.03]
    below = vertices[used] - jaw
    chin = np.clip(-below[:, 2] / 0.02, 0.0, 1.0) * np.clip(-below[:, 1] / 0.03, 0.0, 1.0)
    skin = np.zeros((len(used), 55))
    skin[:, :22], skin[:, 25:] = weights[used, :22], weights[used, 22:]
    skin[:, 22] = chin * skin[:, 15]
    skin[:, 15] -= skin[:, 22]
    ball, ball_faces = _sphere()
    parts, all_faces, owned, moved = [vertices[used]], [faces], [skin], [shapes[used]]
    for index, eye in enumerate(eyes):
        all_faces.append(ball_faces + sum(map(len, parts)))
        parts.append(eye + EYE_RADIUS * ball)
        owned.append(np.tile(np.eye(55)[23 + index], (len(ball), 1)))
        nearest = np.linalg.norm(vertices[used] - eye, axis=1).argsort()[:20]
        moved.append(np.tile(shapes[used][nearest].mean(axis=0), (len(ball), 1, 1)))
    places = np.concatenate([places[:22], [jaw], eyes, places[22:]])
    shifted = np.where(parents[22:] >= 22, parents[22:] + 3, parents[22:])
    parents = np.concatenate([parents[:22], [15, 15, 15], shifted])
    return *map(np.concatenate, (parts, all_faces, owned, moved)), places, parents


def _sphere() -> tuple[np.ndarray, np.ndarray]:
    """Return a closed unit sphere of 2 poles and rings of points."""
    polar = np.pi * np.arange(1, RINGS + 1) / (RINGS + 1)
    around = 2.0 * np.pi * np.arange(SPOKES) / SPOKES
    ring = np.stack([np.outer(np.sin(polar), np.cos(around)), np.outer(np.sin(polar), np.sin(around))], axis=-1)
    points = np.concatenate([ring, np.broadcast_to(np.cos(polar)[:, None, None], (RINGS, SPOKES, 1))], axis=-1)
    index = np.arange(RINGS * SPOKES).reshape(RINGS, SPOKES)
    after = np.roll(index, -1, axis=1)
    top, bottom = RINGS * SPOKES, RINGS * SPOKES + 1
    faces = [np.stack([np.full(SPOKES, top), index[0], after[0]], axis=1)]
    faces += [np.stack([np.full(SPOKES, bottom), after[-1], index[-1]], axis=1)]
    for upper, lower in ((0, 1), (1, 0)):
        a, b, c = (index[:-1], index[1:], after[1:]) if upper < lower else (index[:-1], after[1:], after[:-1])
        faces.append(np.stack([a, b, c], axis=-1).reshape(-1, 3))
    return np.concatenate([points.reshape(-1, 3), [[0, 0, 1.0], [0, 0, -1.0]]]), np.concatenate(faces)


def _collapsed(vertices: np.ndarray, faces: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return ``count`` of the vertices and new faces: the shortest edges are collapsed onto one of their ends.

    An edge stays if it touches a hole, if its ends share other neighbours than its two faces have (the surface would
    pinch), or if a face would turn over.
    """
    corners = {index: list(map(int, face)) for index, face in enumerate(faces)}
    around: list[set[int]] = [set() for _ in vertices]
    for index, face in corners.items():
        for corner in face:
            around[corner].add(index)
    edges = np.unique(np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1), axis=0)
    heap = [(float(np.linalg.norm(vertices[a] - vertices[b])), int(a), int(b)) for a, b in edges]
    heapq.heapify(heap)
    alive = len(vertices)
    while alive > count:
        _, a, b = heapq.heappop(heap)
        shared = around[a] & around[b]
        ring_a, ring_b = ({corner for index in around[end] for corner in corners[index]} for end in (a, b))
        closed = len(ring_a) == len(around[a]) + 1 and len(ring_b) == len(around[b]) + 1
        if len(shared) != 2 or not closed or len(ring_a & ring_b) != 4:
            continue
        moved = [(index, [a if corner == b else corner for corner in corners[index]]) for index in around[b] - shared]
        if any(_normal(vertices, face) @ _normal(vertices, corners[index]) < 0.2 for index, face in moved):
            continue
        for index in shared:
            for corner in corners.pop(index):
                around[corner].discard(index)
        for index, face in moved:
            corners[index] = face
            around[a].add(index)
        around[b].clear()
        for corner in ring_b - {a, b}:
            heapq.heappush(heap, (float(np.linalg.norm(vertices[a] - vertices[corner])), a, corner))
        alive -= 1
    kept, faces = np.unique(np.array(list(corners.values())), return_inverse=True)
    return kept, faces.reshape(-1, 3)


def _normal(vertices: np.ndarray, face: list[int]) -> np.ndarray:
    a, b, c = vertices[face]
    normal = np.cross(b - a, c - a)
    return normal / max(np.linalg.norm(normal), 1e-12)


def _arrays(
    vertices: np.ndarray,
    faces: np.ndarray,
    weights: np.ndarray,
    shapes: np.ndarray,
    places: np.ndarray,
    parents: np.ndarray,
    columns: int,
) -> dict[str, np.ndarray]:
    """Return the members of the file, in SMPL's axes with the pelvis at the origin."""
    count = len(parents)
    vertices, places = (vertices - places[0]) @ TO_SMPL.T, (places - places[0]) @ TO_SMPL.T
    shapes = np.einsum("ab,vbs->vas", TO_SMPL, shapes)
    directions = np.zeros((len(vertices), 3, columns), np.float32)
    first = min(10 if columns < 400 else 300, columns) if count == 55 else columns
    directions[..., : min(first, shapes.shape[2])] = shapes[..., :first]
    if count == 55:  # the mouth opens, the chin goes forward
        directions[:, 1, first], directions[:, 2, first + 1] = -0.004 * weights[:, 22], 0.002 * weights[:, 22]
    normals = np.zeros_like(vertices)
    crossed = np.cross(*(vertices[faces[:, corner]] - vertices[faces[:, 0]] for corner in (1, 2)))
    for corner in range(3):
        np.add.at(normals, faces[:, corner], crossed)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    pose = np.zeros((len(vertices), 3, count - 1, 9), np.float32)
    bends = 4.0 * weights[:, 1:] * (1.0 - weights[:, 1:])
    for diagonal in (0, 4, 8):  # of R - I, -1 where a joint is bent by a right angle
        pose[..., diagonal] = -0.5 * BULGE * normals[:, :, None] * bends[:, None, :]
    mean = np.tile([0.0, 0.0, CURL], 15)
    tree = np.stack([parents, np.arange(count)]).astype(np.uint32)
    members = {"v_template": vertices, "f": faces.astype(np.uint32), "weights": weights, "shapedirs": directions}
    members |= {"posedirs": pose.reshape(len(vertices), 3, -1), "J_regressor": _regressor(vertices, places)}
    members |= {"kintree_table": tree}
    if count > 24:
        members |= {
            "hands_meanl": -mean,
            "hands_meanr": mean,
            "hands_componentsl": np.eye(45),
            "hands_componentsr": np.eye(45),
        }
    return members


def _regressor(vertices: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Return the smallest weights of the nearest vertices that give each joint, shape ``(J, V)``."""
    matrix = np.zeros((len(places), len(vertices)))
    for joint, place in enumerate(places):
        near = np.linalg.norm(vertices - place, axis=1).argsort()[:60]
        system = np.vstack([vertices[near].T, np.ones(len(near))])
        matrix[joint, near] = np.linalg.lstsq(system, np.append(place, 1.0), rcond=None)[0]
    return matrix


def main(path: tyro.conf.Positional[Path], joints: int = 55, columns: int = 20) -> None:
    """Write a model.

    Args:
        path: an .npz file.
        joints: 55 for SMPL-X, 52 for SMPL-H, 24 for SMPL.
        columns: of shape and expression.
    """
    np.savez_compressed(path, **synthetic_model(joints, columns))
    print(f"{path}: {joints} joints, made from the embedded body; {len(JOINT_NAMES)} of them move the avatar")


if __name__ == "__main__":
    tyro.cli(main)
