"""Films as geometry: the meshes of a series of scenes, each with its shapes in time (NumPy)."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from piavatar_envs.avatar.body.textures import Textures
from piavatar_envs.render.coloring import color_by
from piavatar_envs.render.scene import Body, Marker, Scene, Solid

#: Begin of the names of bodies.
_BODY = "body_"
#: Name or place of a mesh, its vertices, triangles, colours of the vertices, and textures.
Named = tuple[str, np.ndarray, np.ndarray, np.ndarray, Textures | None]


@dataclass(eq=False)
class Moving:
    """A mesh whose vertices move.

    Attributes:
        name: a valid name of a file, and of a prim in USD.
        faces: outward oriented triangles, shape ``(T, 3)`` int.
        shapes: vertices [m] in each frame, shape ``(V, 3)`` float32, or None where it is not there; one that stays is
            the same array.
        colors: sRGB of the vertices in each frame, shape ``(V, 3)`` uint8; equal ones are the same array.
        textures: of the base colour, of which these are the colours at the vertices; None without any.
        changes: number of frames in which it is not as it was last seen.
    """

    name: str
    faces: np.ndarray
    shapes: list[np.ndarray | None] = field(default_factory=list)
    colors: list[np.ndarray | None] = field(default_factory=list)
    textures: Textures | None = None
    changes: int = 0

    @property
    def first(self) -> int:
        """The first frame in which it is there."""
        return next(frame for frame, shape in enumerate(self.shapes) if shape is not None)

    @property
    def repaints(self) -> bool:
        """Whether its colours change."""
        return any(color is not None and color is not self.colors[self.first] for color in self.colors)

    def held(self) -> list[np.ndarray]:
        """Return the shapes with that of the frame before, or of the first one, where it is not there."""
        shapes, last = [], self.shapes[self.first]
        for shape in self.shapes:
            last = last if shape is None else shape
            shapes.append(last)
        return shapes

    def append(self, frame: int, shape: np.ndarray, color: np.ndarray) -> None:
        """Add its shape and its colours in a frame; it was not there in those that were left out."""
        missing = frame - len(self.shapes)
        last = _last(self.colors)
        if last is not None and np.array_equal(last, color):
            color = last
        before = _last(self.shapes)
        if before is not None and np.array_equal(before, shape):
            shape = before
        self.changes += before is not None and shape is not before
        self.shapes += [*(missing * [None]), shape]
        self.colors += [*(missing * [None]), color]

    def drop(self) -> None:
        """Take back the last call of :meth:`append`."""
        shape = self.shapes.pop()
        self.colors.pop()
        before = _last(self.shapes)
        self.changes -= shape is not None and before is not None and shape is not before


def _last(values: list[np.ndarray | None]) -> np.ndarray | None:
    """Return the last one that is not None."""
    return next((value for value in reversed(values) if value is not None), None)


class Film:
    """Scenes in time.

    Attributes:
        rate: frames per second [1/s].
        num_frames: number of scenes so far.
    """

    def __init__(self, rate: float) -> None:
        """Begin without scenes.

        Raises:
            ValueError: the rate is not positive.
        """
        if not rate > 0.0:
            raise ValueError(f"rate={rate} must be positive: it is the frames of a second")
        self.rate = rate
        self.num_frames = 0
        self._names = Names()
        self._meshes: dict[str, Moving] = {}

    def add(self, scene: Scene) -> None:
        """Append a frame."""
        for name, vertices, faces, color, textures in self._names.meshes(scene):
            mesh = self._meshes.setdefault(name, Moving(name, np.asarray(faces), textures=textures))
            mesh.append(self.num_frames, vertices, color)
        self.num_frames += 1

    def drop(self) -> None:
        """Take back the last frame."""
        self.num_frames -= 1
        for mesh in self._meshes.values():
            if len(mesh.shapes) > self.num_frames:
                mesh.drop()
        self._meshes = {name: mesh for name, mesh in self._meshes.items() if _last(mesh.shapes) is not None}

    @property
    def meshes(self) -> list[Moving]:
        """The meshes so far, each with a shape or None for every frame."""
        for mesh in self._meshes.values():
            missing = self.num_frames - len(mesh.shapes)
            mesh.shapes += missing * [None]
            mesh.colors += missing * [None]
        return list(self._meshes.values())


class Names:
    """Names of meshes in a series of scenes.

    A mesh that has the same place in the scene and the same triangles keeps its name, a marker one of the same colours
    as well; others are numbered. What is not finite has no place that programs could read: it is left out, with a
    warning about the first one.
    """

    def __init__(self) -> None:
        """Begin without names."""
        self._known: dict[tuple[str, int, bytes, bytes], str] = {}
        self._has_warned = False

    def shows(self, name: str, values: np.ndarray) -> bool:
        """Return whether the values of something are finite; warn of the first that are not."""
        finite = bool(np.isfinite(values).all())
        if not finite and not self._has_warned:
            self._has_warned = True
            warnings.warn(
                f"{name} is not finite, as in a simulation that has failed; it is left out of such frames", stacklevel=2
            )
        return finite

    def meshes(self, scene: Scene) -> Iterator[Named]:
        """Yield name, vertices, triangles, colours (sRGB, uint8) and textures of everything seen in the next scene."""
        for place, vertices, faces, color, textures in _meshes(scene):
            fixed = b"" if place.startswith(_BODY) else color.tobytes()
            key = (place, len(vertices), np.ascontiguousarray(faces).tobytes(), fixed)
            if key not in self._known:
                others = sum(other[0] == place for other in self._known)
                self._known[key] = f"{place}_{others}" if others else place
            vertices = np.asarray(vertices, dtype=np.float32)
            if self.shows(self._known[key], vertices):
                yield self._known[key], vertices, faces, color, textures


def _meshes(scene: Scene) -> Iterator[Named]:
    """Yield place in the scene, vertices, triangles, colours and textures of everything in it."""
    for index, body in enumerate(scene.bodies):
        textures = body.textures if body.scalars is None else None
        yield f"{_BODY}{index}", body.vertices, body.faces, _colors_of(body), textures
    for index, marker in enumerate(scene.markers):
        vertices, faces = marker.mesh()
        kind, number = type(marker).__name__.lower(), index
        if isinstance(marker, Solid):
            kind, number = marker.kind, marker.number
        yield f"{kind}_{number}", vertices, faces, _colors_of(marker, len(vertices)), None


def _colors_of(thing: Body | Marker, count: int = 0) -> np.ndarray:
    """Return the colours of the vertices, shape ``(V, 3)`` uint8."""
    if isinstance(thing, Body):
        count = len(thing.vertices)
        if thing.scalars is not None:
            return np.rint(255.0 * color_by(thing.scalars, thing.scalar_max)).astype(np.uint8)
        if thing.colors is not None:
            return np.asarray(thing.colors, dtype=np.uint8)
    return np.tile(np.rint(255.0 * np.asarray(thing.color)).astype(np.uint8), (count, 1))
