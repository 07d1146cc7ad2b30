"""Clothes of the embedded body: covered where people are covered, seams that are lines, in place on every shape."""

import dataclasses

import numpy as np
import pytest
from scipy.spatial import cKDTree

from piavatar_envs.avatar.body.asset import turned_shares
from piavatar_envs.avatar.body.eyes import find_eyes
from piavatar_envs.avatar.body.outfit import KITS
from piavatar_envs.avatar.body.skeleton import JOINT_NAMES
from piavatar_envs.avatar.body.sources import load_asset
from piavatar_envs.config import ConfigError, load_config
from piavatar_envs.config.schema import EnvConfig


@pytest.fixture(scope="module")
def asset():
    return load_asset()


def worn(look, name: str, kit: int = 0) -> np.ndarray:
    """Return which vertices have the colour of a part of a kit."""
    return (look.colors_of(kit) == getattr(KITS[kit], name)).all(axis=1)


def test_trunk_hips_and_thighs_are_covered(asset):
    look = asset.drawn
    bare = worn(look, "skin")[look.faces].all(axis=1)
    shares = turned_shares(look.skin_joints, look.skin_weights)[look.faces].mean(axis=1)
    free = [f"{side}_{part}" for side in ("left", "right") for part in ("shoulder", "knee")] + ["neck"]
    limb = np.max([shares[:, JOINT_NAMES.index(name)] for name in free], axis=0)
    assert not (bare & (limb < 0.25) & (look.vertices[look.faces].mean(axis=1)[:, 2] > asset.joints[4, 2] + 0.2)).any()
    assert bare.any() and all(worn(look, part).any() for part in ("hair", "shirt", "trim", "shorts", "shoes", "soles"))


def test_seams_are_lines_however_coarse_the_skin_is(asset):
    look = asset.drawn
    colors, corners = look.colors_of(0).astype(int), look.vertices[look.faces]
    mixed = (np.ptp(colors[look.faces], axis=1) > 0).any(axis=1)
    soles = worn(look, "soles")[look.faces].any(axis=1)
    edges = np.sort(np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=-1), axis=1)
    area = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    # as wide as the change of colour, and the height of the cloth that begins there, whatever their lengths
    width = 2.0 * area[mixed & ~soles] / edges[mixed & ~soles, 2]
    assert np.percentile(width, 95) < 0.008 and mixed.sum() > 300


def test_cloth_lies_on_the_body_of_every_shape(asset):
    for seed in range(3):
        parameters = asset.sample_parameters(np.random.default_rng(seed))
        skin, look = asset.shape(parameters), asset.shape_drawn(parameters)
        away = cKDTree(skin.vertices).query(look.vertices)[0]
        shod = worn(asset.drawn, "shoes") | worn(asset.drawn, "soles")
        assert away[~shod].max() < 0.03 and away.max() < 0.05
        assert abs(look.vertices[:, 2].min()) < 0.006  # soles stand on the ground


def test_avatars_of_a_scene_have_colours_of_their_own(asset):
    look = asset.drawn
    shirts = [look.colors_of(avatar)[worn(look, "shirt")][0].astype(int) for avatar in range(len(KITS))]
    assert all(np.abs(a - b).sum() > 100 for i, a in enumerate(shirts) for b in shirts[:i])
    assert look.colors_of(len(KITS)) is look.colors_of(0)
    light = [shirt @ [0.2126, 0.7152, 0.0722] for shirt in shirts[:2]]
    assert abs(light[0] - light[1]) > 50.0


def test_the_bare_body_is_there_and_the_simulated_one_is_the_same(asset):
    bare = load_asset(appearance="skin")
    np.testing.assert_array_equal(bare.vertices, asset.vertices)
    assert bare.drawn.vertices is bare.vertices and bare.drawn.colors is None
    config = load_config(EnvConfig, {"avatar": {"appearance": "skin"}})
    assert config.avatar.settings == {"appearance": "skin"}
    with pytest.raises(ConfigError, match="appearance='naked'"):
        load_config(EnvConfig, {"avatar": {"appearance": "naked"}})


def test_a_body_of_another_size_is_dressed_as_well(asset):
    large = dataclasses.replace(
        asset, vertices=1.3 * asset.vertices, joints=1.3 * asset.joints, shape_deltas=1.3 * asset.shape_deltas
    )
    hems = [body.drawn.vertices[worn(body.drawn, "shorts"), 2].min() for body in (asset, large)]
    assert hems[1] == pytest.approx(1.3 * hems[0], rel=0.02)


def test_eyes_fill_both_sockets_of_every_shape(asset):
    look = asset.drawn
    eye = worn(look, "pupils") | worn(look, "irises") | worn(look, "whites")
    for seed in range(3):
        parameters = asset.sample_parameters(np.random.default_rng(seed))
        skin, shown = asset.shape(parameters), asset.shape_drawn(parameters).vertices
        pupils = shown[worn(look, "pupils")]
        left, right = (pupils[side * pupils[:, 0] > 0.0].mean(axis=0) for side in (1.0, -1.0))
        assert np.abs(left - right * [-1.0, 1.0, 1.0]).max() < 0.003 and 0.05 < left[0] - right[0] < 0.07
        assert cKDTree(skin.vertices).query(shown[eye])[0].max() < 0.014  # a radius, within the sockets
        front = skin.vertices[np.linalg.norm(skin.vertices[:, [0, 2]] - left[[0, 2]], axis=1) < 0.02, 1].min()
        assert 0.0 < left[1] - front < 0.012  # behind the brow, before the back of the socket


def test_a_face_without_sockets_has_no_eyes(asset):
    angle, height = np.meshgrid(np.linspace(0.0, 2.0 * np.pi, 60), np.linspace(0.0, np.pi, 40))
    points = np.stack([np.sin(height) * np.sin(angle), np.sin(height) * np.cos(angle), np.cos(height)], -1)
    corner = np.arange(2400).reshape(40, 60)
    a, b, c, d = (
        corner[rows, columns].ravel() for rows in (slice(-1), slice(1, None)) for columns in (slice(-1), slice(1, None))
    )
    faces = np.concatenate([np.stack([a, c, b], 1), np.stack([b, c, d], 1)])
    assert find_eyes(0.1 * points.reshape(-1, 3), faces, np.array([0.0, 0.0, -0.06])) == []
    assert find_eyes(asset.vertices, asset.faces, np.array([0.0, 0.0, 10.0])) == []
