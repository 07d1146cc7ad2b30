"""Bodies under garments, as they are drawn: sunk below the cloth, without painted clothes that these replace.

Cloth keeps a few millimetres off a proxy of the skin, which is coarser than the skin that is drawn, and an outfit lies
above the skin. So the drawn surface is brought in beneath garments, where they are at rest: most where cloth lies on
it, less where it hangs apart, and not at all outside of it. It stays closed, so that nothing is missing where a skirt
flies up. The simulation is the same.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING
from weakref import WeakKeyDictionary

import numpy as np
from scipy.spatial import cKDTree

from piavatar_envs.avatar.body.asset import AvatarAsset, Look, dense_weights, vertex_normals
from piavatar_envs.avatar.body.outfit import dressed
from piavatar_envs.avatar.body.skeleton import joint_index
from piavatar_envs.cloth.subdivision import levels_for, subdivided
from piavatar_envs.sim.bodies import Flesh

if TYPE_CHECKING:
    from piavatar_envs.cloth.garment import Garment

#: Depth to which a surface sinks where cloth lies on it, and where it hangs apart [m].
_TIGHT, _LOOSE = 0.014, 0.010
#: Distance of cloth that lies on a surface, and of cloth that hangs before it, at most [m].
_NEAR, _FAR = 0.03, 0.15
#: Depth of cloth in a surface that it covers, at most [m]: outfits lie above the skin, and folds are drawn rounder.
_THROUGH = 0.015
#: Ways from a border over which sinking sets in: inside, where cloth lies on a surface and where it hangs apart, which
#: may be seen; and outside of one that is held, such as a waistband [m].
_INSIDE, _FAR_INSIDE, _OUTSIDE = 0.03, 0.10, 0.03
#: Depth at a held border, where an outfit would lie on the cloth, and of a garment beneath another one [m].
_TUCKED, _LAYER = 0.007, 0.009
#: Greatest distance of points of a garment, among which the nearest is looked for [m].
_SPACING = 0.01
#: Share of the chest, in front and at the back, that a garment covers which replaces a painted shirt.
_MOST = 0.6

#: Garments of avatars, and the assets that :func:`worn_asset` has made for them.
_worn: WeakKeyDictionary[Flesh, tuple[list[Garment], AvatarAsset]] = WeakKeyDictionary()


def worn_asset(flesh: Flesh, garments: Sequence[Garment]) -> AvatarAsset:
    """Return the asset of an avatar as it is drawn under the garments that it wears; the same on every call."""
    if not garments:
        return flesh.asset
    before, asset = _worn.get(flesh, ([], flesh.asset))
    if len(before) != len(garments) or any(one is not other for one, other in zip(before, garments, strict=True)):
        asset = _wearing(flesh.asset, flesh.base_parameters, garments)
        _worn[flesh] = list(garments), asset
    return asset


def _wearing(asset: AvatarAsset, parameters: np.ndarray, garments: Sequence[Garment]) -> AvatarAsset:
    if asset.look is None and asset.outfit is dressed:
        skin = asset.shape(parameters).vertices.astype(np.float64)
        chest = dense_weights(asset.skin_joints, asset.skin_weights)[:, joint_index("spine3")] > 0.5
        normals = smooth_normals(skin, asset.faces)
        sides = [chest & (way * normals[:, 1] > 0.3) for way in (1.0, -1.0)]
        covered = [_covered(garment, skin, normals)[0] for garment in garments]
        # neither a scarf nor a cape, nor both together
        if max(min(each[side].mean() for side in sides) for each in covered) > _MOST:
            asset = replace(asset, outfit=partial(dressed, with_shirt=False))
    look, shown = asset.drawn, asset.shape_drawn(parameters).vertices.astype(np.float64)
    normals = smooth_normals(shown, look.faces)
    depth = np.max([sinking(garment, shown, normals) for garment in garments], axis=0)
    sunk = (look.vertices - depth[:, None] * normals).astype(np.float32)
    return replace(asset, look=_without(replace(look, vertices=sunk), asset, garments))


def _without(look: Look, asset: AvatarAsset, garments: Sequence[Garment]) -> Look:
    """Return a look without the surfaces of the file that garments are made of."""
    gone = [asset.worn[garment.replaces].drawn for garment in garments if garment.replaces]
    if not gone:
        return look
    left = np.setdiff1d(np.arange(len(look.faces)), np.concatenate(gone))
    textures = None if look.textures is None else look.textures.chosen(np.arange(len(look.vertices)), left)
    return replace(look, faces=look.faces[left], textures=textures)


def sinking(garment: Garment, points: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Return how far points of a body's surface sink beneath a garment in its rest pose [m].

    Args:
        garment: is draped on the body.
        points: of the surface [m], shape ``(V, 3)``.
        normals: of the surface, outward, shape ``(V, 3)``.
    """
    gap, inside, edge, held = _covered(garment, points, normals)[1:]
    share = np.clip(2.0 - gap / _NEAR, 0.0, 1.0)
    deep = share * _TIGHT * np.clip(edge / _INSIDE, 0.0, 1.0)
    deep += (1.0 - share) * _LOOSE * np.clip(edge / _FAR_INSIDE, 0.0, 1.0)
    tucked = np.where(held < _OUTSIDE, _TUCKED * (1.0 - np.clip(held / _OUTSIDE, 0.0, 1.0)), 0.0)
    return np.maximum(np.where(inside, deep, 0.0), tucked)


def layering(inner: Garment, outer: Garment) -> np.ndarray:
    """Return how far the vertices of a garment sink beneath another one that is worn over it [m], shape ``(V,)``.

    Cloth does not touch cloth, so that both lie equally far from the skin.
    """
    normals = vertex_normals(inner.draped, inner.mesh.faces)
    _, gap, inside, edge, _ = _covered(outer, inner.draped, normals)
    outside = np.where(edge > 0.0, 0.0, gap)
    return np.where(inside & (gap < _NEAR), _LAYER * np.clip(1.0 - outside / _OUTSIDE, 0.0, 1.0), 0.0)


def _covered(
    garment: Garment, points: np.ndarray, normals: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return where points lie with regard to a garment, each shape ``(V,)``.

    Returns:
        Whether it covers them; its distance from them [m]; whether they are inside of it; the distance of its nearest
        point from its borders [m]; their own distance from borders that are held [m].
    """
    cloth = garment.mesh.faces
    fine = subdivided(cloth, garment.mesh.num_vertices, levels_for(cloth, garment.draped, _SPACING, most=3))
    places = fine.matrix @ garment.draped
    outward = vertex_normals(places, fine.faces)
    start, end = fine.faces.ravel(), np.roll(fine.faces, -1, axis=1).ravel()
    count = len(places)
    border = np.unique(start[~np.isin(start * count + end, end * count + start)])
    gap, nearest = cKDTree(places).query(points)
    offset = places[nearest] - points
    # of two layers only the one that faces as the surface does covers it: not a sleeve beside the trunk
    inside = (np.einsum("vc,vc->v", offset, outward[nearest]) > -_THROUGH) & (gap < _FAR)
    inside &= np.einsum("vc,vc->v", normals, outward[nearest]) > 0.0
    edge = cKDTree(places[border]).query(places)[0][nearest] if len(border) else np.full(len(points), np.inf)
    held_vertices = np.asarray(garment.held.vertices, int)
    held = np.full(len(points), np.inf)
    if len(held_vertices):
        held = cKDTree(garment.draped[held_vertices]).query(points)[0]
    return inside & (edge > 0.0), gap, inside, edge, held


def smooth_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return unit normals of the vertices; those at one place, as along seams of a texture, have the same."""
    _, first, place = np.unique(np.round(vertices, 6), axis=0, return_index=True, return_inverse=True)
    place = place.ravel()
    return vertex_normals(vertices[first], place[faces])[place]
