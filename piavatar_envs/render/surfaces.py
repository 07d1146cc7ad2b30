"""Surfaces that pictures show: triangles, colours and textures, which stay while the vertices move."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import warp as wp

from piavatar_envs.avatar.body.textures import REPEAT, TEXTURE_SIDE, Textures, joined
from piavatar_envs.core.srgb import srgb_to_linear
from piavatar_envs.render.scene import CLAY, Color
from piavatar_envs.render.texels import alpha_levels, color_levels

#: Memory of all textures on the device [bytes], which are reduced until they fit: 32 of the largest side do.
_MOST_BYTES = 2**27


@dataclass(frozen=True, eq=False)
class MeshPart:
    """One mesh among those that are drawn together.

    Attributes:
        num_vertices: number of its vertices ``V``.
        faces: outward oriented triangles, shape ``(T, 3)`` int; only their fronts are drawn.
        color: sRGB in [0, 1] of all of it.
        colors: sRGB of the vertices instead, shape ``(V, 3)`` uint8.
        textures: of the base colour instead.
        subject: label of its pixels in a segmentation, from 1 to 255; 0 is the ground and the sky.
        is_drawn: whether it is seen; it casts shadows in either case, such as those of splats that are drawn instead.
    """

    num_vertices: int
    faces: np.ndarray
    color: Color = CLAY
    colors: np.ndarray | None = None
    textures: Textures | None = None
    subject: int = 1
    is_drawn: bool = True

    def __post_init__(self) -> None:
        shape = (self.num_vertices, 3)
        if self.colors is not None and np.shape(self.colors) != shape:
            raise ValueError(f"colors have shape {np.shape(self.colors)}; give a row per vertex: {self.num_vertices}")
        if self.textures is not None and (len(self.textures.uv), len(self.textures.image)) != (
            self.num_vertices,
            len(self.faces),
        ):
            raise ValueError(
                f"textures have uv of {len(self.textures.uv)} vertices and images of {len(self.textures.image)} "
                f"triangles; the mesh has {self.num_vertices} and {len(self.faces)}"
            )
        if not 0 <= self.subject <= 255:
            raise ValueError(f"subject={self.subject} is outside [0, 255]: a label is one byte")


@dataclass(frozen=True, eq=False)
class Surfaces:
    """Meshes laid one after the other, on a device.

    A vertex that is not finite hides its triangles, so that one topology serves pictures that show less than all.

    Attributes:
        num_vertices: of all meshes, ``V``.
        triangles: corners, shape ``(T,)``.
        incident_offsets: first entry of each vertex in :attr:`incident`, shape ``(V + 1,)``.
        incident: triangles of every vertex, ascending.
        neighbour_offsets: first entry of each vertex in :attr:`neighbours`, shape ``(V + 1,)``.
        neighbours: vertices that share an edge with every vertex, ascending.
        albedo: linear light in [0, 1] that each vertex reflects, times its texture if it has one, shape ``(1, V)``, or
            ``(N, V)`` with a row per picture; may be rewritten at any time.
        uv: place of each vertex in its texture, shape ``(V,)``.
        texture: texture of each triangle, -1 without one, shape ``(T,)``.
        texels: textures with all their reduced levels, from the full size to one texel, sRGB, shape ``(K, n, 3)``.
        wraps: how each texture goes on beyond its borders, see :class:`Texture`, shape ``(K, 2)``.
        texture_size: side of the textures [texels], a power of two.
        subject: label of each triangle, -1 of one that is not drawn, shape ``(T,)``.
        whole: whether each triangle is drawn and has no holes, shape ``(T,)`` bool.
        cutouts: drawn triangles with holes and the row of each in :attr:`alpha`, shape ``(M,)``.
        alpha: levels of the textures with holes, which are where it is below ``texels.OPAQUE``, shape ``(A, n)`` uint8.
    """

    num_vertices: int
    triangles: wp.array
    incident_offsets: wp.array
    incident: wp.array
    neighbour_offsets: wp.array
    neighbours: wp.array
    albedo: wp.array
    uv: wp.array
    texture: wp.array
    texels: wp.array
    wraps: wp.array
    texture_size: int
    subject: wp.array
    whole: wp.array
    cutouts: wp.array
    alpha: wp.array

    @classmethod
    def build(cls, meshes: Sequence[MeshPart], device: str | wp.Device, num_albedos: int = 1) -> Surfaces:
        """Join meshes on a device.

        Args:
            meshes: their vertices follow one another in this order.
            device: of the pictures.
            num_albedos: rows of :attr:`albedo`: one for all pictures, or one for each.

        Raises:
            ValueError: no mesh, or a triangle that has a corner outside its mesh.
        """
        if not meshes:
            raise ValueError("nothing to draw: give at least one mesh")
        counts = [mesh.num_vertices for mesh in meshes]
        first = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
        faces = []
        for mesh, offset in zip(meshes, first, strict=False):
            own = np.asarray(mesh.faces, dtype=np.int64).reshape(-1, 3)
            if len(own) and not (own.min() >= 0 and own.max() < mesh.num_vertices):
                raise ValueError(
                    f"faces have corners from {own.min()} to {own.max()}, and the mesh has {mesh.num_vertices} vertices"
                )
            faces.append(own + offset)
        triangles = np.concatenate(faces)
        labels = [
            np.full(len(own), mesh.subject if mesh.is_drawn else -1) for mesh, own in zip(meshes, faces, strict=True)
        ]
        albedo = [np.broadcast_to(linear_albedo(_plain(mesh)), (mesh.num_vertices, 3)) for mesh in meshes]
        # an avatar that is there twice has its images once; without textures, one that no triangle has
        no_colors = (np.zeros((mesh.num_vertices, 3), np.uint8) for mesh in meshes)
        textures = joined(
            [(mesh.textures, none, len(own)) for mesh, none, own in zip(meshes, no_colors, faces, strict=True)]
        ) or Textures((), np.full(len(triangles), -1), np.zeros((first[-1], 2)), np.zeros((first[-1], 3)))
        images = [texture.pixels for texture in textures.images] or [np.zeros((1, 1, 3), np.uint8)]
        size = _side(images)
        incident = _incident(triangles, int(first[-1]))
        neighbours = _neighbours(triangles, int(first[-1]))
        texels = np.stack([color_levels(image, size) for image in images])
        clear = [index for index, texture in enumerate(textures.images) if texture.alpha is not None]
        alpha = [alpha_levels(textures.images[index].alpha, textures.images[index].cutoff, size) for index in clear]
        is_drawn, has_holes = np.concatenate(labels) >= 0, np.isin(textures.image, clear)
        holed = np.flatnonzero(is_drawn & has_holes)
        rows = np.searchsorted(clear, textures.image[holed])
        wraps = np.array([texture.wraps for texture in textures.images] or [(REPEAT, REPEAT)], np.int32)

        def upload(values: np.ndarray, dtype: type) -> wp.array:
            # Kernels take no empty arrays.
            values = values if len(values) else np.zeros((1, *values.shape[1:]), values.dtype)
            return wp.array(np.ascontiguousarray(values), dtype=dtype, device=device)

        return cls(
            num_vertices=int(first[-1]),
            triangles=wp.array(triangles.astype(np.int32), dtype=wp.vec3i, device=device),
            incident_offsets=upload(incident[0], wp.int32),
            incident=upload(incident[1], wp.int32),
            neighbour_offsets=upload(neighbours[0], wp.int32),
            neighbours=upload(neighbours[1], wp.int32),
            albedo=wp.array(np.tile(np.concatenate(albedo), (num_albedos, 1, 1)), dtype=wp.vec3, device=device),
            uv=upload(textures.uv.astype(np.float32), wp.vec2),
            texture=upload(textures.image.astype(np.int32), wp.int32),
            texels=upload(texels, wp.uint8),
            wraps=upload(wraps, wp.int32),
            texture_size=size,
            subject=upload(np.concatenate(labels).astype(np.int32), wp.int32),
            whole=upload(is_drawn & ~has_holes, wp.bool),
            cutouts=wp.array(np.stack([holed, rows], axis=1).astype(np.int32), dtype=wp.vec2i, device=device),
            alpha=upload(np.stack(alpha) if alpha else np.zeros((0, 1), np.uint8), wp.uint8),
        )


def _plain(mesh: MeshPart) -> Color | np.ndarray:
    """Return the colour of a mesh but for its textures, or those of its vertices."""
    if mesh.textures is not None:
        return mesh.textures.tints
    return mesh.color if mesh.colors is None else mesh.colors


def linear_albedo(color: Color | np.ndarray) -> np.ndarray:
    """Return linear light in [0, 1], float32, of a colour (sRGB in [0, 1]) or of colours ``(V, 3)`` uint8."""
    if isinstance(color, np.ndarray) and color.dtype == np.uint8:
        return _LINEAR[color]
    return srgb_to_linear(color).astype(np.float32)


#: Linear light of every sRGB byte.
_LINEAR = srgb_to_linear(np.arange(256) / 255.0).astype(np.float32)


def _incident(triangles: np.ndarray, num_vertices: int) -> tuple[np.ndarray, np.ndarray]:
    """Return offsets and triangles of every vertex, ascending."""
    corners = triangles.ravel()
    offsets = np.concatenate([[0], np.cumsum(np.bincount(corners, minlength=num_vertices))])
    return offsets.astype(np.int32), (np.argsort(corners, kind="stable") // 3).astype(np.int32)


def _neighbours(triangles: np.ndarray, num_vertices: int) -> tuple[np.ndarray, np.ndarray]:
    """Return offsets and neighbours of every vertex, ascending."""
    start, end = triangles.ravel(), np.roll(triangles, -1, axis=1).ravel()
    edges = np.unique(np.concatenate([start * num_vertices + end, end * num_vertices + start]))
    owner, other = np.divmod(edges, max(num_vertices, 1))
    offsets = np.concatenate([[0], np.cumsum(np.bincount(owner, minlength=num_vertices))])
    return offsets.astype(np.int32), other.astype(np.int32)


def _side(images: Sequence[np.ndarray]) -> int:
    """Return the side of the textures on the device: a power of two that holds the largest image, within the limits."""
    largest = max(max(image.shape[:2]) for image in images)
    side = min(TEXTURE_SIDE, 1 << int(np.ceil(np.log2(max(largest, 1)))))
    while side > 1 and 4 * side * side * len(images) > _MOST_BYTES:
        side //= 2
    return side
