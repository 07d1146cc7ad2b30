"""Light on the vertices: a warm key light with soft shadows, sky and ground light, a rim (NumPy).

The skin has a vertex about every centimetre, close to a pixel of a small picture, so the light is worked out there
and not by the graphics driver: soft shadows become affordable on a CPU, and every machine draws the same colours.
Arrays of points are ``(3, N)`` float32.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from piavatar_envs.render.coloring import srgb_to_linear
from piavatar_envs.render.geometry import Topology, length, unit

#: Direction to the key light: from the avatar's right front, high.
KEY = unit(np.array([-0.42, -0.72, 0.95], dtype=np.float32))
_KEY_LIGHT = np.array([1.12, 1.06, 0.985], dtype=np.float32)
_SKY_LIGHT = np.array([0.43, 0.455, 0.50], dtype=np.float32)
_GROUND_LIGHT = np.array([0.27, 0.245, 0.225], dtype=np.float32)
_RIM_LIGHT = np.array([0.34, 0.38, 0.44], dtype=np.float32)
#: Light bleeds around the terminator, red furthest, as in skin.
_WRAP = np.array([0.30, 0.19, 0.14], dtype=np.float32)
_SHININESS = 5  # as a power of two: cheaper by squaring
_SPECULAR = 0.09

_MAP_TEXEL = 0.014
_MAP_LIMIT = 320
_MAP_MARGIN = 4
_SHADOW_BIAS = 0.03
_SHADOW_SOFTNESS = 0.03
_TAPS = np.array([[0, 0], [1, 1], [-1, 1], [1, -1], [-1, -1], [2, 0], [-2, 0], [0, 2], [0, -2]], dtype=np.float32)

_VOXEL = 0.035
_VOXEL_LIMIT = 96
_REACHES = (1.6, 3.0)
_FLAT_OCCLUSION = 0.22


@dataclass(frozen=True, eq=False)
class Casters:
    """Points that stand for all surfaces shown [m] and their outward area vectors [m^2], both ``(3, N)``."""

    points: np.ndarray
    areas: np.ndarray


def shade(
    topology: Topology, positions: np.ndarray, colors: np.ndarray, eye: np.ndarray, casters: Casters
) -> np.ndarray:
    """Light leaving the vertices towards the eye.

    Args:
        topology: how the vertices are joined.
        positions: vertices [m], shape ``(3, V)``.
        colors: their own colours, sRGB in [0, 1], shape ``(3, V)``.
        eye: the camera's position [m], shape ``(3,)``.
        casters: the triangles, which throw shadows.

    Returns:
        Linear light, not negative, shape ``(3, V)``.
    """
    normals = unit(topology.vertex_areas(casters.areas))
    view = unit(np.asarray(eye, dtype=np.float32)[:, None] - positions)
    shares = np.stack([_lit_share(positions, casters), 1.0 - _occlusion(positions, normals, casters)], axis=1)
    # Smoothing along the skin hides the cells that both were found in.
    lit, open_sky = np.ascontiguousarray(topology.smooth(shares, passes=3).T)
    facing = KEY @ normals
    up = 0.5 + 0.5 * normals[2]
    grazing = 1.0 - np.clip((normals * view).sum(axis=0), 0.0, 1.0)
    rim = grazing**3 * (0.35 + 0.65 * up) * open_sky
    gloss = np.maximum((normals * unit(view + KEY[:, None])).sum(axis=0), 0.0)
    for _ in range(_SHININESS):
        gloss = gloss * gloss
    gloss *= _SPECULAR * lit * (0.4 + grazing)
    albedo = srgb_to_linear(colors)
    light = np.empty_like(positions)
    for channel in range(3):
        wrap = _WRAP[channel]
        key = np.maximum((facing + wrap) / (1.0 + wrap), 0.0) * _KEY_LIGHT[channel]
        # The wrapped light passes a shadow's edge too: keep a little of its red.
        key *= lit + (1.0 - lit) * (0.25 * wrap)
        ambient = (_GROUND_LIGHT[channel] + (_SKY_LIGHT[channel] - _GROUND_LIGHT[channel]) * up) * open_sky
        light[channel] = albedo[channel] * (key + ambient + _RIM_LIGHT[channel] * rim) + gloss
    return light


def _lit_share(positions: np.ndarray, casters: Casters) -> np.ndarray:
    """Return the share of the key light that reaches each vertex, shape ``(V,)``: a shadow map seen from the light."""
    side = unit(np.cross(KEY, [0.0, 0.0, 1.0])).astype(np.float32)
    frame = np.stack([side, np.cross(KEY, side), KEY])
    points = frame @ casters.points
    low = points[:2].min(axis=1)
    extent = points[:2].max(axis=1) - low
    texel = np.float32(max(_MAP_TEXEL, float(extent.max()) / (_MAP_LIMIT - 2 * _MAP_MARGIN)))
    rows, columns = (np.ceil(extent / texel).astype(int) + 2 * _MAP_MARGIN).tolist()
    cell = ((points[:2] - low[:, None]) / texel).astype(np.int32) + _MAP_MARGIN
    depth = np.full(rows * columns, -np.inf, dtype=np.float32)
    np.maximum.at(depth, cell[0] * columns + cell[1], points[2])
    depth = ndimage.maximum_filter(depth.reshape(rows, columns), size=3).ravel()
    own = frame @ positions
    at = (own[:2] - low[:, None]) / texel + np.float32(_MAP_MARGIN)
    hidden = np.zeros(positions.shape[1], dtype=np.float32)
    threshold = own[2] + np.float32(_SHADOW_BIAS)
    for tap in _TAPS * np.float32(_MAP_TEXEL / texel):
        row = np.clip((at[0] + tap[0]).astype(np.int32), 0, rows - 1)
        column = np.clip((at[1] + tap[1]).astype(np.int32), 0, columns - 1)
        hidden += np.clip((depth[row * columns + column] - threshold) / np.float32(_SHADOW_SOFTNESS), 0.0, 1.0)
    return 1.0 - hidden / np.float32(len(_TAPS))


def _occlusion(positions: np.ndarray, normals: np.ndarray, casters: Casters) -> np.ndarray:
    """Return the share of the sky hidden by near surfaces, ``(V,)``: surface in blurred voxels along the normal."""
    low = casters.points.min(axis=1) - np.float32(3.0 * _VOXEL)
    extent = casters.points.max(axis=1) - low
    voxel = np.float32(max(_VOXEL, float(extent.max()) / (_VOXEL_LIMIT - 4)))
    shape = tuple((np.ceil(extent / voxel).astype(int) + 4).tolist())
    x, y, z = ((casters.points - low[:, None]) / voxel).astype(np.int32)
    area = np.bincount((x * shape[1] + y) * shape[2] + z, weights=length(casters.areas), minlength=int(np.prod(shape)))
    filled = (area / voxel**2).astype(np.float32).reshape(shape)
    for _ in range(2):
        filled = ndimage.uniform_filter(filled, 3, mode="constant")
    at = (positions - low[:, None]) / voxel - np.float32(0.5)
    hidden = sum(
        ndimage.map_coordinates(filled, at + np.float32(reach) * normals, order=1, mode="constant")
        for reach in _REACHES
    )
    # A flat surface sees some of itself in the blur: what is above that is occlusion.
    return np.clip(1.1 * (hidden - np.float32(_FLAT_OCCLUSION)), 0.0, 0.75)
