"""Reader of glTF 2.0 and GLB files: the document, its buffers and accessors, node hierarchy, skins and animations.

After the specification of the Khronos Group ("glTF 2.0 Specification", 2021). A file is data of anyone: every count,
offset and index is checked against the bytes that are there before anything is allocated, and what it costs is bounded.
Files are y up, in metres, and mostly face +z; they are returned as they are.
"""

from __future__ import annotations

import base64
import binascii
import json
import struct
import urllib.parse
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from piavatar_envs.core.reading import check_file, reading

MAX_FILE = 2**31  # [bytes] of the file, and of a buffer beside it
MAX_JSON = 2_000_000  # brackets and commas of the document, which may hold long strings of data
MAX_VALUES = 10**8  # numbers of one accessor
MAX_NODES, MAX_DEPTH = 20_000, 256
_COMPONENTS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
#: Columns and rows of an element; a column of a matrix begins at a multiple of four bytes.
_SHAPES = {
    "SCALAR": (1, 1), "VEC2": (1, 2), "VEC3": (1, 3), "VEC4": (1, 4), "MAT2": (2, 2), "MAT3": (3, 3), "MAT4": (4, 4),
}  # fmt: skip
_WIDTHS = {"translation": 3, "rotation": 4, "scale": 3}
#: Extensions that files may require, because they change nothing that is read or are read here.
_READ = frozenset(
    "KHR_mesh_quantization KHR_texture_transform KHR_texture_basisu EXT_texture_webp EXT_texture_avif "
    "KHR_lights_punctual MSFT_texture_dds VRM VRMC_vrm VRMC_springBone VRMC_node_constraint VRMC_materials_mtoon "
    "VRMC_materials_hdr_emissiveMultiplier KHR_animation_pointer KHR_xmp_json_ld "
    "KHR_gaussian_splatting".split()
)
_COMPRESSED = {
    "EXT_meshopt_compression": "undo the compression with: npx @gltf-transform/cli copy IN.glb OUT.glb",
    "KHR_meshopt_compression": "undo the compression with: npx @gltf-transform/cli copy IN.glb OUT.glb",
    "KHR_draco_mesh_compression": "undo the compression with: npx @gltf-transform/cli copy IN.glb OUT.glb",
}
_FOREIGN = (
    (b"Kaydara FBX", ".fbx", "FBX", "Blender's File > Import > FBX and File > Export > glTF 2.0, or FBX2glTF"),
    (b"; FBX", ".fbx", "FBX", "Blender's File > Import > FBX and File > Export > glTF 2.0, or FBX2glTF"),
    (b"BLENDER", ".blend", "Blender", "Blender's File > Export > glTF 2.0"),
    (b"PK\x03\x04", ".usdz", "USDZ", "Blender's File > Import > Universal Scene Description and Export > glTF 2.0"),
    (b"<?xml", ".dae", "Collada", "Blender 4's File > Import > Collada and File > Export > glTF 2.0"),
)


@dataclass(frozen=True, eq=False)
class Skin:
    """Joints of skinned meshes.

    Attributes:
        joints: nodes, shape ``(J,)``.
        inverse_binds: from the mesh to each joint's node, shape ``(J, 4, 4)``.
    """

    joints: np.ndarray
    inverse_binds: np.ndarray


@dataclass(frozen=True, eq=False)
class Track:
    """Keys of one property of a node.

    Attributes:
        node: that it moves.
        path: ``"translation"``, ``"rotation"`` (xyzw) or ``"scale"``.
        mode: ``"LINEAR"``, ``"STEP"`` or ``"CUBICSPLINE"``.
        times: of the ``K`` keys, rising [s].
        values: shape ``(K, W)``; for cubic splines in-tangent, value and out-tangent, shape ``(K, 3, W)``.
    """

    node: int
    path: str
    mode: str
    times: np.ndarray
    values: np.ndarray

    def at(self, times: np.ndarray) -> np.ndarray:
        """Return the property at some times [s], held before the first and after the last key, shape ``(T, W)``."""
        keys, values = self.times, self.values
        times = np.clip(np.asarray(times, dtype=np.float64), keys[0], keys[-1])
        first = np.clip(np.searchsorted(keys, times, side="right") - 1, 0, max(len(keys) - 2, 0))
        last = np.minimum(first + 1, len(keys) - 1)
        span = keys[last] - keys[first]
        share = np.where(span > 0.0, (times - keys[first]) / np.where(span > 0.0, span, 1.0), 0.0)[:, None]
        if self.mode == "STEP":
            result = np.where(share < 1.0, values[first], values[last])
        elif self.mode == "CUBICSPLINE":
            square, cube = share**2, share**3
            result = (
                (2.0 * cube - 3.0 * square + 1.0) * values[first, 1]
                + (cube - 2.0 * square + share) * span[:, None] * values[first, 2]
                + (3.0 * square - 2.0 * cube) * values[last, 1]
                + (cube - square) * span[:, None] * values[last, 0]
            )
        elif self.path == "rotation":
            start, end = values[first], values[last]
            arcs = (Rotation.from_quat(start).inv() * Rotation.from_quat(end)).as_rotvec()  # the shorter ones
            result = (Rotation.from_quat(start) * Rotation.from_rotvec(share * arcs)).as_quat()
        else:
            result = values[first] + share * (values[last] - values[first])
        if self.path == "rotation":
            result = result / np.maximum(np.linalg.norm(result, axis=1, keepdims=True), 1e-12)
        return result


@dataclass(frozen=True, eq=False)
class Animation:
    """Tracks that are played together.

    Attributes:
        name: empty without one.
        tracks: of the nodes that it moves.
    """

    name: str
    tracks: tuple[Track, ...]

    @property
    def start(self) -> float:
        """Time of the first key [s]."""
        return min((float(track.times[0]) for track in self.tracks), default=0.0)

    @property
    def end(self) -> float:
        """Time of the last key [s]."""
        return max((float(track.times[-1]) for track in self.tracks), default=0.0)

    @property
    def rate(self) -> float:
        """Keys a second [1/s]: the median over neighbouring keys of all tracks; 30 without any."""
        steps = [np.diff(track.times) for track in self.tracks]
        steps = np.concatenate([step[step > 1e-6] for step in steps] or [np.zeros(0)])
        return 1.0 / float(np.median(steps)) if len(steps) else 30.0


class Gltf:
    """A glTF document.

    Attributes:
        path: of the file.
        json: the document.
        names: of the ``N`` nodes, empty where there is none.
        parents: node that each hangs on, -1 for a root, shape ``(N,)``.
        order: nodes, parents before children, shape ``(N,)``.
        shown: whether each node is in the scene that is shown, shape ``(N,)`` bool.
        translations: of the nodes at rest, shape ``(N, 3)``.
        rotations: unit quaternions xyzw, shape ``(N, 4)``.
        scales: shape ``(N, 3)``.
    """

    def __init__(self, path: str | Path, document: dict[str, Any], binary: memoryview | None):
        self.path = Path(path)
        self.json = document
        self._binary = binary
        self._buffers: dict[int, bytes | memoryview] = {}
        self._lists: dict[str, list[dict[str, Any]]] = {}
        self._check_extensions()
        nodes = self.items("nodes")
        if len(nodes) > MAX_NODES:
            raise ValueError(f"it has {len(nodes)} nodes, more than {MAX_NODES}")
        self.names = [str(node.get("name", ""))[:200] for node in nodes]
        self.parents = self._parents(nodes)
        self.order = self._order()
        self.shown = self._shown()
        self.translations, self.rotations, self.scales = (np.zeros((len(nodes), width)) for width in (3, 4, 3))
        self._fixed: dict[int, np.ndarray] = {}
        for index, node in enumerate(nodes):
            self._read_node(index, node)

    def items(self, key: str) -> list[dict[str, Any]]:
        """Return a list of objects of the document; empty if there is none.

        Raises:
            ValueError: it is something else.
        """
        if key not in self._lists:
            found = self.json.get(key, [])
            if not isinstance(found, list) or not all(isinstance(item, dict) for item in found):
                raise ValueError(f"{key} is not a list of objects")
            self._lists[key] = found
        return self._lists[key]

    def item(self, key: str, index: Any) -> dict[str, Any]:
        """Return one object of a list of the document.

        Raises:
            ValueError: the index is none of its.
        """
        found = self.items(key)
        return found[whole(index, f"an index of {key}", len(found) - 1)]

    @cached_property
    def local(self) -> np.ndarray:
        """Transforms of the nodes at rest relative to their parents, shape ``(N, 4, 4)``."""
        matrices = compose(self.translations, self.rotations, self.scales)
        for node, matrix in self._fixed.items():
            matrices[node] = matrix
        return matrices

    @cached_property
    def world(self) -> np.ndarray:
        """Transforms of the nodes as the file shows them, to the scene, shape ``(N, 4, 4)``."""
        return self.to_world(self.local)

    def to_world(self, local: np.ndarray) -> np.ndarray:
        """Return transforms to the scene from those to the parents, shape ``(..., N, 4, 4)`` both."""
        world = np.array(local, dtype=np.float64)
        for node in self.order:
            if self.parents[node] >= 0:
                world[..., node, :, :] = world[..., self.parents[node], :, :] @ world[..., node, :, :]
        return world

    @cached_property
    def skins(self) -> list[Skin]:
        """The skins of the file."""
        with reading(self.path, "a glTF file that can be read"):
            return [self._skin(index, skin) for index, skin in enumerate(self.items("skins"))]

    @cached_property
    def animations(self) -> list[Animation]:
        """The animations of the file; tracks of what is not read (weights of morph targets) are left out."""
        with reading(self.path, "a glTF file that can be read"):
            return [self._animation(index, animation) for index, animation in enumerate(self.items("animations"))]

    def local_at(self, animation: Animation, times: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return translations ``(T, N, 3)``, rotations xyzw ``(T, N, 4)`` and scales ``(T, N, 3)`` of an animation."""
        count = len(times)
        rest = (self.translations, self.rotations, self.scales)
        moved = dict(zip(_WIDTHS, (np.repeat(values[None], count, axis=0) for values in rest), strict=True))
        for track in animation.tracks:
            moved[track.path][:, track.node] = track.at(times)
        return moved["translation"], moved["rotation"], moved["scale"]

    def world_at(self, animation: Animation, times: np.ndarray) -> np.ndarray:
        """Return transforms of the nodes to the scene at some times [s] of an animation, shape ``(T, N, 4, 4)``."""
        local = compose(*self.local_at(animation, times))
        still = set(self._fixed) - {track.node for track in animation.tracks}
        for node in still:
            local[:, node] = self._fixed[node]
        return self.to_world(local)

    @cached_property
    def humanoid(self) -> dict[str, int] | None:
        """Nodes of the bones of a VRM file, 0.x or 1.0; None for other files."""
        with reading(self.path, "a VRM file"):
            extensions = self.json.get("extensions") or {}
            if "VRMC_vrm" in extensions:
                bones = extensions["VRMC_vrm"]["humanoid"]["humanBones"]
                pairs = [(bone, entry["node"]) for bone, entry in bones.items()]
            elif "VRM" in extensions:
                pairs = [(entry["bone"], entry["node"]) for entry in extensions["VRM"]["humanoid"]["humanBones"]]
            else:
                return None
            return {str(bone): whole(node, f"node of the bone {bone}", len(self.names) - 1) for bone, node in pairs}

    def accessor(self, index: Any, finite: bool = True) -> np.ndarray:
        """Return the elements of an accessor.

        Args:
            index: of the accessor.
            finite: whether values that are not finite are refused.

        Returns:
            Shape ``(count, width)``; integers as stored, normalised ones and floats as float64. Matrices are stored
            by columns.

        Raises:
            ValueError: it reaches beyond its buffer, or holds what it must not.
        """
        accessor = self.item("accessors", index)
        what = f"accessor {index}"
        kind, component = accessor.get("type"), accessor.get("componentType")
        if kind not in _SHAPES or component not in _COMPONENTS:
            raise ValueError(f"{what} has type {kind!r} of components {component!r}")
        dtype, (columns, rows) = np.dtype(_COMPONENTS[component]), _SHAPES[kind]
        count = whole(accessor.get("count"), f"count of {what}", MAX_VALUES // (columns * rows), low=1)
        if "bufferView" in accessor:
            values = self._elements(accessor["bufferView"], accessor.get("byteOffset", 0), count, dtype, kind, what)
        else:
            values = np.zeros((count, columns * rows), dtype)
        if "sparse" in accessor:
            values = self._sparse(accessor["sparse"], values, dtype, kind, what)
        if accessor.get("normalized") and dtype.kind in "iu":
            return np.maximum(values / float(np.iinfo(dtype).max), -1.0)
        if dtype.kind == "f":
            if finite and not np.isfinite(values).all():
                raise ValueError(f"{what} holds values that are not finite")
            return values.astype(np.float64)
        return values

    def buffer_view(self, index: Any, what: str) -> memoryview:
        """Return the bytes of a buffer view."""
        view = self.item("bufferViews", index)
        fallback = self.item("buffers", view.get("buffer")).get("extensions") or {}
        for name in _COMPRESSED:
            if name in fallback:
                raise ValueError(f"{what} is compressed by {name}; {_COMPRESSED[name]}")
        buffer = self.buffer(view.get("buffer"))
        start = whole(view.get("byteOffset", 0), f"offset of buffer view {index}", len(buffer))
        length = whole(view.get("byteLength"), f"length of buffer view {index}", len(buffer) - start, low=1)
        return memoryview(buffer)[start : start + length]

    def buffer(self, index: Any) -> bytes | memoryview:
        """Return the bytes of a buffer: the binary chunk, a data URI, or a file in the folder of this one.

        Raises:
            ValueError: it is none of these, or shorter than it says.
        """
        entry = self.item("buffers", index)
        if index not in self._buffers:
            if "uri" in entry:
                self._buffers[index] = self.resource(entry["uri"], f"buffer {index}")
            elif self._binary is not None:
                self._buffers[index] = self._binary
            else:
                raise ValueError(f"buffer {index} has no bytes")
        content = self._buffers[index]
        whole(entry.get("byteLength"), f"length of buffer {index}, which has {len(content)} bytes", len(content), low=1)
        return content

    def resource(self, uri: Any, what: str) -> bytes:
        """Return the bytes that a URI stands for: data, or a file in the folder of this one or below it.

        Raises:
            ValueError: it is neither, or the file is not there.
        """
        if not isinstance(uri, str):
            raise ValueError(f"{what} has the URI {uri!r:.40}")
        if uri.startswith("data:"):
            head, _, data = uri.partition(",")
            if not head.endswith(";base64"):
                raise ValueError(f"{what} is a data URI without base64")
            try:
                return base64.b64decode(data, validate=True)
            except binascii.Error as error:
                raise ValueError(f"{what} is not base64: {error}") from None
        folder = self.path.parent.resolve()
        file = (folder / urllib.parse.unquote(uri)).resolve()
        if "://" in uri or not file.is_relative_to(folder):
            raise ValueError(f"{what} is outside of the file's folder: {uri!r:.80}; put it beside the file")
        if not file.is_file():
            raise ValueError(f"{what} is the file {uri!r:.80}, which is not beside it")
        if file.stat().st_size > MAX_FILE:
            raise ValueError(f"{what} has {file.stat().st_size} bytes, more than {MAX_FILE}")
        return file.read_bytes()

    def _check_extensions(self) -> None:
        """Refuse a document that requires what is not read."""
        required = self.json.get("extensionsRequired", [])
        if not isinstance(required, list):
            raise ValueError("extensionsRequired is not a list")
        for name in required:
            if name in _COMPRESSED:
                raise ValueError(f"it requires {name}, which is not read; {_COMPRESSED[name]}")
            if name not in _READ and not str(name).startswith("KHR_materials_"):
                raise ValueError(f"it requires {name}, which is not read; export it without")
        version = str((self.json.get("asset") or {}).get("version", ""))
        if not version.startswith("2."):
            raise ValueError(f"it is of glTF {version or 'without a version'}, and 2.0 is read; export it as glTF 2.0")

    def _parents(self, nodes: Sequence[dict[str, Any]]) -> np.ndarray:
        parents = np.full(len(nodes), -1, dtype=np.int64)
        for index, node in enumerate(nodes):
            children = node.get("children", [])
            if not isinstance(children, list):
                raise ValueError(f"children of node {index} are not a list")
            for child in children:
                child = whole(child, f"child of node {index}", len(nodes) - 1)
                if parents[child] >= 0:
                    raise ValueError(f"node {child} hangs on the nodes {parents[child]} and {index}")
                parents[child] = index
        return parents

    def _order(self) -> np.ndarray:
        """Return the nodes, parents before children.

        Raises:
            ValueError: the nodes form a cycle, or hang on each other too deeply.
        """
        depth = np.where(self.parents < 0, 0, -1)
        for level in range(1, MAX_DEPTH + 1):
            below = (depth < 0) & (self.parents >= 0) & (depth[self.parents] == level - 1)
            if not below.any():
                break
            depth[below] = level
        if (depth < 0).any():
            raise ValueError(
                f"node {int(np.flatnonzero(depth < 0)[0])} is in a cycle, or more than {MAX_DEPTH} nodes deep"
            )
        return np.argsort(depth, kind="stable")

    def _shown(self) -> np.ndarray:
        """Return whether each node is in the scene that is shown; all are in a file without scenes."""
        if not self.items("scenes"):
            return np.ones(len(self.parents), bool)
        shown = np.zeros(len(self.parents), bool)
        roots = self.item("scenes", self.json.get("scene", 0)).get("nodes", [])
        for root in roots if isinstance(roots, list) else []:
            shown[whole(root, "a node of the scene", len(shown) - 1)] = True
        for node in self.order:
            shown[node] |= self.parents[node] >= 0 and shown[self.parents[node]]
        return shown

    def _read_node(self, index: int, node: dict[str, Any]) -> None:
        what = f"of node {index}"
        self.translations[index] = numbers(node.get("translation", (0, 0, 0)), 3, f"translation {what}")
        rotation = numbers(node.get("rotation", (0, 0, 0, 1)), 4, f"rotation {what}")
        self.scales[index] = numbers(node.get("scale", (1, 1, 1)), 3, f"scale {what}")
        norm = float(np.linalg.norm(rotation))
        if not norm > 1e-6:
            raise ValueError(f"rotation {what} has the norm {norm:g}")
        self.rotations[index] = rotation / norm
        if "matrix" in node:
            matrix = numbers(node["matrix"], 16, f"matrix {what}").reshape(4, 4).T
            if not np.allclose(matrix[3], (0.0, 0.0, 0.0, 1.0)):
                raise ValueError(f"matrix {what} is not a transform of points")
            self._fixed[index] = matrix
            self.translations[index] = matrix[:3, 3]
            self.scales[index] = np.maximum(np.linalg.norm(matrix[:3, :3], axis=0), 1e-12)
            if np.linalg.det(matrix[:3, :3]) < 0.0:
                self.scales[index, 0] *= -1.0
            turn = matrix[:3, :3] / self.scales[index]
            if abs(np.linalg.det(turn)) > 1e-6:
                self.rotations[index] = Rotation.from_matrix(turn).as_quat()

    def _skin(self, index: int, skin: dict[str, Any]) -> Skin:
        listed = skin.get("joints")
        if not isinstance(listed, list) or not listed:
            raise ValueError(f"skin {index} has no joints")
        joints = np.array([whole(joint, f"joint of skin {index}", len(self.names) - 1) for joint in listed])
        if "inverseBindMatrices" not in skin:
            return Skin(joints, np.tile(np.eye(4), (len(joints), 1, 1)))
        matrices = self.accessor(skin["inverseBindMatrices"])
        if matrices.shape[1] != 16 or len(matrices) < len(joints):
            raise ValueError(
                f"skin {index} has inverse bind matrices of shape {matrices.shape} for {len(joints)} joints"
            )
        return Skin(joints, matrices[: len(joints)].reshape(-1, 4, 4).transpose(0, 2, 1))

    def _animation(self, index: int, animation: dict[str, Any]) -> Animation:
        tracks = []
        samplers = animation.get("samplers", [])
        for channel in animation.get("channels", []):
            target = channel["target"]
            path = target.get("path")
            if path not in _WIDTHS or "node" not in target:
                continue
            what = f"animation {index}"
            node = whole(target["node"], f"node of {what}", len(self.names) - 1)
            sampler = samplers[whole(channel["sampler"], f"sampler of {what}", len(samplers) - 1)]
            mode = sampler.get("interpolation", "LINEAR")
            times = self.accessor(sampler["input"]).astype(np.float64)[:, 0]
            values = self.accessor(sampler["output"]).astype(np.float64)
            spline = mode == "CUBICSPLINE"
            if mode not in ("LINEAR", "STEP", "CUBICSPLINE"):
                raise ValueError(f"{what} interpolates by {mode!r:.40}")
            if values.shape != (len(times) * (3 if spline else 1), _WIDTHS[path]) or np.any(np.diff(times) < 0.0):
                raise ValueError(f"{what} has values of shape {values.shape} for {len(times)} times, which must rise")
            if spline:
                values = values.reshape(len(times), 3, -1)
            elif path == "rotation":
                values = values / np.maximum(np.linalg.norm(values, axis=1, keepdims=True), 1e-12)
            tracks.append(Track(node, path, mode, times, values))
        return Animation(str(animation.get("name", "")), tuple(tracks))

    def _elements(self, view: Any, offset: Any, count: int, dtype: np.dtype, kind: str, what: str) -> np.ndarray:
        """Return ``count`` elements of a buffer view, shape ``(count, width)``, a copy."""
        content = self.buffer_view(view, what)
        columns, rows = _SHAPES[kind]
        column = rows * dtype.itemsize
        if columns > 1:
            column = -(-column // 4) * 4
        size = columns * column
        stride = whole(self.item("bufferViews", view).get("byteStride", size) or size, f"stride of {what}", 2**16)
        offset = whole(offset, f"offset of {what}", len(content))
        needed = offset + (count - 1) * stride + size
        if stride < size or needed > len(content):
            raise ValueError(
                f"{what} has {count} elements of {size} bytes at a stride of {stride} from {offset}, and its buffer "
                f"view has {len(content)} bytes"
            )
        raw = np.frombuffer(content, np.uint8, needed - offset, offset)
        cells = np.lib.stride_tricks.as_strided(raw, (count, columns, rows * dtype.itemsize), (stride, column, 1))
        return np.ascontiguousarray(cells).view(dtype).reshape(count, columns * rows)

    def _sparse(self, sparse: dict[str, Any], values: np.ndarray, dtype: np.dtype, kind: str, what: str) -> np.ndarray:
        """Return elements with some of them replaced."""
        what = f"sparse {what}"
        count = whole(sparse.get("count"), f"count of {what}", len(values), low=1)
        indices, replaced = sparse["indices"], sparse["values"]
        index_type = np.dtype(_COMPONENTS[indices["componentType"]])
        if index_type.kind != "u":
            raise ValueError(f"{what} has indices of components {indices['componentType']}")
        where = self._elements(indices["bufferView"], indices.get("byteOffset", 0), count, index_type, "SCALAR", what)
        if where.max() >= len(values):
            raise ValueError(f"{what} replaces element {where.max()} of {len(values)}")
        values = values.copy()
        values[where[:, 0]] = self._elements(
            replaced["bufferView"], replaced.get("byteOffset", 0), count, dtype, kind, what
        )
        return values


def compose(translations: np.ndarray, rotations: np.ndarray, scales: np.ndarray) -> np.ndarray:
    """Return transforms of translation, rotation (xyzw) and scale, shape ``(..., 4, 4)``."""
    matrices = np.zeros((*translations.shape[:-1], 4, 4))
    turns = Rotation.from_quat(rotations.reshape(-1, 4)).as_matrix() if rotations.size else np.zeros((0, 3, 3))
    matrices[..., :3, :3] = turns.reshape(*rotations.shape[:-1], 3, 3) * scales[..., None, :]
    matrices[..., :3, 3] = translations
    matrices[..., 3, 3] = 1.0
    return matrices


def whole(value: Any, what: str, high: int, low: int = 0) -> int:
    """Return a whole number of a document.

    Raises:
        ValueError: it is none, or outside ``low`` to ``high``.
    """
    if isinstance(value, float) and value.is_integer():
        value = int(value)
    if not isinstance(value, int) or isinstance(value, bool) or not low <= value <= high:
        raise ValueError(f"{what} is {value!r:.40}, it must be a whole number from {low} to {high}")
    return value


def numbers(values: Any, count: int, what: str) -> np.ndarray:
    """Return some finite numbers of a document, shape ``(count,)`` float64.

    Raises:
        ValueError: they are none.
    """
    fine = isinstance(values, (list, tuple)) and len(values) == count
    if not fine or not all(isinstance(value, (int, float)) and abs(value) < 1e30 for value in values):
        raise ValueError(f"{what} is {values!r:.60}, it must be {count} finite numbers")
    return np.array(values, dtype=np.float64)


def check_format(path: Path, content: bytes = b"") -> None:
    """Refuse a file of another program by its ending or its first bytes, and name the converter.

    Raises:
        ValueError: it is such a file.
    """
    for magic, suffix, name, converter in _FOREIGN:
        if content.startswith(magic) or path.suffix.lower() == suffix:
            raise ValueError(f"it is {name}, which is not read; convert it to GLB by {converter}")


def read_gltf(path: str | Path) -> Gltf:
    """Read a ``.gltf``, ``.glb`` or ``.vrm`` file; its arrays are read when they are asked of the result.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it is damaged, of another format, or requires an extension that is not read.
    """
    path = Path(path)
    check_file(path)
    with reading(path, "a glTF file that can be read"):
        if path.stat().st_size > MAX_FILE:
            raise ValueError(f"it has {path.stat().st_size} bytes, more than {MAX_FILE}")
        content = path.read_bytes()
        check_format(path, content)
        document, binary = _chunks(content) if content[:4] == b"glTF" else (content, None)
        document = bytes(document)
        marks = sum(document.count(mark) for mark in (b"[", b"{", b","))
        if marks > MAX_JSON:
            raise ValueError(f"its JSON has {marks} brackets and commas, more than {MAX_JSON}")
        parsed = json.loads(document.decode("utf-8-sig"), parse_constant=_refuse)
        if not isinstance(parsed, dict):
            raise ValueError("its JSON is not an object")
        return Gltf(path, parsed, binary)


def _chunks(content: bytes) -> tuple[memoryview, memoryview | None]:
    """Return the JSON and the binary chunk of a GLB file."""
    version, length = struct.unpack_from("<II", content, 4)
    if version != 2:
        raise ValueError(f"it is GLB version {version}, and 2 is read")
    if length > len(content):
        raise ValueError(f"it has {len(content)} bytes of {length}: it is cut off")
    found: dict[int, memoryview] = {}
    start = 12
    while start + 8 <= length:
        size, kind = struct.unpack_from("<II", content, start)
        if start + 8 + size > length:
            raise ValueError(f"a chunk of {size} bytes at {start} reaches beyond the {length} bytes of the file")
        found.setdefault(kind, memoryview(content)[start + 8 : start + 8 + size])
        start += 8 + size
    if 0x4E4F534A not in found:
        raise ValueError("it has no JSON chunk")
    return found[0x4E4F534A], found.get(0x004E4942)


def _refuse(constant: str) -> float:
    raise ValueError(f"its JSON holds {constant}")
