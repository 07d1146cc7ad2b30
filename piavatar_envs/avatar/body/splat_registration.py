"""Registration of a body to splats: a surface with normals from their places, a fit, and the way back to its rest pose.

Splats have no inside and no outside. Cells of a grid are inside where they are closed in on at least five of six sides,
as in the parity votes of Nooruddin & Turk ("Simplification and repair of polygonal models using volumetric techniques",
IEEE TVCG 9 (2003)), so that a capture may have holes; normals follow from the smoothed inside.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from piavatar_envs.avatar.body.asset import AvatarAsset, dense_weights
from piavatar_envs.avatar.body.registration import Cloud, Fit, Model, fit_body
from piavatar_envs.avatar.body.sampling import ClosedSurface
from piavatar_envs.avatar.body.skeleton import blended_maps
from piavatar_envs.avatar.body.splats import SplatCloud

#: Opacity from which a splat is part of the surface.
OPAQUE = 0.5
#: Part of the splats beyond which, along each axis, are what a capture has left floating.
_STRAY = 5e-4
#: Cells of the grid over the height.
_CELLS = 128
#: Closed sides of six that make a cell an inside one, and the width of its smoothing [cells].
_CLOSED_SIDES, _SMOOTHING = 5, 1.2
#: Points of the surface that are fitted, in search of a start and in the fit.
_COARSE_POINTS, _POINTS = 1600, 6000


@dataclass(frozen=True, eq=False)
class FittedBody:
    """A body in the place, size, shape and pose of splats.

    Attributes:
        turn: rotation vector of the body, which faces -y without one [rad], shape ``(3,)``.
        size: metres of the splats a metre of the body.
        vertices: of its skin as it rests, in metres of the splats, shape ``(V, 3)``.
        joints: likewise, shape ``(22, 3)``.
        posed: the skin where the splats are [m], shape ``(V, 3)``.
        maps: affine maps of the bones from rest to there, shape ``(22, 3, 4)``.
        residual: mean distance between the surfaces, both ways, over the height.
    """

    turn: np.ndarray
    size: float
    vertices: np.ndarray
    joints: np.ndarray
    posed: np.ndarray
    maps: np.ndarray
    residual: float


def opaque_box(cloud: SplatCloud) -> tuple[np.ndarray, np.ndarray]:
    """Return the lowest and highest corner of the opaque splats, without stray ones.

    Raises:
        ValueError: there are too few.
    """
    points = cloud.means[cloud.opacities > OPAQUE]
    if len(points) < 1000:
        raise ValueError(
            f"{len(points)} splats are more opaque than {OPAQUE:g}, fewer than the 1000 that a body is fitted to"
        )
    low, high = np.quantile(points, (_STRAY, 1.0 - _STRAY), axis=0).astype(np.float64)
    return low, high


def register_splats(
    asset: AvatarAsset, cloud: SplatCloud, poses: Sequence[str], pose: np.ndarray | None = None
) -> FittedBody:
    """Fit a body to splats that stand on their feet, in metres, z up; they may face any horizontal axis.

    The same on every call.

    Args:
        asset: the body.
        cloud: the splats.
        poses: that the search starts from, see :data:`.registration.POSES`.
        pose: local rotations that these are added to, shape ``(22, 3, 3)``.

    Raises:
        ValueError: too few splats are opaque, or they enclose nothing.
    """
    box = opaque_box(cloud)
    surface = outer_surface(cloud, box)
    rng = np.random.default_rng(0)
    chosen = rng.permutation(len(surface.points))[:_POINTS]
    clouds = [Cloud(surface.points[rows], surface.normals[rows]) for rows in (chosen[:_COARSE_POINTS], chosen)]
    fit = fit_body(asset, *clouds, box, poses, pose)
    return _fitted(asset, fit, clouds[1], pose)


def _fitted(asset: AvatarAsset, fit: Fit, cloud: Cloud, pose: np.ndarray | None) -> FittedBody:
    model = Model(asset, np.arange(len(asset.vertices)), pose)
    rest, joints = model.shaped(fit)
    posed = model.points(fit)[0]
    maps = model.maps(fit)
    # rest positions are in metres of the splats, so the maps only turn and shift
    maps[:, :, :3] /= fit.scale
    surface = ClosedSurface(posed.astype(np.float32), asset.faces)
    apart = float(np.abs(surface.distance(cloud.points)).mean()) + float(cKDTree(cloud.points).query(posed)[0].mean())
    residual = 0.5 * apart / float(np.ptp(cloud.points[:, 2]))
    return FittedBody(fit.turn, fit.scale, fit.scale * rest, fit.scale * joints, posed, maps, residual)


def outer_surface(cloud: SplatCloud, box: tuple[np.ndarray, np.ndarray]) -> Cloud:
    """Return points of the opaque splats, one a cell of a grid, with outward normals.

    Args:
        cloud: the splats, z up.
        box: corners outside of which they are left out [m].

    Raises:
        ValueError: the splats enclose nothing.
    """
    kept = (cloud.opacities > OPAQUE) & ((cloud.means >= box[0]) & (cloud.means <= box[1])).all(axis=1)
    own = cloud.chosen(kept)
    axes = Rotation.from_quat(own.rotations).as_matrix() * own.scales[:, None]
    extent = np.sort(own.scales, axis=1)[:, 1]
    cell = max(float(box[1][2] - box[0][2]) / _CELLS, 1.5 * float(np.median(extent)))
    margin = 3
    shape = np.ceil((box[1] - box[0]) / cell).astype(int) + 2 * margin + 1
    solid = np.zeros(shape, bool)
    for axis in range(3):
        for side in (-1.0, 0.0, 1.0):
            at = np.floor((own.means + side * axes[:, :, axis] - box[0]) / cell).astype(int) + margin
            solid[tuple(np.clip(at, 0, shape - 1).T)] = True
    solid = ndimage.binary_closing(solid, np.ones((3, 3, 3)), border_value=0)
    closed = sum(_behind(solid, axis, flip).astype(np.int8) for axis in range(3) for flip in (False, True))
    inside = ndimage.gaussian_filter((solid | (closed >= _CLOSED_SIDES)).astype(np.float32), _SMOOTHING)
    where = (own.means - box[0]) / cell + margin - 0.5
    slope = [
        ndimage.map_coordinates(np.gradient(inside, axis=axis), where.T, order=1, mode="nearest") for axis in range(3)
    ]
    normals = -np.stack(slope, axis=1)
    steep = np.linalg.norm(normals, axis=1)
    order = np.argsort(-steep, kind="stable")  # of a cell, the splat nearest to its surface
    place = np.ravel_multi_index(tuple(np.clip(np.floor(where).astype(int), 0, shape - 1).T), shape)
    rows = order[np.unique(place[order], return_index=True)[1]]
    rows = np.sort(rows[steep[rows] > 0.25 * np.median(steep)])
    if len(rows) < 100:
        raise ValueError("the splats enclose nothing; use those of a whole body")
    return Cloud(own.means[rows].astype(np.float64), normals[rows] / steep[rows, None])


def _behind(solid: np.ndarray, axis: int, flip: bool) -> np.ndarray:
    """Return which cells have a solid one on one side along an axis."""
    turned = np.flip(solid, axis) if flip else solid
    found = np.maximum.accumulate(turned, axis=axis)
    return np.flip(found, axis) if flip else found


def nearest_weights(asset: AvatarAsset, fitted: FittedBody, points: np.ndarray) -> np.ndarray:
    """Return the skinning weights of the nearest points of the fitted skin, shape ``(S, 22)``."""
    _, face, at = ClosedSurface(fitted.posed.astype(np.float32), asset.faces).query(points)
    dense = dense_weights(asset.skin_joints, asset.skin_weights).astype(np.float32)
    return sum(at[:, corner, None] * dense[asset.faces[face, corner]] for corner in range(3))


def at_rest(cloud: SplatCloud, weights: np.ndarray, fitted: FittedBody) -> SplatCloud:
    """Return the splats where the body rests: by the inverse of the maps by which their bones have posed them.

    Args:
        cloud: the splats where the body is posed.
        weights: of the joints at each, shape ``(S, 22)``.
        fitted: the body.
    """
    maps = blended_maps(weights.astype(np.float64), fitted.maps)
    back = np.linalg.inv(maps[..., :3])
    means = np.einsum("sij,sj->si", back, cloud.means - maps[..., 3])
    u, _, vt = np.linalg.svd(back)
    return SplatCloud.deformed(cloud, means, back @ cloud.covariances() @ back.transpose(0, 2, 1), u @ vt)
