"""Garments made to measure: at rest on the skin, held, bound to bones, graded, layered, and kept in a file."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp

from piavatar_envs.avatar.body.asset import AvatarAsset
from piavatar_envs.avatar.body.sources import load_asset
from piavatar_envs.cloth import garments, tailor
from piavatar_envs.cloth.cut import Cut
from piavatar_envs.cloth.fabric import FABRICS
from piavatar_envs.cloth.garment import Garment
from piavatar_envs.cloth.garments import register_garment
from piavatar_envs.cloth.proxy import parts_of, proxy_of
from piavatar_envs.cloth.solver import Cloth
from piavatar_envs.cloth.tailor import LAYER, make_garment, still
from piavatar_envs.cloth.wearer import Wearer
from piavatar_envs.core import result_cache
from piavatar_envs.core.launch_graph import LaunchGraph

#: Edges for quick tests [m].
EDGE = 0.05


@pytest.fixture(scope="module")
def asset() -> AvatarAsset:
    return load_asset()


def made(asset: AvatarAsset, kind: str, fabric: str = "cotton", parameters=None, **more) -> Garment:
    """Return a garment of wide edges."""
    shape = asset.parameters() if parameters is None else parameters
    return make_garment(kind, {"edge": EDGE, **more.pop("settings", {})}, FABRICS[fabric], asset, shape, **more)


@pytest.fixture(scope="module")
def skirt(asset) -> Garment:
    return made(asset, "skirt", grading=True)


def check_rest(garment: Garment, wearer: Wearer) -> None:
    """Check that a garment is outside of the skin, in its pattern's size, and stays as it is."""
    distance, face, _ = wearer.surface.query(garment.draped)
    part = parts_of(wearer.asset.skin_joints, wearer.asset.skin_weights)[wearer.faces[face, 0]]
    touched = (part & garment.sees) != 0  # in the armpit a sleeve may lie in the trunk
    assert distance[touched].min() > -0.001 and distance.min() > -0.01 and touched.mean() > 0.9
    strain = garment.mesh.strain(garment.draped)
    assert np.sqrt((strain**2).mean()) < 0.02
    cloth = Cloth([garment], still(wearer, proxy_of(wearer.asset)), control_dt=1.0 / 30.0)
    graph, failure = LaunchGraph("cpu"), wp.zeros(1, dtype=int, device="cpu")
    cloth.record_step(graph, failure)
    for _ in range(20):
        graph.run()
    assert failure.numpy()[0] == 0
    speed = np.linalg.norm(cloth.state.v.numpy()[0], axis=1)
    assert np.sqrt((speed**2).mean()) < 0.003
    assert np.linalg.norm(cloth.state.x.numpy()[0] - garment.draped, axis=1).max() < 0.01


def test_a_skirt_rests_on_its_wearer(asset, skirt):
    check_rest(skirt, Wearer.of(asset, asset.parameters()))
    assert np.ptp(skirt.draped[:, 2]) == pytest.approx(0.5, abs=0.06)


@pytest.mark.parametrize(("kind", "fabric", "seed"), [("shirt", "jersey", 0), ("trousers", "denim", 1)])
def test_garments_rest_on_random_shapes(asset, kind, fabric, seed):
    shape = asset.sample_parameters(np.random.default_rng(seed))
    check_rest(made(asset, kind, fabric, shape), Wearer.of(asset, shape))


def test_held_vertices_are_where_the_skin_holds_them(skirt):
    """Check the waistband: a ring, level, at the places that the drape kept."""
    band = skirt.draped[skirt.held.vertices]
    assert len(band) > 8 and np.ptp(band[:, 2]) < 0.01
    assert np.allclose(skirt.held.weights.sum(axis=1), 1.0, atol=1e-5)
    assert (np.abs(skirt.held.offset) < 0.05).all()


def test_bones_of_the_nearest_skin_move_a_garment_smoothly(skirt):
    assert np.allclose(skirt.skin_weights.sum(axis=1), 1.0, atol=1e-5)
    left = skirt.draped[:, 0] > 0.15
    pairs = skirt.mesh.edges
    dense = np.zeros((len(skirt.draped), 22))
    np.add.at(dense, (np.arange(len(dense))[:, None], skirt.skin_joints), skirt.skin_weights)
    assert dense[left, 1].sum() > dense[left, 2].sum(), "the right leg moves the left side"
    assert np.abs(dense[pairs[:, 0]] - dense[pairs[:, 1]]).max() < 0.4


def test_grading_follows_the_shape(asset, skirt):
    """Check that changes of the shape widen and shift the garment as the body, of which most stays outside."""
    assert skirt.shape_deltas.shape == (2 * len(asset.shape_names), *skirt.draped.shape)
    weight = asset.shape_names.index("weight")
    for half, sign in enumerate((-1.0, 1.0)):
        wearer = Wearer.of(asset, asset.parameters(weight=sign))
        placed = skirt.draped + skirt.shape_deltas[2 * weight + half]
        band = placed[skirt.held.vertices]
        assert (wearer.surface.distance(placed) > -0.005).mean() > 0.95
        assert np.ptp(band[:, 0]) == pytest.approx(np.ptp(wearer.section(band[:, 2].mean())[:, 0]), abs=0.03)


@pytest.mark.parametrize("kind", ["scarf", "dress"])
def test_grading_keeps_the_pattern_even(asset, kind):
    """Check that no edge of a graded garment shrinks or grows far more than the body does."""
    garment, rng = made(asset, kind, grading=True, settings={"edge": 0.04}), np.random.default_rng(0)
    span = garment.mesh.strain(garment.draped) + 1.0
    for given in asset.sample_parameters(rng, size=16):
        halves = np.stack([np.maximum(-given, 0.0), np.maximum(given, 0.0)], axis=1).ravel()
        placed = garment.draped + np.tensordot(halves, garment.shape_deltas, axes=1)
        ratio = (garment.mesh.strain(placed) + 1.0) / span
        assert ratio.min() > 0.6 and ratio.max() < 1.6, (ratio.min(), ratio.max())


def test_outer_garments_lie_over_inner_ones(asset):
    inner, outer = (made(asset, "skirt", layer=layer) for layer in (0, 1))
    assert outer.thickness == pytest.approx(inner.thickness + LAYER)
    wearer = Wearer.of(asset, asset.parameters())
    nearest = [wearer.surface.distance(garment.draped).min() for garment in (inner, outer)]
    assert nearest[1] > nearest[0] + 0.5 * LAYER


def test_a_garment_is_made_once(asset, monkeypatch, empty_kernel_cache):
    """Check that a second time it is read from its file, bit for bit, and made anew for another fabric."""
    monkeypatch.setattr(result_cache, "LEAST_SECONDS", 0.0)
    calls = []
    usual = tailor._made
    monkeypatch.setattr(tailor, "_made", lambda *given: calls.append(given) or usual(*given))
    monkeypatch.setattr(tailor, "drape", lambda garment, *_: garment.draped)
    first, again = made(asset, "skirt"), made(asset, "skirt")
    assert len(calls) == 1 and len(list(empty_kernel_cache.rglob("garment_*.npz"))) == 1
    assert np.array_equal(first.draped, again.draped) and np.array_equal(first.mesh.edges, again.mesh.edges)
    assert again.mesh.num_vertices == len(again.draped) and again.thickness == first.thickness
    made(asset, "skirt", "silk")
    assert len(calls) == 2


def test_a_cut_without_a_fit_follows_the_nearest_skin(asset, monkeypatch):
    monkeypatch.setattr(garments, "_registered", {})

    def band(wearer: Wearer) -> Cut:
        cut = garments.cut_garment("skirt", wearer, {"length": 0.1, "edge": EDGE})
        return Cut(cut.positions, cut.faces, cut.sees, cut.held, cut.lengths)

    register_garment("band", band)
    monkeypatch.setattr(tailor, "drape", lambda garment, *_: garment.draped)
    garment = make_garment("band", {}, FABRICS["cotton"], asset, asset.parameters(), grading=True)
    weight = asset.shape_names.index("weight")
    thin, heavy = (garment.draped + garment.shape_deltas[2 * weight + half] for half in range(2))
    assert np.ptp(thin[:, 0]) + 0.005 < np.ptp(garment.draped[:, 0]) < np.ptp(heavy[:, 0]) - 0.005
