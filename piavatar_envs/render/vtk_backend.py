"""Draws a lit mesh and the ground off screen with pyvista (VTK): on a GPU, or through Mesa without a display."""

from __future__ import annotations

from types import ModuleType

import numpy as np

from piavatar_envs.core.extras import missing
from piavatar_envs.render import ground
from piavatar_envs.render.backend import Shot
from piavatar_envs.render.display import off_screen_window
from piavatar_envs.render.geometry import Topology
from piavatar_envs.render.ground import GroundShadow

_SUPERSAMPLING = 2
_CORNERS = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], dtype=np.float32)
_RINGS, _SEGMENTS = 14, 48


def import_pyvista() -> ModuleType:
    """Return the pyvista module.

    Raises:
        ImportError: it is not installed; names the extra that has it.
    """
    try:
        import pyvista
    except ImportError as error:
        raise missing("rendering", "pyvista", "render") from error
    return pyvista


class VtkBackend:
    """One off-screen window. Actors are made once; their points, colours and textures change in place."""

    def __init__(self, width: int, height: int) -> None:
        pyvista = import_pyvista()
        self._pyvista = pyvista
        with off_screen_window():
            size = (_SUPERSAMPLING * width, _SUPERSAMPLING * height)
            self._plotter = pyvista.Plotter(off_screen=True, window_size=size, lighting="none")
            self._plotter.set_background(ground.BACKGROUND_BOTTOM, top=ground.BACKGROUND_TOP)
            # Four plain samples a pixel: in software OpenGL a third quicker than multisampling.
            self._plotter.disable_anti_aliasing()
            # Ground and shadow come in the right order, so they need no sorting of transparent fragments.
            self._plotter.renderer.SetUseOIT(False)
            self._add_ground()
            self._add_shadow()
            self._topology: Topology | None = None
            self._mesh = None
            self._plotter.show(auto_close=False, interactive=False)

    def draw(
        self, topology: Topology, vertices: np.ndarray, colors: np.ndarray, shadow: GroundShadow, shot: Shot
    ) -> np.ndarray:
        """Draw one picture; see :class:`piavatar_envs.render.backend.Backend`."""
        from PIL import Image  # comes with pyvista

        self._set_mesh(topology, vertices, colors)
        self._set_ground(shot.center)
        self._set_shadow(shadow)
        camera = self._plotter.camera
        camera.position, camera.focal_point, camera.up = tuple(shot.eye), tuple(shot.target), shot.up
        camera.view_angle = shot.field_of_view
        camera.clipping_range = (0.05, 60.0)
        self._plotter.render()
        samples = self._plotter.screenshot(return_img=True)[..., :3]
        return np.array(Image.fromarray(np.ascontiguousarray(samples)).reduce(_SUPERSAMPLING))

    def close(self) -> None:
        """Free the window."""
        self._plotter.close()
        self._mesh = self._topology = None

    def _set_mesh(self, topology: Topology, vertices: np.ndarray, colors: np.ndarray) -> None:
        if topology is not self._topology:
            if self._mesh is not None:
                self._plotter.remove_actor("mesh", render=False)
            self._mesh = self._pyvista.PolyData.from_regular_faces(vertices.copy(), topology.faces)
            self._mesh.point_data["rgb"] = colors.copy()
            # only fronts, as the software does: cloth has a second side of its own at the same place
            self._plotter.add_mesh(
                self._mesh, scalars="rgb", rgb=True, lighting=False, culling="back", name="mesh", reset_camera=False,
                render=False,
            )  # fmt: skip
            self._topology = topology
            return
        self._mesh.points[:] = vertices
        self._mesh.point_data["rgb"][:] = colors
        self._mesh.GetPoints().Modified()
        self._mesh.GetPointData().GetArray("rgb").Modified()
        self._mesh.Modified()

    def _add_ground(self) -> None:
        """Add a disc that follows the camera's centre; its texture stays fixed to the world."""
        radius = np.concatenate([[0.0], np.linspace(ground.FADE_START, ground.FADE_END, _RINGS - 1)])
        angle = np.linspace(0.0, 2.0 * np.pi, _SEGMENTS, endpoint=False)
        disc = radius[:, None, None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        self._disc = disc.reshape(-1, 2)
        ring, segment = (i.ravel() for i in np.meshgrid(np.arange(_RINGS - 1), np.arange(_SEGMENTS), indexing="ij"))
        following = (segment + 1) % _SEGMENTS
        inner, outer = ring * _SEGMENTS, (ring + 1) * _SEGMENTS
        quads = np.stack([inner + segment, outer + segment, outer + following, inner + following], axis=-1)
        points = np.column_stack([self._disc, np.full(len(self._disc), ground.HEIGHT)])
        self._ground = self._pyvista.PolyData.from_regular_faces(points.astype(np.float32), quads)
        rgba = np.full((len(points), 4), 255, dtype=np.uint8)
        rgba[:, 3] = np.rint(255.0 * ground.fade(np.linalg.norm(self._disc, axis=1)))
        self._ground.point_data["rgba"] = rgba
        self._ground.active_texture_coordinates = (self._disc / (2.0 * ground.SQUARE)).astype(np.float32)
        texture = self._pyvista.Texture(ground.tile()[::-1])
        texture.repeat, texture.interpolate, texture.mipmap = True, True, True
        texture.SetMaximumAnisotropicFiltering(1.0)  # VTK's default of 4 costs half a frame on a CPU
        self._plotter.add_mesh(
            self._ground, scalars="rgba", rgb=True, texture=texture, lighting=False, reset_camera=False, render=False
        )

    def _set_ground(self, center: np.ndarray) -> None:
        xy = self._disc + center
        self._ground.points[:, :2] = xy
        self._ground.active_texture_coordinates[:] = xy / (2.0 * ground.SQUARE)
        self._ground.GetPoints().Modified()
        self._ground.GetPointData().GetTCoords().Modified()

    def _add_shadow(self) -> None:
        corners = np.column_stack([_CORNERS, np.full(4, ground.SHADOW_HEIGHT, dtype=np.float32)])
        self._patch = self._pyvista.PolyData.from_regular_faces(corners, [[0, 1, 2, 3]])
        self._patch.active_texture_coordinates = _CORNERS.copy()
        image = np.zeros((4, 4, 4), dtype=np.uint8)
        self._shadow_texture = self._pyvista.Texture(image)
        self._shadow_texture.interpolate = True
        self._shadow_texture.SetMaximumAnisotropicFiltering(1.0)
        self._plotter.add_mesh(
            self._patch, texture=self._shadow_texture, color="white", lighting=False, reset_camera=False, render=False
        )
        self._shadow_rgba: np.ndarray | None = None

    def _set_shadow(self, shadow: GroundShadow) -> None:
        size = len(shadow.opacity)
        if self._shadow_rgba is None:
            image = self._pyvista.ImageData(dimensions=(size, size, 1))
            rgba = np.empty((size * size, 4), dtype=np.uint8)
            rgba[:, :3] = np.rint(255.0 * np.array(ground.SHADOW_COLOR))
            image.point_data["rgba"] = rgba
            image.point_data.active_scalars_name = "rgba"
            self._shadow_texture.SetInputDataObject(image)
            self._shadow_image, self._shadow_rgba = image, image.point_data["rgba"]
        self._shadow_rgba[:, 3] = np.rint(255.0 * shadow.opacity.T.ravel())
        self._shadow_image.GetPointData().GetScalars().Modified()
        self._shadow_image.Modified()
        self._patch.points[:, :2] = shadow.origin + shadow.size * _CORNERS
        self._patch.GetPoints().Modified()
