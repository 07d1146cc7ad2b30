"""Triangles into samples: the nearest front that each sample of a picture shows.

A sample's key has the inverse depth in its upper half and the triangle in its lower half, so that the greatest key is
the nearest triangle whatever the order of the threads. Edges are evaluated in the plane of the picture, in the same
way from both sides, so that no sample between two triangles is lost (J. Pineda, "A parallel algorithm for polygon
rasterization", 1988). Triangles that reach before the near plane are intersected with the samples' rays instead.
"""

from __future__ import annotations

import warp as wp

from piavatar_envs.core.launch_graph import LaunchGraph
from piavatar_envs.render.shadows import Threads, is_shown
from piavatar_envs.render.surfaces import Surfaces
from piavatar_envs.render.views import View, to_camera

# Fused products would be rounded differently from the two sides of an edge.
wp.set_module_options({"enable_backward": False, "fuse_fp": False})

#: Surfaces nearer than this are not drawn [m].
NEAR = wp.constant(0.05)
_MOST = wp.constant(1.0 / 0.05)
#: Samples of a triangle's frame above which the threads of a GPU share it, and such triangles of a picture at most.
_LARGE, _MOST_LARGE = 1024, 8192
_LANES = wp.constant(32)
#: Samples along one side of a picture at most, as a bound of what a float becomes an integer for.
_FAR_OUT = wp.constant(1.0e6)


@wp.struct
class Frame:
    """A triangle in a picture: corners (samples to the right and down, inverse depth [1/m]) and the samples around.

    ``kind`` is 0 where nothing shows, 1 where it is drawn in the picture's plane, 2 where by rays.
    """

    kind: int
    a: wp.vec3
    b: wp.vec3
    c: wp.vec3
    left: int
    right: int
    top: int
    bottom: int


@wp.func
def on_screen(view: View, samples: float, at: wp.vec3) -> wp.vec3:
    """Return sample coordinates, x to the right and y down, and the inverse depth [1/m], of a point before the eye."""
    inverse = 1.0 / at[2]
    scale = samples * view.focal * inverse
    return wp.vec3(
        0.5 * samples * float(view.width) + scale * at[0], 0.5 * samples * float(view.height) - scale * at[1], inverse
    )


@wp.func
def frame_of(view: View, samples: int, a: wp.vec3, b: wp.vec3, c: wp.vec3) -> Frame:
    """Return the frame of a triangle whose corners are given along the camera's axes [m]."""
    frame = Frame()
    s = float(samples)
    farthest = wp.max(a[2], wp.max(b[2], c[2]))
    low = wp.vec2()
    high = wp.vec2()
    if is_shown(a) and is_shown(b) and is_shown(c) and farthest > NEAR:
        if wp.min(a[2], wp.min(b[2], c[2])) >= NEAR:
            frame.a = on_screen(view, s, a)
            frame.b = on_screen(view, s, b)
            frame.c = on_screen(view, s, c)
            p = frame.a
            q = frame.b
            r = frame.c
            # Twice the signed area; positive where the front shows (y points down).
            if (r[0] - p[0]) * (q[1] - p[1]) - (q[0] - p[0]) * (r[1] - p[1]) > 0.0:
                frame.kind = 1
                low = wp.vec2(wp.min(p[0], wp.min(q[0], r[0])), wp.min(p[1], wp.min(q[1], r[1])))
                high = wp.vec2(wp.max(p[0], wp.max(q[0], r[0])), wp.max(p[1], wp.max(q[1], r[1])))
        elif wp.dot(wp.cross(b - a, c - a), a) > 0.0:
            # The axes right, up and forward are left-handed, so a front has a positive product.
            frame.kind = 2
            low = wp.vec2(_FAR_OUT, _FAR_OUT)
            high = wp.vec2(-_FAR_OUT, -_FAR_OUT)
            for k in range(3):
                p = wp.where(k == 0, a, wp.where(k == 1, b, c))
                q = wp.where(k == 0, b, wp.where(k == 1, c, a))
                if p[2] >= NEAR:
                    seen = on_screen(view, s, p)
                    low = wp.min(low, wp.vec2(seen[0], seen[1]))
                    high = wp.max(high, wp.vec2(seen[0], seen[1]))
                if (p[2] < NEAR) != (q[2] < NEAR):
                    # where the edge crosses the near plane
                    crossing = p + (q - p) * ((NEAR - p[2]) / (q[2] - p[2]))
                    seen = on_screen(view, s, wp.vec3(crossing[0], crossing[1], NEAR))
                    low = wp.min(low, wp.vec2(seen[0], seen[1]))
                    high = wp.max(high, wp.vec2(seen[0], seen[1]))
    if frame.kind > 0:
        frame.left = wp.max(int(wp.ceil(wp.clamp(low[0], -1.0, _FAR_OUT) - 0.5)), 0)
        frame.top = wp.max(int(wp.ceil(wp.clamp(low[1], -1.0, _FAR_OUT) - 0.5)), 0)
        frame.right = wp.min(int(wp.floor(wp.clamp(high[0], -1.0, _FAR_OUT) - 0.5)), samples * view.width - 1)
        frame.bottom = wp.min(int(wp.floor(wp.clamp(high[1], -1.0, _FAR_OUT) - 0.5)), samples * view.height - 1)
        if frame.left > frame.right or frame.top > frame.bottom:
            frame.kind = 0
    return frame


@wp.func
def edge(p: wp.vec3, q: wp.vec3, x: float, y: float) -> float:
    """Return twice the signed area between an edge and a sample; the edge from the other side gives its negative."""
    return (q[0] - x) * (p[1] - y) - (p[0] - x) * (q[1] - y)


@wp.func
def hit_in_plane(frame: Frame, x: float, y: float) -> wp.vec4:
    """Return the corners' weights in the plane of the picture, without scale, and the inverse depth; 0 beside it."""
    wa = edge(frame.b, frame.c, x, y)
    wb = edge(frame.c, frame.a, x, y)
    wc = edge(frame.a, frame.b, x, y)
    inverse = float(0.0)
    if wp.min(wa, wp.min(wb, wc)) >= 0.0:
        total = wa + wb + wc
        if total > 0.0:
            inverse = (wa * frame.a[2] + wb * frame.b[2] + wc * frame.c[2]) / total
    return wp.vec4(wa, wb, wc, inverse)


@wp.func
def hit_by_ray(a: wp.vec3, b: wp.vec3, c: wp.vec3, volume: float, ray: wp.vec3) -> wp.vec4:
    """Return the corners' weights where a ray of forward component 1 meets a triangle, likewise but in space."""
    ua = wp.dot(wp.cross(b, c), ray)
    ub = wp.dot(wp.cross(c, a), ray)
    uc = wp.dot(wp.cross(a, b), ray)
    inverse = (ua + ub + uc) / volume
    if not (wp.min(ua, wp.min(ub, uc)) >= 0.0 and inverse <= _MOST):
        inverse = 0.0
    return wp.vec4(ua, ub, uc, inverse)


@wp.func
def keep_nearest(nearest: wp.array2d[wp.uint64], c: int, sample: int, inverse: float, triangle: int):
    """Show a triangle at a sample if nothing nearer is there."""
    key = (wp.uint64(wp.cast(inverse, wp.uint32)) << wp.uint64(32)) | wp.uint64(triangle + 1)
    if key > nearest[c, sample]:
        wp.atomic_max(nearest, c, sample, key)


@wp.func
def draw(
    view: View,
    samples: int,
    frame: Frame,
    a: wp.vec3,
    b: wp.vec3,
    c: wp.vec3,
    picture: int,
    triangle: int,
    row: int,
    rows: int,
    lane: int,
    lanes: int,
    nearest: wp.array2d[wp.uint64],
):
    """Draw every ``rows``-th row from ``row`` on, and in it every ``lanes``-th sample from ``lane`` on."""
    width = samples * view.width
    if frame.kind == 1:
        for y in range(frame.top + row, frame.bottom + 1, rows):
            py = float(y) + 0.5
            x = frame.left + lane
            while x <= frame.right:
                hit = hit_in_plane(frame, float(x) + 0.5, py)
                if hit[3] > 0.0:
                    keep_nearest(nearest, picture, y * width + x, hit[3], triangle)
                x += lanes
    else:
        scale = 1.0 / (float(samples) * view.focal)
        volume = wp.dot(wp.cross(b - a, c - a), a)
        for y in range(frame.top + row, frame.bottom + 1, rows):
            for x in range(frame.left + lane, frame.right + 1, lanes):
                px = (float(x) + 0.5 - 0.5 * float(width)) * scale
                py = (0.5 * float(samples * view.height) - float(y) - 0.5) * scale
                hit = hit_by_ray(a, b, c, volume, wp.vec3(px, py, 1.0))
                if hit[3] > 0.0:
                    keep_nearest(nearest, picture, y * width + x, hit[3], triangle)


@wp.kernel
def draw_triangles(
    # in
    drawn: wp.array[wp.bool],  # pictures that change, (C,)
    first: int,
    threads: int,
    samples: int,
    large: int,
    views: wp.array[View],
    triangles: wp.array[wp.vec3i],
    whole: wp.array[wp.bool],  # triangles that are drawn, and have no holes
    vertices: wp.array2d[wp.vec3],  # [m], (N, V)
    areas: wp.array2d[wp.vec3],  # outward normals times area, zero where hidden, (C, T)
    # in, out
    nearest: wp.array2d[wp.uint64],  # keys of the samples, 0 where nothing is drawn, (C, samples)
    num_large: wp.array[int],
    # out
    large_triangles: wp.array2d[int],
):
    """Draw the triangles' fronts; those of more than ``large`` samples are left for :func:`draw_large`."""
    c, thread = wp.tid()
    if not drawn[c]:
        return
    n = first + c
    view = views[n]
    for t in range(thread, triangles.shape[0], threads):
        corner = triangles[t]
        a = vertices[n, corner[0]]
        frame = Frame()
        p = wp.vec3()
        q = wp.vec3()
        r = wp.vec3()
        if wp.dot(areas[c, t], view.eye - a) > 0.0 and whole[t]:
            p = to_camera(view, a)
            q = to_camera(view, vertices[n, corner[1]])
            r = to_camera(view, vertices[n, corner[2]])
            frame = frame_of(view, samples, p, q, r)
        if frame.kind > 0:
            slot = int(large_triangles.shape[1])
            if (frame.right - frame.left + 1) > large // (frame.bottom - frame.top + 1):
                slot = wp.atomic_add(num_large, c, 1)
            if slot < large_triangles.shape[1]:
                large_triangles[c, slot] = t
            else:
                draw(view, samples, frame, p, q, r, c, t, 0, 1, 0, 1, nearest)


@wp.kernel
def draw_large(
    # in
    drawn: wp.array[wp.bool],  # pictures that change, (C,)
    first: int,
    threads: int,
    samples: int,
    views: wp.array[View],
    triangles: wp.array[wp.vec3i],
    vertices: wp.array2d[wp.vec3],  # [m], (N, V)
    num_large: wp.array[int],
    large_triangles: wp.array2d[int],
    # in, out
    nearest: wp.array2d[wp.uint64],
):
    """Draw large triangles, all threads of a picture one after the other."""
    c, thread = wp.tid()
    if not drawn[c]:
        return
    n = first + c
    view = views[n]
    for k in range(wp.min(num_large[c], large_triangles.shape[1])):
        t = large_triangles[c, k]
        corner = triangles[t]
        p = to_camera(view, vertices[n, corner[0]])
        q = to_camera(view, vertices[n, corner[1]])
        r = to_camera(view, vertices[n, corner[2]])
        frame = frame_of(view, samples, p, q, r)
        draw(view, samples, frame, p, q, r, c, t, thread // _LANES, threads // _LANES, thread % _LANES, _LANES, nearest)


class Raster:
    """Samples of a chunk of pictures, and the launches that fill them.

    Attributes:
        nearest: keys of the samples, row by row, 0 where nothing is drawn, shape ``(C, samples)``. Whatever reads the
            keys sets them back to zero for the next run.
        num_large: large triangles of each picture, shape ``(C,)``; set back likewise.
    """

    def __init__(self, surfaces: Surfaces, pictures: int, pixels: int, samples: int, device: wp.Device) -> None:
        """Allocate the samples.

        Args:
            surfaces: the surfaces that are drawn.
            pictures: number of pictures ``C`` at a time.
            pixels: of a picture.
            samples: along each side of a pixel.
            device: of the surfaces.
        """
        self._surfaces, self._samples, self._shares = surfaces, samples, wp.get_device(device).is_cuda
        self.nearest = wp.zeros((pictures, pixels * samples**2), dtype=wp.uint64, device=device)
        self.num_large = wp.zeros(pictures, dtype=int, device=device)
        self._large = wp.zeros((pictures, _MOST_LARGE if self._shares else 1), dtype=int, device=device)

    def record(
        self, graph: LaunchGraph, drawn: wp.array, first: int, vertices: wp.array, views: wp.array, areas: wp.array,
        threads: Threads,
    ) -> None:  # fmt: skip
        """Append the launches that draw a chunk.

        Args:
            graph: the graph to append to.
            drawn: which pictures of the chunk change, shape ``(C,)``.
            first: picture of the chunk's first row.
            vertices: of all pictures [m], shape ``(N, V)``.
            views: of all pictures, shape ``(N,)``.
            areas: outward normals times area of the chunk's triangles, zero where hidden, shape ``(C, T)``.
            threads: returns the number of threads a picture.
        """
        triangles = self._surfaces.triangles
        count, k = len(drawn), threads(len(triangles))
        large = _LARGE if self._shares else (1 << 31) - 1
        graph.launch(
            draw_triangles,
            (count, k),
            [drawn, first, k, self._samples, large, views, triangles, self._surfaces.whole, vertices, areas],
            [self.nearest, self.num_large, self._large],
        )
        if self._shares:
            k = -(-threads(1 << 14) // 32) * 32
            graph.launch(
                draw_large,
                (count, k),
                [drawn, first, k, self._samples, views, triangles, vertices, self.num_large, self._large],
                [self.nearest],
            )
