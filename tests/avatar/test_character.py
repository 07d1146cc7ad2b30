"""Characters: posed as the embedded body rests, and their bodies."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy.spatial import cKDTree

import piavatar_envs
from piavatar_envs.avatar.body.asset import mesh_volume
from piavatar_envs.avatar.body.character import Character, Surface, body_of, to_reference_pose, with_all_joints
from piavatar_envs.avatar.body.sampling import sample_particles
from piavatar_envs.avatar.body.skeleton import JOINT_NAMES, PARENTS, joint_index
from piavatar_envs.avatar.body.sources import load_asset
from piavatar_envs.avatar.motion.retarget import LIMB_ENDS
from piavatar_envs.config import ConfigError, EnvConfig, load_config
from piavatar_envs.sim.world import Simulation
from tests.avatar.characters import SKIN_COLOR, in_t_pose


@pytest.fixture(scope="module")
def character() -> Character:
    return in_t_pose(load_asset())


def test_a_t_pose_comes_back_to_the_rest_pose_that_it_was_posed_from(character):
    asset, posed = load_asset(), to_reference_pose(character)
    np.testing.assert_allclose(posed.joints, asset.joints, atol=1e-5)
    for name, end in LIMB_ENDS.items():
        ours = posed.joints[joint_index(end)] - posed.joints[joint_index(name)]
        theirs = (asset.joints[joint_index(end)] - asset.joints[joint_index(name)]).astype(float)
        assert ours @ theirs / np.linalg.norm(ours) / np.linalg.norm(theirs) == pytest.approx(1.0, abs=1e-8)
    # exactly, where one bone moves a vertex; between bones, blending twice is not blending once
    rigid = asset.skin_weights[:, 0] > 0.999
    assert rigid.mean() > 0.2
    np.testing.assert_allclose(posed.vertices[rigid], asset.vertices[rigid], atol=1e-5)
    assert np.linalg.norm(posed.vertices - asset.vertices, axis=1).max() < 0.03
    volume = mesh_volume(posed.vertices, posed.faces)
    assert volume == pytest.approx(mesh_volume(asset.vertices, asset.faces), rel=0.02)


def test_other_shapes_are_posed_with_it(character):
    asset, posed = load_asset(), to_reference_pose(character)
    for parameter, half in np.ndindex(2, 2):
        np.testing.assert_allclose(
            posed.shape_joints[parameter, half] - posed.shape_joints[parameter, half, 0],
            asset.shape_joints[parameter, half] - asset.shape_joints[parameter, half, 0],
            atol=1e-5,
        )
    rigid = asset.skin_weights[:, 0] > 0.999
    shift = posed.shape_joints[0, 0, 0] - asset.shape_joints[0, 0, 0]
    np.testing.assert_allclose(posed.shape_deltas[0, 0][rigid] - shift, asset.shape_deltas[0, 0][rigid], atol=1e-5)


def test_the_body_of_a_closed_character_is_its_own_surface(character):
    asset, body = load_asset(), body_of(character)
    assert len(body.vertices) == len(asset.vertices)
    assert body.volume([0.0, 0.0]) == pytest.approx(asset.volume(np.zeros(len(asset.shape_names))), rel=0.02)
    assert body.volume([1.0, 0.0]) == pytest.approx(
        asset.volume(asset.parameters(**{asset.shape_names[0]: 1.0})), rel=0.03
    )
    assert body.look is not None and (body.look.colors == SKIN_COLOR).all()
    # skin and look are one surface, in every shape
    for parameters in ([0.0, 0.0], [0.5, -1.0]):
        shaped, drawn = body.shape(parameters), body.shape_drawn(parameters)
        assert cKDTree(drawn.vertices).query(shaped.vertices)[0].max() < 1e-5
    assert len(sample_particles(body, 0.05)) == pytest.approx(len(sample_particles(asset, 0.05)), rel=0.03)


def dressed_in_a_tube(character: Character) -> tuple[Character, int]:
    """Return the character in a skirt, an open tube about the hips that is blue, and its number of triangles."""
    low, high = 0.7, 1.1  # a skirt: an open tube about the hips [m]
    angle = np.linspace(0.0, 2.0 * np.pi, 24, endpoint=False)
    rings = [np.stack([0.3 * np.cos(angle), 0.3 * np.sin(angle), np.full(24, z)], -1) for z in (low, high)]
    a = np.arange(24)
    b = (a + 1) % 24
    tube = np.concatenate([np.stack([a, b, b + 24], -1), np.stack([a, b + 24, a + 24], -1)])
    count, more = len(character.vertices), np.zeros((48, 22))
    more[:, 0] = 1.0
    zeros = np.zeros((2, 2, 48, 3))
    dressed = dataclasses.replace(
        character,
        vertices=np.concatenate([character.vertices, *rings]),
        faces=np.concatenate([character.faces, tube + count]).astype(np.int32),
        weights=np.concatenate([character.weights, more]),
        colors=np.concatenate([character.colors, np.tile(np.array([[20, 30, 200]], np.uint8), (48, 1))]),
        shape_deltas=np.concatenate([character.shape_deltas, zeros], axis=2),
    )
    return dressed, len(tube)


def test_worn_surfaces_are_drawn_from_both_sides_and_are_no_body(character):
    dressed, tube = dressed_in_a_tube(character)
    bare, body = body_of(character), body_of(dressed)
    assert np.array_equal(body.vertices, bare.vertices) and np.array_equal(body.faces, bare.faces)
    assert len(body.look.faces) == len(bare.look.faces) + 2 * tube
    blue = (body.look.colors == (20, 30, 200)).all(axis=1)
    assert blue.sum() == 2 * 48  # an own vertex for either side, so that both have normals
    sides = body.look.faces[blue[body.look.faces].all(axis=1)]
    assert abs(mesh_volume(body.look.vertices, sides)) < 1e-9


def test_a_look_of_too_many_triangles_is_drawn_with_fewer(character, monkeypatch):
    dressed, _ = dressed_in_a_tube(character)
    whole = body_of(dressed).look
    monkeypatch.setattr("piavatar_envs.avatar.body.character.MOST_DRAWN", 4000)
    body = body_of(dressed)
    look, bare = body.look, body_of(character).look
    assert len(look.faces) < 8000 < len(whole.faces)
    assert cKDTree(whole.vertices).query(look.vertices)[0].max() == 0.0
    assert cKDTree(look.vertices).query(whole.vertices)[0].max() < 0.06
    assert np.abs(mesh_volume(bare.vertices, bare.faces) / body.volume([0.0, 0.0]) - 1.0) < 0.02
    # no triangle joins the skirt to the body
    blue = (look.colors == (20, 30, 200)).all(axis=1)[look.faces]
    assert (blue.all(axis=1) | ~blue.any(axis=1)).all() and blue.any()


def test_flesh_below_a_surface_of_the_file_is_of_another_material(character, device):
    boots = (character.vertices[character.faces, 2] < 0.12).all(axis=1)
    faces = np.concatenate([character.faces[~boots], character.faces[boots]])
    surfaces = (Surface("body", 0, (~boots).sum(), "Skin"), Surface("boots", (~boots).sum(), len(faces), "Leather"))
    booted = body_of(dataclasses.replace(character, faces=faces, surfaces=surfaces))
    assert set(booted.groups) == {"body", "Skin", "boots", "Leather"}
    piavatar_envs.register_source("booted", lambda: booted)

    def world(**region):
        avatars = [{"avatar": {"source": "booted"}, "regions": [{"young_modulus": 5.0e5, **region}]}]
        return Simulation(load_config(EnvConfig, None, {"fidelity": "tiny", "scene.avatars": avatars}), 1, device)

    simulation = world(group="Leather")
    stiff = simulation.model.particles.mu.numpy()[0] * 2.6 > 4.0e5
    height = simulation.flesh[0].sampled.rest_positions[:, 2] - booted.vertices[:, 2].min()
    assert stiff[height < 0.08].all() and not stiff[height > 0.16].any()
    left = world(group="Leather", joints=["left_ankle"]).model.particles.mu.numpy()[0] * 2.6 > 4.0e5
    assert 0 < left.sum() < stiff.sum() and stiff[left].all()
    with pytest.raises(ConfigError, match=r"no group 'Silk' on its skin; it has body, Skin, boots, Leather"):
        world(group="Silk")
    with pytest.raises(ConfigError, match=r"scene\.avatars\.0\.regions\.0.*neither joints nor a group"):
        world()


def test_joints_without_flesh_take_a_share_of_their_parents(character):
    weights = character.weights.copy()
    lacking = [joint_index(name) for name in ("left_foot", "right_foot", "spine2", "left_collar", "right_collar")]
    for joint in lacking:
        weights[:, PARENTS[joint]] += weights[:, joint]
        weights[:, joint] = 0.0
    given = with_all_joints(dataclasses.replace(character, weights=weights)).weights
    np.testing.assert_allclose(given.sum(axis=1), 1.0, atol=1e-6)
    assert (given >= 0.0).all() and (given.max(axis=0) > 0.9)[lacking[:2]].all()
    toes = given.argmax(axis=1) == joint_index("left_foot")
    ankle = character.joints[joint_index("left_ankle")]
    assert (character.vertices[toes, 1] < ankle[1]).all() and (character.vertices[toes, 0] > 0.0).all()
    body = body_of(dataclasses.replace(character, weights=weights))
    particles = sample_particles(body, 0.05)
    assert {JOINT_NAMES[joint] for joint in np.unique(particles.bone[particles.bone >= 0])} == set(JOINT_NAMES)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"vertices": lambda c: 100.0 * c.vertices, "joints": lambda c: 100.0 * c.joints}, r"1\d\d m tall.*0.3, 3"),
        ({"weights": lambda c: c.weights[:-1]}, "weights have shape"),
        ({"joints": lambda c: c.joints * np.nan}, "joints are not all finite"),
        ({"faces": lambda c: c.faces + 5}, "a triangle names a vertex outside"),
    ],
)
def test_bad_characters_are_refused(character, change, message):
    with pytest.raises(ValueError, match=message):
        body_of(dataclasses.replace(character, **{name: make(character) for name, make in change.items()}))
