"""Triangles with holes into samples: hair, lashes and lace, which are cards with transparent texels.

A sample at a hole shows what lies behind. Shadows, and pictures in the colours of vertices, are those of whole cards.
"""

from __future__ import annotations

import warp as wp

from piavatar_envs.core.launch_graph import LaunchGraph
from piavatar_envs.render.raster import frame_of, hit_by_ray, hit_in_plane, keep_nearest
from piavatar_envs.render.shadows import Threads
from piavatar_envs.render.surfaces import Surfaces
from piavatar_envs.render.texels import OPAQUE, Level, level_of, texels_around
from piavatar_envs.render.views import View, to_camera

# As in the raster, with whose triangles these share edges.
wp.set_module_options({"enable_backward": False, "fuse_fp": False})

_LEAST = wp.constant(float(OPAQUE))


@wp.func
def is_opaque(
    alpha: wp.array2d[wp.uint8], row: int, level: Level, wraps: wp.array2d[int], texture: int, uv: wp.vec2
) -> bool:
    """Return whether there is no hole at a place of a texture, between the texels of a level."""
    around = texels_around(level, wraps, texture, uv)
    upper = wp.lerp(float(alpha[row, around.upper_left]), float(alpha[row, around.upper_right]), around.across)
    lower = wp.lerp(float(alpha[row, around.lower_left]), float(alpha[row, around.lower_right]), around.across)
    return wp.lerp(upper, lower, around.down) >= _LEAST


@wp.kernel
def draw_cutouts(
    # in
    drawn: wp.array[wp.bool],  # pictures that change, (C,)
    first: int,
    threads: int,
    samples: int,
    views: wp.array[View],
    triangles: wp.array[wp.vec3i],
    cutouts: wp.array[wp.vec2i],  # triangles, and rows of ``alpha``
    uv: wp.array[wp.vec2],
    textures: wp.array[int],
    wraps: wp.array2d[int],
    texture_size: int,
    alpha: wp.array2d[wp.uint8],
    vertices: wp.array2d[wp.vec3],  # [m], (N, V)
    areas: wp.array2d[wp.vec3],  # outward normals times area, zero where hidden, (C, T)
    # in, out
    nearest: wp.array2d[wp.uint64],  # keys of the samples, 0 where nothing is drawn, (C, samples)
):
    """Draw the triangles' fronts where their textures are opaque."""
    c, thread = wp.tid()
    if not drawn[c]:
        return
    n = first + c
    view = views[n]
    width = samples * view.width
    scale = 1.0 / (float(samples) * view.focal)
    for k in range(thread, cutouts.shape[0], threads):
        t = cutouts[k][0]
        corner = triangles[t]
        if wp.dot(areas[c, t], view.eye - vertices[n, corner[0]]) > 0.0:
            p = to_camera(view, vertices[n, corner[0]])
            q = to_camera(view, vertices[n, corner[1]])
            r = to_camera(view, vertices[n, corner[2]])
            frame = frame_of(view, samples, p, q, r)
            if frame.kind > 0:
                volume = wp.dot(wp.cross(q - p, r - p), p)
                side = uv[corner[1]] - uv[corner[0]]
                other = uv[corner[2]] - uv[corner[0]]
                level = level_of(texture_size, 0.0)
                if frame.kind == 1:
                    a = frame.b - frame.a
                    b = frame.c - frame.a
                    area = wp.max(wp.abs(a[0] * b[1] - a[1] * b[0]), 1.0e-9)
                    full = float(texture_size) * float(texture_size)
                    level = level_of(texture_size, wp.abs(side[0] * other[1] - side[1] * other[0]) * full / area)
                for y in range(frame.top, frame.bottom + 1):
                    for x in range(frame.left, frame.right + 1):
                        hit = wp.vec4()
                        if frame.kind == 1:
                            hit = hit_in_plane(frame, float(x) + 0.5, float(y) + 0.5)
                            # Weights in space are those in the plane over the corners' depths.
                            hit = wp.vec4(hit[0] * frame.a[2], hit[1] * frame.b[2], hit[2] * frame.c[2], hit[3])
                        else:
                            px = (float(x) + 0.5 - 0.5 * float(width)) * scale
                            py = (0.5 * float(samples * view.height) - float(y) - 0.5) * scale
                            hit = hit_by_ray(p, q, r, volume, wp.vec3(px, py, 1.0))
                        if hit[3] > 0.0:
                            at = uv[corner[0]] + (hit[1] * side + hit[2] * other) / (hit[0] + hit[1] + hit[2])
                            if is_opaque(alpha, cutouts[k][1], level, wraps, textures[t], at):
                                keep_nearest(nearest, c, y * width + x, hit[3], t)


def record_cutouts(
    graph: LaunchGraph, surfaces: Surfaces, samples: int, drawn: wp.array, first: int, vertices: wp.array,
    views: wp.array, areas: wp.array, nearest: wp.array, threads: Threads,
) -> None:  # fmt: skip
    """Append the launch that draws the triangles with holes of a chunk of pictures, if there are any.

    Args:
        graph: the graph to append to.
        surfaces: the surfaces that are drawn.
        samples: along each side of a pixel.
        drawn: which pictures of the chunk change, shape ``(C,)``.
        first: picture of the chunk's first row.
        vertices: of all pictures [m], shape ``(N, V)``.
        views: of all pictures, shape ``(N,)``.
        areas: outward normals times area of the chunk's triangles, zero where hidden, shape ``(C, T)``.
        nearest: keys of the samples, see :class:`piavatar_envs.render.raster.Raster`.
        threads: returns the number of threads a picture.
    """
    if not len(surfaces.cutouts):
        return
    k = threads(len(surfaces.cutouts))
    graph.launch(
        draw_cutouts,
        (len(drawn), k),
        [
            drawn, first, k, samples, views, surfaces.triangles, surfaces.cutouts, surfaces.uv, surfaces.texture,
            surfaces.wraps, surfaces.texture_size, surfaces.alpha, vertices, areas,
        ],
        [nearest],
    )  # fmt: skip
