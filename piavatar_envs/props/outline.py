"""Surfaces of simple solids for pictures, fine enough to bend with the particles below them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

SEGMENTS = 32  # around a round surface
RINGS = 8  # from a pole to the equator
SQUARES = 6  # along each edge of a box


def round_surface(radius: float, half_length: float) -> tuple[np.ndarray, np.ndarray]:
    """Surface of a capsule along z, or of a ball where ``half_length`` [m] is zero.

    Returns:
        Vertices [m] ``(V, 3)`` float32 and outward triangles ``(T, 3)`` int32.
    """
    quarter = np.linspace(0.0, 0.5 * np.pi, RINGS + 1)[1:]  # from the pole, which is one vertex
    lower = quarter if half_length > 0.0 else quarter[:-1]  # a ball has one equator
    height = np.concatenate([half_length + radius * np.cos(quarter), -half_length - radius * np.cos(lower[::-1])])
    width = radius * np.sin(np.concatenate([quarter, lower[::-1]]))
    angle = 2.0 * np.pi * np.arange(SEGMENTS) / SEGMENTS
    across = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    rings = np.empty((len(height), SEGMENTS, 3))
    rings[..., :2] = width[:, None, None] * across
    rings[..., 2] = height[:, None]
    pole = [0.0, 0.0, half_length + radius]
    vertices = np.concatenate([rings.reshape(-1, 3), [pole], np.negative([pole])])

    here = np.arange(SEGMENTS)
    there = np.roll(here, -1)
    top, bottom = len(vertices) - 2, len(vertices) - 1
    faces = [np.stack([np.full(SEGMENTS, top), here, there], axis=1)]
    for ring in range(len(height) - 1):
        a, b = here + ring * SEGMENTS, there + ring * SEGMENTS
        faces += [np.stack([a, a + SEGMENTS, b], axis=1), np.stack([b, a + SEGMENTS, b + SEGMENTS], axis=1)]
    last = (len(height) - 1) * SEGMENTS
    faces.append(np.stack([np.full(SEGMENTS, bottom), last + there, last + here], axis=1))
    return vertices.astype(np.float32), np.concatenate(faces).astype(np.int32)


def box_surface(half_size: Sequence[float]) -> tuple[np.ndarray, np.ndarray]:
    """Surface of a box; every side has vertices of its own, so that its edges are shaded sharp.

    Returns:
        Vertices [m] ``(V, 3)`` float32 and outward triangles ``(T, 3)`` int32.
    """
    ticks = np.linspace(-1.0, 1.0, SQUARES + 1)
    i, j = np.meshgrid(np.arange(SQUARES), np.arange(SQUARES), indexing="ij")
    a = (i * (SQUARES + 1) + j).ravel()
    b, c, d = a + SQUARES + 1, a + SQUARES + 2, a + 1
    squares = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    vertices, faces = [], []
    for axis in range(3):
        for sign in (1.0, -1.0):
            side = np.empty((SQUARES + 1, SQUARES + 1, 3))
            side[..., axis] = sign
            side[..., (axis + 1) % 3] = sign * ticks[:, None]  # turned with the side, so that it faces outward
            side[..., (axis + 2) % 3] = ticks[None, :]
            faces.append(squares + len(vertices) * (SQUARES + 1) ** 2)
            vertices.append(side.reshape(-1, 3))
    corners = np.concatenate(vertices) * np.asarray(half_size, dtype=np.float64)
    return corners.astype(np.float32), np.concatenate(faces).astype(np.int32)
