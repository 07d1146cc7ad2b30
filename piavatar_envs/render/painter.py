"""Pictures of surfaces for many environments at once, on any device, as launches of a graph."""

from __future__ import annotations

from typing import Protocol

import warp as wp

from piavatar_envs.config.schema import LEAST_PICTURE
from piavatar_envs.core.launch_graph import LaunchGraph
from piavatar_envs.core.structs import fill
from piavatar_envs.render.cutouts import record_cutouts
from piavatar_envs.render.ground import Ground, GroundStyle
from piavatar_envs.render.raster import Raster
from piavatar_envs.render.resolve import Paint, resolve, to_bytes
from piavatar_envs.render.shading import Lighting
from piavatar_envs.render.shadows import Shadows
from piavatar_envs.render.surfaces import Surfaces
from piavatar_envs.render.views import View

#: Greatest number of pixels along a side of a picture, and of samples along a side of a pixel.
GREATEST_SIDE, MOST_SAMPLES = 8192, 4
#: Memory of the workspace of the pictures that are drawn at the same time [bytes].
_WORKSPACE = 1 << 28
#: Threads that all pictures of a chunk have together on a GPU, about.
_THREADS = 1 << 18


class Layer(Protocol):
    """Draws over the pictures of a painter before they become bytes."""

    def record(self, graph: LaunchGraph, painter: Painter) -> None:
        """Append launches that blend over ``painter.color`` where nearer than ``painter.nearest``."""
        ...


class Painter:
    """Draws pictures of one size.

    Each picture has its own vertices and camera; triangles and colours are shared. Pictures are bytes of their own
    vertices and camera alone: equal in every run, and beside any other pictures.

    Attributes:
        surfaces: the surfaces that are shown.
        vertices: positions [m], shape ``(N, V)``; input. A vertex that is not finite hides its triangles.
        views: cameras, shape ``(N,)``; input.
        centers: points of the ground about which it fades [m], shape ``(N,)``; input.
        drawn: pictures that change; the others stay as they were last drawn, shape ``(N,)`` bool; input, all at first.
        picture: sRGB bytes, shape ``(N, height, width, 3)``.
        depth: along the camera's axis, of the nearest surface in each pixel or of the ground, infinite in the sky [m],
            shape ``(N, height, width)``; None unless asked for.
        labels: subject of that surface, 0 for ground and sky, shape ``(N, height, width)`` uint8; None likewise.
        color: sRGB in [0, 1] of each pixel, shape ``(N, height, width)``, which the layers draw over.
        nearest: inverse depth of each pixel [1/m], 0 in the sky, shape ``(N, height, width)``.
        coverage: share of a pixel's samples that show the subject that is nearest in it, shape ``(N, height, width)``;
            empty without layers.
        backdrop: sRGB of the other samples, and the inverse depth [1/m] of what they show, or of the former if there
            are none, likewise.
        layers: drawn over the surfaces, in this order; append before :meth:`record`.
    """

    def __init__(
        self,
        surfaces: Surfaces,
        num_pictures: int,
        height: int,
        width: int,
        device: str | wp.Device,
        *,
        samples: int = 2,
        ground: GroundStyle | None = None,
        depth: bool = False,
        segmentation: bool = False,
        vertices: wp.array | None = None,
        views: wp.array | None = None,
    ) -> None:
        """Allocate the pictures.

        Args:
            surfaces: the surfaces to show, on the same device.
            num_pictures: ``N``.
            height: of each picture [px].
            width: of each picture [px].
            device: the device to draw on.
            samples: along each side of a pixel.
            ground: colours of ground and sky.
            depth: whether to fill :attr:`depth`.
            segmentation: whether to fill :attr:`labels`.
            vertices: array to use as :attr:`vertices`, instead of a new one.
            views: array to use as :attr:`views`, instead of a new one.

        Raises:
            ValueError: a size or a number of samples out of range, or an array of another shape.
        """
        for name, value in (("height", height), ("width", width)):
            if not LEAST_PICTURE <= value <= GREATEST_SIDE:
                raise ValueError(f"{name}={value} px is outside [{LEAST_PICTURE}, {GREATEST_SIDE}]")
        if not 1 <= samples <= MOST_SAMPLES:
            raise ValueError(f"samples={samples} is outside [1, {MOST_SAMPLES}]: it is along each side of a pixel")
        if num_pictures < 1:
            raise ValueError(f"num_pictures={num_pictures}; draw at least one picture")
        self.surfaces, self.num_pictures, self.height, self.width = surfaces, num_pictures, height, width
        self.device, self._samples = wp.get_device(device), samples
        shape = (num_pictures, height, width)
        most = max(1, surfaces.num_vertices)
        self.vertices = self._given(vertices, "vertices", (num_pictures, most), wp.vec3)
        self.views = self._given(views, "views", (num_pictures,), View)
        self.centers = wp.zeros(num_pictures, dtype=wp.vec2, device=device)
        self.drawn = wp.full(num_pictures, True, dtype=wp.bool, device=device)
        self.color = wp.zeros(shape, dtype=wp.vec3, device=device)
        self.nearest = wp.zeros(shape, dtype=float, device=device)
        self.picture = wp.zeros((*shape, 3), dtype=wp.uint8, device=device)
        self._depth = wp.zeros(shape if depth else (0, 0, 0), dtype=float, device=device)
        self._labels = wp.zeros(shape if segmentation else (0, 0, 0), dtype=wp.uint8, device=device)
        self.depth = self._depth if depth else None
        self.labels = self._labels if segmentation else None
        self.coverage = wp.zeros((0, 0, 0), dtype=float, device=device)
        self.backdrop = wp.zeros((0, 0, 0), dtype=wp.vec4, device=device)
        self.layers: list[Layer] = []
        self._ground = fill(Ground(), **{k: wp.vec3(*v) for k, v in vars(ground or GroundStyle()).items()})
        self._paint = fill(Paint(), surfaces)
        self.chunk = min(num_pictures, self._pictures_at_a_time())
        self._shadows = Shadows(surfaces, self.chunk, self.device)
        self._lighting = Lighting(surfaces, self.chunk, self.device)
        self._raster = Raster(surfaces, self.chunk, height * width, samples, self.device)

    def record(self, graph: LaunchGraph) -> None:
        """Append the launches that draw all pictures from the present vertices and views."""
        if self.layers and not self.coverage.size:
            self.coverage = wp.zeros(self.color.shape, dtype=float, device=self.device)
            self.backdrop = wp.zeros(self.color.shape, dtype=wp.vec4, device=self.device)
        for first in range(0, self.num_pictures, self.chunk):
            self._record_chunk(graph, first, min(self.chunk, self.num_pictures - first))
        for layer in self.layers:
            layer.record(graph, self)
        if self.layers:
            k = self._threads(self.height * self.width)
            graph.launch(
                to_bytes,
                (self.num_pictures, k),
                [self.drawn, k, _flat(self.color), _flat(self.nearest)],
                [_flat(self.picture), _flat(self._depth)],
            )

    def _record_chunk(self, graph: LaunchGraph, first: int, count: int) -> None:
        shadows, lighting, raster, surfaces = self._shadows, self._lighting, self._raster, self.surfaces
        vertices, views, drawn = self.vertices, self.views, self.drawn[first : first + count]
        shadows.record(graph, drawn, first, vertices, self._threads)
        lighting.record(graph, drawn, first, vertices, views, shadows, self._threads)
        raster.record(graph, drawn, first, vertices, views, shadows.areas, self._threads)
        record_cutouts(
            graph, surfaces, self._samples, drawn, first, vertices, views, shadows.areas, raster.nearest, self._threads
        )
        k = self._threads(self.height * self.width)
        graph.launch(
            resolve,
            (count, k),
            [
                drawn, first, k, self._samples, self._ground, self._paint, views, self.centers, surfaces.triangles,
                vertices, lighting.light, lighting.lit, shadows.grids, shadows.opacity, raster.nearest,
                raster.num_large,
            ],
            [
                _flat(array)
                for array in (
                    self.color, self.nearest, self._labels, self.picture, self._depth, self.coverage, self.backdrop,
                )
            ],
        )  # fmt: skip

    def _threads(self, items: int) -> int:
        """Return the number of threads of a picture that share ``items``; one on a CPU, which runs one at a time."""
        if not self.device.is_cuda:
            return 1
        return max(1, min(items, max(1024, _THREADS // self.chunk)))

    def _pictures_at_a_time(self) -> int:
        """Return the number of pictures whose workspaces fit the memory that is set aside for them."""
        surfaces = self.surfaces
        samples = 8 * self.height * self.width * self._samples**2
        return max(
            1, _WORKSPACE // (samples + Shadows.BYTES + 56 * surfaces.num_vertices + 12 * len(surfaces.triangles))
        )

    def _given(self, array: wp.array | None, name: str, shape: tuple[int, ...], dtype: type) -> wp.array:
        """Return an array that was given, or a new one."""
        if array is None:
            return wp.zeros(shape, dtype=dtype, device=self.device)
        if array.shape != shape:
            raise ValueError(f"{name} have shape {array.shape}; give {shape}")
        return array


def _flat(array: wp.array) -> wp.array:
    """Return an array of pictures with the pixels of each in one row."""
    return array.reshape((array.shape[0], -1)) if array.size else wp.zeros((0, 0), array.dtype, array.device)
