"""The embedded body, baked from MakeHuman's CC0 mesh by ``scripts/bake_body.py``; fingers follow the wrists."""

from __future__ import annotations

from importlib import resources
from typing import Literal

import numpy as np

from piavatar_envs.avatar.body.asset import AvatarAsset, dense_weights, top_weights
from piavatar_envs.avatar.body.outfit import dressed
from piavatar_envs.avatar.body.skeleton import NUM_JOINTS, PARENTS
from piavatar_envs.avatar.body.skeleton_mesh import read_skeleton


def _merged_into_body(parents: np.ndarray) -> np.ndarray:
    """Return, for each joint of the file, the body joint that it moves with."""
    body = np.arange(len(parents))
    for joint in range(NUM_JOINTS, len(parents)):
        body[joint] = body[parents[joint]]  # parents come before children
    return body


def build(skeleton: str | None = None, appearance: Literal["clothed", "skin"] = "clothed") -> AvatarAsset:
    """Return the embedded body.

    Args:
        skeleton: mesh of a skeleton, or a folder of its parts, in the body's place, pose and axes; for bone particles.
        appearance: in pictures: in shirt, shorts and shoes, each avatar of a scene in colours of its own, or bare.

    Raises:
        ValueError: the file has another skeleton, or that of ``skeleton`` cannot be read.
    """
    file = resources.files("piavatar_envs.data").joinpath("body.npz")
    with file.open("rb") as stream, np.load(stream, allow_pickle=False) as arrays:
        data = {key: arrays[key] for key in arrays.files}
    if tuple(data["parents"][:NUM_JOINTS]) != PARENTS:
        raise ValueError(f"body.npz has parents {data['parents'][:NUM_JOINTS].tolist()}; bake it again")
    to_body = _merged_into_body(data["parents"])
    dense = dense_weights(to_body[data["skin_joints"]], data["skin_weights"].astype(np.float64))
    skin_joints, skin_weights = top_weights(dense)
    names = tuple(str(name) for name in data["shape_names"])
    deltas = data["shape_deltas"].astype(np.float32) * data["shape_step"]
    return AvatarAsset(
        name="embedded (MakeHuman, CC0)",
        vertices=data["vertices"],
        faces=data["faces"].astype(np.int32),
        joints=data["joints"][:NUM_JOINTS],
        skin_joints=skin_joints,
        skin_weights=skin_weights,
        shape_names=names,
        shape_deltas=deltas.reshape(len(names), 2, *deltas.shape[1:]),
        shape_joints=data["shape_joints"][:, :NUM_JOINTS].reshape(len(names), 2, NUM_JOINTS, 3),
        outfit=dressed if appearance == "clothed" else None,
        skeleton=None if skeleton is None else read_skeleton(skeleton, data["joints"][:NUM_JOINTS].astype(np.float64)),
    )
