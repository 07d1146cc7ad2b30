"""Damage files of splats at random: readers return splats or one line of refusal, soon, and within four times the file.

The tests take some hundreds of inputs; for 100,000, with the compressed forms where gsply is installed::

    python -m tests.avatar.fuzz_splats --inputs 100000 --out fuzz.json
"""

from __future__ import annotations

import gzip
import time
import tracemalloc
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from benchmarks import runner
from piavatar_envs.avatar.body.sources import load_asset
from piavatar_envs.avatar.body.splat_files import read_splats, write_ply
from piavatar_envs.avatar.body.splats import SplatCloud
from scripts.gltf_files import Y_UP, Writer
from scripts.synthetic_splats import on_body

#: Memory beyond four times the file that a message, or the header of an archive, may take [bytes].
SPARE_BYTES = 500_000
GZIP = b"\x1f\x8b"


# ---- whole files


def with_rows(cloud: SplatCloud, order: str) -> tuple[list[str], np.ndarray]:
    """Return the names and values of a 3DGS file."""
    rest = cloud.sh[:, 1:].transpose(0, 2, 1).reshape(len(cloud), -1)
    names = ["opacity", *(f"scale_{i}" for i in range(3)), *(f"rot_{i}" for i in range(4)), "x", "y", "z"]
    names += [*(f"f_dc_{i}" for i in range(3)), *(f"f_rest_{i}" for i in range(rest.shape[1]))]
    o = cloud.opacities.astype(np.float64)
    columns = [np.log(o / (1.0 - o))[:, None], np.log(cloud.scales), np.roll(cloud.rotations, 1, axis=1), cloud.means]
    return names, np.concatenate([*columns, cloud.sh[:, 0], rest], axis=1).astype(f"{order}f4")


def ply(names: list[str], rows: np.ndarray, form: str, before: str = "") -> bytes:
    header = f"ply\nformat {form} 1.0\ncomment x\n{before}element vertex {len(rows)}\n"
    header += "".join(f"property float {name}\n" for name in names) + "end_header\n"
    if form == "ascii":
        return (header + "".join(" ".join(f"{value:.9g}" for value in row) + "\n" for row in rows)).encode()
    return header.encode() + rows.tobytes()


def gltf_of(cloud: SplatCloud, path, space: str = "srgb_rec709_display", **change):
    """Write a cloud in glTF's axes."""
    turned = cloud.placed(Y_UP, 1.0, np.zeros(3))
    out = Writer()
    names = {"POSITION": turned.means, "ROTATION": turned.rotations, "SCALE": turned.scales}
    names |= {"OPACITY": turned.opacities[:, None]}
    for k in range(turned.sh.shape[1]):
        names[f"SH_DEGREE_{int(k**0.5)}_COEF_{k - int(k**0.5) ** 2}"] = turned.sh[:, k]
    kinds = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}
    attributes = {
        name if name == "POSITION" else f"KHR_gaussian_splatting:{name}": out.accessor(array, kinds[array.shape[1]])
        for name, array in names.items()
    }
    extension = {"kernel": "ellipse", "colorSpace": space}
    primitive = {"mode": 0, "attributes": attributes, "extensions": {"KHR_gaussian_splatting": extension}}
    out.add("meshes", {"primitives": [primitive | change]})
    out.document["nodes"] = [{"mesh": 0, "scale": [2.0, 2.0, 2.0], "translation": [0.0, 1.0, 0.0]}]
    out.document["extensionsUsed"] = out.document["extensionsRequired"] = ["KHR_gaussian_splatting"]
    return out.save(path)


def files_of(cloud: SplatCloud, folder: Path) -> dict[str, bytes]:
    """Return a cloud as a file of every form, by file name; the compressed forms where gsply is installed."""
    names, rows = with_rows(cloud, "<")
    files = {"binary.ply": ply(names, rows, "binary_little_endian"), "ascii.ply": ply(names, rows, "ascii")}
    files["whole.glb"] = Path(gltf_of(cloud, folder / "whole.glb")).read_bytes()
    try:
        import gsply
    except ImportError:
        return files
    write_ply(folder / "own.ply", cloud)
    other = gsply.plyread(folder / "own.ply")
    gsply.write_spz(folder / "whole.spz", other)
    return files | {"compressed.ply": gsply.compress_to_bytes(other), "whole.spz": (folder / "whole.spz").read_bytes()}


# ---- damage


def mutations(content: bytes, rng: np.random.Generator, count: int):
    """Yield damaged copies: bytes changed anywhere or in the header, numbers exchanged, cut off, doubled parts."""
    for _ in range(count):
        damaged, way = bytearray(content), rng.integers(5)
        if way == 0:
            for _ in range(rng.integers(1, 6)):
                damaged[rng.integers(len(damaged))] = rng.integers(256)
        elif way == 1:
            for _ in range(rng.integers(1, 4)):
                damaged[rng.integers(min(1200, len(damaged)))] = rng.integers(256)
        elif way == 2:
            digits = [i for i, value in enumerate(damaged[:3000]) if chr(value).isdigit()]
            for _ in range(rng.integers(1, 4) if digits else 0):
                damaged[digits[rng.integers(len(digits))]] = ord("0") + rng.integers(10)
        elif way == 3:
            del damaged[rng.integers(len(damaged)) :]
        else:
            first, last = np.sort(rng.integers(len(damaged), size=2))
            damaged[last:last] = damaged[first:last]
        yield bytes(damaged)


def damaged_files(content: bytes, rng: np.random.Generator, count: int) -> Iterator[bytes]:
    """Yield damaged copies of a file; of an archive mostly of what it holds, as few others can be unpacked."""
    if not content.startswith(GZIP):
        yield from mutations(content, rng, count)
        return
    packed = mutations(content, rng, count)
    for inside in mutations(gzip.decompress(content), rng, count):
        yield gzip.compress(inside, 1) if rng.random() < 0.8 else next(packed)


def fuzz(cloud: SplatCloud, count: int, folder: Path) -> Iterator[dict[str, Any]]:
    """Read ``count`` damaged files of every form.

    Args:
        cloud: the splats of the whole files.
        count: damaged files of each form.
        folder: of the files.

    Yields:
        Of a form: its name, size [bytes], files refused and read, the longest time of a core [s], and the most memory
        of a reader beyond four times its file [bytes].

    Raises:
        AssertionError: a message of several lines, or splats that are not finite.
    """
    for name, content in files_of(cloud, folder).items():
        found = {"case": name, "size": len(content), "refused": 0, "read": 0, "cpu_seconds": 0.0, "spare_bytes": 0}
        inputs = damaged_files(content, np.random.default_rng(0), count)
        (folder / name).write_bytes(content)
        read_splats(folder / name)  # modules are imported, and functions compiled
        tracemalloc.start()
        try:
            for damaged in runner.progress(inputs, name, count):
                (folder / name).write_bytes(damaged)
                tracemalloc.reset_peak()
                held, began = tracemalloc.get_traced_memory()[0], time.process_time()
                try:
                    assert np.isfinite(read_splats(folder / name).means).all()
                    found["read"] += 1
                except ValueError as error:
                    assert "\n" not in str(error)
                    found["refused"] += 1
                found["cpu_seconds"] = max(found["cpu_seconds"], time.process_time() - began)
                most = tracemalloc.get_traced_memory()[1] - held - 4 * len(damaged)
                found["spare_bytes"] = max(found["spare_bytes"], most)
        finally:
            tracemalloc.stop()
        yield found


@dataclass(frozen=True)
class Options(runner.Options):
    """Options of the run."""

    #: damaged files, of all forms together
    inputs: int = 100_000
    #: splats of a whole file
    splats: int = 20


def cases(options: Options) -> Iterator[dict[str, Any]]:
    """Yield the rows of all forms."""
    with TemporaryDirectory() as folder:
        cloud = on_body(load_asset(), options.splats, degree=3)
        forms = len(files_of(cloud, Path(folder)))
        for found in fuzz(cloud, -(-options.inputs // forms), Path(folder)):
            assert found["cpu_seconds"] < 1.0 and found["spare_bytes"] < SPARE_BYTES, found
            yield found


if __name__ == "__main__":
    runner.main("fuzz_splats", cases, Options)
