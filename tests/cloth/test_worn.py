"""Clothes of a character's file as garments: cut from its surface, drawn once, in its colours, and refused if none."""

from __future__ import annotations

from collections.abc import Iterator

import gymnasium as gym
import numpy as np
import pytest
from scipy.spatial import cKDTree

import piavatar_envs
from piavatar_envs.avatar.body import sources
from piavatar_envs.avatar.body.asset import AvatarAsset
from piavatar_envs.avatar.body.character import body_of
from piavatar_envs.avatar.body.sources import load_asset
from piavatar_envs.cloth.garments import cut_garment
from piavatar_envs.cloth.wearer import Wearer
from piavatar_envs.config import ConfigError
from tests.avatar.characters import in_a_skirt, in_t_pose

BLUE = (20, 30, 200)


@pytest.fixture(scope="module")
def dressed() -> AvatarAsset:
    """Return the body of a character whose file has a skirt of many triangles."""
    character = in_t_pose(load_asset())
    bare = body_of(character)
    wearer = Wearer.of(bare, np.zeros(2))
    skirt = cut_garment("skirt", wearer, {"length": 0.45, "flare": 0.4, "edge": 0.015})
    place = bare.vertices[0] - wearer.vertices[0]  # where the file has it
    return body_of(in_a_skirt(character, skirt.positions + place, skirt.faces, BLUE))


@pytest.fixture(scope="module")
def source(dressed) -> Iterator[str]:
    piavatar_envs.register_source("in_a_skirt", lambda: dressed)
    yield "in_a_skirt"
    sources._registered.pop("in_a_skirt", None)


@pytest.mark.parametrize("shape", [(0.0, 0.0), (1.0, -0.5)])
def test_a_surface_of_the_file_is_cut_as_it_is(dressed, shape):
    wearer = Wearer.of(dressed, np.array(shape))
    cut = cut_garment("worn", wearer, {"surface": "Skirt", "edge": 0.03})
    own = dressed.worn["Skirt"]
    assert len(cut.positions) < 0.5 * len(own.vertices), "fine triangles are meshed anew"
    assert (cut.colors == BLUE).all() and len(cut.held) > 10
    assert cut.positions[cut.held, 2].min() > cut.positions[:, 2].max() - 0.08, "the waist is held"
    if shape == (0.0, 0.0):
        shift = wearer.vertices[0] - dressed.vertices[0]
        assert cKDTree(own.vertices + shift).query(cut.positions)[0].max() < 0.01
    assert wearer.surface.distance(cut.positions).min() > 0.003
    by_material, only = (cut_garment("worn", wearer, given) for given in ({"surface": "Cloth"}, {}))
    assert np.array_equal(by_material.faces, only.faces)


def test_a_garment_of_the_file_swings_and_is_drawn_once(source, dressed):
    settings = {"fidelity": "tiny", "avatar": {"source": source}, "device": "cpu"}
    garment = {"kind": "worn", "edge": 0.05}
    env = gym.make("PIAvatar/Stand-v0", garments=[garment], render_mode="rgb_array", **settings).unwrapped
    plain = gym.make("PIAvatar/Stand-v0", render_mode="rgb_array", **settings).unwrapped
    blue = []
    for each in (env, plain):
        each.reset(seed=0)
        picture = each.render().astype(int)
        blue.append((picture[..., 2] > picture[..., 0] + 40).mean())
    assert blue[1] > 0.005 and blue[0] == pytest.approx(blue[1], rel=0.35), "in the colour of the file, once"
    world = env.host.groups[0].simulation
    made = world.garments.garments[0]
    assert made.replaces in ("Skirt", "Cloth")
    corners = made.draped[made.mesh.faces]
    area = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum()
    # what the waist holds has no mass of its own
    assert 0.7 < world.garments.cloth.mass.sum() / (made.fabric.areal_density * area) < 1.05
    env.close()
    plain.close()


def test_without_such_a_surface_it_is_refused_with_the_names(source):
    for avatar, garment, words in (
        ({"source": "embedded"}, {}, "wears nothing of its own"),
        ({"source": source}, {"surface": "Hat"}, "it has 'Cloth', 'Skirt'"),
    ):
        with pytest.raises(ConfigError, match=words):
            gym.make(
                "PIAvatar/Stand-v0",
                fidelity="tiny",
                avatar=avatar,
                garments=[{"kind": "worn", **garment}],
                device="cpu",
            )
