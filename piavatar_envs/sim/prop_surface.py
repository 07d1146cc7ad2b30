"""Surfaces of soft props on the device: they move rigidly with the prop, plus displacement of its particles.

Symbols in kernels: ``i`` picture, ``e = envs[i]`` its environment, ``v`` vertex, ``k`` neighbour of a vertex.
"""

from __future__ import annotations

import numpy as np
import warp as wp
from scipy import sparse
from scipy.spatial import cKDTree

from piavatar_envs.core.structs import fill

wp.set_module_options({"enable_backward": False})

#: Particles that move a vertex of a prop.
_PROP_NEIGHBOURS = 6


@wp.struct
class PropSurface:
    """Constants of a prop's surface of ``V`` vertices."""

    vertices: wp.array(dtype=wp.vec3)  # (V,) in the rest frame [m]
    near: wp.array2d(dtype=int)  # (K, V) particles that move a vertex
    weight: wp.array2d(dtype=float)  # (K, V) their weights, which sum to one
    rest: wp.array(dtype=wp.vec3)  # (P,) particles in the rest frame [m]


@wp.kernel
def deform_prop(
    envs: wp.array(dtype=int),
    surface: PropSurface,
    first_particle: int,
    column: int,
    position: wp.array2d(dtype=wp.vec3),
    rotation: wp.array2d(dtype=wp.quat),
    x: wp.array2d(dtype=wp.vec3),
    first: int,
    # out
    vertices: wp.array2d(dtype=wp.vec3),
):
    """Write the surface of the prop in a ``column``, from vertex ``first`` of every picture on; ``(pictures, V)``."""
    i, v = wp.tid()
    e = envs[i]
    if e < 0:
        return
    center = position[e, column]
    turn = wp.quat_to_matrix(rotation[e, column])
    at = turn * surface.vertices[v] + center
    for k in range(surface.near.shape[0]):
        p = surface.near[k, v]
        at += surface.weight[k, v] * (x[e, first_particle + p] - (turn * surface.rest[p] + center))
    vertices[i, first + v] = at


class SolidSurface:
    """Surface mesh of one prop, which its particles deform.

    Attributes:
        faces: its triangles, shape ``(T, 3)`` int32.
    """

    def __init__(self, rest: np.ndarray, vertices: np.ndarray, faces: np.ndarray) -> None:
        """Bake the weights: a vertex moves with its nearest particles, the nearer the more.

        Args:
            rest: particles in the rest frame [m], shape ``(P, 3)``.
            vertices: surface in the same frame [m], shape ``(V, 3)``.
            faces: its triangles, shape ``(T, 3)``.
        """
        self.vertices, self.faces = np.asarray(vertices, np.float64), np.ascontiguousarray(faces, np.int32)
        self._rest = np.asarray(rest, np.float64)
        near = np.arange(1, 1 + min(_PROP_NEIGHBOURS, len(rest)))
        distance, self._near = cKDTree(self._rest).query(self.vertices, k=near)
        weight = 1.0 / np.maximum(distance, 1e-6) ** 2
        self._weight = weight / weight.sum(axis=1, keepdims=True)

    def weights(self) -> sparse.csr_array:
        """Return the weights of the particles in the vertices, rows sum to one, shape ``(V, P)``."""
        near = self._near.reshape(len(self.vertices), -1)
        rows = np.arange(len(near) + 1) * near.shape[1]
        return sparse.csr_array((self._weight.ravel(), near.ravel(), rows), shape=(len(near), len(self._rest)))

    def interpolate(self, per_particle: np.ndarray) -> np.ndarray:
        """Interpolate a quantity of the particles on the surface, shape ``(P,)`` to ``(V,)``."""
        return (self._weight * np.asarray(per_particle, np.float64)[self._near]).sum(axis=1)

    def upload(self, device: str) -> PropSurface:
        """Return the constants on a device."""

        def array(values: np.ndarray, dtype: type) -> wp.array:
            scalar = np.int32 if dtype is int else np.float32
            return wp.array(np.ascontiguousarray(values, scalar), dtype=dtype, device=device)

        return fill(
            PropSurface(),
            vertices=array(self.vertices, wp.vec3),
            near=array(self._near.T, int),
            weight=array(self._weight.T, float),
            rest=array(self._rest, wp.vec3),
        )
