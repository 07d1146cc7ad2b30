"""Files of Gaussian splats: 3DGS ``.ply``, glTF with ``KHR_gaussian_splatting``, compressed PLY and SPZ.

Axes and lengths are returned as the file has them. A 3DGS file stores the logarithms of scales and the logits of
opacities, quaternions wxyz, and higher harmonics by colour (Kerbl et al. 2023); a glTF file stores scales and opacities
themselves and quaternions xyzw. The compressed formats are decoded by gsply, which gets to see only files whose sizes
agree with their headers.

A file is data of anyone: what a header promises is compared with the bytes that are there before anything is allocated.
"""

from __future__ import annotations

import gzip
import re
import struct
import tempfile
import zlib
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any, BinaryIO

import numpy as np
from scipy.special import expit, logit

from piavatar_envs.avatar.body.splats import COEFFICIENTS, SplatCloud
from piavatar_envs.avatar.gltf import Gltf, read_gltf, whole
from piavatar_envs.core.extras import missing
from piavatar_envs.core.reading import check_file, reading

#: Endings of the files that are read.
SUFFIXES = (".ply", ".spz", ".glb", ".gltf")
#: Splats of a file.
MAX_SPLATS = 10_000_000
MAX_HEADER, MAX_PROPERTIES, MAX_LINE = 1 << 16, 512, 1 << 14
#: What a compressed file may become, over its own size.
MAX_INFLATION = 64
#: Opacities that a logit is taken of.
_OPAQUE = (1e-7, 1.0 - 1e-7)
_TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4",
    "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4",
    "float32": "f4", "float64": "f8",
}  # fmt: skip
_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": "="}
_PACKED = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
_CHUNK = 256
_EXTENSION = "KHR_gaussian_splatting"
_SPZ_MAGIC = 0x5053474E
_SH_SIZES = (0, 3, 8, 15)


def read_splats(path: str | Path) -> SplatCloud:
    """Return the splats of a file, in its own axes and unit.

    Raises:
        FileNotFoundError: there is no such file.
        ImportError: gsply is not installed, which compressed files need.
        ValueError: it is damaged, of another format, or has no splats.
    """
    path = Path(path)
    readers = {".ply": _read_ply, ".spz": _read_spz, ".glb": _read_gltf, ".gltf": _read_gltf}
    if path.suffix.lower() not in readers:
        raise ValueError(f"{path} is not a file of splats by its ending; use one of {', '.join(SUFFIXES)}")
    check_file(path)
    with reading(path, "a file of Gaussian splats"):
        return readers[path.suffix.lower()](path)


def holds_splats(path: str | Path) -> bool:
    """Return whether the beginning of a file names splats; False where there is no such file."""
    try:
        with Path(path).open("rb") as stream:
            head = stream.read(MAX_HEADER)
    except OSError:
        return False
    if head.startswith(b"ply"):
        return b" f_dc_0" in head or b" packed_position" in head
    return f'"{_EXTENSION}"'.encode() in head


def write_ply(path: str | Path, cloud: SplatCloud) -> None:
    """Write splats as a 3DGS ``.ply``: binary, little endian.

    Args:
        path: of the file, which is replaced.
        cloud: the splats.
    """
    count, rest = len(cloud), 3 * (cloud.sh.shape[1] - 1)
    names = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", *(f"f_rest_{i}" for i in range(rest))]
    names += ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    columns = (
        cloud.means,
        np.zeros((count, 3), np.float32),
        cloud.sh[:, 0],
        cloud.sh[:, 1:].transpose(0, 2, 1).reshape(count, rest),
        logit(np.clip(cloud.opacities, *_OPAQUE).astype(np.float64))[:, None],
        np.log(np.maximum(cloud.scales, 1e-30)),
        cloud.rotations[:, [3, 0, 1, 2]],
    )
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {count}"]
    header += [*(f"property float {name}" for name in names), "end_header", ""]
    rows = np.concatenate([np.asarray(column, "<f4") for column in columns], axis=1)
    with Path(path).open("wb") as stream:
        stream.write("\n".join(header).encode())
        stream.write(np.ascontiguousarray(rows).data)


@dataclass
class _Element:
    """A part of a PLY file: its rows and the type of each of their properties by name."""

    name: str
    count: int
    types: dict[str, str]
    has_lists: bool = False

    def dtype(self, order: str) -> np.dtype:
        return np.dtype([(name, order + kind) for name, kind in self.types.items()])


def _read_ply(path: Path) -> SplatCloud:
    size = path.stat().st_size
    with path.open("rb") as stream:
        order, elements = _header(stream)
        vertex = next((element for element in elements if element.name == "vertex"), None)
        if vertex is None:
            raise ValueError("it has no element vertex")
        if set(_PACKED) <= vertex.types.keys():
            return _read_packed(stream, size, order, elements)
        _check_properties(vertex)
        before = elements[: elements.index(vertex)]
        if any(element.has_lists for element in (*before, vertex)) or (order == "=" and before):
            raise ValueError("there are lists or other elements before its vertices; export the splats alone")
        for element in before:
            stream.seek(_bytes(element, order, size - stream.tell()), 1)
        if order == "=":
            columns = _ascii_rows(stream, vertex, size)
        else:
            needed = _bytes(vertex, order, size - stream.tell())
            columns = np.fromfile(stream, vertex.dtype(order), vertex.count)
            if len(columns) < vertex.count:
                raise ValueError(f"it ends within its {needed} bytes of vertices")
    rest = sum(name.startswith("f_rest_") for name in vertex.types)
    sh = np.empty((vertex.count, 1 + rest // 3, 3), np.float32)
    for channel in range(3):
        sh[:, 0, channel] = columns[f"f_dc_{channel}"]
        for k in range(rest // 3):
            sh[:, 1 + k, channel] = columns[f"f_rest_{channel * (rest // 3) + k}"]
    with np.errstate(over="ignore", invalid="ignore"):
        return SplatCloud.of(
            _stacked(columns, "x", "y", "z"),
            _stacked(columns, "rot_1", "rot_2", "rot_3", "rot_0"),
            np.exp(_stacked(columns, "scale_0", "scale_1", "scale_2")),
            expit(np.asarray(columns["opacity"], np.float32)),
            sh,
        )


def _header(stream: BinaryIO) -> tuple[str, list[_Element]]:
    """Return the byte order, ``=`` for text, and the elements of a PLY file; leaves the stream behind its header."""
    head = stream.read(MAX_HEADER)
    end = re.search(rb"^end_header[ \t]*\r?\n", head, re.MULTILINE)
    if not re.match(rb"ply[ \t]*\r?\n", head) or end is None:
        raise ValueError(f"it does not begin with a PLY header of at most {MAX_HEADER} bytes")
    stream.seek(end.end())
    order, elements = "", []
    for line in head[: end.start()].decode("ascii", "replace").splitlines()[1:]:
        words = line.split()
        if not words or words[0] in ("comment", "obj_info"):
            continue
        if words[0] == "format" and len(words) == 3 and words[1] in _ORDERS:
            order = _ORDERS[words[1]]
        elif words[0] == "element" and len(words) == 3 and re.fullmatch(r"[0-9]{1,18}", words[2]):
            elements.append(_Element(words[1], int(words[2]), {}))
        elif words[0] == "property" and elements and len(words) == 5 and words[1] == "list":
            elements[-1].has_lists = True
        elif words[0] == "property" and elements and len(words) == 3 and words[1] in _TYPES:
            if words[2] in elements[-1].types or len(elements[-1].types) >= MAX_PROPERTIES:
                raise ValueError(f"the property {words[2]!r:.40} is there twice, or one of over {MAX_PROPERTIES}")
            elements[-1].types[words[2]] = _TYPES[words[1]]
        else:
            raise ValueError(f"its header has the line {line!r:.80}")
    if not order:
        raise ValueError(f"its header names no format of {', '.join(_ORDERS)}")
    return order, elements


def _check_properties(vertex: _Element) -> None:
    """Refuse vertices without the properties of splats, and harmonics of no degree."""
    names = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity"]
    names += [*(f"scale_{i}" for i in range(3)), *(f"rot_{i}" for i in range(4))]
    rest = sum(name.startswith("f_rest_") for name in vertex.types)
    for name in (*names, *(f"f_rest_{i}" for i in range(rest))):
        if name not in vertex.types:
            raise ValueError(
                f"its vertices have no property {name}, so they are not splats of 3DGS; for a surface use the source "
                "mesh"
            )
        if vertex.types[name][0] != "f":
            raise ValueError(f"its property {name} is of type {vertex.types[name]}, not float; export it as 3DGS does")
    if rest not in [3 * (count - 1) for count in COEFFICIENTS]:
        raise ValueError(f"it has {rest} properties f_rest_i, not 0, 9, 24 or 45")
    _check_count(vertex.count)


def _check_count(count: int) -> None:
    if not 1 <= count <= MAX_SPLATS:
        raise ValueError(f"it has {count} splats, outside [1, {MAX_SPLATS}]; thin it out, as in SuperSplat")


def _bytes(element: _Element, order: str, left: int) -> int:
    """Return the bytes of an element's rows.

    Raises:
        ValueError: fewer are left in the file.
    """
    needed = element.count * element.dtype(order).itemsize
    if needed > left:
        raise ValueError(f"its header says {needed} bytes of {element.count} {element.name} rows, and {left} follow")
    return needed


def _ascii_rows(stream: BinaryIO, vertex: _Element, size: int) -> np.ndarray:
    """Return the rows of a text file, shape ``(S,)`` of float32 fields."""
    width = len(vertex.types)
    if vertex.count * (2 * width - 1) > size - stream.tell():
        raise ValueError(f"its header says {vertex.count} rows of {width} numbers, too many for {size} bytes")
    rows = np.empty((vertex.count, width), np.float32)
    for index in range(vertex.count):
        line = stream.readline(MAX_LINE)
        words = line.split()
        if len(words) != width:
            raise ValueError(f"row {index} of its vertices has {len(words)} numbers, not {width}")
        with np.errstate(over="ignore"):  # infinite, and refused as such
            rows[index] = words
    return rows.view([(name, np.float32) for name in vertex.types])[:, 0]


def _stacked(columns: np.ndarray, *names: str) -> np.ndarray:
    """Return columns side by side, shape ``(S, len(names))`` float32."""
    result = np.empty((len(columns), len(names)), np.float32)
    for index, name in enumerate(names):
        result[:, index] = columns[name]
    return result


def _read_packed(stream: BinaryIO, size: int, order: str, elements: list[_Element]) -> SplatCloud:
    """Return the splats of a compressed PLY, in chunks of 256 with bounds of their own."""
    gsply = _import_gsply("compressed PLY files")
    names = [element.name for element in elements]
    if order != "<" or names not in (["chunk", "vertex"], ["chunk", "vertex", "sh"]):
        raise ValueError(
            f"it is packed, of elements {', '.join(names)[:80]}, not chunk, vertex and sh of little endian"
        )
    chunk, vertex = elements[:2]
    _check_count(vertex.count)
    kinds = [{"f4"}, {"u4"}, {"u1"}]
    widths = [{18}, {4}, {9, 24, 45}]
    counts = [-(-vertex.count // _CHUNK), vertex.count, vertex.count]
    for element, kind, width, count in zip(elements, kinds, widths, counts, strict=False):
        if set(element.types.values()) != kind or len(element.types) not in width or element.count != count:
            raise ValueError(
                f"its {element.count} rows of {len(element.types)} {element.name} properties do not fit to "
                f"{vertex.count} packed splats"
            )
    if tuple(vertex.types) != _PACKED:
        raise ValueError(f"its packed properties are {', '.join(vertex.types)[:80]}")
    needed = sum(element.count * element.dtype(order).itemsize for element in elements)
    content = stream.read(needed)
    if len(content) < needed:
        raise ValueError(f"its header says {needed} bytes of packed splats, and {len(content)} follow")
    bounds = np.frombuffer(content, "<f4", 18 * chunk.count)
    if not np.isfinite(bounds).all():
        raise ValueError("bounds of a chunk are not finite")
    lines = ["ply", "format binary_little_endian 1.0"]
    for element, kind in zip(elements, ("float", "uint", "uchar"), strict=False):
        lines += [f"element {element.name} {element.count}", *(f"property {kind} {name}" for name in element.types)]
    header = "\n".join([*lines, "end_header", ""]).encode()
    return _of_gsply(gsply.decompress_from_bytes(header + content))


def _read_spz(path: Path) -> SplatCloud:
    """Return the splats of an SPZ file whose content is as long as its header says."""
    content = path.read_bytes()
    if content[:2] != b"\x1f\x8b":
        raise ValueError("it is no SPZ of version 2 or 3; save it as such, or as .ply, as SuperSplat does")
    content = _inflated(content)
    count, degree, version = _spz_header(content)
    needed = 16 + count * (16 + (4 if version >= 3 else 3) + 3 * _SH_SIZES[degree])
    if len(content) < needed:
        raise ValueError(f"its header says {needed} bytes of {count} splats, and it holds {len(content)}")
    gsply = _import_gsply("SPZ files")
    with tempfile.TemporaryDirectory() as folder:
        checked = Path(folder) / "checked.spz"
        checked.write_bytes(gzip.compress(content[:needed], compresslevel=0))
        return _of_gsply(gsply.read_spz(checked))


def _inflated(content: bytes) -> bytes:
    """Return the content of a gzip file.

    Raises:
        ValueError: it is damaged, or larger than its splats may be.
    """
    most = min(MAX_INFLATION * len(content), 70 * MAX_SPLATS)
    unpacker = zlib.decompressobj(31)
    result = unpacker.decompress(content, most)
    if unpacker.unconsumed_tail or not unpacker.eof:
        raise ValueError(f"it is cut off, or unpacks to more than {most} bytes, {MAX_INFLATION} times its size")
    return result


def _spz_header(content: bytes) -> tuple[int, int, int]:
    """Return the number of splats, the degree of their harmonics and the version of an SPZ file."""
    if len(content) < 16:
        raise ValueError(f"it has {len(content)} bytes, fewer than a header")
    magic, version, count, degree, bits = struct.unpack_from("<IIIBB", content)
    if magic == _SPZ_MAGIC and version == 1:
        raise ValueError(
            "it is an SPZ of version 1, and 2 and 3 are read; save it anew, or as .ply, as SuperSplat does"
        )
    if magic != _SPZ_MAGIC or version not in (2, 3):
        raise ValueError(f"its header has the mark {magic:#x} and version {version}, and 2 and 3 are read")
    if degree > 3 or not 1 <= bits <= 24:
        raise ValueError(f"its harmonics are of degree {degree} and its places have {bits} fractional bits")
    _check_count(count)
    return count, degree, version


def _import_gsply(what: str) -> ModuleType:
    try:
        import gsply
    except ImportError as error:
        raise missing(f"reading {what}", "gsply", "splats") from error
    return gsply


def _of_gsply(data: Any) -> SplatCloud:
    """Return what gsply has read: scales and opacities as in a 3DGS file, quaternions wxyz."""
    first = np.asarray(data.sh0, np.float32)[:, None]
    rest = [] if data.shN is None else [np.asarray(data.shN, np.float32).reshape(len(first), -1, 3)]
    with np.errstate(over="ignore", invalid="ignore"):
        return SplatCloud.of(
            np.asarray(data.means),
            np.asarray(data.quats)[:, [1, 2, 3, 0]],
            np.exp(np.asarray(data.scales)),
            expit(np.asarray(data.opacities, np.float32).reshape(-1)),
            np.concatenate([first, *rest], axis=1),
        )


def _read_gltf(path: Path) -> SplatCloud:
    """Return the splats of all primitives of the scene that is shown, in its axes."""
    gltf = read_gltf(path)
    found: list[SplatCloud] = []
    budget = path.stat().st_size + sum(len(gltf.buffer(index)) for index in range(len(gltf.items("buffers"))))
    for index, node in enumerate(gltf.items("nodes")):
        if not gltf.shown[index] or "mesh" not in node:
            continue
        for primitive in gltf.item("meshes", node["mesh"]).get("primitives", []):
            if _EXTENSION in (primitive.get("extensions") or {}):
                budget -= 32 * whole(_count(gltf, primitive), "number of splats", min(MAX_SPLATS, budget // 32), low=1)
                found.append(_placed(_primitive(gltf, primitive), gltf.world[index]))
    if not found:
        raise ValueError(f"no primitive of its scene has {_EXTENSION}; for a surface use the source glb or mesh")
    if len(found) == 1:
        return found[0]
    degree = min(cloud.degree for cloud in found)
    return SplatCloud(
        *(
            np.concatenate([getattr(cloud, name) for cloud in found])
            for name in SplatCloud.__annotations__
            if name != "sh"
        ),
        sh=np.concatenate([cloud.sh[:, : COEFFICIENTS[degree]] for cloud in found]),
    )


def _count(gltf: Gltf, primitive: dict[str, Any]) -> Any:
    return gltf.item("accessors", primitive["attributes"].get("POSITION")).get("count")


def _primitive(gltf: Gltf, primitive: dict[str, Any]) -> SplatCloud:
    """Return the splats of a primitive, in the space of its mesh."""
    attributes, count = primitive["attributes"], _count(gltf, primitive)
    extension, mode = primitive["extensions"][_EXTENSION], primitive.get("mode", 4)
    kernel, space = (str(extension.get(name, other)) for name, other in (("kernel", "ellipse"), ("colorSpace", "")))
    if mode != 0 or kernel != "ellipse":
        raise ValueError(f"its splats are of mode {mode!r:.20} and kernel {kernel:.40}, not 0 and ellipse")
    if space.startswith("lin"):
        raise ValueError(f"its colours are linear ({space:.40}); export them as srgb_rec709_display")

    def values(name: str, width: int) -> np.ndarray:
        if name not in attributes:
            raise ValueError(f"its splats have no attribute {name}")
        accessor = gltf.item("accessors", attributes[name])
        if "bufferView" not in accessor or accessor.get("count") != count:
            raise ValueError(f"{name} has {accessor.get('count')!r:.20} stored values of {count} splats")
        result = gltf.accessor(attributes[name])
        if result.shape[1] != width or result.dtype.kind != "f":
            raise ValueError(f"{name} has {result.shape[1]} numbers a splat of type {result.dtype}, not {width} floats")
        return result.astype(np.float32)

    degree = 0
    while degree < 3 and f"{_EXTENSION}:SH_DEGREE_{degree + 1}_COEF_0" in attributes:
        degree += 1
    sh = np.empty((count, COEFFICIENTS[degree], 3), np.float32)
    for k in range(COEFFICIENTS[degree]):
        own = int(np.sqrt(k))
        sh[:, k] = values(f"{_EXTENSION}:SH_DEGREE_{own}_COEF_{k - own * own}", 3)
    return SplatCloud.of(
        values("POSITION", 3),
        values(f"{_EXTENSION}:ROTATION", 4),
        values(f"{_EXTENSION}:SCALE", 3),
        values(f"{_EXTENSION}:OPACITY", 1)[:, 0],
        sh,
    )


def _placed(cloud: SplatCloud, matrix: np.ndarray) -> SplatCloud:
    """Return the splats of a node in the scene.

    Raises:
        ValueError: the node does not turn, move and scale evenly only.
    """
    size = float(np.cbrt(np.linalg.det(matrix[:3, :3])))
    if not (size > 1e-9 and np.allclose(matrix[:3, :3] @ matrix[:3, :3].T, size**2 * np.eye(3), atol=1e-4 * size**2)):
        raise ValueError("a node of its splats is mirrored or scaled unevenly; apply its transform before export")
    if np.array_equal(matrix, np.eye(4)):
        return cloud
    return cloud.placed(matrix[:3, :3] / size, size, matrix[:3, 3])
