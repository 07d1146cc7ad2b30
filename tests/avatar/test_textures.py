"""Textures of brought characters: read, posed, worn and reduced with their surfaces, with colours at the vertices."""

from __future__ import annotations

import dataclasses
import io

import numpy as np
import pytest

from piavatar_envs.avatar.body.character import body_of
from piavatar_envs.avatar.body.sources import load_asset, mesh
from piavatar_envs.avatar.body.sources.glb import read_character
from piavatar_envs.avatar.body.textures import CLAMP, MIRROR, REPEAT, Texture, Textures, joined
from scripts.gltf_files import rig_of
from scripts.synthetic_character import dressed
from tests.avatar.characters import in_t_pose
from tests.avatar.test_character import dressed_in_a_tube
from tests.avatar.test_rigs import named

image = pytest.importorskip("PIL.Image", reason="needs the extra render")

#: Sides of a field of the checker [m].
FIELD = 0.1


def checker(fields: int = 20, pixels: int = 8) -> np.ndarray:
    """Return an image of fields that are white and blue in turn, sRGB, ``(n, n, 3)`` uint8."""
    white = np.add.outer(np.arange(fields), np.arange(fields)) % 2 == 0
    colors = np.where(white[..., None], [255, 255, 255], [10, 40, 200]).astype(np.uint8)
    return colors.repeat(pixels, 0).repeat(pixels, 1)


def png(pixels: np.ndarray) -> bytes:
    stream = io.BytesIO()
    image.fromarray(pixels).save(stream, "PNG")
    return stream.getvalue()


def front(points: np.ndarray) -> np.ndarray:
    """Return the places of points in a checker that hangs before them, from the left and from above."""
    return np.stack([0.5 + points[:, 0] / (20 * FIELD), 1.0 - points[:, 2] / (20 * FIELD)], axis=1)


def checkered(folder, pixels=None, more=None, opacity=1, **fields):
    """Write a character in a checker, or another image, with hair of a plain colour."""
    asset = load_asset()
    rig = rig_of(asset, named("mixamo"), parts=dressed(asset)[:1], **fields)
    rig.attributes["TEXCOORD_0"] = (front(rig.vertices).astype("<f4"), "VEC2")
    rig.material = {"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}, "baseColorFactor": [1, 0.5, 1, opacity]}}
    rig.material |= more or {}
    out = rig.write()
    out.add("images", {"bufferView": out.view(png(checker() if pixels is None else pixels)), "mimeType": "image/png"})
    out.add("samplers", {"wrapS": 33071, "wrapT": 33648})
    out.add("textures", {"source": 0, "sampler": 0})
    return out.save(folder / "checkered.glb")


@pytest.fixture(scope="module")
def character(tmp_path_factory):
    return read_character(checkered(tmp_path_factory.mktemp("glb")))


def test_a_look_has_the_texture_of_its_file(character):
    look = body_of(character).look
    textures = look.textures
    (texture,) = textures.images
    assert np.array_equal(texture.pixels, checker()) and texture.wraps == (CLAMP, MIRROR)
    assert textures.image.shape == (len(look.faces),) and len(textures.uv) == len(look.vertices)
    on_body = (textures.image == 0).sum()
    assert 0 < on_body < len(look.faces) and set(textures.image) == {-1, 0}  # the hair has none
    bare = np.unique(look.faces[textures.image == 0])
    # of a body that rests as ours does, the places are those of its vertices
    shift = character.vertices[:, 2].min() - look.vertices[:, 2].min()
    expected = front(look.vertices[bare] + [0.0, 0.0, shift])
    assert np.abs(textures.uv[bare] - expected).max() < 0.02
    assert (textures.tints[bare] == (255, 188, 255)).all()
    np.testing.assert_array_equal(look.colors, textures.colors(look.faces))
    assert len(np.unique(look.colors[bare], axis=0)) > 2
    hair = np.setdiff1d(np.arange(len(look.vertices)), bare)
    np.testing.assert_array_equal(look.colors[hair], textures.tints[hair])


def test_worn_surfaces_have_their_texture_on_both_sides():
    worn, tube = dressed_in_a_tube(in_t_pose(load_asset()))
    count = len(worn.faces)
    index = np.where(np.arange(count) < count - tube, -1, 0)
    places = np.random.default_rng(0).uniform(size=(len(worn.vertices), 2)).astype(np.float32)
    textures = Textures((Texture(checker()),), index, places, worn.colors)
    look = body_of(dataclasses.replace(worn, textures=textures)).look
    textured = look.textures.image == 0
    assert textured.sum() == 2 * tube
    np.testing.assert_array_equal((look.textures.tints[look.faces] == (20, 30, 200)).all(axis=(1, 2)), textured)
    outer, inner = np.split(look.faces[textured], 2)
    np.testing.assert_array_equal(look.textures.uv[outer], look.textures.uv[inner[:, ::-1]])
    with pytest.raises(ValueError, match=f"textures of {len(places)} vertices and {count - 1} triangles"):
        body_of(dataclasses.replace(worn, textures=textures.chosen(np.arange(len(places)), np.arange(count - 1))))


@pytest.mark.parametrize(
    ("material", "cutoff"),
    [
        ({}, None),
        ({"alphaMode": "OPAQUE", "alphaCutoff": 0.2}, None),
        ({"alphaMode": "MASK"}, 0.5),
        ({"alphaMode": "MASK", "alphaCutoff": 0.2}, 0.2),
        ({"alphaMode": "BLEND", "alphaCutoff": 0.2}, 0.5),
    ],
)
def test_materials_say_where_a_texture_has_holes(tmp_path, material, cutoff):
    """Opacity counts where the material says so, as a share of its own; the colours beneath it are kept."""
    opacity = np.linspace(0, 255, 160).astype(np.uint8)[None].repeat(160, 0)
    path = checkered(tmp_path, pixels=np.dstack([checker(), opacity]), more=material, opacity=0.8)
    (texture,) = body_of(read_character(path)).look.textures.images
    assert np.array_equal(texture.pixels, checker())
    if cutoff is None:
        assert texture.alpha is None
    else:
        assert np.array_equal(texture.alpha, opacity) and texture.cutoff == pytest.approx(cutoff / 0.8)


def test_images_without_opacity_have_no_holes(tmp_path):
    (texture,) = body_of(read_character(checkered(tmp_path, more={"alphaMode": "MASK"}))).look.textures.images
    assert texture.alpha is None


def test_a_look_with_fewer_triangles_has_colours_only(character, monkeypatch):
    monkeypatch.setattr("piavatar_envs.avatar.body.character.MOST_DRAWN", 4000)
    look = body_of(character).look
    assert look.textures is None and len(np.unique(look.colors, axis=0)) > 2


def test_joined_surfaces_share_their_images():
    faces, colors = np.array([[0, 1, 2]]), np.full((3, 3), 7, np.uint8)
    shared = Texture(checker())
    one, other = (Textures((shared, Texture(checker(2))), np.array([i]), np.zeros((3, 2)), colors) for i in (0, 1))
    found = joined([(one, colors, 1), (None, colors, 1), (other, colors, 1)])
    assert len(found.images) == 3 and found.image.tolist() == [0, -1, 2] and len(found.uv) == 9
    assert joined([(None, colors, 1)]) is None
    for bad in ({"image": np.array([2])}, {"uv": np.zeros((3, 3))}, {"tints": colors[:2]}):
        with pytest.raises(ValueError, match=r"texture 2 of 2|shapes"):
            dataclasses.replace(one, **bad)
    assert one.colors(faces).shape == (3, 3)


@pytest.mark.parametrize(("wrap", "inside"), [(REPEAT, [0.7, 0.1]), (CLAMP, [0.0, 0.999]), (MIRROR, [0.3, 0.9])])
def test_places_beyond_an_image(wrap, inside):
    rng = np.random.default_rng(0)
    texture = Texture(rng.integers(0, 255, (16, 8, 3)).astype(np.uint8), (wrap, wrap))
    beyond = np.array([[-0.3, 0.55], [1.1, 0.55]])
    expected = texture.at(np.stack([inside, [0.55, 0.55]], axis=1))
    if wrap == CLAMP:  # within the last half of a pixel it is that pixel's
        expected = texture.at(np.array([[0.5 / 8, 0.55], [1.0 - 0.5 / 8, 0.55]]))
    np.testing.assert_allclose(texture.at(beyond), expected, atol=1e-12)


def write_obj(folder, pixels: np.ndarray, name: str = "skin.png") -> None:
    """Write a square with an image, and one in a plain colour, as an OBJ file with its materials."""
    (folder / "square.mtl").write_text(f"newmtl cloth\nKd 0 0 0\nmap_Kd {name}\nnewmtl red\nKd 1 0 0\n")
    (folder / "skin.png").write_bytes(png(pixels))
    corners = [(0, 0), (1, 0), (1, 1), (0, 1)]
    lines = ["mtllib square.mtl", *(f"v {x} {y} 0" for x, y in corners), *(f"v {x + 2} {y} 0" for x, y in corners)]
    lines += [*(f"vt {x} {y}" for x, y in corners), "usemtl cloth", "f 1/1 2/2 3/3", "f 1/1 3/3 4/4"]
    (folder / "square.obj").write_text("\n".join([*lines, "usemtl red", "f 5 6 7", "f 5 7 8", ""]))


def test_an_obj_file_has_the_images_of_its_materials(tmp_path):
    pytest.importorskip("trimesh")
    pixels = np.zeros((4, 4, 3), np.uint8)
    pixels[:2, :2] = (0, 255, 0)  # upper left
    write_obj(tmp_path, pixels)
    loaded = mesh.load_surface(tmp_path / "square.obj")
    (texture,) = loaded.textures.images
    assert np.array_equal(texture.pixels, pixels)
    on_image = loaded.textures.image == 0
    assert on_image.sum() == 2 and len(loaded.faces) == 4
    corners = np.unique(loaded.faces[on_image])
    x, y = loaded.vertices[corners, :2].T
    np.testing.assert_allclose(loaded.textures.uv[corners], np.stack([x, 1.0 - y], axis=1))
    # the corners repeat, so each is the mean of four pixels, of which one is green
    assert (loaded.colors[corners, 1] > 60).all() and (loaded.colors[corners, 0] == 0).all()
    plain = np.unique(loaded.faces[~on_image])
    assert (loaded.colors[plain] == (255, 0, 0)).all()


def test_an_obj_file_reads_nothing_outside_of_its_folder(tmp_path):
    pytest.importorskip("trimesh")
    inner = tmp_path / "inner"
    inner.mkdir()
    write_obj(inner, checker(2))
    write_obj(tmp_path, checker(2))
    (inner / "square.mtl").write_text("newmtl cloth\nmap_Kd ../skin.png\n")
    assert mesh.load_surface(inner / "square.obj").textures is None
    (inner / "square.mtl").unlink()
    assert mesh.load_surface(inner / "square.obj").textures is None
