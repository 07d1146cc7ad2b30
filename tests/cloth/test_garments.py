"""Cuts of garments: lengths of flat patterns, sound meshes outside of any body, files of users, and refusals."""

from __future__ import annotations

import numpy as np
import pytest

from piavatar_envs.avatar.body.asset import AvatarAsset
from piavatar_envs.avatar.body.character import body_of
from piavatar_envs.avatar.body.sources import load_asset
from piavatar_envs.cloth import garments
from piavatar_envs.cloth.cut import Cut
from piavatar_envs.cloth.garments import check_settings, cut_garment, describe, list_garments, register_garment
from piavatar_envs.cloth.garments.skirt import waist_belt
from piavatar_envs.cloth.pattern import Sector
from piavatar_envs.cloth.remesh import boundary_loops
from piavatar_envs.cloth.wearer import Wearer
from tests.avatar.characters import in_t_pose

#: Kinds that need no file, and edges for quick tests [m].
CUT, EDGE = ("cape", "dress", "scarf", "shirt", "skirt", "trousers"), 0.05


@pytest.fixture(scope="module")
def asset() -> AvatarAsset:
    return load_asset()


@pytest.fixture(scope="module")
def wearers(asset) -> dict[str, Wearer]:
    """Return the mean body, two random ones, and one that a character in T-pose has become."""
    shapes = asset.sample_parameters(np.random.default_rng(1), size=2)
    brought = body_of(in_t_pose(asset))
    small = Wearer.of(brought, np.zeros(len(brought.shape_names)))
    found = {"mean": Wearer.of(asset, asset.parameters()), "brought": small}
    return found | {f"random {n}": Wearer.of(asset, shape) for n, shape in enumerate(shapes)}


def edges_of(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the directed edges of triangles and all edges, each once."""
    half = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    return half, np.unique(np.sort(half, axis=1), axis=0)


def check_mesh(cut: Cut, wearer: Wearer, edge: float = EDGE) -> None:
    """Check that a cut is a manifold, oriented outwards, of even edges, outside of its wearer."""
    half, edges = edges_of(cut.faces)
    assert len(np.unique(half, axis=0)) == len(half), "an edge has two triangles on one side"
    assert np.array_equal(np.unique(cut.faces), np.arange(len(cut.positions))), "a vertex has no triangle"
    length = cut.measure(edges)
    assert 0.2 * edge < length.min() and length.max() < 3.0 * edge
    assert np.median(length) == pytest.approx(edge, rel=0.2)
    corner = cut.positions[cut.faces]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    face, weights = wearer.anchors(corner.mean(axis=1))
    outward = np.einsum("nc,ncd->nd", weights, wearer.normals[wearer.faces[face]])
    assert np.einsum("nd,nd->n", normal, outward).sum() > 0.0, "its outside is inwards"
    placed = wearer.outside(cut.positions, cut.thickness)
    assert wearer.surface.distance(placed).min() > 0.5 * cut.thickness
    assert np.linalg.norm(placed - cut.positions, axis=1).max() < 0.1
    assert cut.sees.shape == (len(cut.positions),) and (cut.sees > 0).all()


@pytest.mark.parametrize("flare", [0.25, 0.5, 1.0])
def test_a_skirts_lengths_are_those_of_the_flat_pattern(wearers, flare):
    """Check a hem of 2 pi f (r0 + L), and all lengths against the sector laid out in the plane."""
    wearer, length = wearers["mean"], 0.5
    cut = cut_garment("skirt", wearer, {"flare": flare, "length": length, "edge": EDGE})
    belt = waist_belt(wearer, 1.0)
    inner = belt.length / (2.0 * np.pi * flare)
    sector = Sector.around(belt.length, length, flare, EDGE)
    hem = sector.rows[-1]
    chords = cut.measure(np.stack([hem, np.roll(hem, -1)], axis=1))
    expected = 2.0 * (inner + length) * np.sin(np.pi * flare / len(hem))
    np.testing.assert_allclose(chords, expected, rtol=1e-9)
    assert chords.sum() == pytest.approx(2.0 * np.pi * flare * (inner + length), rel=2e-3)
    assert belt.length == pytest.approx(cut.measure(np.stack([cut.held, np.roll(cut.held, -1)], 1)).sum(), rel=8e-3)
    radius, angle = sector.polar.T
    plane = radius[:, None] * np.stack([np.cos(flare * angle), np.sin(flare * angle)], axis=1)
    _, edges = edges_of(cut.faces)
    inside = np.abs(angle[edges[:, 0]] - angle[edges[:, 1]]) < np.pi  # not over the seam
    straight = np.linalg.norm(plane[edges[:, 0]] - plane[edges[:, 1]], axis=1)
    np.testing.assert_allclose(cut.measure(edges)[inside], straight[inside], rtol=1e-9)


def test_a_half_circle_hangs_without_stretch(wearers):
    cut = cut_garment("skirt", wearers["mean"], {"flare": 0.5, "edge": EDGE})
    _, edges = edges_of(cut.faces)
    placed = np.linalg.norm(cut.positions[edges[:, 0]] - cut.positions[edges[:, 1]], axis=1)
    assert np.sqrt(((placed / cut.measure(edges) - 1.0) ** 2).mean()) < 0.05


@pytest.mark.parametrize("kind", CUT)
def test_every_kind_fits_bodies_of_any_shape_and_source(kind, wearers):
    for wearer in wearers.values():
        check_mesh(cut_garment(kind, wearer, {"edge": EDGE}), wearer)


@pytest.mark.parametrize("kind", CUT)
def test_what_is_held_keeps_the_lengths_of_the_pattern(kind, wearers):
    """Check edges that no drape can relax."""
    for name, wearer in wearers.items():
        cut = cut_garment(kind, wearer, {})
        edges = edges_of(cut.faces)[1]
        held = edges[np.isin(edges, cut.held).all(axis=1)]
        placed = cut.positions.copy()
        placed[cut.held] = wearer.outside(placed[cut.held], cut.thickness)
        strain = np.linalg.norm(placed[held[:, 0]] - placed[held[:, 1]], axis=1) / cut.measure(held) - 1.0
        assert (np.abs(strain) < 0.25).all(), (name, strain.min(), strain.max())


@pytest.mark.parametrize("kind", CUT)
def test_a_cut_fits_other_shapes_with_the_same_vertices(kind, wearers):
    """Check that on the wearer's own shape it is what it was, and outside of another shape."""
    wearer, other = wearers["mean"], wearers["random 1"]
    cut = cut_garment(kind, wearer, {"edge": EDGE})
    np.testing.assert_allclose(cut.fit(wearer), cut.positions, atol=1e-9)
    placed = cut.fit(other)
    assert placed.shape == cut.positions.shape
    assert (other.surface.distance(placed) > 0.0).mean() > 0.9


@pytest.mark.parametrize("kind", ["shirt", "trousers"])
def test_edges_are_as_short_as_asked_for(wearers, kind):
    """The skin's own edges are 19 and 26 mm long."""
    cut = cut_garment(kind, wearers["mean"], {"edge": 0.014})
    corners = cut.positions[cut.faces]
    length = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=-1)
    assert 0.9 < length.mean() / 0.014 < 1.1


@pytest.mark.parametrize(("sleeve", "borders"), [(0.0, 4), (0.6, 4), (1.9, 4)])
def test_sleeves_end_where_they_should(wearers, sleeve, borders):
    wearer = wearers["mean"]
    cut = cut_garment("shirt", wearer, {"sleeve": sleeve, "edge": EDGE})
    assert len(boundary_loops(cut.faces)) == borders
    shoulder, elbow, wrist = (wearer.at(f"left_{joint}")[0] for joint in ("shoulder", "elbow", "wrist"))
    end = shoulder + sleeve * (elbow - shoulder) if sleeve < 1.0 else elbow + (sleeve - 1.0) * (wrist - elbow)
    assert cut.positions[:, 0].max() == pytest.approx(end, abs=0.06)


def write_obj(path, points: np.ndarray, faces: np.ndarray, soup: bool = True) -> str:
    """Write a surface, z up; as a soup, every triangle with vertices of its own."""
    if soup:
        points, faces = points[faces].reshape(-1, 3), np.arange(3 * len(faces)).reshape(-1, 3)
    lines = [f"v {x:.6f} {y:.6f} {z:.6f}" for x, y, z in points] + [f"f {a + 1} {b + 1} {c + 1}" for a, b, c in faces]
    path.write_text("\n".join(lines))
    return str(path)


def test_a_file_becomes_a_garment_however_its_triangles_are_turned(tmp_path, wearers):
    wearer = wearers["mean"]
    source = cut_garment("skirt", wearer, {"edge": EDGE})
    faces = source.faces.copy()
    turned = np.random.default_rng(0).random(len(faces)) < 0.5
    faces[turned] = faces[turned, ::-1]
    path = write_obj(tmp_path / "skirt.obj", source.positions, faces)
    cut = cut_garment("mesh", wearer, {"path": path, "edge": EDGE})
    assert len(cut.positions) == len(source.positions) and len(cut.held) == len(source.held)
    assert cut.positions[cut.held, 2].min() > cut.positions[:, 2].max() - 0.01
    check_mesh(cut, wearer)


def test_a_fine_file_put_on_askew_is_meshed_anew_and_brought_out_of_the_skin(tmp_path, wearers):
    wearer = wearers["mean"]
    source = cut_garment("dress", wearer, {"edge": 0.03})
    path = write_obj(tmp_path / "dress.obj", 100.0 * source.positions, source.faces)
    settings = {"path": path, "scale": 0.0097, "offset": (0.02, -0.03, 0.03), "edge": 0.06, "held": "none"}
    cut = cut_garment("mesh", wearer, settings)
    assert len(cut.positions) < 0.6 * len(source.positions) and not len(cut.held)
    check_mesh(cut, wearer, 0.06)


def test_a_waist_that_is_too_narrow_is_stretched_evenly(tmp_path, wearers):
    """Check that a held border inside of the body comes out of it without crowding; each vertex alone would."""
    wearer = wearers["mean"]
    source = cut_garment("skirt", wearer, {"edge": EDGE})
    middle = source.positions[source.held].mean(axis=0)
    narrow = (source.positions - middle) * (0.8, 0.8, 1.0) + middle + (0.0, 0.03, 0.0)
    cut = cut_garment("mesh", wearer, {"path": write_obj(tmp_path / "n.obj", narrow, source.faces), "edge": EDGE})
    ring = np.stack([cut.held, np.roll(cut.held, -1)], axis=1)
    length = np.linalg.norm(cut.positions[ring[:, 0]] - cut.positions[ring[:, 1]], axis=1)
    stretch = length / cut.measure(ring)
    assert stretch.mean() > 1.1 and stretch.max() < 1.5 * stretch.min()
    distance = wearer.surface.distance(cut.positions[cut.held])
    assert distance.min() > 0.9 * cut.thickness and np.ptp(cut.positions[cut.held, 2]) < 0.06


def test_files_that_are_no_garment_are_refused(tmp_path, wearers):
    wearer = wearers["mean"]
    source = cut_garment("skirt", wearer, {"edge": EDGE})
    far = write_obj(tmp_path / "far.obj", source.positions + [3.0, 0.0, 0.0], source.faces)
    with pytest.raises(ValueError, match=r"far.obj is not around the body.*give scale, offset or up"):
        cut_garment("mesh", wearer, {"path": far})
    body = write_obj(tmp_path / "body.obj", wearer.vertices, wearer.faces, soup=False)
    with pytest.raises(ValueError, match="no border that could be held; set held='none'"):
        cut_garment("mesh", wearer, {"path": body})
    with pytest.raises(FileNotFoundError, match=r"none\.obj"):
        cut_garment("mesh", wearer, {"path": str(tmp_path / "none.obj")})
    with pytest.raises(ValueError, match="unknown mesh format"):
        cut_garment("mesh", wearer, {"path": "a.txt"})


@pytest.mark.parametrize(
    ("kind", "settings", "words"),
    [
        ("skirt", {"flare": 3.0}, r"flare=3.0 of the garment 'skirt' must be less than or equal to 1 \[-\]"),
        ("skirt", {"length": 9.0}, r"length=9.0 .* must be less than or equal to 1.5 \[m\]"),
        ("skirt", {"length": "long"}, "length='long' .* must be a valid number"),
        ("skirt", {"sleeve": 1.0}, "sleeve=1.0 is not a setting of the garment 'skirt'; it has length, flare"),
        ("trousers", {"length": 2.5}, "length=2.5"),
        ("mesh", {}, "path is missing"),
        ("mesh", {"path": "a.obj", "held": "hem"}, "held='hem' .* 'top' or 'none'"),
        ("kilt", {}, "unknown garment 'kilt'; use one of cape, dress, mesh"),
    ],
)
def test_bad_settings_are_refused_with_value_and_limit(kind, settings, words):
    with pytest.raises(ValueError, match=words):
        check_settings(kind, settings)


def test_a_skirt_down_into_the_ground_is_refused(wearers):
    with pytest.raises(ValueError, match=r"length=1.4 of the garment 'skirt' must be at most 1\.0\d* \[m\]"):
        cut_garment("skirt", wearers["mean"], {"length": 1.4})


def test_every_setting_says_what_it_is():
    for kind in list_garments():
        for name in garments.settings_of(kind):
            assert name == "path" or describe(kind, name), f"{kind}.{name} has no description"


def test_a_kind_of_ones_own_is_one_function(monkeypatch, wearers):
    monkeypatch.setattr(garments, "_registered", {})

    def patch(wearer: Wearer, size: float = 0.2) -> Cut:
        points = np.array([[0.0, 0.0, 0.0], [size, 0.0, 0.0], [0.0, 0.0, size]]) + [0.0, -0.5, 1.0]
        return Cut(points, np.array([[0, 1, 2]], np.int32), np.ones(3, np.int32))

    register_garment("patch", patch)
    assert "patch" in list_garments()
    assert np.ptp(cut_garment("patch", wearers["mean"], {"size": 0.1}).positions[:, 0]) == pytest.approx(0.1)
    with pytest.raises(ValueError, match="colour='red' is not a setting of the garment 'patch'; it has size"):
        check_settings("patch", {"colour": "red"})
    with pytest.raises(ValueError, match="'skirt' is one of this package"):
        register_garment("skirt", patch)
    with pytest.raises(TypeError, match="pass a function"):
        register_garment("patch", 3)
    register_garment("wrong", lambda wearer: wearer)
    with pytest.raises(TypeError, match="return a Cut"):
        cut_garment("wrong", wearers["mean"], {})
