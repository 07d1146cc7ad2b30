"""Write small glTF and GLB files, and rigged bodies in the many ways in which files have them."""

from __future__ import annotations

import base64
import json
import struct
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from piavatar_envs.avatar.body.asset import AvatarAsset, top_weights
from piavatar_envs.avatar.body.skeleton import PARENTS

_CODES = {"i1": 5120, "u1": 5121, "i2": 5122, "u2": 5123, "u4": 5125, "f4": 5126}
#: Rows: x, y, z of glTF (y up, facing +z, left +x) in our axes.
Y_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])


@dataclass
class Writer:
    """A glTF document in the making, and its buffer."""

    document: dict[str, Any] = field(default_factory=lambda: {"asset": {"version": "2.0"}, "nodes": []})
    blob: bytearray = field(default_factory=bytearray)

    def add(self, key: str, item: dict[str, Any]) -> int:
        """Append an item to a list of the document, and return its index."""
        self.document.setdefault(key, []).append(item)
        return len(self.document[key]) - 1

    def view(self, content: bytes, **more: Any) -> int:
        """Append bytes to the buffer, and return the index of their view."""
        self.blob += b"\0" * (-len(self.blob) % 4)
        entry = {"buffer": 0, "byteOffset": len(self.blob), "byteLength": len(content), **more}
        self.blob += content
        return self.add("bufferViews", entry)

    def accessor(self, array: np.ndarray, kind: str, stride: int = 0, sparse: bool = False, **more: Any) -> int:
        """Append an array, and return the index of its accessor.

        Args:
            array: an element a row.
            kind: of glTF, such as ``"VEC3"``.
            stride: bytes from one element to the next, 0 for none between them.
            sparse: whether every other element is in the sparse part.
            **more: of the accessor.
        """
        array = np.ascontiguousarray(array)
        entry = {"componentType": _CODES[array.dtype.str[1:]], "count": len(array), "type": kind, **more}
        rows = array.reshape(len(array), -1)
        if sparse:  # the odd elements replace zeros of the buffer view
            odd = np.arange(1, len(rows), 2, dtype=np.uint32)
            base = rows.copy()
            base[odd] = 0
            entry["bufferView"] = self.view(base.tobytes())
            entry["sparse"] = {
                "count": len(odd),
                "indices": {"bufferView": self.view(odd.tobytes()), "componentType": 5125},
                "values": {"bufferView": self.view(rows[odd].tobytes())},
            }
        elif stride:
            padded = np.full((len(rows), stride), 0xAB, np.uint8)
            size = rows.shape[1] * rows.itemsize
            padded[:, 4 : 4 + size] = rows.view(np.uint8).reshape(len(rows), size)
            entry |= {"bufferView": self.view(padded.tobytes(), byteStride=stride), "byteOffset": 4}
        else:
            entry["bufferView"] = self.view(rows.tobytes())
        return self.add("accessors", entry)

    def save(self, path: Path, storage: str = "glb") -> Path:
        """Write the file: ``"glb"``, or JSON with a ``"file"`` beside it or the ``"data"`` within."""
        buffer: dict[str, Any] = {"byteLength": len(self.blob)}
        if storage == "file":
            (path.parent / "its data.bin").write_bytes(self.blob)
            buffer["uri"] = "its%20data.bin"
        if storage == "data":
            buffer["uri"] = "data:application/octet-stream;base64," + base64.b64encode(self.blob).decode()
        document = self.document | ({"buffers": [buffer]} if self.blob else {})
        text = json.dumps(document).encode()
        path.write_bytes(glb(text, bytes(self.blob)) if storage == "glb" else text)
        return path


def glb(document: bytes, blob: bytes) -> bytes:
    """Return a GLB file of a document and its buffer."""
    document += b" " * (-len(document) % 4)
    blob += b"\0" * (-len(blob) % 4)
    head = struct.pack("<III", 0x46546C67, 2, 28 + len(document) + len(blob))
    chunks = struct.pack("<II", len(document), 0x4E4F534A) + document + struct.pack("<II", len(blob), 0x004E4942)
    return head + chunks + blob


@dataclass
class Part:
    """Another skinned mesh of a test character, in our axes and metres."""

    name: str
    material: str
    vertices: np.ndarray
    faces: np.ndarray
    weights: np.ndarray
    attributes: dict[str, tuple[np.ndarray, str]] = field(default_factory=dict)


@dataclass
class Rig:
    """Rig and mesh of a test character, in our axes and metres, and how its file has them.

    Attributes:
        names: of the bones.
        parents: of the bones.
        joints: positions of the bones, shape ``(J, 3)``.
        vertices: of the skin, shape ``(V, 3)``.
        faces: shape ``(T, 3)``.
        weights: of the bones, shape ``(V, J)``.
        axes: from ours to those of the file, shape ``(3, 3)``.
        unit: lengths in the file of a metre.
        armature: transform of the node over the root bone; the mesh is written through its inverse.
        turns: seed of rotations of the bones, None for none.
        shown: whether the file shows the bind pose, or another one.
        storage: of positions: ``"float"``, ``"sparse"``, ``"strided"`` or ``"quantized"``.
        weight_type: of the weights.
        material: of the skin.
        attributes: more of the skin, by name: array and accessor type.
        parts: further meshes on the same bones, floats in a file without an armature.
    """

    names: Sequence[str]
    parents: Sequence[int]
    joints: np.ndarray
    vertices: np.ndarray
    faces: np.ndarray
    weights: np.ndarray
    axes: np.ndarray = field(default_factory=lambda: Y_UP)
    unit: float = 1.0
    armature: np.ndarray = field(default_factory=lambda: np.eye(4))
    turns: int | None = None
    shown: bool = True
    storage: str = "float"
    weight_type: str = "f4"
    material: dict[str, Any] | None = None
    attributes: dict[str, tuple[np.ndarray, str]] = field(default_factory=dict)
    parts: Sequence[Part] = ()

    def write(self) -> Writer:
        """Return the document: the armature is node 0, bones follow, the skin is the last node."""
        out = Writer()
        joints, points = (self.unit * np.asarray(a, np.float64) @ self.axes.T for a in (self.joints, self.vertices))
        count = len(self.names)
        faces = self.faces[:, ::-1] if np.linalg.det(self.axes) < 0.0 else self.faces
        rng = np.random.default_rng(self.turns)
        spins = Rotation.identity(count) if self.turns is None else Rotation.random(count, rng=rng)
        world = np.tile(np.eye(4), (count, 1, 1))
        world[:, :3, :3], world[:, :3, 3] = spins.as_matrix(), joints
        inside = np.linalg.inv(self.armature)
        binds = np.linalg.inv(world) @ self.armature  # from the mesh, which is in the space of the armature
        local = np.stack(
            [(inside if p < 0 else np.linalg.inv(world[p])) @ world[i] for i, p in enumerate(self.parents)]
        )
        if not self.shown:
            arm = next(i for i, name in enumerate(self.names) if "Arm" in name)
            local[arm, :3, :3] = local[arm, :3, :3] @ Rotation.from_euler("y", 40.0, degrees=True).as_matrix()
        out.add("nodes", {"name": "Armature", "matrix": self.armature.T.ravel().tolist(), "children": []})
        for index, parent in enumerate(self.parents):
            scale = np.linalg.norm(local[index, :3, :3], axis=0) * [np.sign(np.linalg.det(local[index, :3, :3])), 1, 1]
            turn = Rotation.from_matrix(local[index, :3, :3] / scale).as_quat()
            out.add(
                "nodes",
                {
                    "name": self.names[index],
                    "translation": local[index, :3, 3].tolist(),
                    "rotation": turn.tolist(),
                    "scale": scale.tolist(),
                },
            )
            out.document["nodes"][parent + 1].setdefault("children", []).append(index + 1)
        points = points @ inside[:3, :3].T + inside[:3, 3]
        faces = faces[:, ::-1] if np.linalg.det(self.armature[:3, :3]) < 0.0 else faces
        if self.storage == "quantized":
            low, step = points.min(axis=0), np.ptp(points, axis=0).max() / 65535.0
            stored = np.round((points - low) / step).astype("<u2")
            back = np.diag([step, step, step, 1.0])
            back[:3, 3] = low
            binds = binds @ back
            position = out.accessor(stored, "VEC3", stride=12)
            out.document |= {"extensionsRequired": ["KHR_mesh_quantization"]}
        else:
            stride = 24 if self.storage == "strided" else 0
            position = out.accessor(points.astype("<f4"), "VEC3", stride, sparse=self.storage == "sparse")
        bones, weights = top_weights(self.weights)
        if self.weight_type != "f4":
            weights = np.round(weights * np.iinfo(self.weight_type).max)
        more = {"normalized": True} if self.weight_type != "f4" else {}
        attributes = {
            "POSITION": position,
            "JOINTS_0": out.accessor(bones.astype("<u1" if count < 256 else "<u2"), "VEC4"),
            "WEIGHTS_0": out.accessor(weights.astype(f"<{self.weight_type}"), "VEC4", **more),
            **{name: out.accessor(array, kind) for name, (array, kind) in self.attributes.items()},
        }
        primitive = {"attributes": attributes, "indices": out.accessor(faces.astype("<u4").ravel(), "SCALAR")}
        if self.material is not None:
            primitive["material"] = out.add("materials", self.material)
        skin = {"joints": list(range(1, count + 1))}
        skin["inverseBindMatrices"] = out.accessor(binds.transpose(0, 2, 1).reshape(-1, 16).astype("<f4"), "MAT4")
        out.add("skins", skin)
        out.add("meshes", {"name": "Body", "primitives": [primitive]})
        node = out.add("nodes", {"name": "Body", "mesh": 0, "skin": 0})
        nodes = [0, node]
        for part in self.parts:
            bones, weights = top_weights(part.weights)
            attributes = {
                "POSITION": out.accessor((self.unit * part.vertices @ self.axes.T).astype("<f4"), "VEC3"),
                "JOINTS_0": out.accessor(bones.astype("<u1"), "VEC4"),
                "WEIGHTS_0": out.accessor(weights.astype("<f4"), "VEC4"),
                **{name: out.accessor(array, kind) for name, (array, kind) in part.attributes.items()},
            }
            primitive = {"attributes": attributes, "indices": out.accessor(part.faces.astype("<u4").ravel(), "SCALAR")}
            primitive["material"] = out.add("materials", {"name": part.material})
            mesh = out.add("meshes", {"name": part.name, "primitives": [primitive]})
            nodes.append(out.add("nodes", {"name": part.name, "mesh": mesh, "skin": 0}))
        out.document |= {"scene": 0, "scenes": [{"nodes": nodes}]}
        return out


def rig_of(asset: AvatarAsset, names: Sequence[str], **more: Any) -> Rig:
    """Return the rig of a body with our 22 joints under some names."""
    body = asset.mean_body()
    weights = np.zeros((len(body.vertices), len(names)))
    np.add.at(weights, (np.arange(len(weights))[:, None], asset.skin_joints), asset.skin_weights)
    return Rig(names, PARENTS, body.joints, body.vertices, asset.faces, weights, **more)
