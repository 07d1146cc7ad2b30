"""The skin that cloth touches: few of its vertices, and a curved patch over each of their triangles.

A proxy is made on the mean shape and has the same topology for all shapes. Between its vertices the surface is curved
by their normals (Phong tessellation, Boubekeur & Alexa 2008): the point ``p = sum b_i p_i`` of a triangle goes to

    p + 3/4 sum_i b_i ((p_i - p) . n_i) n_i.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from piavatar_envs.avatar.body.asset import AvatarAsset, dense_weights
from piavatar_envs.avatar.body.skeleton import joint_index
from piavatar_envs.cloth import remesh as remeshing
from piavatar_envs.cloth.remesh import remesh
from piavatar_envs.core.result_cache import digest_of, kept

#: Vertices of a proxy.
PROXY_VERTICES = 900
#: Share of the curvature by vertex normals that is added to the flat triangles.
CURVATURE = 0.75

#: Bits of body parts.
TRUNK, HEAD = 1, 2
LEFT_ARM, RIGHT_ARM, LEFT_HAND, RIGHT_HAND = 4, 8, 16, 32
LEFT_LEG, RIGHT_LEG, LEFT_FOOT, RIGHT_FOOT = 64, 128, 256, 512
ALL_PARTS = 1023
#: Joints whose bones are a part, by its bit.
PART_JOINTS: dict[int, tuple[str, ...]] = {
    TRUNK: ("pelvis", "spine1", "spine2", "spine3", "left_collar", "right_collar"),
    HEAD: ("neck", "head"),
    LEFT_ARM: ("left_shoulder", "left_elbow"),
    RIGHT_ARM: ("right_shoulder", "right_elbow"),
    LEFT_HAND: ("left_wrist",),
    RIGHT_HAND: ("right_wrist",),
    LEFT_LEG: ("left_hip", "left_knee"),
    RIGHT_LEG: ("right_hip", "right_knee"),
    LEFT_FOOT: ("left_ankle", "left_foot"),
    RIGHT_FOOT: ("right_ankle", "right_foot"),
}
#: Joints around which a proxy is coarse.
_COARSE_JOINTS = ("head", "left_wrist", "right_wrist", "left_ankle", "right_ankle", "left_foot", "right_foot")
#: Least weight of a part's bones where the skin belongs to it.
_LEAST_SHARE = 0.3


@dataclass(frozen=True, eq=False)
class Proxy:
    """Some vertices of a skin, and triangles between them.

    Attributes:
        keep: its vertices, as indices into the asset's, shape ``(N,)`` int32.
        faces: triangles over the ``N`` vertices, outward, shape ``(T, 3)`` int32.
        part: bits of the body parts that a vertex belongs to, one or several, shape ``(N,)`` int32.
    """

    keep: np.ndarray
    faces: np.ndarray
    part: np.ndarray

    def of(self, asset: AvatarAsset) -> AvatarAsset:
        """Return the asset with the vertices of the proxy only, drawn as such.

        Its :meth:`~piavatar_envs.avatar.body.asset.AvatarAsset.shape` does not put a body on the ground.
        """
        return replace(
            asset,
            vertices=asset.vertices[self.keep],
            faces=self.faces,
            skin_joints=asset.skin_joints[self.keep],
            skin_weights=asset.skin_weights[self.keep],
            shape_deltas=asset.shape_deltas[:, :, self.keep],
            look=None,
            outfit=None,
            groups={},
        )


@lru_cache(maxsize=16)
def proxy_of(asset: AvatarAsset, count: int = PROXY_VERTICES) -> Proxy:
    """Return the proxy of an asset, of about ``count`` vertices or all of a coarser skin; arrays are read-only.

    Head, hands and feet have cells three times as wide as the rest.
    """
    count = min(count, len(np.unique(asset.faces)))

    def compute() -> dict[str, np.ndarray]:
        coarse = np.isin(asset.skin_joints[:, 0], [joint_index(name) for name in _COARSE_JOINTS])
        found = remesh(asset.vertices, asset.faces, count, coarse=coarse)
        return {"keep": found.keep, "faces": found.faces}

    digest = digest_of([asset.vertices, asset.faces, asset.skin_joints, count], [remeshing])
    arrays = kept("proxy", digest, compute, f"preparing the skin of {asset.name} for cloth")
    keep = arrays["keep"]
    proxy = Proxy(keep, arrays["faces"], parts_of(asset.skin_joints[keep], asset.skin_weights[keep]))
    for array in vars(proxy).values():
        array.setflags(write=False)
    return proxy


def parts_of(skin_joints: np.ndarray, skin_weights: np.ndarray) -> np.ndarray:
    """Return the bits of the body parts that points belong to, from their skinning, shape ``(N,)`` int32.

    A point belongs to the part that moves it most, and to all that move it by a share of 0.3 at least.
    """
    weights = dense_weights(skin_joints, skin_weights)
    columns = [[joint_index(name) for name in names] for names in PART_JOINTS.values()]
    shares = np.stack([weights[:, own].sum(axis=1) for own in columns], axis=1)
    belongs = (shares >= _LEAST_SHARE) | (shares == shares.max(axis=1, keepdims=True))
    return (belongs * np.array(list(PART_JOINTS))).sum(axis=1).astype(np.int32)


def curved(
    points: np.ndarray, normals: np.ndarray, triangles: np.ndarray, coordinates: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return points of the curved surface [m] and its unit normals there, both shape ``(K, 3)``.

    Args:
        points: vertices [m], shape ``(N, 3)``.
        normals: their unit normals, shape ``(N, 3)``.
        triangles: that of each point, by its vertices, shape ``(K, 3)``.
        coordinates: barycentric coordinates in it, shape ``(K, 3)``.
    """
    corner, normal = points[triangles], normals[triangles]
    flat = np.einsum("kc,kcd->kd", coordinates, corner)
    height = coordinates * np.einsum("kcd,kcd->kc", corner - flat[:, None], normal)
    at = flat + CURVATURE * np.einsum("kc,kcd->kd", height, normal)
    upright = np.einsum("kc,kcd->kd", coordinates, normal)
    return at, upright / np.maximum(np.linalg.norm(upright, axis=1, keepdims=True), 1e-20)
