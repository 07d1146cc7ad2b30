"""Pictures of bodies and markers: the one entry point of this package."""

from __future__ import annotations

from collections.abc import Sequence
from types import TracebackType

import numpy as np

from piavatar_envs.render import coloring, shading, vtk_backend
from piavatar_envs.render.backend import Backend, Shot
from piavatar_envs.render.display import claim_opengl, opengl_available, owns_opengl
from piavatar_envs.render.geometry import Topology, drawable, topology_key
from piavatar_envs.render.ground import ground_shadow
from piavatar_envs.render.overlay import draw_scale
from piavatar_envs.render.scene import Body, Camera, Follower, Marker

BACKENDS = ("auto", "pyvista", "software")


class Renderer:
    """Draws off screen into arrays.

    Example::

        with Renderer(480, 480) as renderer:
            frame = renderer.render([Body(vertices, faces)], [Sphere(target, 0.05)], follow=root_position)
    """

    def __init__(
        self, width: int = 480, height: int = 480, camera: Camera | None = None, backend: str = "auto"
    ) -> None:
        """Open the window.

        Args:
            width: of the picture [px].
            height: of the picture [px].
            camera: the view; by default of a standing person, three-quarters from the front.
            backend: ``"pyvista"`` (OpenGL), ``"software"`` (no graphics driver needed; the CPU) or ``"auto"``: the
                first where OpenGL works off screen, else the second. They draw the same. OpenGL is for the main
                thread, and not for processes that were forked after the first window was opened: a renderer that is
                used there goes on by software.

        Raises:
            ImportError: pyvista is not installed.
            ValueError: a size outside [16, 8192], or an unknown back end.
            RuntimeError: ``backend="pyvista"`` where there is no OpenGL, or where it may not be used.
        """
        for name, value in (("width", width), ("height", height)):
            if not 16 <= value <= 8192:
                raise ValueError(f"{name}={value} px is outside [16, 8192]")
        self.width, self.height = int(width), int(height)
        self.camera = camera or Camera()
        self._follower = Follower(self.camera)
        self._topology: Topology | None = None
        self._corner = 0  # of the colour scale
        self._backend: Backend | None = _open(backend, self.width, self.height)

    def render(
        self,
        bodies: Sequence[Body],
        markers: Sequence[Marker] = (),
        follow: np.ndarray | None = None,
        elapsed: float = 1.0 / 30.0,
    ) -> np.ndarray:
        """Draw one picture.

        Args:
            bodies: meshes in world coordinates.
            markers: spheres, arrows, boxes, capsules and rings.
            follow: the point the camera follows [m], shape ``(3,)``, for example the root; the origin if None.
            elapsed: time since the last picture [s], in which the camera has glided.

        Returns:
            The picture, shape ``(height, width, 3)`` uint8; the caller's own.

        Raises:
            RuntimeError: the renderer is closed.
            ValueError: nothing to show, or a body's arrays do not fit together.
        """
        if self._backend is None:
            raise RuntimeError("this Renderer is closed; make a new one")
        if isinstance(self._backend, vtk_backend.VtkBackend) and not owns_opengl():
            _elsewhere.append(self._backend)
            self._backend = _open("software", self.width, self.height)
        center = self._follower.move(follow, elapsed)
        topology, vertices, colors = self._gather(bodies, markers)
        offset = np.array([*center, 0.0])
        shot = Shot(offset + self.camera.position, offset + self.camera.target, self.camera.field_of_view, center)
        columns = np.ascontiguousarray(vertices.T)
        casters = shading.Casters(*topology.triangles(columns))
        light = shading.shade(topology, columns, colors.T, shot.eye, casters)
        picture = self._backend.draw(topology, vertices, coloring.to_bytes(light.T), ground_shadow(casters), shot)
        for body in bodies:
            if body.scalars is not None:
                of_bodies = vertices[: sum(len(body.vertices) for body in bodies)]
                seen = shot.project(of_bodies, self.height, self.width)
                self._corner = draw_scale(picture, body.scalar_max, body.scalar_label, seen, self._corner)
                break
        return picture

    def reset_camera(self) -> None:
        """Let the next picture's camera start at what it follows, without a glide from where it was."""
        self._follower.cut()

    def close(self) -> None:
        """Free the window; closing twice is fine."""
        if isinstance(self._backend, vtk_backend.VtkBackend) and not owns_opengl():
            _elsewhere.append(self._backend)
        elif self._backend is not None:
            self._backend.close()
        self._backend = None

    def __enter__(self) -> Renderer:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _gather(self, bodies: Sequence[Body], markers: Sequence[Marker]) -> tuple[Topology, np.ndarray, np.ndarray]:
        """Join all bodies and markers to one mesh: triangles, vertices ``(V, 3)`` [m] and own colours ``(V, 3)``."""
        if not bodies and not markers:
            raise ValueError("nothing to show: give at least one body or marker")
        meshes = [(body.vertices, body.faces) for body in bodies] + [marker.mesh() for marker in markers]
        colors = [_body_colors(body) for body in bodies]
        colors += [
            np.broadcast_to(marker.color, (len(mesh[0]), 3))
            for marker, mesh in zip(markers, meshes[len(bodies) :], strict=True)
        ]
        faces, counts = [mesh[1] for mesh in meshes], [len(mesh[0]) for mesh in meshes]
        if self._topology is None or self._topology.key != topology_key(faces, counts):
            self._topology = Topology(faces, counts)
        vertices = drawable(np.concatenate([np.asarray(mesh[0], dtype=np.float32) for mesh in meshes]))
        return self._topology, vertices, np.concatenate(colors)


#: Windows of other threads and processes, kept because only these may close them.
_elsewhere: list[Backend] = []


def _open(backend: str, width: int, height: int) -> Backend:
    if backend not in BACKENDS:
        raise ValueError(f"unknown backend {backend!r}; use one of {', '.join(BACKENDS)}")
    # Also without OpenGL, so that a missing extra shows on every machine alike.
    vtk_backend.import_pyvista()
    if backend == "pyvista" and not owns_opengl():
        raise RuntimeError(
            "backend='pyvista' is for the main thread, and not for a process that was forked after the first picture; "
            "use backend='software', or start processes by the method 'spawn'"
        )
    if backend != "software" and owns_opengl() and opengl_available():
        claim_opengl()
        return vtk_backend.VtkBackend(width, height)
    if backend == "pyvista":
        raise RuntimeError(
            "backend='pyvista' needs OpenGL, and no EGL driver was found; install one (Debian, Ubuntu: libegl1) or "
            "use backend='software'"
        )
    from piavatar_envs.render.software_backend import SoftwareBackend

    return SoftwareBackend(width, height)


def _body_colors(body: Body) -> np.ndarray:
    if body.scalars is None and body.colors is not None:
        if np.shape(body.colors) != (len(body.vertices), 3):
            raise ValueError(f"colors have shape {np.shape(body.colors)}; give a row a vertex: {len(body.vertices)}")
        return body.colors / np.float32(255.0)
    if body.scalars is None:
        return np.broadcast_to(body.color, (len(body.vertices), 3))
    if np.shape(body.scalars) != (len(body.vertices),):
        raise ValueError(
            f"scalars have shape {np.shape(body.scalars)}; give one value a vertex, shape ({len(body.vertices)},)"
        )
    return coloring.color_by(body.scalars, body.scalar_max)
