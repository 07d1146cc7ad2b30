"""Splats: covariances and colours that turn with them, files that are read and written, and files that are refused."""

from __future__ import annotations

import struct
import time
import tracemalloc

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from piavatar_envs.avatar.body.sources import load_asset
from piavatar_envs.avatar.body.splat_files import read_splats, write_ply
from piavatar_envs.avatar.body.splats import SplatCloud, harmonics, turned_colors
from piavatar_envs.core.extras import MissingExtra
from scripts.gltf_files import Y_UP
from scripts.synthetic_splats import on_body
from tests.avatar.fuzz_splats import SPARE_BYTES, fuzz, gltf_of, ply, with_rows

FIELDS = ("means", "rotations", "scales", "opacities", "sh")


@pytest.fixture(scope="module")
def cloud() -> SplatCloud:
    return on_body(load_asset(), 300, degree=3)


def assert_equal(one: SplatCloud, other: SplatCloud, tolerance: float) -> None:
    for name in FIELDS:
        first, second = getattr(one, name), getattr(other, name)
        if name == "rotations":  # q and -q are one rotation
            first = first * np.sign((first * second).sum(axis=1, keepdims=True))
        np.testing.assert_allclose(first, second, atol=tolerance, rtol=tolerance)


@pytest.mark.parametrize("form", ["binary_little_endian", "binary_big_endian", "ascii"])
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_forms_of_ply(cloud, form, degree, tmp_path):
    own = SplatCloud(*(getattr(cloud, name) for name in FIELDS[:-1]), cloud.sh[:, : (degree + 1) ** 2])
    names, rows = with_rows(own, ">" if "big" in form else "<")
    (tmp_path / "a.ply").write_bytes(ply(names, rows, form))
    read = read_splats(tmp_path / "a.ply")
    assert_equal(read, own, 2e-6)
    write_ply(tmp_path / "b.ply", read)
    assert_equal(read_splats(tmp_path / "b.ply"), read, 2e-6)


def test_elements_before_the_vertices_are_skipped(cloud, tmp_path):
    names, rows = with_rows(cloud, "<")
    content = ply(names, rows, "binary_little_endian", "element camera 2\nproperty double f\nproperty uchar k\n")
    end = content.index(b"end_header\n") + len(b"end_header\n")
    (tmp_path / "a.ply").write_bytes(content[:end] + bytes(18) + content[end:])
    assert_equal(read_splats(tmp_path / "a.ply"), cloud, 2e-6)


def test_gltf(cloud, tmp_path):
    read = read_splats(gltf_of(cloud, tmp_path / "a.glb")).placed(Y_UP.T, 1.0, np.zeros(3))
    assert_equal(read, cloud.placed(np.eye(3), 2.0, np.array([0.0, 0.0, 1.0])), 1e-5)
    with pytest.raises(ValueError, match="kernel"):
        read_splats(gltf_of(cloud, tmp_path / "b.glb", mode=4))
    with pytest.raises(ValueError, match=r"linear \(lin_rec709_display\)"):
        read_splats(gltf_of(cloud, tmp_path / "b.glb", "lin_rec709_display"))


def test_colours_turn_with_their_splats(cloud):
    turns = Rotation.random(len(cloud), rng=np.random.default_rng(1)).as_matrix()
    seen = Rotation.random(rng=np.random.default_rng(2)).as_matrix()[0]
    found = np.einsum("k,skc->sc", harmonics(seen, 3), turned_colors(cloud.sh, turns))
    before = np.einsum("sk,skc->sc", harmonics(np.einsum("sji,j->si", turns, seen), 3), cloud.sh)
    np.testing.assert_allclose(found, before, atol=1e-5)


def test_a_deformed_cloud_has_the_covariances_given(cloud):
    stretch = np.random.default_rng(0).normal(size=(3, 3))
    covariances = stretch @ cloud.covariances() @ stretch.T
    moved = SplatCloud.deformed(cloud, cloud.means, covariances)
    scale = np.trace(covariances, axis1=1, axis2=2)[:, None, None]
    np.testing.assert_allclose(moved.covariances() / scale, covariances / scale, atol=1e-6)


def header_of(lines: str, form: str = "binary_little_endian") -> bytes:
    names = "x y z f_dc_0 f_dc_1 f_dc_2 opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3".split()
    properties = "".join(f"property float {name}\n" for name in names)
    return f"ply\nformat {form} 1.0\n{lines}{properties}end_header\n".encode()


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.ply", b"", "PLY header"),
        ("a.ply", b"ply\nformat binary_little_endian 1.0\nelement vertex 9\n", "PLY header"),
        ("a.ply", header_of("element vertex 4000000\n"), "4000000 vertex rows, and 0 follow"),
        ("a.ply", header_of("element vertex 4000000000\n"), r"4000000000 splats, outside \[1, 10000000\]"),
        ("a.ply", header_of("element vertex 4000000\n", "ascii"), "4000000 rows of 14 numbers"),
        ("a.ply", header_of("element vertex 0\n"), "0 splats"),
        ("a.ply", header_of("element face 1\nproperty list uchar int i\nelement vertex 1\n") + bytes(56), "lists"),
        ("a.ply", header_of("element vertex 1\nproperty float f_rest_0\n") + bytes(60), "1 properties f_rest_i"),
        ("a.ply", header_of("element vertex 1\n") + bytes(56), "quaternion of splat 0 is zero"),
        ("a.ply", header_of("element vertex 1\n") + b"\xff" * 56, "splat 0 are not finite"),
        ("a.ply", header_of("element vertex 1\nproperty float3 q\n"), "the line 'property float3 q'"),
        ("a.ply", header_of("element vertex 1\n").replace(b"rot_3", b"rot_4"), "no property rot_3.*source mesh"),
        ("a.ply", header_of("element vertex 1\n").replace(b"float x", b"uchar x"), "x is of type u1"),
        ("a.ply", header_of("element vertex 1\n", "ascii") + b"1 2 x " * 5, "row 0 .* 15 numbers, not 14"),
        ("a.spz", b"NGSP", "no SPZ of version 2 or 3"),
        ("a.spz", b"\x1f\x8b123456", "a.spz is not a file"),
        ("a.glb", b"glTF", "a.glb is not a"),
        ("a.splat", b"", "use one of .ply, .spz"),
    ],
)  # fmt: skip
def test_files_that_are_no_splats_are_refused(name, content, message, tmp_path):
    (tmp_path / name).write_bytes(content)
    began = time.perf_counter()
    with pytest.raises(ValueError, match=message) as error:
        read_splats(tmp_path / name)
    assert time.perf_counter() - began < 1.0 and "\n" not in str(error.value)
    with pytest.raises(FileNotFoundError):
        read_splats(tmp_path / "none.ply")


def test_memory_stays_within_four_times_the_file(cloud, tmp_path):
    many = cloud.chosen(np.arange(20_000) % len(cloud))
    write_ply(tmp_path / "a.ply", many)
    gltf_of(many, tmp_path / "a.glb")
    for name in ("a.ply", "a.glb"):
        tracemalloc.start()
        read_splats(tmp_path / name)
        most = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert most < 4 * (tmp_path / name).stat().st_size


def test_damaged_files_are_read_or_refused(cloud, tmp_path):
    for found in fuzz(cloud.chosen(np.arange(5)), 120, tmp_path):
        assert found["refused"] > 20 and found["cpu_seconds"] < 1.0
        assert found["spare_bytes"] < SPARE_BYTES


def test_an_spz_that_promises_more_than_it_holds_is_refused_without_gsply(tmp_path):
    import gzip

    for count, message in ((1_000_000, "20000016 bytes of 1000000 splats"), (2**32 - 1, "4294967295 splats")):
        head = struct.pack("<IIIBBBB", 0x5053474E, 3, count, 0, 12, 0, 0)
        (tmp_path / "a.spz").write_bytes(gzip.compress(head))
        with pytest.raises(ValueError, match=message):
            read_splats(tmp_path / "a.spz")
    (tmp_path / "a.spz").write_bytes(gzip.compress(bytes(10_000_000)))
    with pytest.raises(ValueError, match="64 times its size"):
        read_splats(tmp_path / "a.spz")


def test_an_spz_of_version_1_is_refused_by_name(tmp_path):
    """Its places have 6 bytes, those of the later versions 9."""
    import gzip

    for size in (16, 19):
        head = struct.pack("<IIIBBBB", 0x5053474E, 1, 10, 0, 12, 0, 0)
        (tmp_path / "a.spz").write_bytes(gzip.compress(head + bytes(range(10)) * size))
        with pytest.raises(ValueError, match=r"SPZ of version 1, .*save it anew, or as \.ply"):
            read_splats(tmp_path / "a.spz")


def test_gsply_reads_the_same(cloud, tmp_path):
    gsply = pytest.importorskip("gsply")
    write_ply(tmp_path / "a.ply", cloud)
    other = gsply.plyread(tmp_path / "a.ply")
    own = read_splats(tmp_path / "a.ply")
    np.testing.assert_allclose(other.means, own.means, atol=1e-6)
    np.testing.assert_allclose(other.quats[:, [1, 2, 3, 0]], own.rotations, atol=1e-6)
    np.testing.assert_allclose(np.exp(other.scales), own.scales, atol=1e-6)
    np.testing.assert_allclose(1.0 / (1.0 + np.exp(-other.opacities.ravel())), own.opacities, atol=1e-6)
    np.testing.assert_allclose(np.concatenate([other.sh0[:, None], other.shN], axis=1), own.sh, atol=1e-6)
    (tmp_path / "b.ply").write_bytes(gsply.compress_to_bytes(other))
    gsply.write_spz(tmp_path / "c.spz", other)
    for path in (tmp_path / "b.ply", tmp_path / "c.spz"):
        read = read_splats(path)
        order = np.linalg.norm(read.means[:, None] - own.means, axis=2).argmin(axis=1)
        np.testing.assert_allclose(read.means, own.means[order], atol=3e-3)
        np.testing.assert_allclose(read.covariances(), own.covariances()[order], rtol=0.2, atol=1e-4)
        np.testing.assert_allclose(read.sh[:, 0], own.sh[order, 0], atol=0.05)


def test_packed_files_name_the_extra(cloud, tmp_path):
    try:
        import gsply  # noqa: F401
    except ImportError:
        pass
    else:
        pytest.skip("gsply is installed")
    import gzip

    head = struct.pack("<IIIBBBB", 0x5053474E, 3, 1, 0, 12, 0, 0)
    (tmp_path / "a.spz").write_bytes(gzip.compress(head + bytes(20)))
    with pytest.raises(MissingExtra, match=r"gsply.*\[splats\]"):
        read_splats(tmp_path / "a.spz")
