"""Garments as they are drawn: smooth between the vertices of their cloth, with two sides and a hem.

A garment's mesh is divided until folds look round (:mod:`piavatar_envs.cloth.subdivision`). Clothes of a character's
file that have textures keep their own triangles, which the divided mesh moves. Every point of it is drawn twice, half
of the cloth's drawn thickness out and in along the normal, and borders are closed, so that each side has its own
colour and light, and programs that read films find a closed surface.

Symbols in kernels: ``i`` picture, ``e = envs[i]`` its environment, ``v`` vertex of cloth, ``w`` point of the finer one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import warp as wp
from scipy import sparse

from piavatar_envs.avatar.body.asset import AvatarAsset, vertex_normals
from piavatar_envs.avatar.body.sampling import ClosedSurface
from piavatar_envs.avatar.body.textures import Textures
from piavatar_envs.cloth.subdivision import Subdivision, levels_for, subdivided
from piavatar_envs.core.launch_graph import LaunchGraph
from piavatar_envs.core.structs import fill
from piavatar_envs.render.wearing import layering

if TYPE_CHECKING:
    from piavatar_envs.cloth.garment import Garment

wp.set_module_options({"enable_backward": False})

#: Greatest mean edge that is drawn, and half of the thickness of the drawn cloth [m].
_EDGE, _HALF = 0.016, 0.001
#: Distance along the cloth from its border, beyond which triangles of a file are no part of it [m].
_APART = 0.02


@dataclass(frozen=True, eq=False)
class GarmentMesh:
    """Two sides of a garment.

    Attributes:
        rows: shares of the ``V`` vertices of its cloth in its points: offsets ``(W + 1,)``, vertices and weights.
        depth: by which its points sink beneath garments that are worn over it [m], shape ``(W,)``.
        faces: closed, outward triangles over ``2 W`` vertices, the outer side first, shape ``(U, 3)`` int32.
        colors: sRGB of these vertices, shape ``(2 W, 3)`` uint8.
        textures: of the base colour, of which these are the colours at the vertices; None without any.
    """

    rows: tuple[np.ndarray, np.ndarray, np.ndarray]
    depth: np.ndarray
    faces: np.ndarray
    colors: np.ndarray
    textures: Textures | None = None

    @staticmethod
    def of(garment: Garment, over: Sequence[Garment] = (), asset: AvatarAsset | None = None) -> GarmentMesh:
        """Divide a garment, close its borders, colour its sides, and let it sink beneath those ``over`` it.

        Colours of its own, such as those of a file, are the same on both sides. Where the surface of the wearer's file
        that it replaces has textures, the file's triangles are drawn with them, moved by the cloth.

        Args:
            garment: the garment.
            over: those that are worn over it.
            asset: of the wearer; None draws no textures.
        """
        levels = levels_for(garment.mesh.faces, garment.draped, _EDGE)
        fine = subdivided(garment.mesh.faces, garment.mesh.num_vertices, levels)
        matrix, sides = fine.matrix, np.array([garment.fabric.front, garment.fabric.back])
        colors = np.rint(255.0 * np.clip(sides, 0.0, 1.0)).astype(np.uint8)
        sunk = np.max([np.zeros(matrix.shape[1]), *(layering(garment, other) for other in over)], axis=0)
        if asset is not None and garment.source is not None:
            surface = TexturedSurface.of(asset, garment.replaces)
            if surface is not None:
                return _of_file(garment, surface, fine, sunk)
        faces = both_sides(fine.faces, matrix.shape[0])
        painted = np.repeat(colors, matrix.shape[0], axis=0)
        if garment.colors is not None:
            painted = np.tile(np.rint(matrix @ garment.colors.astype(np.float64)).clip(0, 255).astype(np.uint8), (2, 1))
        return GarmentMesh(_rows(matrix), matrix @ sunk, faces, painted)

    @property
    def num_vertices(self) -> int:
        """Number of its vertices, those of both sides."""
        return len(self.colors)


@dataclass(frozen=True, eq=False)
class TexturedSurface:
    """A surface of a character's file as its look draws it from outside, without the other surfaces.

    Attributes:
        vertices: in the mean shape [m], shape ``(L, 3)`` float64; one for each place in a texture.
        faces: triangles of at most :data:`_EDGE` on average, or a sixteenth of the file's, shape ``(K, 3)``.
        textures: of these vertices and triangles.
    """

    vertices: np.ndarray
    faces: np.ndarray
    textures: Textures

    @staticmethod
    def of(asset: AvatarAsset, name: str) -> TexturedSurface | None:
        """Return the surface of a name; None where no triangle of it has a texture."""
        look, drawn = asset.look, asset.worn[name].drawn
        if look is None or look.textures is None or (look.textures.image[drawn] < 0).all():
            return None
        outer = drawn[: len(drawn) // 2]
        used, faces = np.unique(look.faces[outer], return_inverse=True)
        faces, points = faces.reshape(-1, 3), look.vertices[used].astype(np.float64)
        levels = levels_for(faces, points, _EDGE)
        fine, own = subdivided(faces, len(used), levels, smooth=False), look.textures.chosen(used, outer)
        tints = np.rint(fine.matrix @ own.tints.astype(np.float64)).astype(np.uint8)
        uv = (fine.matrix @ own.uv.astype(np.float64)).astype(np.float32)
        textures = Textures(own.images, np.tile(own.image, 4**levels), uv, tints)
        return TexturedSurface(fine.matrix @ points, fine.faces, textures)


def _of_file(garment: Garment, surface: TexturedSurface, fine: Subdivision, sunk: np.ndarray) -> GarmentMesh:
    """Return the two sides of a file's surface, each point moved with the nearest place of the divided cloth.

    A point keeps its distance along the cloth's normal. Triangles that are apart from the cloth are not drawn, such as
    those of pieces that were too small to be cloth.

    Args:
        garment: of which ``source`` is the place of the cloth in the file.
        surface: of the file.
        fine: the cloth, divided.
        sunk: depth of the cloth's vertices beneath other garments [m], shape ``(V,)``.
    """
    cloth = fine.matrix @ garment.source
    _, face, weights = ClosedSurface(cloth, fine.faces).query(surface.vertices)
    count = len(surface.vertices)
    corners = np.repeat(np.arange(count), 3), fine.faces[face].ravel()
    nearest = sparse.csr_array((weights.astype(np.float64).ravel(), corners), shape=(count, len(cloth)))
    matrix = (nearest @ fine.matrix).tocsr()
    matrix.sort_indices()
    normals = matrix @ vertex_normals(garment.source, garment.mesh.faces)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    away = surface.vertices - matrix @ garment.source
    height = np.einsum("nd,nd->n", away, normals)
    apart = np.linalg.norm(away - height[:, None] * normals, axis=1) > _APART
    kept = ~apart[surface.faces].all(axis=1)
    faces, own = surface.faces[kept], surface.textures.chosen(np.arange(count), np.flatnonzero(kept))
    both = np.concatenate([faces, faces[:, ::-1] + count]).astype(np.int32)
    textures = Textures(own.images, np.tile(own.image, 2), np.tile(own.uv, (2, 1)), np.tile(own.tints, (2, 1)))
    return GarmentMesh(_rows(matrix), matrix @ sunk - height, both, textures.colors(both), textures)


def _rows(matrix: sparse.csr_array) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return matrix.indptr.astype(np.int32), matrix.indices.astype(np.int32), matrix.data.astype(np.float32)


def both_sides(faces: np.ndarray, count: int) -> np.ndarray:
    """Return the triangles of a closed surface around a sheet: its two sides, and strips along its borders.

    Args:
        faces: of the sheet of ``count`` vertices, shape ``(T, 3)``; those of the other side are counted after them.
        count: number of its vertices.
    """
    start, end = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    alone = ~np.isin(start * count + end, end * count + start)
    a, b = start[alone], end[alone]
    strips = [np.stack([b, a, a + count], axis=1), np.stack([b, a + count, b + count], axis=1)]
    return np.concatenate([faces, faces[:, ::-1] + count, *strips]).astype(np.int32)


@wp.struct
class ClothSurface:
    """Constants of all garments of a world: ``V`` vertices of cloth, ``W`` points that are drawn on both sides."""

    triangles: wp.array(dtype=wp.vec3i)  # of the cloth
    fan_start: wp.array(dtype=int)  # (V + 1,)
    fan: wp.array(dtype=int)  # triangles around a vertex
    start: wp.array(dtype=int)  # (W + 1,)
    vertex: wp.array(dtype=int)  # that move a point
    weight: wp.array(dtype=float)
    depth: wp.array(dtype=float)  # (W,) by which a point sinks beneath other garments [m]
    outer: wp.array(dtype=int)  # (W,) drawn vertex of a point's outer side
    inner: wp.array(dtype=int)  # (W,) and of its inner side


@wp.kernel
def find_cloth_normals(
    envs: wp.array(dtype=int), surface: ClothSurface, x: wp.array2d(dtype=wp.vec3), normals: wp.array2d(dtype=wp.vec3)
):
    """Write unit normals of the vertices of cloth, over ``(pictures, V)``."""
    i, v = wp.tid()
    e = envs[i]
    if e < 0:
        return
    total = wp.vec3()
    for k in range(surface.fan_start[v], surface.fan_start[v + 1]):
        corner = surface.triangles[surface.fan[k]]
        origin = x[e, corner[0]]
        total += wp.cross(x[e, corner[1]] - origin, x[e, corner[2]] - origin)
    normals[i, v] = wp.normalize(total)


@wp.kernel
def place_cloth(
    envs: wp.array(dtype=int),
    surface: ClothSurface,
    x: wp.array2d(dtype=wp.vec3),
    normals: wp.array2d(dtype=wp.vec3),
    half: float,
    first: int,
    # out
    vertices: wp.array2d(dtype=wp.vec3),
):
    """Write both sides of the garments, from vertex ``first`` of every picture on; over ``(pictures, W)``."""
    i, w = wp.tid()
    e = envs[i]
    if e < 0:
        return
    at = wp.vec3()
    normal = wp.vec3()
    for k in range(surface.start[w], surface.start[w + 1]):
        v = surface.vertex[k]
        at += surface.weight[k] * x[e, v]
        normal += surface.weight[k] * normals[i, v]
    normal = wp.normalize(normal)
    at -= surface.depth[w] * normal
    vertices[i, first + surface.outer[w]] = at + half * normal
    vertices[i, first + surface.inner[w]] = at - half * normal


class Drapery:
    """The drawn surfaces of all garments of a world.

    Attributes:
        meshes: of every garment; their vertices follow one another in this order.
    """

    def __init__(self, garments: Sequence[Garment], assets: Sequence[AvatarAsset]) -> None:
        """Divide the garments, which follow one another among the vertices of the cloth; later ones are worn over.

        Args:
            garments: in this order.
            assets: of all avatars.
        """
        self.meshes = []
        for index, own in enumerate(garments):
            over = [other for other in garments[index + 1 :] if own.wearer == other.wearer >= 0]
            self.meshes.append(GarmentMesh.of(own, over, assets[own.wearer] if own.wearer >= 0 else None))
        self._cloth = [garment.mesh for garment in garments]

    @property
    def num_vertices(self) -> int:
        """Number of all drawn vertices."""
        return sum(mesh.num_vertices for mesh in self.meshes)

    @property
    def num_points(self) -> int:
        """Number of vertices of the cloth."""
        return sum(mesh.num_vertices for mesh in self._cloth)

    @property
    def bytes_of_picture(self) -> int:
        """Memory of a picture's garments: drawn vertices, and normals of the cloth [bytes]."""
        return 12 * (self.num_vertices + self.num_points)

    def record(
        self, graph: LaunchGraph, envs: wp.array, x: wp.array, vertices: wp.array, first: int, device: str
    ) -> None:
        """Append the launches that write the garments of pictures.

        Args:
            graph: the launch graph to append to.
            envs: environment of each picture, ``(pictures,)`` int32; a picture of a negative one keeps its vertices.
            x: positions of the cloth [m], ``(num_envs, V)``.
            vertices: of all pictures ``(pictures, ...)`` [m].
            first: index of the first garment's first vertex.
            device: of the arrays.
        """
        surface, pictures = self._upload(device), len(envs)
        normals = wp.zeros((pictures, self.num_points), dtype=wp.vec3, device=device)
        graph.launch(find_cloth_normals, normals.shape, [envs, surface, x], [normals])
        shape = (pictures, self.num_vertices // 2)
        graph.launch(place_cloth, shape, [envs, surface, x, normals, _HALF, first], [vertices])

    def _upload(self, device: str) -> ClothSurface:
        """Return the constants on a device."""
        ends = np.cumsum([0, *(cloth.num_vertices for cloth in self._cloth)])
        triangles = np.concatenate([cloth.faces + begin for cloth, begin in zip(self._cloth, ends, strict=False)])
        corners = triangles.ravel()
        fan_start = np.concatenate([[0], np.cumsum(np.bincount(corners, minlength=ends[-1]))])
        outer, inner, counts, columns, weights, first = [], [], [], [], [], 0
        for mesh, begin in zip(self.meshes, ends, strict=False):
            points, (start, vertex, weight) = mesh.num_vertices // 2, mesh.rows
            outer.append(first + np.arange(points))
            inner.append(first + points + np.arange(points))
            counts.append(np.diff(start))
            columns.append(vertex + begin)
            weights.append(weight)
            first += mesh.num_vertices

        def upload(values: np.ndarray, dtype: type) -> wp.array:
            numbers = np.float32 if dtype is float else np.int32
            return wp.array(np.ascontiguousarray(values, numbers), dtype=dtype, device=device)

        return fill(
            ClothSurface(),
            triangles=upload(triangles, wp.vec3i),
            fan_start=upload(fan_start, int),
            fan=upload(np.argsort(corners, kind="stable") // 3, int),
            start=upload(np.concatenate([[0], np.cumsum(np.concatenate(counts))]), int),
            vertex=upload(np.concatenate(columns), int),
            weight=upload(np.concatenate(weights), float),
            depth=upload(np.concatenate([mesh.depth for mesh in self.meshes]), float),
            outer=upload(np.concatenate(outer), int),
            inner=upload(np.concatenate(inner), int),
        )


def garment_names(garments: Sequence[Garment], wearers: Sequence[str]) -> list[str]:
    """Return names of garments: of the wearer and the kind, numbered where a wearer has two of a kind.

    Args:
        garments: the garments.
        wearers: names of the avatars.
    """
    plain = [f"{wearers[own.wearer]}.{own.kind}" if own.wearer >= 0 else own.kind for own in garments]
    before = [plain[:index].count(name) for index, name in enumerate(plain)]
    return [f"{name}_{count}" if count else name for name, count in zip(plain, before, strict=True)]
