"""The glTF reader: accessors, hierarchy, animations, colours, and files that are refused."""

from __future__ import annotations

import io
import json
import struct

import numpy as np
import pytest
from scipy.interpolate import CubicHermiteSpline
from scipy.spatial.transform import Rotation, Slerp

from piavatar_envs.avatar.gltf import read_gltf
from piavatar_envs.avatar.gltf_surfaces import read_surfaces
from scripts.gltf_files import Writer, glb
from tests.conftest import in_core_seconds


@pytest.fixture
def file(tmp_path):
    return tmp_path / "a.glb"


@pytest.mark.parametrize("code", ["i1", "u1", "i2", "u2", "u4", "f4"])
@pytest.mark.parametrize("kind", ["SCALAR", "VEC2", "VEC3", "VEC4", "MAT4"])
@pytest.mark.parametrize("way", ["plain", "sparse", "strided", "normalized"])
def test_accessors(code, kind, way, file):
    width = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}[kind]
    values = (np.random.default_rng(0).uniform(-100, 100, (9, width))).astype(f"<{code}")
    out = Writer()
    out.accessor(
        values, kind, stride=128 if way == "strided" else 0, sparse=way == "sparse", normalized=way == "normalized"
    )
    read = read_gltf(out.save(file)).accessor(0)
    if way == "normalized" and code != "f4":
        values = np.maximum(values / np.iinfo(code).max, -1.0)
    np.testing.assert_array_equal(read, values)


def test_columns_of_small_matrices_begin_at_four_bytes(file):
    out = Writer()
    rows = np.arange(2 * 12, dtype=np.uint8).reshape(2, 3, 4)
    out.add("accessors", {"componentType": 5121, "count": 2, "type": "MAT3", "bufferView": out.view(rows.tobytes())})
    np.testing.assert_array_equal(read_gltf(out.save(file)).accessor(0), rows[:, :, :3].reshape(2, 9))


@pytest.mark.parametrize("storage", ["glb", "file", "data"])
def test_buffers(storage, file):
    out = Writer()
    out.accessor(np.arange(5, dtype=np.uint16), "SCALAR")
    read = read_gltf(out.save(file, storage)).accessor(0)
    np.testing.assert_array_equal(read[:, 0], np.arange(5))


def test_hierarchy_of_transforms_and_matrices(file):
    out = Writer()
    turn = Rotation.from_euler("zyx", [0.3, -0.4, 0.5])
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = turn.as_matrix() * [2.0, 2.0, -2.0], (1.0, 2.0, 3.0)
    out.document["nodes"] = [  # the child comes first
        {
            "name": "hand",
            "translation": [0.0, 0.5, 0.0],
            "rotation": (2.0 * turn.as_quat()).tolist(),
            "scale": [1, 2, 3],
        },
        {"name": "arm", "matrix": matrix.T.ravel().tolist(), "children": [0]},
    ]
    gltf = read_gltf(out.save(file))
    local = np.eye(4)
    local[:3, :3], local[:3, 3] = turn.as_matrix() * [1.0, 2.0, 3.0], (0.0, 0.5, 0.0)
    assert gltf.parents.tolist() == [1, -1] and gltf.order.tolist() == [1, 0]
    np.testing.assert_allclose(gltf.world, [matrix @ local, matrix], atol=1e-12)


def test_animations_follow_their_interpolation(file):
    rng = np.random.default_rng(1)
    keys = np.array([0.5, 1.0, 2.0, 2.25], np.float32)
    turns = Rotation.random(4, rng=rng)
    places, cubic = rng.normal(size=(4, 3)).astype(np.float32), rng.normal(size=(4, 3, 3)).astype(np.float32)
    out = Writer()
    out.document["nodes"] = [{"translation": [1, 1, 1]}, {"children": [0]}, {}]
    times = out.accessor(keys, "SCALAR")
    quaternions = np.round(turns.as_quat() * 32767).astype("<i2")
    outputs = [
        ("rotation", "LINEAR", 0, out.accessor(quaternions, "VEC4", normalized=True)),
        ("translation", "STEP", 0, out.accessor(places, "VEC3")),
        ("translation", "CUBICSPLINE", 1, out.accessor(cubic.reshape(12, 3), "VEC3")),
        ("scale", "LINEAR", 2, out.accessor(places, "VEC3")),
    ]
    samplers = [{"input": times, "output": o, "interpolation": mode} for _, mode, _, o in outputs]
    channels = [{"sampler": i, "target": {"node": n, "path": p}} for i, (p, _, n, _) in enumerate(outputs)]
    channels.append({"sampler": 0, "target": {"node": 0, "path": "weights"}})
    out.document["animations"] = [{"name": "walk", "samplers": samplers, "channels": channels}]
    gltf = read_gltf(out.save(file))
    (walk,) = gltf.animations
    assert (walk.name, walk.start, walk.end, walk.rate, len(walk.tracks)) == ("walk", 0.5, 2.25, 2.0, 4)
    at = np.array([0.0, 0.5, 0.7, 1.0, 1.3, 2.2, 2.25, 9.0])
    inside = np.clip(at, 0.5, 2.25)
    translations, rotations, scales = gltf.local_at(walk, at)
    expected = Slerp(keys, turns)(inside)
    assert (Rotation.from_quat(rotations[:, 0]).inv() * expected).magnitude().max() < 1e-4
    np.testing.assert_allclose(translations[:, 0], places[[0, 0, 0, 1, 1, 2, 3, 3]])
    for first, last in ((0, 1), (1, 2), (2, 3)):  # the tangents are those of an interval's own two keys
        here = (at >= keys[first]) & (at < keys[last])
        pair = CubicHermiteSpline(keys[[first, last]], cubic[[first, last], 1], [cubic[first, 2], cubic[last, 0]])
        np.testing.assert_allclose(translations[here, 1], pair(at[here]), atol=1e-6)
    np.testing.assert_allclose(scales[:, 2, 0], np.interp(at, keys, places[:, 0]), atol=1e-6)
    world = gltf.world_at(walk, at)
    np.testing.assert_allclose(world[:, 0, :3, 3], translations[:, 0] + translations[:, 1], atol=1e-12)


def triangle(out: Writer, material: dict | None = None, **attributes) -> Writer:
    """Add a mesh of one triangle."""
    points = np.eye(3, dtype=np.float32)
    primitive = {"attributes": {"POSITION": out.accessor(points, "VEC3"), **attributes}}
    if material is not None:
        primitive["material"] = out.add("materials", material)
    out.add("nodes", {"mesh": out.add("meshes", {"primitives": [primitive]})})
    return out


def test_colours_are_factor_times_vertex_colour_times_texture(file):
    image = pytest.importorskip("PIL.Image", reason="needs the extra render")
    pixels = np.array([[[255, 0, 0], [0, 255, 0]], [[0, 0, 255], [188, 188, 188]]], np.uint8)
    stream = io.BytesIO()
    image.fromarray(pixels).save(stream, "PNG")
    out = Writer()
    out.add("images", {"bufferView": out.view(stream.getvalue()), "mimeType": "image/png"})
    out.add("textures", {"source": 0})
    uv = out.accessor(np.array([[0.25, 0.25], [0.75, 1.25], [0.75, 0.75]], np.float32), "VEC2")  # the second wraps
    half = out.accessor(np.full((3, 4), 128, np.uint8), "VEC4", normalized=True)
    factor = {"baseColorFactor": [1.0, 1.0, 0.5, 1.0], "baseColorTexture": {"index": 0}}
    triangle(out, {"name": "skin", "pbrMetallicRoughness": factor}, TEXCOORD_0=uv, COLOR_0=half)
    triangle(out)
    moved = {"index": 0, "extensions": {"KHR_texture_transform": {"offset": [0.5, 0.0]}}}
    triangle(out, {"pbrMetallicRoughness": factor | {"baseColorTexture": moved}}, TEXCOORD_0=uv)
    first, plain, moved = read_surfaces(read_gltf(out.save(file))).pieces
    # 188 is half of the light, and half of that again is 137, three quarters of it off are 99.
    np.testing.assert_allclose(first.colors, [[188, 0, 0], [0, 188, 0], [137, 137, 99]], atol=1)
    assert first.material == "skin" and (plain.colors == 255).all()
    np.testing.assert_allclose(moved.colors, [[0, 255, 0], [255, 0, 0], [0, 0, 188]], atol=1)


def test_an_unreadable_texture_is_a_note(file):
    pytest.importorskip("PIL.Image", reason="needs the extra render")
    out = Writer()
    out.add("images", {"bufferView": out.view(b"no picture")})
    out.add("textures", {"source": 0})
    uv = out.accessor(np.zeros((3, 2), np.float32), "VEC2")
    triangle(out, {"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}, TEXCOORD_0=uv)
    surfaces = read_surfaces(read_gltf(out.save(file)))
    assert (surfaces.pieces[0].colors == 255).all() and "texture 0 is left out" in surfaces.notes[0]


def test_a_skin_without_a_bind_pose_is_read_as_shown(file):
    """Vertices are then in the spaces of their bones, which have no pose of their own."""
    out = Writer()
    out.document["nodes"] = [{"children": [1]}, {"translation": [1.0, 2.0, 3.0]}]
    bones = out.accessor(np.array([[0, 1, 0, 0], [1, 0, 0, 0], [1, 0, 0, 0]], np.uint8), "VEC4")
    shares = np.array([[128, 128, 0, 0], [255, 0, 0, 0], [0, 0, 0, 0]], np.uint8)  # the last has none
    weights = out.accessor(shares, "VEC4", normalized=True)
    triangle(out, JOINTS_0=bones, WEIGHTS_0=weights)
    out.add("skins", {"joints": [0, 1]})
    out.document["nodes"][-1]["skin"] = 0
    surfaces = read_surfaces(read_gltf(out.save(file)))
    np.testing.assert_allclose(surfaces.places[0], [[1.5, 1.0, 1.5], [1.0, 3.0, 3.0], [0.0, 0.0, 1.0]])
    assert "do not agree" in surfaces.notes[-1] and "1 vertices" in surfaces.notes[0]


def test_skins_that_share_bones_agree_on_the_bind_pose(file):
    """The mesh of either skin is in a space of its own, from which its inverse bind matrices lead."""
    out = Writer()
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_euler("x", 90.0, degrees=True).as_matrix()
    out.document["nodes"] = [{"children": [1]}, {"translation": [0.0, 1.0, 0.0], "rotation": [0, 0, 0.6, 0.8]}]
    weights = out.accessor(np.tile(np.float32([1, 0, 0, 0]), (3, 1)), "VEC4")
    bones = out.accessor(np.zeros((3, 4), np.uint8), "VEC4")
    upper = np.eye(4)
    upper[1, 3] = -1.0  # bound without the turn that is shown
    for own in (np.eye(4), turn):
        binds = np.stack([np.eye(4), upper]) @ own
        matrices = out.accessor(binds.transpose(0, 2, 1).reshape(2, 16).astype("<f4"), "MAT4")
        out.add("skins", {"joints": [0, 1], "inverseBindMatrices": matrices})
        triangle(out, JOINTS_0=bones, WEIGHTS_0=weights)
        out.document["nodes"][-1]["skin"] = len(out.document["skins"]) - 1
    surfaces = read_surfaces(read_gltf(out.save(file)))
    np.testing.assert_allclose(surfaces.places[0], np.eye(3), atol=1e-6)
    np.testing.assert_allclose(surfaces.places[1], turn[:3, :3].T, atol=1e-6)
    np.testing.assert_allclose(surfaces.world[1], np.linalg.inv(upper), atol=1e-6)


def test_strips_and_fans_are_triangles(file):
    out = Writer()
    points = out.accessor(np.random.default_rng(0).normal(size=(5, 3)).astype(np.float32), "VEC3")
    modes = [{"attributes": {"POSITION": points}, "mode": mode} for mode in (5, 6, 1)]
    out.add("nodes", {"mesh": out.add("meshes", {"primitives": modes})})
    strip, fan = read_surfaces(read_gltf(out.save(file))).pieces
    assert strip.faces.tolist() == [[0, 1, 2], [2, 1, 3], [2, 3, 4]] and strip.faces.dtype == np.int64
    assert fan.faces.tolist() == [[0, 1, 2], [0, 2, 3], [0, 3, 4]]


@pytest.mark.parametrize(
    ("extension", "remedy"),
    [
        ("EXT_meshopt_compression", "gltf-transform"),
        ("KHR_meshopt_compression", "gltf-transform"),
        ("KHR_draco_mesh_compression", "gltf-transform"),
        ("XYZ_unheard_of", "export it without"),
    ],
)
def test_required_extensions_that_are_not_read_are_refused(extension, remedy, file):
    out = Writer()
    out.document["extensionsRequired"] = [extension]
    with pytest.raises(ValueError, match=f"requires {extension}.*{remedy}"):
        read_gltf(out.save(file))


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.fbx", b"Kaydara FBX Binary  \x00", "is FBX.*Blender"),
        ("renamed.glb", b"Kaydara FBX Binary  \x00", "is FBX.*Blender"),
        ("a.blend", b"BLENDER-v300", "is Blender.*Export"),
        ("a.dae", b"<?xml version='1.0'?>", "is Collada"),
        ("a.glb", b"glTF" + struct.pack("<II", 1, 20) + bytes(8), "GLB version 1"),
        ("a.glb", b"glTF" + struct.pack("<II", 2, 2**32 - 1), "cut off"),
        ("a.glb", b"glTF", "is not a glTF file"),
        ("a.glb", b"", "is not a glTF file"),
        ("a.gltf", b'{"asset": {"version": "1.0"}}', "2.0 is read"),
        ("a.gltf", b"\xff\xfe\x00", "is not a glTF file"),
        ("a.gltf", b"[" * 100_000, "is not a glTF file"),
        ("a.gltf", b'{"a": ' * 100_000, "is not a glTF file"),
        ("a.gltf", b"[" + b"[]," * 10_000_000 + b"0]", "brackets and commas"),
        ("a.gltf", b'{"asset": {"version": "2.0"}, "nodes": [{"translation": [NaN, 0, 0]}]}', "NaN"),
        ("a.gltf", b'{"asset": {"version": "2.0"}, "nodes": [{"translation": [1e999, 0, 0]}]}', "finite"),
    ],
)
def test_foreign_and_damaged_files_are_refused_in_one_line(name, content, message, tmp_path):
    path = tmp_path / name
    path.write_bytes(content)
    with in_core_seconds(1.0), pytest.raises(ValueError, match=message) as caught:
        read_gltf(path)
    assert "\n" not in str(caught.value) and str(path) in str(caught.value)


def chain(count: int) -> list[dict]:
    return [{"children": [index + 1]} for index in range(count - 1)] + [{}]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"nodes": [{"children": [1]}, {"children": [0]}]}, "cycle"),
        ({"nodes": [{"children": [0]}]}, "cycle"),
        ({"nodes": chain(5000)}, "deep"),
        ({"nodes": [{}] * 30_000}, "more than 20000"),
        ({"nodes": [{"children": [2]}, {"children": [2]}, {}]}, "hangs on"),
        ({"nodes": [{"children": [7]}]}, "child of node 0"),
        ({"nodes": [{"rotation": [0, 0, 0, 0]}]}, "norm"),
        ({"nodes": [{"scale": "big"}]}, "scale"),
        ({"nodes": 7}, "not a list"),
        ({"nodes": [{"mesh": 0.5}]}, "index of meshes"),
        ({"nodes": [{"mesh": -1}]}, "index of meshes"),
        ({"accessors": [{"componentType": 5126, "type": "VEC3", "count": 2**32 - 1}]}, "count"),
        ({"accessors": [{"componentType": 5126, "type": "VEC3", "count": -3, "bufferView": 0}]}, "count"),
        ({"accessors": [{"componentType": 5126, "type": "VEC3", "count": 10**6, "bufferView": 0}]}, "its buffer view"),
        ({"accessors": [{"componentType": 5126, "type": "VEC3", "count": 3, "bufferView": 9}]}, "bufferViews"),
        (
            {"accessors": [{"componentType": 5126, "type": "VEC3", "count": 3, "bufferView": 0, "byteOffset": 30}]},
            "view",
        ),
        ({"accessors": [{"componentType": 99, "type": "VEC3", "count": 3}]}, "components 99"),
        ({"bufferViews": [{"buffer": 0, "byteLength": 2**40}]}, "length of buffer view"),
        ({"bufferViews": [{"buffer": 0, "byteLength": 36, "byteStride": 2}]}, "stride"),
        ({"buffers": [{"byteLength": 2**40}]}, "length of buffer"),
        ({"buffers": [{"byteLength": 36, "uri": "/etc/hostname"}]}, "outside"),
        ({"buffers": [{"byteLength": 36, "uri": "../x.bin"}]}, "outside"),
        ({"buffers": [{"byteLength": 36, "uri": "http://example.org/x.bin"}]}, "outside"),
        ({"buffers": [{"byteLength": 36, "uri": "x.bin"}]}, "not beside"),
        ({"buffers": [{"byteLength": 36, "uri": "data:,%00"}]}, "base64"),
        ({"buffers": [{"byteLength": 36, "uri": "data:a;base64,*"}]}, "base64"),
        ({"skins": [{"joints": [5]}]}, "joint of skin"),
        ({"skins": [{"joints": []}]}, "no joints"),
    ],
)
def test_hostile_documents_are_refused_in_a_second(change, message, file):
    out = triangle(Writer())
    out.save(file)
    out.document["buffers"] = [{"byteLength": len(out.blob)}]
    file.write_bytes(glb(json.dumps(out.document | change).encode(), bytes(out.blob)))
    with in_core_seconds(1.0), pytest.raises(ValueError, match=message) as caught:
        read_surfaces(read_gltf(file))
    assert "\n" not in str(caught.value) and str(file) in str(caught.value)


def test_values_that_are_not_finite_are_refused(file):
    out = Writer()
    out.accessor(np.array([[0.0, np.nan, 0.0]] * 3, np.float32), "VEC3")
    out.add("nodes", {"mesh": out.add("meshes", {"primitives": [{"attributes": {"POSITION": 0}}]})})
    with pytest.raises(ValueError, match="accessor 0 holds values that are not finite"):
        read_surfaces(read_gltf(out.save(file)))


def test_indices_and_instances_are_bounded(file):
    out = triangle(Writer())
    primitive = out.document["meshes"][0]["primitives"][0]
    primitive["indices"] = out.accessor(np.array([0, 1, 3], np.uint16), "SCALAR")
    with pytest.raises(ValueError, match="reach from 0 to 3 of 3"):
        read_surfaces(read_gltf(out.save(file)))
    many = out.accessor(np.tile(np.arange(3, dtype=np.uint8), 100_000), "SCALAR")
    primitive["indices"] = many
    out.document["nodes"] *= 10_000  # 10,000 times 100,000 triangles
    with in_core_seconds(1.0), pytest.raises(ValueError, match=r"over \d+ vertices.*simplify"):
        read_surfaces(read_gltf(out.save(file)))
