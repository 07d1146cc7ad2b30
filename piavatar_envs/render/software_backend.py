"""Draws a lit mesh and the ground without any graphics driver: a small rasteriser in Warp, on the CPU.

It stands in where OpenGL is missing, as in a bare container, and draws what the other back end draws.
"""

from __future__ import annotations

import numpy as np
import warp as wp

from piavatar_envs.render import ground
from piavatar_envs.render.backend import Shot
from piavatar_envs.render.geometry import Topology
from piavatar_envs.render.ground import GroundShadow
from piavatar_envs.render.raster import SAMPLES, GroundLook, View, rasterise, resolve


class SoftwareBackend:
    """Buffers of one picture size."""

    def __init__(self, width: int, height: int) -> None:
        size = (height * SAMPLES, width * SAMPLES)
        self._nearest = wp.zeros(size, dtype=float, device="cpu")
        self._image = wp.zeros(size, dtype=wp.vec3, device="cpu")
        self._picture = wp.zeros((height, width, 3), dtype=wp.uint8, device="cpu")
        self._topology: Topology | None = None
        self._corners: wp.array | None = None

    def draw(
        self, topology: Topology, vertices: np.ndarray, colors: np.ndarray, shadow: GroundShadow, shot: Shot
    ) -> np.ndarray:
        """Draw one picture; see :class:`piavatar_envs.render.backend.Backend`."""
        if topology is not self._topology:
            self._corners = wp.array(topology.faces, dtype=wp.vec3i, device="cpu")
            self._topology = topology
        view = _view(shot, self._nearest.shape)
        points = wp.array(vertices, dtype=wp.vec3, device="cpu")
        tints = wp.array(colors.astype(np.float32), dtype=wp.vec3, device="cpu")
        opacity = wp.array(shadow.opacity, dtype=float, device="cpu")
        look = _look(shadow, shot.center)
        wp.launch(rasterise, 1, inputs=[view, points, tints, self._corners, self._nearest, self._image], device="cpu")
        wp.launch(
            resolve,
            self._picture.shape[:2],
            inputs=[view, look, opacity, self._nearest, self._image, self._picture],
            device="cpu",
        )
        return self._picture.numpy().copy()

    def close(self) -> None:
        """Free the buffers."""
        self._nearest = self._image = self._picture = self._corners = self._topology = None


def _view(shot: Shot, size: tuple[int, ...]) -> View:
    forward, right, up = shot.axes
    view = View()
    view.eye, view.forward, view.right = wp.vec3(*shot.eye), wp.vec3(*forward), wp.vec3(*right)
    view.up = wp.vec3(*up)
    view.height, view.width = size[:2]
    view.focal = shot.focal(view.height)
    return view


def _look(shadow: GroundShadow, center: np.ndarray) -> GroundLook:
    look = GroundLook()
    look.light, look.dark, look.line = _bytes(ground.LIGHT_SQUARE), _bytes(ground.DARK_SQUARE), _bytes(ground.LINE)
    look.sky_top, look.sky_bottom = _bytes(ground.BACKGROUND_TOP), _bytes(ground.BACKGROUND_BOTTOM)
    look.shadow = _bytes(ground.SHADOW_COLOR)
    look.center, look.shadow_origin = wp.vec2(*center), wp.vec2(*shadow.origin)
    look.shadow_size = shadow.size
    return look


def _bytes(color: tuple[float, float, float]) -> wp.vec3:
    return wp.vec3(*(255.0 * channel for channel in color))
