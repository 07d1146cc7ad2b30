"""Files of films: animated glTF, a PLY file for each mesh and frame, and USD (extra ``usd``).

A glTF file stores a mesh's shapes as morph targets, one per frame, and an animation of their weights ("glTF 2.0
Specification", Khronos Group, 2021, sections 3.7.2.2 and 3.11): this is what importers read without an extension, and
exact in every frame. Its axes are those of glTF, y up and facing z; the other formats have the suite's, z up.
"""

from __future__ import annotations

import json
import struct
import warnings
from importlib.util import find_spec
from itertools import pairwise
from pathlib import Path
from types import ModuleType
from typing import Any, Protocol

import numpy as np

from piavatar_envs.avatar.body.asset import vertex_normals
from piavatar_envs.avatar.body.splat_files import write_ply
from piavatar_envs.avatar.body.textures import Texture, encoded
from piavatar_envs.core.extras import missing
from piavatar_envs.core.srgb import srgb_to_linear
from piavatar_envs.render.film import Film, Moving, Names
from piavatar_envs.render.scene import Scene

FORMATS = ("glb", "ply", "usd")
#: Of a file [bytes]: what the suite's own reader accepts.
MAX_GLB = 2**31
_ARRAYS, _INDICES = 34962, 34963  # kinds of buffer views
_FLOAT, _UINT32, _UINT16 = 5126, 5125, 5123
_LINEAR, _STEP = "LINEAR", "STEP"
#: Most text of the document for a mesh without its targets, and for each of its targets [bytes].
_MESH_TEXT, _TARGET_TEXT = 3000, 800


class FilmWriter(Protocol):
    """Writes a series of scenes into a folder."""

    def add(self, scene: Scene) -> None:
        """Append a frame; what is not finite is left out, with a warning."""
        ...

    def finish(self) -> list[Path]:
        """Write what is not written yet, and return the files, or the folders of files."""
        ...


def film_writer(folder: Path, kind: str, rate: float) -> FilmWriter:
    """Return the writer of a format.

    Args:
        folder: for ``film.glb``, ``film.usdc`` or ``MESH/0000.ply``; it is made when it is written to.
        kind: one of :data:`FORMATS`.
        rate: frames per second [1/s].

    Raises:
        ImportError: usd-core is not installed, for USD.
        ValueError: an unknown format, or a rate that is not positive.
    """
    check_format(kind)
    return PlyWriter(folder) if kind == "ply" else WholeWriter(folder, kind, rate)


def check_format(kind: str) -> None:
    """Refuse a format that is unknown, or whose library is not installed.

    Raises:
        ImportError: usd-core is not installed, for USD.
        ValueError: it is unknown.
    """
    if kind not in FORMATS:
        raise ValueError(f"no format {kind!r}; use {', '.join(FORMATS[:-1])} or {FORMATS[-1]}")
    if kind == "usd":
        _import_usd()


class _Glb:
    """A document and its one buffer, which grow together."""

    def __init__(self) -> None:
        self.document: dict[str, Any] = {
            "asset": {"version": "2.0", "generator": "piavatar-envs"},
            "scene": 0,
            "scenes": [{"nodes": []}],
            "nodes": [],
            "meshes": [],
            "materials": [{"pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 0.8}}],
            "accessors": [],
            "bufferViews": [],
        }
        self._content: list[bytes] = []
        self._materials: dict[int, int] = {}  # by identity of the texture
        self.size = 0

    def add(self, values: np.ndarray, component: int, target: int | None = None, **more: Any) -> int:
        """Append an accessor of rows of 1 to 4 numbers, and return its index."""
        values = np.ascontiguousarray(values)
        view = self._add_view(values.tobytes(), **({} if target is None else {"target": target}))
        width = 1 if values.ndim == 1 else values.shape[1]
        accessor = {"bufferView": view, "componentType": component}
        accessor |= {"count": len(values), "type": {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4"}[width], **more}
        return self._append("accessors", accessor)

    def add_points(self, points: np.ndarray) -> int:
        """Append positions or displacements, with the bounds that these must have."""
        bounds = {"min": points.min(axis=0).tolist(), "max": points.max(axis=0).tolist()}
        return self.add(points, _FLOAT, _ARRAYS, **bounds)

    def add_material(self, texture: Texture) -> int | None:
        """Append a material with a texture, once, and return its index; None without Pillow, which writes images."""
        if find_spec("PIL") is None:
            return None
        if id(texture) not in self._materials:
            view = self._add_view(encoded(texture))
            wraps = dict(zip(("wrapS", "wrapT"), texture.wraps, strict=True))
            source = {
                "source": self._append("images", {"bufferView": view, "mimeType": "image/png"}),
                "sampler": self._append("samplers", wraps),
            }
            base = {"baseColorTexture": {"index": self._append("textures", source)}}
            plain = self.document["materials"][0]["pbrMetallicRoughness"]
            holes = {} if texture.alpha is None else {"alphaMode": "MASK", "alphaCutoff": texture.cutoff}
            self._materials[id(texture)] = self._append("materials", {"pbrMetallicRoughness": plain | base} | holes)
        return self._materials[id(texture)]

    def _append(self, key: str, item: dict[str, Any]) -> int:
        """Append to a list of the document, and return the index."""
        self.document.setdefault(key, []).append(item)
        return len(self.document[key]) - 1

    def _add_view(self, content: bytes, **more: Any) -> int:
        """Append a part of the buffer, of whole words, and return its index."""
        view = {"buffer": 0, "byteOffset": self.size, "byteLength": len(content), **more}
        content += b"\0" * (-len(content) % 4)
        self.size += len(content)
        self._content.append(content)
        return self._append("bufferViews", view)

    def write(self, path: Path) -> None:
        """Write the file: the two chunks, of whole words (section 4.4)."""
        self.document["buffers"] = [{"byteLength": self.size}]
        document = json.dumps(self.document, separators=(",", ":")).encode()
        document += b" " * (-len(document) % 4)
        with path.open("wb") as stream:
            stream.write(struct.pack("<4sII", b"glTF", 2, 28 + len(document) + self.size))
            stream.write(struct.pack("<I4s", len(document), b"JSON") + document)
            stream.write(struct.pack("<I4s", self.size, b"BIN\0"))
            stream.writelines(self._content)


def write_glb(film: Film, folder: Path) -> Path:
    """Write ``film.glb`` and return its path; raises as :meth:`WholeWriter.finish`."""
    if any(mesh.repaints for mesh in film.meshes):
        raise ValueError("glTF has no colours that change; use ply or usd, or color=skin")
    glb = _Glb()
    times = None
    samplers: list[dict[str, Any]] = []
    channels: list[dict[str, Any]] = []

    def animate(path: str, values: np.ndarray, mode: str) -> None:
        nonlocal times
        if times is None:
            seconds = np.arange(film.num_frames, dtype=np.float32) / np.float32(film.rate)
            times = glb.add(seconds, _FLOAT, min=[0.0], max=[float(seconds[-1])])
        samplers.append({"input": times, "output": glb.add(values, _FLOAT), "interpolation": mode})
        target = {"node": len(glb.document["nodes"]) - 1, "path": path}
        channels.append({"sampler": len(samplers) - 1, "target": target})

    for mesh in film.meshes:
        glb.document["scenes"][0]["nodes"].append(len(glb.document["nodes"]))
        glb.document["nodes"].append({"name": mesh.name, "mesh": len(glb.document["meshes"])})
        weights = _add_mesh(glb, mesh)
        if weights.shape[1]:
            animate("weights", weights.ravel(), _LINEAR)
        shown = np.array([shape is not None for shape in mesh.shapes], dtype=np.float32)
        if not shown.all():
            animate("scale", np.repeat(shown[:, None], 3, axis=1), _STEP)
    if samplers:
        glb.document["animations"] = [{"name": "film", "samplers": samplers, "channels": channels}]
    path = folder / "film.glb"
    glb.write(path)
    return path


def _add_mesh(glb: _Glb, mesh: Moving) -> np.ndarray:
    """Append a mesh with a target for each shape after the first, and return the targets' weights ``(frames, K)``."""
    shapes = mesh.held()
    # a shape that stays has one target
    changed = np.array([False, *(a is not b for a, b in pairwise(shapes))])
    number = np.cumsum(changed)
    base, normals = _y_up(shapes[0]), _y_up(_normals(shapes[0], mesh.faces))
    parts, tints = _materials_of(glb, mesh)
    light = np.ones((len(base), 4))
    light[:, :3] = srgb_to_linear(tints / 255.0)
    attributes = {
        "POSITION": glb.add_points(base),
        "NORMAL": glb.add(normals, _FLOAT, _ARRAYS),
        "COLOR_0": glb.add(np.rint(65535.0 * light).astype("<u2"), _UINT16, _ARRAYS, normalized=True),
    }
    if any(material for material, _ in parts):
        attributes["TEXCOORD_0"] = glb.add(mesh.textures.uv.astype("<f4"), _FLOAT, _ARRAYS)
    primitives: list[dict[str, Any]] = []
    for material, own in parts:
        indices = glb.add(mesh.faces[own].astype("<u4").ravel(), _UINT32, _INDICES)
        primitives.append({"attributes": attributes, "indices": indices, "material": material})
    targets = []
    for frame in np.flatnonzero(changed):
        shape = shapes[frame]
        normal = _y_up(_normals(shape, mesh.faces)) - normals
        targets.append({"POSITION": glb.add_points(_y_up(shape) - base), "NORMAL": glb.add(normal, _FLOAT, _ARRAYS)})
    entry: dict[str, Any] = {"name": mesh.name, "primitives": primitives}
    if targets:
        for primitive in primitives:
            primitive["targets"] = targets
        entry["weights"] = [0.0] * len(targets)
        entry["extras"] = {"targetNames": [f"frame_{frame:04d}" for frame in np.flatnonzero(changed)]}
    glb.document["meshes"].append(entry)
    return (number[:, None] == 1 + np.arange(len(targets))).astype(np.float32)


def _materials_of(glb: _Glb, mesh: Moving) -> tuple[list[tuple[int, np.ndarray | slice]], np.ndarray]:
    """Return the materials of a mesh with the triangles of each, and the colours of the vertices that go with them."""
    textures, plain = mesh.textures, ([(0, slice(None))], mesh.colors[mesh.first])
    if textures is None:
        return plain
    parts = []
    for index in np.unique(textures.image):
        material = 0 if index < 0 else glb.add_material(textures.images[index])
        if material is None:
            return plain
        parts.append((material, textures.image == index))
    return parts, textures.tints


def _y_up(vectors: np.ndarray) -> np.ndarray:
    """Return vectors in the axes of glTF."""
    return np.stack([vectors[:, 0], vectors[:, 2], -vectors[:, 1]], axis=1).astype(np.float32)


def _normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return unit normals of the vertices, up where triangles have no area, shape ``(V, 3)``."""
    normals = vertex_normals(vertices, faces)
    size = np.linalg.norm(normals, axis=1, keepdims=True)
    return np.where(size > 0.5, normals, (0.0, 0.0, 1.0))


def glb_size(film: Film) -> int:
    """Return how large the file of a film is at most [bytes], by what :func:`_add_mesh` writes."""
    frames, meshes = film.num_frames, film.meshes
    every = [image for mesh in meshes if mesh.textures for image in mesh.textures.images]
    images = {id(image): image.pixels.nbytes + (0 if image.alpha is None else image.alpha.nbytes) for image in every}
    size = _MESH_TEXT * (1 + len(images)) + 4 * frames + sum(images.values())
    for mesh in meshes:
        vertex = 12 + 12 + 8 + 8 + 24 * mesh.changes  # position, normal, colour, uv; displacements of the first two
        weights, scale = 4 * frames * mesh.changes, 12 * frames
        primitives = 1 + (len(mesh.textures.images) if mesh.textures else 0)
        text = primitives * (_MESH_TEXT + _TARGET_TEXT * mesh.changes)
        size += vertex * len(mesh.shapes[mesh.first]) + 4 * mesh.faces.size + weights + scale + text
    return size


class WholeWriter:
    """Writes one file when all frames are there: glTF or USD."""

    def __init__(self, folder: Path, kind: str, rate: float) -> None:
        """Begin without frames."""
        self._folder, self._write = folder, {"glb": write_glb, "usd": write_usd}[kind]
        self._film, self._is_full = Film(rate), False

    def add(self, scene: Scene) -> None:
        """Append a frame, unless a glTF file is full: a warning says how many frames it has.

        Raises:
            ValueError: the first frame is too large for glTF.
        """
        if self._is_full:
            return
        self._film.add(scene)
        if self._write is not write_glb or glb_size(self._film) <= MAX_GLB:
            return
        self._film.drop()
        frames, limit = self._film.num_frames, f"{MAX_GLB:.3g} bytes, as many as a glTF file has at most"
        if frames == 0:
            raise ValueError(f"a frame of this scene takes more than {limit}; use ply or usd")
        self._is_full = True
        warnings.warn(
            f"{frames} frames fill {limit}; later ones are left out: use ply or usd for them",
            stacklevel=3,
        )

    def finish(self) -> list[Path]:
        """Write the file.

        Raises:
            ValueError: a film without frames, or with nothing that is seen, or one of colours that change, for glTF.
            OSError: the folder cannot be written.
        """
        _check_seen(self._film.num_frames, bool(self._film.meshes))
        self._folder.mkdir(parents=True, exist_ok=True)
        return [self._write(self._film, self._folder)]


def _check_seen(frames: int, seen: bool) -> None:
    """Refuse a film of nothing.

    Raises:
        ValueError: it has no frames, or nothing is seen in them.
    """
    if not seen:
        remedy = "add a scene first" if frames == 0 else f"in none of its {frames} frames is anything finite"
        raise ValueError(f"this film shows nothing; {remedy}")


class PlyWriter:
    """Writes the files of every frame at once."""

    def __init__(self, folder: Path) -> None:
        """Begin without frames."""
        self._folder, self._names = folder, Names()
        self._num_frames = 0
        self._folders: dict[str, Path] = {}

    def add(self, scene: Scene) -> None:
        """Write a frame.

        Raises:
            OSError: the folder cannot be written.
        """
        for name, vertices, faces, colors, _ in self._names.meshes(scene):
            write_mesh_ply(self._file(name), vertices, faces, colors)
        for index, body in enumerate(scene.bodies):
            name, splats = f"splats_{index}", body.splats
            if splats is not None and self._names.shows(name, np.hstack([splats.means, splats.covariances])):
                write_ply(self._file(name), splats.as_cloud())
        self._num_frames += 1

    def finish(self) -> list[Path]:
        """Return the folders of the meshes and of the splats.

        Raises:
            ValueError: there is no frame, or nothing is seen in any.
        """
        _check_seen(self._num_frames, bool(self._folders))
        return list(self._folders.values())

    def _file(self, name: str) -> Path:
        """Return the file of something in this frame; its folder is made."""
        if name not in self._folders:
            self._folders[name] = self._folder / name
            self._folders[name].mkdir(parents=True, exist_ok=True)
        return self._folders[name] / f"{self._num_frames:04d}.ply"


def write_mesh_ply(path: Path, vertices: np.ndarray, faces: np.ndarray, colors: np.ndarray) -> None:
    """Write a mesh as a PLY file, binary and little endian.

    Args:
        path: of the file, which is replaced.
        vertices: [m], shape ``(V, 3)``.
        faces: triangles, shape ``(T, 3)``.
        colors: sRGB of the vertices, shape ``(V, 3)`` uint8.
    """
    points = np.empty(len(vertices), dtype=[("at", "<f4", 3), ("color", "u1", 3)])
    points["at"], points["color"] = vertices, colors
    triangles = np.empty(len(faces), dtype=[("count", "u1"), ("corners", "<i4", 3)])
    triangles["count"], triangles["corners"] = 3, faces
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(vertices)}"]
    header += [f"property float {axis}" for axis in "xyz"]
    header += [f"property uchar {channel}" for channel in ("red", "green", "blue")]
    header += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header", ""]
    with path.open("wb") as stream:
        stream.write("\n".join(header).encode())
        stream.write(points.tobytes())
        stream.write(triangles.tobytes())


def write_usd(film: Film, folder: Path) -> Path:
    """Write ``film.usdc`` and return its path: mesh prims with points, colours and visibility by time."""
    pxr = _import_usd()
    geometry, arrays = pxr.UsdGeom, pxr.Vt
    path = folder / "film.usdc"
    stage = pxr.Usd.Stage.CreateInMemory()
    geometry.SetStageUpAxis(stage, geometry.Tokens.z)
    geometry.SetStageMetersPerUnit(stage, 1.0)
    stage.SetTimeCodesPerSecond(film.rate)
    stage.SetFramesPerSecond(film.rate)
    stage.SetStartTimeCode(0)
    stage.SetEndTimeCode(film.num_frames - 1)
    stage.SetDefaultPrim(geometry.Xform.Define(stage, "/film").GetPrim())
    for mesh in film.meshes:
        prim = geometry.Mesh.Define(stage, f"/film/{mesh.name}")
        prim.CreateSubdivisionSchemeAttr(geometry.Tokens.none)
        prim.CreateFaceVertexCountsAttr(arrays.IntArray.FromNumpy(np.full(len(mesh.faces), 3, np.int32)))
        prim.CreateFaceVertexIndicesAttr(arrays.IntArray.FromNumpy(mesh.faces.astype(np.int32).ravel()))
        points, extent, visibility = prim.CreatePointsAttr(), prim.CreateExtentAttr(), prim.CreateVisibilityAttr()
        display = geometry.PrimvarsAPI(prim).CreatePrimvar(
            "displayColor", pxr.Sdf.ValueTypeNames.Color3fArray, geometry.Tokens.vertex
        )
        before: tuple[Any, Any] = (None, None)
        always = all(shape is not None for shape in mesh.shapes)
        for frame, (shape, color) in enumerate(zip(mesh.shapes, mesh.colors, strict=True)):
            if not always:
                visibility.Set(geometry.Tokens.invisible if shape is None else geometry.Tokens.inherited, frame)
            if shape is None:
                continue
            points.Set(arrays.Vec3fArray.FromNumpy(np.ascontiguousarray(shape, np.float32)), frame)
            bounds = np.stack([shape.min(axis=0), shape.max(axis=0)]).astype(np.float32)
            extent.Set(arrays.Vec3fArray.FromNumpy(bounds), frame)
            if color is not before[1]:
                light = srgb_to_linear(color / 255.0).astype(np.float32)
                display.Set(arrays.Vec3fArray.FromNumpy(np.ascontiguousarray(light)), frame)
            before = (shape, color)
    stage.Export(str(path))
    return path


def _import_usd() -> ModuleType:
    try:
        import pxr
        from pxr import Sdf, Usd, UsdGeom, Vt  # noqa: F401 - modules of their own
    except ImportError as error:
        raise missing("USD", "usd-core", "usd") from error
    return pxr
