"""Groups of vertices that a file names: by mesh, by material, or painted; and the flesh below them.

A group is a weight in [0, 1] of every vertex, interpolated on the closed skin as skinning weights are. Flesh is in the
group if its nearest point of the skin has at least half of it.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from scipy import sparse

from piavatar_envs.avatar.body.asset import AvatarAsset, area_vectors
from piavatar_envs.avatar.body.sampling import ParticleSet
from piavatar_envs.core.reading import reading

#: Weight from which a place is in a group.
MEMBER = 0.5
#: Groups that a file may paint.
MOST_GROUPS = 256


def on_skin(groups: Mapping[str, np.ndarray], anchors: sparse.csr_array) -> dict[str, np.ndarray]:
    """Return groups on a closed skin, without those that have no part in it, such as things that are worn.

    Args:
        groups: weights of the file's vertices, each shape ``(V,)``.
        anchors: from values at those to values at the skin's, shape ``(N, V)``.
    """
    skin = {name: np.asarray(anchors @ weights, np.float32) for name, weights in groups.items()}
    return {name: weights for name, weights in skin.items() if (weights >= MEMBER).any()}


def read_groups(path: str | Path, count: int) -> dict[str, np.ndarray]:
    """Return the groups of a JSON file, an object from names to lists of vertices, such as segmentations of SMPL-X.

    Args:
        path: of the file.
        count: number of vertices that there are.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it is no such object, or names a vertex that there is not.
    """
    with reading(path, 'groups of vertices (JSON such as {"head": [0, 1, 2]})'):
        content = json.loads(Path(path).read_text(encoding="utf-8"))
        if not isinstance(content, dict):
            raise ValueError("it is not an object")
        if len(content) > MOST_GROUPS:
            raise ValueError(f"it has {len(content)} groups, more than {MOST_GROUPS}")
        groups = {}
        for name, listed in content.items():
            vertices = np.array(listed, dtype=object).ravel()
            if not all(type(vertex) is int and 0 <= vertex < count for vertex in vertices):
                raise ValueError(f"{name!r} lists something else than vertices from 0 to {count - 1}")
            groups[name] = np.zeros(count)
            groups[name][vertices.astype(np.int64)] = 1.0
    return groups


def flesh_of(asset: AvatarAsset, sampled: ParticleSet, name: str) -> np.ndarray:
    """Return which particles are flesh of a group, at any depth, shape ``(P,)`` bool.

    Raises:
        ValueError: the body has no such group.
    """
    if name not in asset.groups:
        known = ", ".join(asset.groups) or "none: its file names no meshes, materials or painted groups"
        raise ValueError(
            f"{asset.name} has no group {name!r} on its skin; it has {known}. What is worn has no flesh: "
            "python -m piavatar_envs inspect FILE lists what is body"
        )
    weights = asset.groups[name][sampled.anchor_vertices]
    return np.einsum("pc,pc->p", weights, sampled.anchor_weights) >= MEMBER


def skin_shares(asset: AvatarAsset) -> dict[str, float]:
    """Return the share of the skin's area that each group has: of triangles with most of it, by name."""
    area = np.linalg.norm(area_vectors(asset.vertices, asset.faces), axis=1)
    inside = {name: weights[asset.faces].mean(axis=1) >= MEMBER for name, weights in asset.groups.items()}
    return {name: float(area[own].sum() / area.sum()) for name, own in inside.items()}
