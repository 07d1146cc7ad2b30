"""Light on the vertices: a warm key light with soft shadows, sky and ground light, a rim and gloss.

The skin has a vertex about every centimetre, close to a pixel of a small picture, so the light is found there and
interpolated: soft shadows become affordable on a CPU, and every machine draws the same colours.
"""

from __future__ import annotations

import warp as wp

from piavatar_envs.core.launch_graph import LaunchGraph
from piavatar_envs.render.shadows import (
    AREA_SCALE,
    DEPTH_SCALE,
    KEY,
    MAP_TEXEL,
    MAP_X,
    MAP_Y,
    Grids,
    Shadows,
    Threads,
    is_near,
)
from piavatar_envs.render.surfaces import Surfaces
from piavatar_envs.render.views import View

wp.set_module_options({"enable_backward": False})

_KEY_LIGHT = wp.constant(wp.vec3(1.12, 1.06, 0.985))
_SKY_LIGHT = wp.constant(wp.vec3(0.43, 0.455, 0.50))
_GROUND_LIGHT = wp.constant(wp.vec3(0.27, 0.245, 0.225))
_RIM_LIGHT = wp.constant(wp.vec3(0.34, 0.38, 0.44))
#: Light bleeds around the terminator, red furthest, as in skin.
_WRAP = wp.constant(wp.vec3(0.30, 0.19, 0.14))
_SHININESS = 5  # as a power of two: cheaper by squaring
_SPECULAR = wp.constant(0.09)
#: Distance behind another surface at which a shadow begins, and over which it becomes full [m].
_SHADOW_BIAS, _SHADOW_SOFTNESS = wp.constant(0.03), wp.constant(0.03)
#: Places of the map around a vertex whose shadows are averaged, in least texels.
_TAPS = wp.constant(
    wp.types.matrix(shape=(9, 2), dtype=float)(
        0.0, 0.0, 1.0, 1.0, -1.0, 1.0, 1.0, -1.0, -1.0, -1.0, 2.0, 0.0, -2.0, 0.0, 0.0, 2.0, 0.0, -2.0
    )
)
_NUM_TAPS = wp.constant(9)
#: Distances along the normal at which surfaces hide the sky, in voxels.
_NEAR_REACH, _FAR_REACH = wp.constant(1.6), wp.constant(3.0)
#: Blurring makes a flat surface occlude itself by this much: only what exceeds it hides the sky.
_FLAT_OCCLUSION = wp.constant(0.22)
#: Averages with the neighbours, which hide the cells of the grids.
_SMOOTHINGS = 3


@wp.func
def lit_share(own: Grids, depth: wp.array2d[int], c: int, at: wp.vec3) -> float:
    """Return the share of the key light that reaches a point [m]."""
    place = wp.vec2(wp.dot(MAP_X, at), wp.dot(MAP_Y, at)) - own.map_origin
    threshold = wp.dot(KEY, at) + _SHADOW_BIAS
    hidden = float(0.0)
    for k in range(_NUM_TAPS):
        row = wp.clamp(int((place[0] + MAP_TEXEL * _TAPS[k, 0]) / own.map_texel), 0, own.map_rows - 1)
        column = wp.clamp(int((place[1] + MAP_TEXEL * _TAPS[k, 1]) / own.map_texel), 0, own.map_columns - 1)
        nearest = float(depth[c, row * own.map_columns + column]) / DEPTH_SCALE
        hidden += wp.clamp((nearest - threshold) / _SHADOW_SOFTNESS, 0.0, 1.0)
    return 1.0 - hidden / float(_NUM_TAPS)


@wp.func
def filled_at(own: Grids, filled: wp.array2d[int], c: int, at: wp.vec3) -> float:
    """Return the surface in the voxels around a point [m], over a voxel's side squared; trilinear, 0 outside."""
    place = (at - own.voxel_origin) / own.voxel - wp.vec3(0.5)
    x = int(wp.floor(place[0]))
    y = int(wp.floor(place[1]))
    z = int(wp.floor(place[2]))
    total = float(0.0)
    if x >= 0 and y >= 0 and z >= 0 and x + 1 < own.voxels_x and y + 1 < own.voxels_y and z + 1 < own.voxels_z:
        u = place[0] - float(x)
        v = place[1] - float(y)
        w = place[2] - float(z)
        cell = (x * own.voxels_y + y) * own.voxels_z + z
        for i in range(2):
            for j in range(2):
                base = cell + (i * own.voxels_y + j) * own.voxels_z
                column = (1.0 - w) * float(filled[c, base]) + w * float(filled[c, base + 1])
                total += wp.where(i == 1, u, 1.0 - u) * wp.where(j == 1, v, 1.0 - v) * column
    return total * AREA_SCALE


@wp.func
def occlusion(own: Grids, filled: wp.array2d[int], c: int, at: wp.vec3, normal: wp.vec3) -> float:
    """Return the share of the sky that near surfaces hide from a point [m]."""
    hidden = filled_at(own, filled, c, at + _NEAR_REACH * own.voxel * normal)
    hidden += filled_at(own, filled, c, at + _FAR_REACH * own.voxel * normal)
    return wp.clamp(1.1 * (hidden - _FLAT_OCCLUSION), 0.0, 0.75)


@wp.kernel
def find_light(
    # in
    drawn: wp.array[wp.bool],  # pictures that change, (C,)
    first: int,
    num_vertices: int,
    threads: int,
    offsets: wp.array[int],  # of the triangles of every vertex, (V + 1,)
    incident: wp.array[int],
    vertices: wp.array2d[wp.vec3],  # [m], (N, V)
    areas: wp.array2d[wp.vec3],  # of the triangles [m^2], (C, T)
    grids: wp.array[Grids],
    depth: wp.array2d[int],
    filled: wp.array2d[int],
    # out
    normals: wp.array2d[wp.vec3],  # (C, V)
    shares: wp.array2d[wp.vec2],  # of the key light and of the sky that reach the vertex
):
    """Find the normals of the vertices, and the light that reaches them."""
    c, thread = wp.tid()
    if not drawn[c]:
        return
    own = grids[c]
    for i in range(thread, num_vertices, threads):
        total = wp.vec3()
        for k in range(offsets[i], offsets[i + 1]):
            total += areas[c, incident[k]]
        normal = wp.normalize(total)
        at = vertices[first + c, i]
        share = wp.vec2(1.0, 1.0)
        if is_near(at):
            share = wp.vec2(lit_share(own, depth, c, at), 1.0 - occlusion(own, filled, c, at, normal))
        normals[c, i] = normal
        shares[c, i] = share


@wp.func
def to_srgb(light: float) -> float:
    """Return the sRGB value of linear light, within half a byte (three square roots in place of a power)."""
    a = wp.sqrt(wp.clamp(light, 0.0, 1.0))
    b = wp.sqrt(a)
    return wp.clamp(0.662002687 * a + 0.684122060 * b - 0.323583601 * wp.sqrt(b) - 0.0225411470 * light, 0.0, 1.0)


@wp.func
def smoothed(offsets: wp.array[int], neighbours: wp.array[int], shares: wp.array2d[wp.vec2], c: int, i: int) -> wp.vec2:
    """Return the mean of a vertex and its neighbours."""
    begin = offsets[i]
    end = offsets[i + 1]
    total = shares[c, i]
    for k in range(begin, end):
        total += shares[c, neighbours[k]]
    return total / float(end - begin + 1)


@wp.kernel
def smooth_light(
    # in
    drawn: wp.array[wp.bool],  # pictures that change, (C,)
    num_vertices: int,
    threads: int,
    offsets: wp.array[int],  # of the neighbours of every vertex, (V + 1,)
    neighbours: wp.array[int],
    shares: wp.array2d[wp.vec2],  # (C, V)
    # out
    shares_out: wp.array2d[wp.vec2],
):
    """Average the light with that of the neighbours."""
    c, thread = wp.tid()
    if not drawn[c]:
        return
    for i in range(thread, num_vertices, threads):
        shares_out[c, i] = smoothed(offsets, neighbours, shares, c, i)


@wp.kernel
def send_light(
    # in
    drawn: wp.array[wp.bool],  # pictures that change, (C,)
    first: int,
    num_vertices: int,
    threads: int,
    offsets: wp.array[int],  # of the neighbours of every vertex, (V + 1,)
    neighbours: wp.array[int],
    views: wp.array[View],
    vertices: wp.array2d[wp.vec3],  # [m], (N, V)
    normals: wp.array2d[wp.vec3],  # (C, V)
    shares: wp.array2d[wp.vec2],
    albedo: wp.array2d[wp.vec3],  # linear, (1 or N, V)
    # out
    light: wp.array2d[wp.vec4],  # (C, V)
    lit: wp.array2d[wp.vec3],
):
    """Find the light that leaves the vertices towards the eye: a factor of their albedo, gloss, and their colour."""
    c, thread = wp.tid()
    if not drawn[c]:
        return
    eye = views[first + c].eye
    row = wp.min(first + c, albedo.shape[0] - 1)
    for i in range(thread, num_vertices, threads):
        share = smoothed(offsets, neighbours, shares, c, i)
        key_share = share[0]
        sky = share[1]
        normal = normals[c, i]
        toward = wp.normalize(eye - vertices[first + c, i])
        facing = wp.dot(KEY, normal)
        up = 0.5 + 0.5 * normal[2]
        grazing = 1.0 - wp.clamp(wp.dot(normal, toward), 0.0, 1.0)
        rim = grazing * grazing * grazing * (0.35 + 0.65 * up) * sky
        gloss = wp.max(wp.dot(normal, wp.normalize(toward + KEY)), 0.0)
        for _ in range(wp.static(_SHININESS)):
            gloss = gloss * gloss
        gloss = gloss * _SPECULAR * key_share * (0.4 + grazing)
        result = wp.vec4(0.0, 0.0, 0.0, gloss)
        for channel in range(3):
            wrap = _WRAP[channel]
            key = wp.max((facing + wrap) / (1.0 + wrap), 0.0) * _KEY_LIGHT[channel]
            # The wrapped light passes a shadow's edge too: keep a little of its red.
            key = key * (key_share + (1.0 - key_share) * (0.25 * wrap))
            ambient = (_GROUND_LIGHT[channel] + (_SKY_LIGHT[channel] - _GROUND_LIGHT[channel]) * up) * sky
            result[channel] = key + ambient + _RIM_LIGHT[channel] * rim
        light[c, i] = result
        own = albedo[row, i]
        lit[c, i] = wp.vec3(
            to_srgb(own[0] * result[0] + gloss),
            to_srgb(own[1] * result[1] + gloss),
            to_srgb(own[2] * result[2] + gloss),
        )


class Lighting:
    """Light on the vertices of a chunk of pictures, and the launches that find it.

    Attributes:
        light: factor of each vertex's albedo (three channels) and gloss, linear, shape ``(C, V)``.
        lit: sRGB that it shows in this light, shape ``(C, V)``.
    """

    def __init__(self, surfaces: Surfaces, pictures: int, device: wp.Device) -> None:
        """Allocate the light.

        Args:
            surfaces: the surfaces that are lit.
            pictures: number of pictures ``C`` at a time.
            device: of the surfaces.
        """
        shape = (pictures, max(1, surfaces.num_vertices))
        self._surfaces = surfaces
        self._normals = wp.zeros(shape, dtype=wp.vec3, device=device)
        self._shares = [wp.zeros(shape, dtype=wp.vec2, device=device) for _ in range(2)]
        self.light = wp.zeros(shape, dtype=wp.vec4, device=device)
        self.lit = wp.zeros(shape, dtype=wp.vec3, device=device)

    def record(
        self, graph: LaunchGraph, drawn: wp.array, first: int, vertices: wp.array, views: wp.array, shadows: Shadows,
        threads: Threads,
    ) -> None:  # fmt: skip
        """Append the launches that light a chunk.

        Args:
            graph: the graph to append to.
            drawn: which pictures of the chunk change, shape ``(C,)``.
            first: picture of the chunk's first row.
            vertices: of all pictures [m], shape ``(N, V)``.
            views: of all pictures, shape ``(N,)``.
            shadows: of the chunk, recorded before.
            threads: returns the number of threads per picture.
        """
        surfaces = self._surfaces
        count, k = len(drawn), threads(surfaces.num_vertices)
        near, other = self._shares
        graph.launch(
            find_light,
            (count, k),
            [
                drawn, first, surfaces.num_vertices, k, surfaces.incident_offsets, surfaces.incident, vertices,
                shadows.areas, shadows.grids, shadows.depth, shadows.filled,
            ],
            [self._normals, near],
        )  # fmt: skip
        around = [surfaces.neighbour_offsets, surfaces.neighbours]
        for _ in range(_SMOOTHINGS - 1):
            graph.launch(smooth_light, (count, k), [drawn, surfaces.num_vertices, k, *around, near], [other])
            near, other = other, near
        graph.launch(
            send_light,
            (count, k),
            [drawn, first, surfaces.num_vertices, k, *around, views, vertices, self._normals, near, surfaces.albedo],
            [self.light, self.lit],
        )
