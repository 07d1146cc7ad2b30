"""Write a person of Gaussian splats: flat ones on the skin of the embedded body, in shirt and trousers.

It serves tests, benchmarks and a first try without a capture::

    python -m scripts.synthetic_splats person.ply --count 60000
"""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import tyro
from scipy.spatial.transform import Rotation

from piavatar_envs.avatar.body.asset import AvatarAsset, area_vectors, dense_weights, top_weights
from piavatar_envs.avatar.body.sampling import ClosedSurface
from piavatar_envs.avatar.body.sources import load_asset
from piavatar_envs.avatar.body.splat_files import write_ply
from piavatar_envs.avatar.body.splats import COEFFICIENTS, SkinnedSplats, SplatCloud, constant_colors

_SKIN, _SHIRT, _STRIPE, _TROUSERS = (0.85, 0.65, 0.55), (0.75, 0.15, 0.2), (0.92, 0.9, 0.85), (0.18, 0.25, 0.45)


def on_body(
    asset: AvatarAsset,
    count: int,
    degree: int = 1,
    seed: int = 0,
    vertices: np.ndarray | None = None,
    inset: float = 0.0,
) -> SplatCloud:
    """Return flat splats that cover the skin of a body evenly.

    Args:
        asset: the body.
        count: number of splats.
        degree: of the harmonics; those above the first are small noise.
        seed: of the places.
        vertices: of the skin, if not those of the mean shape [m], shape ``(V, 3)``.
        inset: depth of the centres below the skin, over the size of a splat; training puts the edge of what is seen at
            the skin, which reaches beyond the centres.
    """
    rng = np.random.default_rng(seed)
    skin = (asset.vertices if vertices is None else vertices).astype(np.float64)
    normals = area_vectors(skin, asset.faces)
    area = np.linalg.norm(normals, axis=1)
    chosen = rng.choice(len(area), count, p=area / area.sum())
    u, v = rng.random((2, count))
    u, v = np.where(u + v > 1.0, 1.0 - u, u), np.where(u + v > 1.0, 1.0 - v, v)
    a, b, c = (skin[asset.faces[chosen, corner]] for corner in range(3))
    means = a + u[:, None] * (b - a) + v[:, None] * (c - a)
    normal = normals[chosen] / area[chosen, None]
    along = np.cross(normal, [0.1, 0.2, 0.97])
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    turns = Rotation.from_matrix(np.stack([along, np.cross(normal, along), normal], axis=2))
    size = 0.75 * np.sqrt(area.sum() / count)
    means -= inset * size * normal
    rest = asset.vertices[asset.faces[chosen, 0]]
    sh = np.zeros((count, COEFFICIENTS[degree], 3))
    sh[:, :1] = constant_colors(_colors(rest))
    sh[:, 1:] = 0.05 * rng.standard_normal(sh[:, 1:].shape)
    return SplatCloud.of(
        means, turns.as_quat(), np.tile([size, size, 0.15 * size], (count, 1)), np.full(count, 0.97), sh
    )


def drawn_as(asset: AvatarAsset, cloud: SplatCloud) -> AvatarAsset:
    """Return a body that is drawn as splats, which move as the nearest points of its skin do."""
    _, face, at = ClosedSurface(asset.vertices, asset.faces).query(cloud.means)
    dense = dense_weights(asset.skin_joints, asset.skin_weights)[asset.faces[face]]
    splats = SkinnedSplats(cloud, *top_weights(np.einsum("sc,scj->sj", at, dense)))
    return dataclasses.replace(asset, look=dataclasses.replace(asset.drawn, splats=splats))


def _colors(rest: np.ndarray) -> np.ndarray:
    """Return the colours of points of the rest pose by their height."""
    height = rest[:, 2]
    colors = np.tile(_SKIN, (len(rest), 1))
    shirt, legs = (height > 0.93) & (height < 1.42), (height > 0.1) & (height <= 0.93)
    colors[shirt] = np.where(np.floor(height[shirt] / 0.05)[:, None] % 2 == 0, _SHIRT, _STRIPE)
    colors[legs & (np.abs(rest[:, 0]) < 0.28)] = _TROUSERS
    return np.clip(colors, 0.02, 0.98)


def main(path: tyro.conf.Positional[Path], count: int = 60_000, degree: int = 1) -> None:
    """Write splats.

    Args:
        path: a .ply file.
        count: number of splats.
        degree: of the spherical harmonics, 0 to 3.
    """
    write_ply(path, on_body(load_asset(), count, degree))
    print(f"{path}: {count} splats on the embedded body")


if __name__ == "__main__":
    tyro.cli(main)
