"""Clothes of a character's file as garments: cut from its surface, drawn once, in its colours, and refused if none."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest
from scipy.spatial import cKDTree

import piavatar_envs
from piavatar_envs.avatar.body import sources
from piavatar_envs.avatar.body.asset import AvatarAsset
from piavatar_envs.avatar.body.character import Character, body_of
from piavatar_envs.avatar.body.sources import load_asset
from piavatar_envs.avatar.body.textures import Texture, Textures
from piavatar_envs.cloth.garments import cut_garment
from piavatar_envs.cloth.wearer import Wearer
from piavatar_envs.config import ConfigError
from piavatar_envs.render.garments import GarmentMesh
from tests.avatar.characters import in_a_skirt, in_t_pose

BLUE = (20, 30, 200)


@pytest.fixture(scope="module")
def character() -> Character:
    """Return a character whose file has a skirt of many triangles."""
    bare = body_of(in_t_pose(load_asset()))
    wearer = Wearer.of(bare, np.zeros(2))
    skirt = cut_garment("skirt", wearer, {"length": 0.45, "flare": 0.4, "edge": 0.015})
    place = bare.vertices[0] - wearer.vertices[0]  # where the file has it
    return in_a_skirt(in_t_pose(load_asset()), skirt.positions + place, skirt.faces, BLUE)


@pytest.fixture(scope="module")
def dressed(character) -> AvatarAsset:
    return body_of(character)


@pytest.fixture(scope="module")
def banded(character) -> AvatarAsset:
    """Return the same body in a skirt with a texture: red above half of its height, green below."""
    skirt, faces = character.surfaces[-1], character.faces
    height = character.vertices[:, 2]
    own = np.unique(faces[skirt.first : skirt.last])
    low, high = height[own].min(), height[own].max()
    pixels = np.zeros((64, 64, 3), np.uint8)
    pixels[:32], pixels[32:] = (220, 20, 20), (20, 200, 20)
    image = np.full(len(faces), -1, np.int32)
    image[skirt.first : skirt.last] = 0
    uv = np.stack([np.full(len(height), 0.5), (high - height) / (high - low)], axis=1).astype(np.float32)
    tints = np.where(np.isin(np.arange(len(height)), own)[:, None], np.uint8(255), character.colors)
    return body_of(replace(character, textures=Textures((Texture(pixels),), image, uv, tints)))


@pytest.fixture(scope="module")
def source(dressed, banded) -> Iterator[str]:
    piavatar_envs.register_source("in_a_skirt", lambda: dressed)
    piavatar_envs.register_source("in_bands", lambda: banded)
    yield "in_a_skirt"
    for name in ("in_a_skirt", "in_bands"):
        sources._registered.pop(name, None)


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


def test_textures_of_the_file_move_with_the_cloth(source, banded):
    garment = {"kind": "worn", "edge": 0.05}
    env = gym.make(
        "PIAvatar/Stand-v0", garments=[garment], fidelity="tiny", avatar={"source": "in_bands"}, device="cpu",
        render_mode="rgb_array", render={"width": 200, "height": 400},
    ).unwrapped  # fmt: skip
    env.reset(seed=0)
    made = env.host.groups[0].simulation.garments.garments[0]
    drawn = GarmentMesh.of(made, asset=banded)
    # where the cloth is in the file, its points are those of the file
    start, vertex, weight = drawn.rows
    matrix = np.zeros((len(start) - 1, made.mesh.num_vertices))
    matrix[np.repeat(np.arange(len(matrix)), np.diff(start)), vertex] = weight
    look = banded.look
    used = np.unique(look.faces[banded.worn["Skirt"].drawn])
    assert cKDTree(look.vertices[used]).query(matrix @ made.source)[0].max() < 0.015
    half = drawn.num_vertices // 2
    skirt_height = 1.0 - drawn.textures.uv[:half, 1]
    place = matrix @ made.draped
    assert np.corrcoef(skirt_height, place[:, 2])[0, 1] > 0.98
    picture = env.render().astype(int)
    red = (picture[..., 0] > picture[..., 1] + 60) & (picture[..., 0] > picture[..., 2] + 60)
    green = (picture[..., 1] > picture[..., 0] + 60) & (picture[..., 1] > picture[..., 2] + 60)
    assert min(red.sum(), green.sum()) > 500
    assert np.nonzero(red)[0].mean() < np.nonzero(green)[0].mean() - 10, "red is above"
    env.close()


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
