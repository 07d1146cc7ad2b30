"""Pictures of bodies and markers that are given as arrays: one picture at a time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from types import TracebackType

import numpy as np
import warp as wp

from piavatar_envs.avatar.body.splats import joined_colors
from piavatar_envs.avatar.body.textures import Textures
from piavatar_envs.config.schema import LEAST_FRAME
from piavatar_envs.core.capture_lock import CAPTURE
from piavatar_envs.core.kernel_cache import init_warp
from piavatar_envs.core.launch_graph import LaunchGraph
from piavatar_envs.core.srgb import srgb_to_linear
from piavatar_envs.render.coloring import strain_color, strain_table
from piavatar_envs.render.overlay import draw_scale
from piavatar_envs.render.painter import GREATEST_SIDE, Painter
from piavatar_envs.render.scene import Body, Camera, Follower, Marker, MovedSplats
from piavatar_envs.render.splats import SplatPainter
from piavatar_envs.render.surfaces import MeshPart, Surfaces, linear_albedo
from piavatar_envs.render.views import Shot, view_rows


class Renderer:
    """Draws pictures into arrays, in any thread and in any process, without a graphics driver.

    Example::

        with Renderer(480, 480) as renderer:
            frame = renderer.render([Body(vertices, faces)], [Sphere(target, 0.05)], follow=root_position)
    """

    def __init__(
        self,
        width: int = 480,
        height: int = 480,
        camera: Camera | None = None,
        device: str | wp.Device = "cpu",
        scale: bool = True,
    ) -> None:
        """Prepare pictures of one size; nothing is allocated before the first.

        Args:
            width: of the picture [px].
            height: of the picture [px].
            camera: the view; by default of a standing person, three-quarters from the front.
            device: Warp device to draw on. A GPU is for the process that first used it.
            scale: draw the colour scale of bodies that have scalars.

        Raises:
            ValueError: a size outside [16, 8192].
        """
        for name, value in (("width", width), ("height", height)):
            if not LEAST_FRAME <= value <= GREATEST_SIDE:
                raise ValueError(f"{name}={value} px is outside [{LEAST_FRAME}, {GREATEST_SIDE}]")
        init_warp()
        self.width, self.height = int(width), int(height)
        self.camera = camera or Camera()
        self._device, self._scale = device, scale
        self._follower = Follower(self.camera)
        self._corner = 0  # of the colour scale
        self._shown: _Shown | None = None
        self._closed = False

    def render(
        self,
        bodies: Sequence[Body],
        markers: Sequence[Marker] = (),
        follow: np.ndarray | None = None,
        elapsed: float = 1.0 / 30.0,
    ) -> np.ndarray:
        """Draw one picture.

        Args:
            bodies: meshes in world coordinates; triangles with a corner that is not finite are left out.
            markers: spheres, arrows, boxes, capsules and rings.
            follow: the point the camera follows [m], shape ``(3,)``, for example the root; the origin if None.
            elapsed: time since the last picture [s], in which the camera has glided.

        Returns:
            The picture, shape ``(height, width, 3)`` uint8; the caller's own.

        Raises:
            ImportError: a body has scalars, whose scale has text, and Pillow is not installed (extra ``render``).
            RuntimeError: the renderer is closed.
            ValueError: nothing to show, or a body's arrays do not fit together.
        """
        if self._closed:
            raise RuntimeError("this Renderer is closed; make a new one")
        if not bodies and not markers:
            raise ValueError("nothing to show: give at least one body or marker")
        center = self._follower.move(follow, elapsed)
        offset = np.array([*center, 0.0])
        shot = Shot(offset + self.camera.position, offset + self.camera.target, self.camera.field_of_view, center)
        meshes = [(body.vertices, body.faces) for body in bodies] + [marker.mesh() for marker in markers]
        vertices = np.concatenate([np.asarray(mesh[0], dtype=np.float32) for mesh in meshes])
        albedo = np.concatenate(
            [_body_albedo(body) for body in bodies]
            + [
                np.broadcast_to(linear_albedo(marker.color), (len(mesh[0]), 3))
                for marker, mesh in zip(markers, meshes[len(bodies) :], strict=True)
            ]
        )
        splats = [body.splats for body in bodies if body.splats is not None]
        textures = [_textures(body) for body in bodies]
        clouds = tuple((id(each.cloud), each.colors is None) for each in splats)
        key = (tuple((id(faces), len(own)) for own, faces in meshes), clouds, tuple(id(each) for each in textures))
        # A picture that is interrupted leaves samples behind: its painter is not used again.
        shown, self._shown = self._shown, None
        if shown is None or shown.key != key:
            parts = [MeshPart(len(own), faces) for own, faces in meshes]
            for index, body in enumerate(bodies):
                parts[index] = replace(parts[index], is_drawn=body.splats is None, textures=_textures(body))
            with CAPTURE.exclusive():
                painter = Painter(Surfaces.build(parts, self._device), 1, self.height, self.width, self._device)
                shown = _Shown(key, [*(mesh[1] for mesh in meshes), *textures], splats, painter)
        with CAPTURE.shared():
            picture = shown.draw(vertices, albedo, splats, shot)
        self._shown = shown
        for body in bodies:
            if body.scalars is not None and self._scale:
                of_bodies = vertices[: sum(len(body.vertices) for body in bodies)]
                seen = shot.project(of_bodies, self.height, self.width)
                self._corner = draw_scale(picture, body.scalar_max, body.scalar_label, seen, self._corner)
                break
        return picture

    def reset_camera(self) -> None:
        """Let the next picture's camera start at what it follows, without a glide from where it was."""
        self._follower.cut()

    def close(self) -> None:
        """Free the memory; closing twice is fine."""
        self._shown, self._closed = None, True

    def __enter__(self) -> Renderer:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


class _Shown:
    """Painter of meshes that are shown again and again, and its launches.

    The launches are made one by one, because a captured graph would exclude other threads while it is captured.
    """

    def __init__(self, key: tuple, owners: Sequence[object], splats: Sequence[MovedSplats], painter: Painter) -> None:
        self.key, self._painter = key, painter
        clouds = [each.cloud for each in splats]
        self._owners = owners, clouds  # an id is only unique while its owner lives
        self._splats: SplatPainter | None = None
        if clouds:
            size, opacities = (1, painter.height, painter.width), np.concatenate([each.opacities for each in clouds])
            self._splats = SplatPainter(opacities, joined_colors([each.sh for each in splats]), *size, painter.device)
            painter.layers.append(self._splats)
        graph = LaunchGraph(painter.device)
        painter.record(graph)
        self._launches = [launch for _, launch in graph.launches]

    def draw(self, vertices: np.ndarray, albedo: np.ndarray, splats: Sequence[MovedSplats], shot: Shot) -> np.ndarray:
        """Draw the meshes with these vertices ``(V, 3)`` [m] and linear colours ``(V, 3)``; returns a copy."""
        for name in ("means", "covariances", "turns") if splats else ():
            getattr(self._splats, name).assign(np.concatenate([getattr(each, name) for each in splats])[None])
        if any(each.colors is not None for each in splats):
            self._splats.harmonics.assign(joined_colors([each.sh for each in splats]))
        painter = self._painter
        painter.vertices.assign(vertices[None])
        painter.surfaces.albedo.assign(albedo[None])
        painter.views.assign(view_rows([shot], painter.height, painter.width))
        painter.centers.assign(np.asarray(shot.center, np.float32)[None])
        with wp.ScopedDevice(painter.device):
            for launch in self._launches:
                launch()
        return painter.picture.numpy()[0].copy()


def _textures(body: Body) -> Textures | None:
    """Return the textures that a body is drawn with."""
    return None if body.scalars is not None else body.textures


def _body_albedo(body: Body) -> np.ndarray:
    """Return the linear light that the vertices of a body reflect, shape ``(V, 3)``."""
    count = len(body.vertices)
    if body.scalars is not None:
        if np.shape(body.scalars) != (count,):
            raise ValueError(
                f"scalars have shape {np.shape(body.scalars)}; give one value per vertex, shape ({count},)"
            )
        return _linear_strain_table()[strain_color(body.scalars, body.scalar_max)]
    if body.colors is not None and np.shape(body.colors) != (count, 3):
        raise ValueError(f"colors have shape {np.shape(body.colors)}; give a row per vertex: {count}")
    if body.textures is not None:
        return linear_albedo(body.textures.tints)
    return np.broadcast_to(linear_albedo(body.color if body.colors is None else body.colors), (count, 3))


@lru_cache(maxsize=1)
def _linear_strain_table() -> np.ndarray:
    return srgb_to_linear(strain_table()).astype(np.float32)
