"""Shadows of all surfaces of a picture: a map seen from the key light, filled voxels for occlusion, a patch of ground.

Every triangle casts from its centre; a triangle larger than the cells casts in pieces. Sums are in fixed point, and
the grids are placed by the extent of the surfaces, so that a picture is the same in every run and beside any others.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import warp as wp

from piavatar_envs.core.launch_graph import LaunchGraph
from piavatar_envs.render.surfaces import Surfaces

wp.set_module_options({"enable_backward": False})

#: Returns the number of threads of a picture that share a number of items.
Threads = Callable[[int], int]

_KEY = np.array([-0.42, -0.72, 0.95]) / np.linalg.norm([-0.42, -0.72, 0.95])
_SIDE = np.cross(_KEY, [0.0, 0.0, 1.0]) / np.linalg.norm(np.cross(_KEY, [0.0, 0.0, 1.0]))
_OTHER = np.cross(_KEY, _SIDE)
#: Direction to the key light (from the avatar's right front, high), and the axes of the map seen from it.
KEY = wp.constant(wp.vec3(*_KEY))
MAP_X, MAP_Y = wp.constant(wp.vec3(*_SIDE)), wp.constant(wp.vec3(*_OTHER))
#: Shift of a point's shadow on the ground for each metre of height.
_SLANT = wp.constant(wp.vec2(*(_KEY[:2] / _KEY[2])))

#: Farther than this from the origin nothing casts a shadow [m].
FAR = wp.constant(50.0)
#: Grids that do not hold the surfaces grow their cells in steps, because steady growth would make shadows shimmer.
_GROWTH = wp.constant(1.25)

#: Least texel of the map [m], its largest number along a side, and texels around the surfaces.
MAP_TEXEL, MAP_LIMIT, _MAP_MARGIN = wp.constant(0.014), wp.constant(320), wp.constant(4)
_DEPTH_UNIT = 1 << 16
DEPTH_SCALE = wp.constant(float(_DEPTH_UNIT))
NO_DEPTH = wp.constant(-(1 << 30))
#: Least side of a voxel [m], their largest number, and voxels around the surfaces.
_VOXEL, VOXEL_LIMIT, _VOXEL_MARGIN = wp.constant(0.035), wp.constant(1 << 17), wp.constant(2)
#: Unit of area in a voxel, and the sum of the weights of its blur.
_AREA_UNIT, _BLUR_SUM = 1024, 9**3
AREA_SCALE = wp.constant(1.0 / (_AREA_UNIT * _BLUR_SUM))
_AREA_UNITS = wp.constant(float(_AREA_UNIT))

#: Most texels of the ground's patch along a side, the least one [m], and the largest one [m].
PATCH_LIMIT = wp.constant(192)
_TEXEL, _LARGEST = wp.constant(0.016), wp.constant(0.5)
#: Texels around the shadow, in those of the coarsest layer, four times as large: as far as it is blurred.
_PATCH_MARGIN = wp.constant(2)
#: Layers of the patch: three bands of height, softer the higher, and contact. By how much their texels are larger.
_SHIFTS = (0, 1, 2, 1)
LAYER_TEXELS = sum(int(PATCH_LIMIT >> shift) ** 2 for shift in _SHIFTS)
#: Upper ends of the lower bands [m].
_LOW_BAND, _MIDDLE_BAND = wp.constant(0.25), wp.constant(0.9)
#: Lower than this nothing casts a shadow on the ground from below [m].
_SUNK = wp.constant(-0.1)
#: Height over which the shadow of contact fades [m], and the greatest opacities of the cast shadow and of that one.
_CONTACT_HEIGHT = wp.constant(0.04)
_STRENGTH, _CONTACT_STRENGTH = wp.constant(0.42), wp.constant(0.50)
_COVER_UNIT = 4096
_COVER_UNITS, _COVER_FULL = wp.constant(float(_COVER_UNIT)), wp.constant(_COVER_UNIT * 81)
_COVER_MOST = wp.constant(float(64 * _COVER_UNIT))
_COVER_SCALE = wp.constant(1.0 / (_COVER_UNIT * 81))
#: Most pieces along an edge of a triangle.
_MOST_PIECES = wp.constant(32)

#: Threads of a picture that find its extents at most.
_EXTENT_THREADS = 256
#: Quantities whose extent is found: x, y, z; the map's x and y; the shadow's x and y on the ground.
EXTENTS = 7
_EXTENTS = wp.constant(EXTENTS)
vec7 = wp.types.vector(length=EXTENTS, dtype=wp.float32)


@wp.struct
class Grids:
    """Places of the three grids of one picture, their cells [m] and sizes."""

    map_origin: wp.vec2
    map_texel: float
    map_rows: int
    map_columns: int
    voxel_origin: wp.vec3
    voxel: float
    voxels_x: int
    voxels_y: int
    voxels_z: int
    patch_origin: wp.vec2
    patch_texel: float
    patch_rows: int
    patch_columns: int


@wp.func
def is_shown(point: wp.vec3) -> bool:
    """Return whether a vertex is finite."""
    return wp.isfinite(point[0]) and wp.isfinite(point[1]) and wp.isfinite(point[2])


@wp.func
def is_near(point: wp.vec3) -> bool:
    """Return whether a vertex is finite and close enough to cast a shadow."""
    return wp.abs(point[0]) < FAR and wp.abs(point[1]) < FAR and wp.abs(point[2]) < FAR


@wp.kernel
def find_extents(
    # in
    drawn: wp.array[wp.bool],  # pictures that change, (C,)
    first: int,
    num_vertices: int,
    threads: int,
    vertices: wp.array2d[wp.vec3],  # [m], (N, V)
    # in, out
    low: wp.array2d[float],  # (C, 7)
    high: wp.array2d[float],
):
    """Find the least and greatest coordinates of the vertices."""
    c, thread = wp.tid()
    if not drawn[c]:
        return
    least = vec7(float(wp.inf))
    greatest = vec7(-float(wp.inf))
    for i in range(thread, num_vertices, threads):
        p = vertices[first + c, i]
        if is_near(p):
            height = wp.max(p[2], 0.0)
            values = vec7(
                p[0],
                p[1],
                p[2],
                wp.dot(MAP_X, p),
                wp.dot(MAP_Y, p),
                p[0] - height * _SLANT[0],
                p[1] - height * _SLANT[1],
            )
            least = wp.min(least, values)
            greatest = wp.max(greatest, values)
    for k in range(_EXTENTS):
        wp.atomic_min(low, c, k, least[k])
        wp.atomic_max(high, c, k, greatest[k])


@wp.kernel
def place_grids(
    # in
    drawn: wp.array[wp.bool],  # pictures that change, (C,)
    # in, out: cleared for the next run
    low: wp.array2d[float],  # (C, 7)
    high: wp.array2d[float],
    # out
    grids: wp.array[Grids],
):
    """Place the grids around the surfaces, on multiples of their cells, so that shadows do not shimmer."""
    c = wp.tid()
    if not drawn[c]:
        return
    least = vec7()
    greatest = vec7()
    for k in range(_EXTENTS):
        if low[c, k] <= high[c, k]:
            least[k] = low[c, k]
            greatest[k] = high[c, k]
        low[c, k] = float(wp.inf)
        high[c, k] = -float(wp.inf)
    own = Grids()
    texel = float(MAP_TEXEL)
    while wp.max(greatest[3] - least[3], greatest[4] - least[4]) > texel * float(MAP_LIMIT - 2 * _MAP_MARGIN - 2):
        texel = texel * _GROWTH
    own.map_texel = texel
    row = int(wp.floor(least[3] / texel)) - _MAP_MARGIN
    column = int(wp.floor(least[4] / texel)) - _MAP_MARGIN
    own.map_origin = wp.vec2(float(row) * texel, float(column) * texel)
    own.map_rows = wp.min(int(wp.floor(greatest[3] / texel)) + _MAP_MARGIN + 1 - row, MAP_LIMIT)
    own.map_columns = wp.min(int(wp.floor(greatest[4] / texel)) + _MAP_MARGIN + 1 - column, MAP_LIMIT)

    voxel = float(_VOXEL)
    origin = wp.vec3i()
    counts = wp.vec3i()
    fits = bool(False)
    while not fits:
        for axis in range(3):
            origin[axis] = int(wp.floor(least[axis] / voxel)) - _VOXEL_MARGIN
            counts[axis] = int(wp.floor(greatest[axis] / voxel)) + _VOXEL_MARGIN + 1 - origin[axis]
        fits = counts[0] * counts[1] <= VOXEL_LIMIT // counts[2]
        if not fits:
            voxel = voxel * _GROWTH
    own.voxel = voxel
    own.voxel_origin = wp.vec3(float(origin[0]) * voxel, float(origin[1]) * voxel, float(origin[2]) * voxel)
    own.voxels_x = counts[0]
    own.voxels_y = counts[1]
    own.voxels_z = counts[2]

    texel = float(_TEXEL)
    fits = bool(False)
    while not fits:
        for axis in range(2):
            begin = int(wp.floor(least[5 + axis] / (4.0 * texel))) - _PATCH_MARGIN
            end = int(wp.floor(greatest[5 + axis] / (4.0 * texel))) + _PATCH_MARGIN + 1
            origin[axis] = begin
            counts[axis] = 4 * (end - begin)
        fits = wp.max(counts[0], counts[1]) <= PATCH_LIMIT or texel > _LARGEST
        if not fits:
            texel = texel * _GROWTH
    own.patch_texel = texel
    own.patch_origin = wp.vec2(4.0 * texel * float(origin[0]), 4.0 * texel * float(origin[1]))
    own.patch_rows = wp.min(counts[0], PATCH_LIMIT)
    own.patch_columns = wp.min(counts[1], PATCH_LIMIT)
    grids[c] = own


@wp.kernel
def clear_grids(
    # in
    drawn: wp.array[wp.bool],  # pictures that change, (C,)
    threads: int,
    grids: wp.array[Grids],
    # out
    depth: wp.array2d[int],  # of the map, (C, 320 * 320)
    area: wp.array2d[int],  # of the voxels, (C, VOXEL_LIMIT)
    cover: wp.array2d[int],  # of the patch's layers, (C, LAYER_TEXELS)
):
    """Empty the grids."""
    c, thread = wp.tid()
    if not drawn[c]:
        return
    own = grids[c]
    for i in range(thread, own.map_rows * own.map_columns, threads):
        depth[c, i] = NO_DEPTH
    for i in range(thread, own.voxels_x * own.voxels_y * own.voxels_z, threads):
        area[c, i] = 0
    for i in range(thread, layer_begin(own, 4), threads):
        cover[c, i] = 0


@wp.func
def patch_cell(own: Grids, x: float, y: float, shift: int) -> int:
    """Return the cell of a layer of the patch at a point of the ground [m], -1 outside."""
    texel = own.patch_texel * float(1 << shift)
    columns = own.patch_columns >> shift
    i = int(wp.floor((x - own.patch_origin[0]) / texel))
    j = int(wp.floor((y - own.patch_origin[1]) / texel))
    inside = i >= 0 and j >= 0 and i < own.patch_rows >> shift and j < columns
    return wp.where(inside, i * columns + j, -1)


@wp.func
def layer_begin(own: Grids, layer: int) -> int:
    """Return the first texel of a layer of the patch; of layer 4, the number of texels of all layers."""
    texels = own.patch_rows * own.patch_columns
    result = int(0)
    if layer >= 1:
        result += texels
    if layer >= 2:
        result += texels >> 2
    if layer >= 3:
        result += texels >> 4
    if layer >= 4:
        result += texels >> 2
    return result


@wp.func
def cast_piece(
    own: Grids,
    c: int,
    at: wp.vec3,
    area: wp.vec3,
    depth: wp.array2d[int],
    filled: wp.array2d[int],
    cover: wp.array2d[int],
):
    """Cast the shadow of a piece of surface at ``at`` [m] with area vector ``area`` [m^2]."""
    row = int((wp.dot(MAP_X, at) - own.map_origin[0]) / own.map_texel)
    column = int((wp.dot(MAP_Y, at) - own.map_origin[1]) / own.map_texel)
    if row >= 0 and column >= 0 and row < own.map_rows and column < own.map_columns:
        wp.atomic_max(depth, c, row * own.map_columns + column, int(wp.dot(KEY, at) * DEPTH_SCALE))

    place = (at - own.voxel_origin) / own.voxel
    x = int(place[0])
    y = int(place[1])
    z = int(place[2])
    if x >= 0 and y >= 0 and z >= 0 and x < own.voxels_x and y < own.voxels_y and z < own.voxels_z:
        share = wp.min(wp.length(area) / (own.voxel * own.voxel), 4.0)
        wp.atomic_add(filled, c, (x * own.voxels_y + y) * own.voxels_z + z, int(share * _AREA_UNITS + 0.5))

    height = wp.max(at[2], 0.0)
    # The sides that face the light, seen from it and laid on the ground, add up to the silhouette.
    facing = wp.dot(KEY, area)
    if facing > 0.0 and at[2] > _SUNK:
        shift = wp.where(height <= _LOW_BAND, 0, wp.where(height <= _MIDDLE_BAND, 1, 2))
        cell = patch_cell(own, at[0] - height * _SLANT[0], at[1] - height * _SLANT[1], shift)
        if cell >= 0:
            texel = own.patch_texel * float(1 << shift)
            units = wp.min(facing / (KEY[2] * texel * texel) * _COVER_UNITS, _COVER_MOST)
            wp.atomic_add(cover, c, layer_begin(own, shift) + cell, int(units + 0.5))
    if area[2] < 0.0 and height < 4.0 * _CONTACT_HEIGHT and at[2] > _SUNK:
        cell = patch_cell(own, at[0], at[1], 1)
        if cell >= 0:
            texel = 2.0 * own.patch_texel
            units = wp.min(-area[2] / (texel * texel) * _COVER_UNITS, _COVER_MOST)
            wp.atomic_add(cover, c, layer_begin(own, 3) + cell, int(units * wp.exp(-height / _CONTACT_HEIGHT) + 0.5))


@wp.kernel
def cast_triangles(
    # in
    drawn: wp.array[wp.bool],  # pictures that change, (C,)
    first: int,
    threads: int,
    triangles: wp.array[wp.vec3i],
    vertices: wp.array2d[wp.vec3],  # [m], (N, V)
    grids: wp.array[Grids],
    # out
    areas: wp.array2d[wp.vec3],  # outward normal times area [m^2], zero where hidden, (C, T)
    depth: wp.array2d[int],
    filled: wp.array2d[int],
    cover: wp.array2d[int],
):
    """Find the area vectors of the triangles, and cast their shadows."""
    c, thread = wp.tid()
    if not drawn[c]:
        return
    n = first + c
    own = grids[c]
    for t in range(thread, triangles.shape[0], threads):
        corner = triangles[t]
        p = vertices[n, corner[0]]
        u = vertices[n, corner[1]] - p
        v = vertices[n, corner[2]] - p
        area = 0.5 * wp.cross(u, v)
        if not is_shown(area):
            area = wp.vec3()
        areas[c, t] = area
        if is_near(p) and is_near(p + u) and is_near(p + v):
            longest = wp.max(wp.length_sq(u), wp.max(wp.length_sq(v), wp.length_sq(u - v)))
            step = 2.5 * wp.min(own.map_texel, own.patch_texel)
            if longest <= step * step:
                cast_piece(own, c, p + (u + v) / 3.0, area, depth, filled, cover)
            else:
                pieces = wp.min(int(wp.ceil(wp.sqrt(longest) / step)), _MOST_PIECES)
                share = 1.0 / float(pieces)
                for i in range(pieces):
                    for j in range(2 * (pieces - i) - 1):
                        # Every second piece of a row is upside down.
                        third = float(1 + j % 2) / 3.0
                        at = p + ((float(i) + third) * u + (float(j // 2) + third) * v) * share
                        cast_piece(own, c, at, area * (share * share), depth, filled, cover)


@wp.func
def blurred(values: wp.array2d[int], c: int, cell: int, stride: int, place: int, size: int) -> int:
    """Return a sum of five cells along an axis with weights 1 2 3 2 1, twice a box of three; empty outside."""
    total = 3 * values[c, cell]
    if place >= 1:
        total += 2 * values[c, cell - stride]
    if place >= 2:
        total += values[c, cell - 2 * stride]
    if place < size - 1:
        total += 2 * values[c, cell + stride]
    if place < size - 2:
        total += values[c, cell + 2 * stride]
    return total


@wp.func
def shift_of(layer: int) -> int:
    """Return by how many powers of two the texels of a layer are larger than those of the first."""
    return wp.where(layer == 3, 1, layer)


@wp.kernel
def blur_first(
    # in
    drawn: wp.array[wp.bool],  # pictures that change, (C,)
    threads: int,
    grids: wp.array[Grids],
    depth: wp.array2d[int],
    area: wp.array2d[int],
    cover: wp.array2d[int],
    # out
    widened: wp.array2d[int],
    area_out: wp.array2d[int],
    cover_out: wp.array2d[int],
):
    """Widen the map by a texel; blur the voxels along x and the patch's layers along columns."""
    c, thread = wp.tid()
    if not drawn[c]:
        return
    own = grids[c]
    for i in range(thread, own.map_rows * own.map_columns, threads):
        row = i // own.map_columns
        column = i - row * own.map_columns
        nearest = int(NO_DEPTH)
        for r in range(wp.max(row - 1, 0), wp.min(row + 2, own.map_rows)):
            for s in range(wp.max(column - 1, 0), wp.min(column + 2, own.map_columns)):
                nearest = wp.max(nearest, depth[c, r * own.map_columns + s])
        widened[c, i] = nearest
    stride = own.voxels_y * own.voxels_z
    for i in range(thread, own.voxels_x * stride, threads):
        area_out[c, i] = blurred(area, c, i, stride, i // stride, own.voxels_x)
    for layer in range(4):
        begin = layer_begin(own, layer)
        columns = own.patch_columns >> shift_of(layer)
        for i in range(thread, layer_begin(own, layer + 1) - begin, threads):
            cover_out[c, begin + i] = blurred(cover, c, begin + i, 1, i % columns, columns)


@wp.kernel
def blur_second(
    # in
    drawn: wp.array[wp.bool],  # pictures that change, (C,)
    threads: int,
    grids: wp.array[Grids],
    area: wp.array2d[int],
    cover: wp.array2d[int],
    # out
    area_out: wp.array2d[int],
    cover_out: wp.array2d[int],
):
    """Blur the voxels along y and the patch's layers along rows; no texel is covered more than once."""
    c, thread = wp.tid()
    if not drawn[c]:
        return
    own = grids[c]
    for i in range(thread, own.voxels_x * own.voxels_y * own.voxels_z, threads):
        area_out[c, i] = blurred(area, c, i, own.voxels_z, (i // own.voxels_z) % own.voxels_y, own.voxels_y)
    for layer in range(4):
        begin = layer_begin(own, layer)
        columns = own.patch_columns >> shift_of(layer)
        rows = own.patch_rows >> shift_of(layer)
        for i in range(thread, rows * columns, threads):
            total = blurred(cover, c, begin + i, columns, i // columns, rows)
            cover_out[c, begin + i] = wp.min(total, _COVER_FULL)


@wp.func
def between(a: float, b: float, c: float, d: float, u: float, v: float) -> float:
    """Return the value between those of four texels, of which ``b`` and ``d`` lie further along ``v``."""
    return (1.0 - u) * ((1.0 - v) * a + v * b) + u * ((1.0 - v) * c + v * d)


@wp.func
def layer_at(own: Grids, cover: wp.array2d[int], c: int, layer: int, i: int, j: int) -> float:
    """Return the share of a texel of the patch that a layer covers, between the layer's texels."""
    shift = shift_of(layer)
    rows = own.patch_rows >> shift
    columns = own.patch_columns >> shift
    scale = 1.0 / float(1 << shift)
    x = wp.clamp((float(i) + 0.5) * scale - 0.5, 0.0, float(rows - 1))
    y = wp.clamp((float(j) + 0.5) * scale - 0.5, 0.0, float(columns - 1))
    row = wp.min(int(x), rows - 2)
    column = wp.min(int(y), columns - 2)
    u = x - float(row)
    v = y - float(column)
    cell = layer_begin(own, layer) + row * columns + column
    a = float(cover[c, cell])
    b = float(cover[c, cell + 1])
    d = float(cover[c, cell + columns])
    e = float(cover[c, cell + columns + 1])
    return between(a, b, d, e, u, v) * _COVER_SCALE


@wp.kernel
def blur_third(
    # in
    drawn: wp.array[wp.bool],  # pictures that change, (C,)
    threads: int,
    grids: wp.array[Grids],
    area: wp.array2d[int],
    cover: wp.array2d[int],
    # out
    area_out: wp.array2d[int],
    opacity: wp.array2d[float],  # of the shadow on the patch, (C, PATCH_LIMIT**2)
):
    """Blur the voxels along z, and join the layers of the patch to the shadow's opacity."""
    c, thread = wp.tid()
    if not drawn[c]:
        return
    own = grids[c]
    for i in range(thread, own.voxels_x * own.voxels_y * own.voxels_z, threads):
        area_out[c, i] = blurred(area, c, i, 1, i % own.voxels_z, own.voxels_z)
    for k in range(thread, own.patch_rows * own.patch_columns, threads):
        i = k // own.patch_columns
        j = k - i * own.patch_columns
        clear = 1.0 - float(cover[c, k]) * _COVER_SCALE
        clear *= 1.0 - layer_at(own, cover, c, 1, i, j)
        clear *= 1.0 - layer_at(own, cover, c, 2, i, j)
        contact = layer_at(own, cover, c, 3, i, j)
        opacity[c, k] = 1.0 - (1.0 - _STRENGTH * (1.0 - clear)) * (1.0 - _CONTACT_STRENGTH * contact)


@wp.func
def opacity_at(own: Grids, opacity: wp.array2d[float], c: int, x: float, y: float) -> float:
    """Return the opacity of the shadow at a point of the ground [m], between texels."""
    u = (x - own.patch_origin[0]) / own.patch_texel - 0.5
    v = (y - own.patch_origin[1]) / own.patch_texel - 0.5
    result = float(0.0)
    if u >= 0.0 and v >= 0.0 and u < float(own.patch_rows - 1) and v < float(own.patch_columns - 1):
        i = int(u)
        j = int(v)
        k = i * own.patch_columns + j
        below = k + own.patch_columns
        result = between(
            opacity[c, k], opacity[c, k + 1], opacity[c, below], opacity[c, below + 1], u - float(i), v - float(j)
        )
    return result


class Shadows:
    """Grids of a chunk of pictures, and the launches that fill them.

    Attributes:
        grids: places of the grids, shape ``(C,)``.
        areas: outward normals times area of the triangles [m^2], zero where hidden, shape ``(C, T)``.
        depth: of the map from the light, in units of 1 / :data:`DEPTH_SCALE` m, shape ``(C, MAP_LIMIT**2)``.
        filled: blurred area in the voxels, over their own, in units of :data:`AREA_SCALE`, shape ``(C, VOXEL_LIMIT)``.
        opacity: of the shadow on the ground, shape ``(C, PATCH_LIMIT**2)``.
    """

    #: Memory of the grids of one picture.
    BYTES = 4 * (2 * MAP_LIMIT**2 + 2 * VOXEL_LIMIT + 2 * LAYER_TEXELS + PATCH_LIMIT**2)

    def __init__(self, surfaces: Surfaces, pictures: int, device: wp.Device) -> None:
        """Allocate the grids.

        Args:
            surfaces: the surfaces that cast shadows.
            pictures: number of pictures ``C`` at a time.
            device: of the surfaces.
        """

        def ints(count: int) -> wp.array:
            return wp.zeros((pictures, count), dtype=int, device=device)

        self._surfaces, self._pictures = surfaces, pictures
        self.grids = wp.zeros(pictures, dtype=Grids, device=device)
        self.areas = wp.zeros((pictures, max(1, len(surfaces.triangles))), dtype=wp.vec3, device=device)
        self._low = wp.full((pictures, EXTENTS), float(wp.inf), dtype=float, device=device)
        self._high = wp.full((pictures, EXTENTS), -float(wp.inf), dtype=float, device=device)
        self._depths = ints(MAP_LIMIT**2), ints(MAP_LIMIT**2)
        self._areas = ints(VOXEL_LIMIT), ints(VOXEL_LIMIT)
        self._covers = ints(LAYER_TEXELS), ints(LAYER_TEXELS)
        self.depth, self.filled = self._depths[1], self._areas[1]
        self.opacity = wp.zeros((pictures, PATCH_LIMIT**2), dtype=float, device=device)

    def record(self, graph: LaunchGraph, drawn: wp.array, first: int, vertices: wp.array, threads: Threads) -> None:
        """Append the launches that find the shadows of a chunk.

        Args:
            graph: the graph to append to.
            drawn: which pictures of the chunk change, shape ``(C,)``.
            first: picture of the chunk's first row.
            vertices: of all pictures [m], shape ``(N, V)``.
            threads: returns the number of threads a picture.
        """
        surfaces, (depth, widened), (area, area_2), (cover, cover_2) = (
            self._surfaces, self._depths, self._areas, self._covers,
        )  # fmt: skip
        # Few threads, because all of them meet at the same extents.
        count, k = len(drawn), min(threads(surfaces.num_vertices), _EXTENT_THREADS)
        graph.launch(
            find_extents, (count, k), [drawn, first, surfaces.num_vertices, k, vertices], [self._low, self._high]
        )
        graph.launch(place_grids, count, [drawn, self._low, self._high], [self.grids])
        cells = threads(LAYER_TEXELS)
        graph.launch(clear_grids, (count, cells), [drawn, cells, self.grids], [depth, area, cover])
        k = threads(len(surfaces.triangles))
        graph.launch(
            cast_triangles,
            (count, k),
            [drawn, first, k, surfaces.triangles, vertices, self.grids],
            [self.areas, depth, area, cover],
        )
        graph.launch(
            blur_first, (count, cells), [drawn, cells, self.grids, depth, area, cover], [widened, area_2, cover_2]
        )
        graph.launch(blur_second, (count, cells), [drawn, cells, self.grids, area_2, cover_2], [area, cover])
        graph.launch(blur_third, (count, cells), [drawn, cells, self.grids, area, cover], [area_2, self.opacity])
