"""Files of films: read back, positions, colours and times are those of the scenes."""

from __future__ import annotations

import sys

import numpy as np
import pytest

from piavatar_envs.avatar.body.textures import CLAMP, MIRROR, REPEAT, Texture, Textures
from piavatar_envs.avatar.gltf import read_gltf
from piavatar_envs.avatar.gltf_surfaces import read_surfaces
from piavatar_envs.core.srgb import linear_to_srgb
from piavatar_envs.render.coloring import color_by
from piavatar_envs.render.film import Film
from piavatar_envs.render.film_files import film_writer, glb_size
from piavatar_envs.render.scene import Body, Box, Scene, Solid, Sphere

RATE, FRAMES = 25.0, 6
FACES = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], dtype=np.int32)
COLORS = np.array([[250, 3, 0], [0, 200, 40], [0, 0, 255], [128, 128, 128]], dtype=np.uint8)


def shape(frame: int) -> np.ndarray:
    """Vertices of a tetrahedron that is bent more from frame to frame, but for one in which it rests."""
    rest = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0.1, 0.2, 1.7]], dtype=np.float32)
    bent = rest + 0.1 * max(frame, 1) * np.sin(3.0 * rest[:, [1, 2, 0]] + 1.0)
    return bent.astype(np.float32)


def write(folder, kind: str, **body) -> list:
    """Write a body that moves, a box that stays, and a sphere in two of the frames."""
    writer = film_writer(folder, kind, RATE)
    for frame in range(FRAMES):
        markers = [Box(np.zeros(3), np.ones(3))]
        if frame in (2, 4):
            markers.append(Sphere(np.array([0.5 * frame, 0.0, 1.0]), 0.1))
        if "scalars" in body:
            body["scalars"] = np.full(4, 0.1 * frame)
        writer.add(Scene([Body(shape(frame), FACES, **(body or {"colors": COLORS}))], markers))
    return writer.finish()


def z_up(points: np.ndarray) -> np.ndarray:
    """Positions of a glTF file in the suite's axes."""
    return np.stack([points[..., 0], -points[..., 2], points[..., 1]], axis=-1)


def played(gltf, node: int) -> tuple[np.ndarray, np.ndarray]:
    """Positions of a node's mesh at every key of its weights, ``(frames, V, 3)``, and those times."""
    primitive = gltf.json["meshes"][gltf.json["nodes"][node]["mesh"]]["primitives"][0]
    base = gltf.accessor(primitive["attributes"]["POSITION"])
    animation = gltf.json["animations"][0]
    channels = [c for c in animation["channels"] if c["target"] == {"node": node, "path": "weights"}]
    if not channels:
        return z_up(base)[None], np.zeros(1)
    sampler = animation["samplers"][channels[0]["sampler"]]
    times = gltf.accessor(sampler["input"])[:, 0]
    weights = gltf.accessor(sampler["output"]).reshape(len(times), -1)
    targets = np.stack([gltf.accessor(target["POSITION"]) for target in primitive["targets"]])
    return z_up(base + np.einsum("tk,kvi->tvi", weights, targets)), times


def test_gltf_plays_the_same_positions(tmp_path):
    (path,) = write(tmp_path / "new", "glb")
    gltf = read_gltf(path)
    assert gltf.names == ["body_0", "box_0", "sphere_1"]
    positions, times = played(gltf, 0)
    np.testing.assert_allclose(times, np.arange(FRAMES) / RATE, rtol=1e-6)
    np.testing.assert_allclose(positions, [shape(frame) for frame in range(FRAMES)], atol=1e-5)
    box, _ = played(gltf, 1)
    np.testing.assert_allclose(box[0], Box(np.zeros(3), np.ones(3)).mesh()[0], atol=1e-5)
    sphere, _ = played(gltf, 2)
    np.testing.assert_allclose(sphere[4], Sphere(np.array([2.0, 0.0, 1.0]), 0.1).mesh()[0], atol=1e-5)
    (track,) = gltf.animations[0].tracks  # it is there in two frames
    assert track.node == 2 and track.path == "scale" and track.mode == "STEP"
    np.testing.assert_array_equal(track.values[:, 0], [0, 0, 1, 0, 1, 0])


def test_gltf_keeps_colours_triangles_and_smooth_normals(tmp_path):
    gltf = read_gltf(write(tmp_path, "glb")[0])
    primitive = gltf.json["meshes"][0]["primitives"][0]
    colors = gltf.accessor(primitive["attributes"]["COLOR_0"])
    np.testing.assert_allclose(linear_to_srgb(colors[:, :3]) * 255.0, COLORS, atol=0.3)
    np.testing.assert_array_equal(gltf.accessor(primitive["indices"]).reshape(-1, 3), FACES)
    assert len(primitive["targets"]) == FRAMES - 2  # the first two shapes are the same
    # a sphere's normals are its radii
    primitive = gltf.json["meshes"][2]["primitives"][0]
    center = np.array([1.0, 1.0, 0.0])  # y up
    radii = (gltf.accessor(primitive["attributes"]["POSITION"]) - center) / 0.1
    normals = gltf.accessor(primitive["attributes"]["NORMAL"])
    assert (np.einsum("vi,vi->v", normals, radii) > 0.97).all()


def test_gltf_has_holes(tmp_path):
    pytest.importorskip("PIL", reason="needs the extra render")
    rng = np.random.default_rng(0)
    pixels = rng.integers(0, 255, (2, 5, 7, 3)).astype(np.uint8)
    images = Texture(pixels[0], alpha=pixels[1, ..., 0], cutoff=0.3), Texture(pixels[0])
    textures = Textures(images, np.array([1, 1, 0, 0]), np.zeros((4, 2), np.float32), COLORS)
    (path,) = write(tmp_path, "glb", colors=textures.colors(FACES), textures=textures)
    whole, holed = (piece.textures.images[0] for piece in read_surfaces(read_gltf(path)).pieces[:2])
    if whole.alpha is not None:
        whole, holed = holed, whole
    assert whole.alpha is None and holed.cutoff == 0.3 and np.array_equal(holed.alpha, images[0].alpha)
    assert np.array_equal(holed.pixels, images[0].pixels)


def test_gltf_has_textures(tmp_path):
    pytest.importorskip("PIL", reason="needs the extra render")
    rng = np.random.default_rng(0)
    images = tuple(
        Texture(rng.integers(0, 255, (5, 7, 3)).astype(np.uint8), (CLAMP, wrap)) for wrap in (MIRROR, REPEAT)
    )
    uv = rng.uniform(-1.0, 2.0, (4, 2)).astype(np.float32)
    textures = Textures(images, np.array([1, -1, 0, 1]), uv, COLORS)
    (path,) = write(tmp_path, "glb", colors=textures.colors(FACES), textures=textures)
    pieces = read_surfaces(read_gltf(path)).pieces[:3]
    for piece, index in zip(pieces, (-1, 0, 1), strict=True):
        own = FACES[textures.image == index]
        np.testing.assert_allclose(z_up(piece.points)[piece.faces], shape(0)[own], atol=1e-6)
        tints = COLORS[own]
        if index < 0:
            assert piece.textures is None
            assert np.abs(piece.colors[piece.faces].astype(int) - tints).max() <= 1
            continue
        (image,) = piece.textures.images
        assert np.array_equal(image.pixels, images[index].pixels) and image.wraps == images[index].wraps
        np.testing.assert_allclose(piece.textures.uv[piece.faces], uv[own], atol=1e-6)
        assert np.abs(piece.textures.tints[piece.faces].astype(int) - tints).max() <= 1
    positions, _ = played(read_gltf(path), 0)  # all parts of a mesh have the same targets
    np.testing.assert_allclose(positions, [shape(frame) for frame in range(FRAMES)], atol=1e-5)
    primitives = read_gltf(path).json["meshes"][0]["primitives"]
    assert all(part["targets"] == primitives[0]["targets"] for part in primitives)


def test_ply_has_a_file_for_each_mesh_and_frame(tmp_path):
    trimesh = pytest.importorskip("trimesh")
    folders = write(tmp_path, "ply", scalars=None)
    assert [folder.name for folder in folders] == ["body_0", "box_0", "sphere_1"]
    assert sorted(file.name for file in folders[2].iterdir()) == ["0002.ply", "0004.ply"]
    for frame in range(FRAMES):
        mesh = trimesh.load(folders[0] / f"{frame:04d}.ply", process=False)
        np.testing.assert_allclose(mesh.vertices, shape(frame), atol=1e-5)
        np.testing.assert_array_equal(mesh.faces, FACES)
        expected = np.rint(255.0 * color_by(np.full(4, 0.1 * frame), 0.3))
        np.testing.assert_array_equal(mesh.visual.vertex_colors[:, :3], expected)


def test_usd_has_points_colours_and_visibility_in_time(tmp_path):
    usd = pytest.importorskip("pxr.Usd", reason="needs the extra usd")
    from pxr import UsdGeom

    stage = usd.Stage.Open(str(write(tmp_path, "usd")[0]))
    assert (stage.GetTimeCodesPerSecond(), stage.GetEndTimeCode()) == (RATE, FRAMES - 1)
    assert UsdGeom.GetStageUpAxis(stage) == "Z" and UsdGeom.GetStageMetersPerUnit(stage) == 1.0
    body, sphere = (UsdGeom.Mesh(stage.GetPrimAtPath(f"/film/{name}")) for name in ("body_0", "sphere_1"))
    for frame in range(FRAMES):
        np.testing.assert_allclose(body.GetPointsAttr().Get(frame), shape(frame), atol=1e-5)
        seen = sphere.GetVisibilityAttr().Get(frame)
        assert seen == ("inherited" if frame in (2, 4) else "invisible")
    colors = linear_to_srgb(np.array(body.GetDisplayColorAttr().Get(3))) * 255.0
    np.testing.assert_allclose(colors, COLORS, atol=0.3)


def test_markers_keep_their_names_when_others_are_hidden(tmp_path):
    writer = film_writer(tmp_path, "glb", RATE)
    for shown in ([0, 1], [1], [0, 1]):
        solids = [Solid("box", shape(3 * i), FACES, ((1, 0, 0), (0, 0, 1))[i], i) for i in shown]
        writer.add(Scene([], [*solids, Sphere(np.zeros(3), 0.1, (0.0, len(shown) / 2, 0.0))]))
    gltf = read_gltf(writer.finish()[0])
    assert gltf.names == ["box_0", "box_1", "sphere_2", "sphere_1"]  # one sphere changes colour and place
    scaled = {gltf.names[track.node]: track.values[:, 0].tolist() for track in gltf.animations[0].tracks}
    assert scaled == {"box_0": [1, 0, 1], "sphere_2": [1, 0, 1], "sphere_1": [0, 1, 0]}


def test_a_full_gltf_file_keeps_the_frames_before(tmp_path, monkeypatch):
    film, sizes = Film(RATE), []
    scenes = [Scene([Body(shape(frame), FACES, colors=COLORS)], []) for frame in range(FRAMES)]
    for scene in scenes:
        film.add(scene)
        sizes.append(glb_size(film))
    film.add(Scene(scenes[0].bodies, [Sphere(np.zeros(3), 0.1)]))
    assert glb_size(film) > sizes[-1]
    film.drop()
    assert glb_size(film) == sizes[-1] and [mesh.name for mesh in film.meshes] == ["body_0"]
    monkeypatch.setattr("piavatar_envs.render.film_files.MAX_GLB", sizes[3])
    writer = film_writer(tmp_path, "glb", RATE)
    with pytest.warns(UserWarning, match="4 frames fill") as caught:
        for scene in scenes:
            writer.add(scene)
    (path,) = writer.finish()
    assert len(caught) == 1 and path.stat().st_size <= sizes[3]
    positions, _ = played(read_gltf(path), 0)
    np.testing.assert_allclose(positions, [shape(frame) for frame in range(4)], atol=1e-5)


@pytest.mark.parametrize("kind", ["glb", "ply", "usd"])
def test_what_is_not_finite_is_left_out(tmp_path, kind):
    if kind == "usd":
        pytest.importorskip("pxr.Usd", reason="needs the extra usd")
    writer = film_writer(tmp_path, kind, RATE)
    with pytest.warns(UserWarning, match="body_1 is not finite") as caught:
        for frame in range(3):
            failed = shape(frame)
            failed[frame:] = np.nan if frame else np.inf
            writer.add(Scene([Body(shape(frame), FACES), Body(shape(0) if frame == 1 else failed, FACES)], []))
    assert len(caught) == 1
    paths = writer.finish()
    if kind == "ply":
        assert [file.name for file in paths[1].iterdir()] == ["0001.ply"]
    elif kind == "glb":
        gltf = read_gltf(paths[0])
        np.testing.assert_array_equal(gltf.animations[0].tracks[0].values[:, 0], [0, 1, 0])
        np.testing.assert_allclose(played(gltf, 1)[0][0], shape(0), atol=1e-5)
    else:
        from pxr import Usd, UsdGeom

        stage = Usd.Stage.Open(str(paths[0]))  # prims are valid only while their stage is referenced
        seen = UsdGeom.Mesh(stage.GetPrimAtPath("/film/body_1")).GetVisibilityAttr()
        assert [seen.Get(frame) for frame in range(3)] == ["invisible", "inherited", "invisible"]
    writer = film_writer(tmp_path / "nothing", kind, RATE)
    with pytest.warns(UserWarning):
        writer.add(Scene([Body(np.full((4, 3), np.nan), FACES)], []))
    with pytest.raises(ValueError, match="finite"):
        writer.finish()


def test_films_that_cannot_be_written_are_refused(tmp_path, monkeypatch):
    with pytest.raises(ValueError, match="colours that change"):
        write(tmp_path, "glb", scalars=None)
    with pytest.raises(ValueError, match="no format"):
        write(tmp_path, "fbx")
    for kind in ("glb", "ply"):
        with pytest.raises(ValueError, match="shows nothing"):
            film_writer(tmp_path, kind, RATE).finish()
    with pytest.raises(ValueError, match="rate"):
        film_writer(tmp_path, "glb", 0.0)
    monkeypatch.setattr("piavatar_envs.render.film_files.MAX_GLB", 1000)
    with pytest.raises(ValueError, match="use ply or usd"):
        write(tmp_path, "glb")
    monkeypatch.setitem(sys.modules, "pxr", None)
    with pytest.raises(ImportError, match="usd"):
        write(tmp_path, "usd")
