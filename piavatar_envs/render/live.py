"""Scenes in a web browser, as they happen: a server on this machine (viser, extra ``live``)."""

from __future__ import annotations

import asyncio
import contextlib
import io
import math
import re
import sys
import weakref
from collections.abc import Callable, Coroutine, Iterator
from dataclasses import dataclass, replace
from functools import lru_cache
from types import ModuleType
from typing import TYPE_CHECKING, TextIO

import numpy as np

from piavatar_envs.avatar.body.splats import SplatCloud, mean_colors
from piavatar_envs.core.extras import missing
from piavatar_envs.render import ground
from piavatar_envs.render.coloring import bands_of, strain_table
from piavatar_envs.render.scene import Camera, Color, Follower, MovedSplats, Scene
from piavatar_envs.render.shading import KEY

if TYPE_CHECKING:
    import viser

HOST = "127.0.0.1"
PORT = 8080
#: Ports that are tried, one after the other.
_TRIES = 1000
#: Parent of all meshes; it moves against the followed point, because browsers control their cameras themselves.
_WORLD = "/world"
#: Names of the meshes of a scene's bodies, with the index of the body.
_BODY = re.compile(rf"{_WORLD}/body_(\d+)")
_GROUND_SIZE = 40.0
_STYLE = ground.GroundStyle()
#: Farther than this from the origin nothing is drawn [m].
_FAR = 50.0
#: Lengths of splats that are sent over those that are shown; and the largest number of half precision.
_SPLAT_SCALE, _LARGEST = 10.0, 65504.0
#: A warm sun, a cool sky and what the ground gives back, as in the pictures; bytes.
_KEY_LIGHT, _SKY_LIGHT, _GROUND_LIGHT = (255, 243, 226), (216, 228, 250), (206, 186, 170)


def import_viser() -> ModuleType:
    """Import the library.

    Raises:
        ImportError: it is not installed; names the extra.
    """
    try:
        import viser
    except ImportError as error:
        raise missing("the live view", "viser", "live") from error
    return viser


def check_port(port: int) -> None:
    """Refuse a port that is followed by fewer ports than are tried.

    Raises:
        ValueError: it is outside [1, 64536].
    """
    if not 1 <= port <= 65536 - _TRIES:
        raise ValueError(f"port={port} is outside [1, {65536 - _TRIES}]")


#: Time in which a browser that has connected takes over the first view [s].
_SETTLE = 1.0
#: Keys held while the left button drags a body, whatever the pointer does without them.
DRAG_KEYS = "cmd/ctrl"
#: Effects of the left button and of a finger, without keys, on a body or, for a throw, anywhere.
POINTERS = ("camera", "drag", "throw")


@dataclass(frozen=True)
class Drag:
    """A mouse that drags a body.

    Attributes:
        body: index in the scene's bodies.
        start: where it was grabbed, shape ``(3,)`` [m].
        end: where the mouse is, in the plane through the grabbed point that faces the camera, shape ``(3,)`` [m].
    """

    body: int
    start: np.ndarray
    end: np.ndarray


class LiveView:
    """Shows scenes in every browser that opens :attr:`url`, until it is closed or collected.

    Attributes:
        server: the library's, for panels.
        url: address of the view.
        drags: what mice drag now, by the number of their browser; written by another thread.
    """

    def __init__(self, camera: Camera | None = None, port: int = PORT) -> None:
        """Start the server, and print its address.

        Args:
            camera: first view of a browser; that of a picture by default.
            port: of this machine, or the next one that is free.

        Raises:
            ImportError: viser is not installed.
            ValueError: a port outside [1, 64536].
        """
        check_port(port)
        library = import_viser()
        self._follower = Follower(camera or Camera())
        self._nodes: dict[str, viser.MeshHandle | viser.GaussianSplatHandle] = {}
        self.drags: dict[int, Drag] = {}
        self._pointer = POINTERS[0]
        with _silence():
            self.server: viser.ViserServer = library.ViserServer(HOST, port, "piavatar-envs", verbose=False)
        # a page of any site could press the hidden button, so no public tunnel may be opened
        self.server.request_share_url = lambda *_arguments, **_more: None
        # also at the end of the process, where the library would print a message of its own
        self._stop = weakref.finalize(self, _stop, self.server)
        self.url = f"http://{HOST}:{self.server.get_port()}"
        self._set_up(self._follower.camera)
        self.server.on_client_connect(_fitter(self._follower.camera))
        print(f"live view: {self.url}", flush=True)

    def _set_up(self, camera: Camera) -> None:
        """Set up camera, light and ground as in the pictures."""
        scene, first = self.server.scene, self.server.initial_camera
        first.position, first.look_at, first.fov = camera.position, camera.target, math.radians(camera.field_of_view)
        self.server.gui.configure_theme(show_logo=False, show_share_button=False, control_width="small")
        top, bottom = np.array(_STYLE.sky_top), np.array(_STYLE.sky_bottom)
        share = np.linspace(0.0, 1.0, 256)[:, None, None]
        sky = np.rint(255.0 * (top + share * (bottom - top))).astype(np.uint8)
        scene.set_background_image(np.repeat(sky, 16, axis=1), format="png")
        scene.configure_environment_map(None)
        scene.configure_default_lights(False)
        scene.add_light_directional(
            "/light/key",
            color=_KEY_LIGHT,
            intensity=2.5,
            cast_shadow=True,
            position=tuple(10.0 * value for value in KEY),
        )
        scene.add_light_hemisphere(
            "/light/sky", sky_color=_SKY_LIGHT, ground_color=_GROUND_LIGHT, intensity=1.5, position=(0.0, 0.0, 1.0)
        )
        self._world = scene.add_frame(_WORLD, show_axes=False)
        self._ground = scene.add_grid(
            "/ground", _GROUND_SIZE, _GROUND_SIZE, cell_size=ground.SQUARE, section_size=2.0 * ground.SQUARE,
            cell_color=_bytes(_STYLE.line), section_color=_bytes(_STYLE.line), plane_color=_bytes(_STYLE.light),
            plane_opacity=1.0, shadow_opacity=0.3, fade_distance=2.0 * ground.FADE_END, fade_from="origin",
            position=(0.0, 0.0, ground.HEIGHT),
        )  # fmt: skip
        scale = np.repeat(strain_table()[None], 12, axis=0)
        self._scale = self.server.gui.add_image(np.rint(255.0 * scale).astype(np.uint8), visible=False, format="png")

    def show(self, scene: Scene, elapsed: float | None) -> None:
        """Show a scene; meshes that exist are moved, not made anew.

        Args:
            scene: the scene description.
            elapsed: simulated time since the last one [s], in which the camera glides after what it follows; None where
                it jumps there.
        """
        if elapsed is None:
            self._follower.cut()
        center = self._follower.move(scene.follow, elapsed or 0.0)
        shown = dict(_meshes(scene))
        splats = {f"{_WORLD}/body_{i}_splats": body.splats for i, body in enumerate(scene.bodies) if body.splats}
        with self.server.atomic():
            self._world.position = (*-center, 0.0)
            # a ground that repeats may stay below the camera for ever
            self._ground.position = (*-np.mod(center, 2.0 * ground.SQUARE), ground.HEIGHT)
            for name in self._nodes.keys() - shown.keys() - splats.keys():
                self._nodes.pop(name).remove()
            for name, (vertices, faces, color) in shown.items():
                self._place(name, _drawable(vertices), faces, _bytes(color))
            for name, moved in splats.items():
                self._place_splats(name, pack_splats(moved))
        strained = [body for body in scene.bodies if body.scalars is not None]
        if strained:
            self._scale.label = f"{strained[0].scalar_label}, 0 to {strained[0].scalar_max:g}"
        self._scale.visible = bool(strained)

    def _place(self, name: str, vertices: np.ndarray, faces: np.ndarray, color: tuple[int, int, int]) -> None:
        """Add or update a mesh; the library sends changes only."""
        node = self._nodes.get(name)
        if node is None:
            self._add(name, self.server.scene.add_mesh_simple(name, vertices, faces, color=color))
            return
        node.vertices, node.faces, node.color = vertices, faces, color

    def _place_splats(self, name: str, packed: np.ndarray) -> None:
        """Add or update splats, from :func:`pack_splats`."""
        if name not in self._nodes:
            none = np.zeros((1, 3)), np.zeros((1, 3, 3)), np.zeros((1, 3)), np.zeros((1, 1))
            self._add(name, self.server.scene.add_gaussian_splats(name, *none, scale=1.0 / _SPLAT_SCALE))
        self._nodes[name].buffer = packed

    def _add(self, name: str, node: viser.MeshHandle | viser.GaussianSplatHandle) -> None:
        """Keep a new node, which the mouse may drag if it is a body."""
        self._nodes[name] = node
        self._bind(name, node)

    def _bind(self, name: str, node: viser.MeshHandle | viser.GaussianSplatHandle) -> None:
        """Let the mouse drag a body: with keys held, and without them if that is what the pointer does."""
        body = _BODY.match(name)
        if body is None:
            return
        node.remove_drag_callback()
        for keys in (DRAG_KEYS, None) if self._pointer == "drag" else (DRAG_KEYS,):
            node.on_drag("left", modifier=keys)(_follower(weakref.WeakMethod(self._follow), int(body[1])))

    @property
    def pointer(self) -> str:
        """Effect of the left button without keys, one of :data:`POINTERS`."""
        return self._pointer

    @pointer.setter
    def pointer(self, pointer: str) -> None:
        self._pointer = pointer
        for name, node in self._nodes.items():
            self._bind(name, node)

    def on_throw(self, call: Callable[[int, np.ndarray, np.ndarray], None]) -> None:
        """Register a function that clicks into the scene call while the pointer throws, in another thread.

        Args:
            call: with the number of the browser, and origin [m] and direction of the ray below the mouse, ``(3,)``.
        """
        view, throws = weakref.ref(self), weakref.WeakMethod(call)

        async def click(event: viser.SceneClickEvent) -> None:
            own, throw = view(), throws()
            if own is not None and throw is not None and own.pointer == "throw":
                throw(event.client_id, np.array(event.ray_origin) - own.offset, np.array(event.ray_direction))

        self.server.scene.on_click()(click)

    @property
    def offset(self) -> np.ndarray:
        """Way from the scene's origin to that of the browsers, whose cameras stay [m]."""
        return np.array(self._world.position)

    def camera_of(self, client: int | None) -> Camera:
        """Return the camera of a browser, as pictures take it; the first one of a view without that browser."""
        own = self.server.get_clients().get(client) if client is not None else None
        camera = self._follower.camera
        if own is None:
            return camera
        angle = min(max(math.degrees(own.camera.fov), 1.0), 120.0)
        place, target = (tuple(np.array(at, float).tolist()) for at in (own.camera.position, own.camera.look_at))
        return replace(camera, position=place, target=target, field_of_view=angle)

    async def _follow(self, body: int, event: viser.SceneNodeDragEvent) -> None:
        """Keep what a mouse drags; a coroutine, because the library runs other functions in any order."""
        end, mouse = np.array(event.end_position) - self.offset, event.client_id
        if event.phase == "end":
            self.drags.pop(mouse, None)
        elif event.phase == "start":
            self.drags[mouse] = Drag(body, np.array(event.start_position) - self.offset, end)
        elif mouse in self.drags:
            self.drags[mouse] = replace(self.drags[mouse], end=end)

    @property
    def closed(self) -> bool:
        """Whether the server was stopped."""
        return not self._stop.alive

    def close(self) -> None:
        """Stop the server; closing twice is fine."""
        self._stop()


def _fitter(camera: Camera) -> Callable[[viser.ClientHandle], Coroutine]:
    """Return a function that fits the first view of a browser to its window."""

    async def fit(client: viser.ClientHandle) -> None:
        if client.camera.aspect < 1.0:
            await asyncio.sleep(_SETTLE)
            position, target = upright_view(camera, client.camera.aspect)
            with client.atomic():
                client.camera.position, client.camera.look_at = position, target

    return fit


def upright_view(camera: Camera, aspect: float) -> tuple[np.ndarray, np.ndarray]:
    """Return position and target of a camera for a window higher than wide, whose lower half shows the panel [m].

    Args:
        camera: of a window as wide as high.
        aspect: width over height of the window.
    """
    target = np.array(camera.target)
    away = 1.0 / max(aspect, 0.3) * (np.array(camera.position) - target)
    half = float(np.linalg.norm(away)) * math.tan(math.radians(camera.field_of_view) / 2.0)
    target = target - [0.0, 0.0, 0.5 * half]
    return target + away, target


def _stop(server: viser.ViserServer) -> None:
    with _silence():
        server.stop()


def _follower(follow: weakref.WeakMethod, body: int) -> Callable[[viser.SceneNodeDragEvent], Coroutine]:
    """Return a handler of drags that does not keep the view: the server, which has threads, keeps its handlers."""

    async def handle(event: viser.SceneNodeDragEvent) -> None:
        method = follow()
        if method is not None:
            await method(body, event)

    return handle


def _meshes(scene: Scene) -> Iterator[tuple[str, tuple[np.ndarray, np.ndarray, Color]]]:
    """Yield name, vertices, triangles and colour of everything in a scene; names persist between scenes."""
    for index, body in enumerate(scene.bodies):
        name = f"{_WORLD}/body_{index}"
        if body.splats is not None:
            continue
        if body.scalars is None and body.colors is None:
            yield name, (body.vertices, body.faces, body.color)
            continue
        for band in bands_of(body):
            yield f"{name}_band_{band.number}", (band.vertices, band.faces, band.color)
    for index, marker in enumerate(scene.markers):
        vertices, faces = marker.mesh()
        yield f"{_WORLD}/{marker.kind}_{index}", (vertices, faces, marker.color)


def pack_splats(splats: MovedSplats) -> np.ndarray:
    """Return splats as browsers take them, :data:`_SPLAT_SCALE` times as large, shape ``(S, 8)`` uint32.

    A row has the centre as single and the covariance as half precision, and the colour as bytes, the mean over all
    directions if it depends on them. Covariances of splats of millimetres in metres would be zero in half precision.
    """
    packed = np.zeros((len(splats.means), 8), np.uint32)
    packed[:, :3] = np.ascontiguousarray(np.float32(_SPLAT_SCALE) * _drawable(splats.means)).view(np.uint32)
    covariances = np.nan_to_num(np.asarray(splats.covariances, np.float32) * _SPLAT_SCALE**2, posinf=0.0, neginf=0.0)
    halves = np.ascontiguousarray(np.clip(covariances, -_LARGEST, _LARGEST), np.float16)
    packed[:, 4:7] = halves.view(np.uint32)
    opacities = splats.cloud.opacities
    packed[:, 7] = _tint(splats.cloud) if splats.colors is None else _color_bytes(splats.colors, opacities)
    return packed


@lru_cache(maxsize=16)
def _tint(cloud: SplatCloud) -> np.ndarray:
    """Return the bytes of a cloud's own colours, which stay."""
    return _color_bytes(mean_colors(cloud.sh), cloud.opacities)


def _color_bytes(colors: np.ndarray, opacities: np.ndarray) -> np.ndarray:
    """Return colours and opacities as bytes, four in one number, shape ``(S,)`` uint32."""
    rgba = np.concatenate([colors, opacities[:, None]], axis=1)
    return np.rint(255.0 * np.clip(rgba, 0.0, 1.0)).astype(np.uint8).view(np.uint32)[:, 0]


def _bytes(color: Color) -> tuple[int, int, int]:
    red, green, blue = (round(255.0 * value) for value in color)
    return red, green, blue


class _Muted(io.TextIOBase):
    """Standard output that drops the lines of the library, from any thread."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def write(self, text: str) -> int:
        """Write a text, unless it is the library's."""
        return len(text) if "viser" in text else self._stream.write(text)

    def flush(self) -> None:
        """Flush what was written."""
        self._stream.flush()


@contextlib.contextmanager
def _silence() -> Iterator[None]:
    """Drop the library's output within a block, because ``verbose=False`` leaves some of it."""
    with contextlib.redirect_stdout(_Muted(sys.stdout)):
        yield


def _drawable(vertices: np.ndarray) -> np.ndarray:
    """Return vertices as float32 that a browser accepts, also of a failed simulation."""
    vertices = np.asarray(vertices, dtype=np.float32)
    return np.clip(np.nan_to_num(vertices, nan=0.0, posinf=_FAR, neginf=-_FAR), -_FAR, _FAR)
