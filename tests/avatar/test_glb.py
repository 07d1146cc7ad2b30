"""Characters of GLB files: written from the embedded body in every way that files have, and read back."""

from __future__ import annotations

import copy
import json
import time
import tracemalloc

import gymnasium as gym
import numpy as np
import pytest

import piavatar_envs  # noqa: F401 - registers the ids
from piavatar_envs.avatar.body.asset import dense_weights, mesh_volume
from piavatar_envs.avatar.body.character import body_of
from piavatar_envs.avatar.body.skeleton import PARENTS, joint_index
from piavatar_envs.avatar.body.sources import load_asset
from piavatar_envs.avatar.body.sources.glb import read_character, scale_of
from scripts.gltf_files import Y_UP, rig_of
from tests.avatar.test_rigs import SCHEMES, named, without

_MIRROR = np.diag([-1.0, 1.0, 1.0])
_CENTIMETRES = np.diag([0.01, 0.01, 0.01, 1.0])
_MIRRORED_NODE = np.diag([-1.0, 1.0, 1.0, 1.0])
_UPSIDE_DOWN = np.diag([1.0, -1.0, -1.0])

#: Fields of the writer's rig, tolerance of the vertices [m] and words of a note.
WAYS: dict[str, tuple[dict, float, str]] = {
    "plain": ({}, 1e-6, ""),
    "turned_bones": ({"turns": 3}, 1e-6, ""),
    "another_pose_shown": ({"turns": 3, "shown": False}, 1e-6, "another pose"),
    "centimetres": ({"unit": 100.0}, 1e-6, "centimetres"),
    "centimetres_under_a_scale": ({"armature": _CENTIMETRES, "turns": 1}, 1e-6, ""),
    "inches": ({"unit": 1.0 / 0.0254}, 1e-6, "inches"),
    "z_up": ({"axes": np.eye(3)}, 1e-6, "stands along +z and faces -y"),
    "facing_minus_z": ({"axes": np.diag([-1.0, 1.0, -1.0]) @ Y_UP, "turns": 5}, 1e-6, "faces -z"),
    "upside_down": ({"axes": _UPSIDE_DOWN @ Y_UP}, 1e-6, "stands along -y"),
    "mirrored_node": ({"armature": _MIRRORED_NODE}, 1e-6, ""),
    "left_handed": ({"axes": _MIRROR @ Y_UP, "turns": 2}, 1e-6, "mirrored back"),
    "sparse": ({"storage": "sparse"}, 1e-6, ""),
    "strided": ({"storage": "strided"}, 1e-6, ""),
    "quantized": ({"storage": "quantized", "turns": 4}, 3e-5, ""),
    "quantized_mirrored_centimetres": (
        {"storage": "quantized", "axes": _MIRROR @ Y_UP, "armature": _CENTIMETRES},
        3e-5,
        "mirrored back",
    ),
    "weights_as_bytes": ({"weight_type": "u1"}, 1e-6, ""),
    "weights_as_shorts": ({"weight_type": "u2"}, 1e-6, ""),
}


@pytest.fixture(scope="module")
def asset():
    return load_asset()


@pytest.fixture(scope="module")
def standing(asset):
    """Return joints and vertices of the embedded body, with the origin of a character: under the pelvis."""
    body = asset.mean_body()
    return body.joints.astype(np.float64), body.vertices.astype(np.float64)


@pytest.mark.parametrize("way", WAYS)
def test_every_way_of_writing_gives_the_same_character(way, asset, standing, tmp_path):
    fields, tolerance, note = WAYS[way]
    path = rig_of(asset, named("mixamo"), **fields).write().save(tmp_path / "a.glb")
    character = read_character(path)
    joints, vertices = standing
    np.testing.assert_allclose(character.joints, joints, atol=1e-6 if tolerance == 1e-6 else 1e-5)
    np.testing.assert_allclose(character.vertices, vertices, atol=tolerance)
    volume = mesh_volume(character.vertices, character.faces)
    assert volume == pytest.approx(mesh_volume(vertices, asset.faces), rel=0.01 if tolerance > 1e-6 else 1e-5)
    weights = dense_weights(asset.skin_joints, asset.skin_weights)
    assert np.abs(character.weights - weights).max() < (0.01 if "bytes" in way else 1e-4)
    assert note in " ".join(character.notes) if note else character.notes == ()


@pytest.mark.parametrize("scheme", SCHEMES)
def test_every_scheme_of_names(scheme, asset, standing, tmp_path):
    path = rig_of(asset, named(scheme)).write().save(tmp_path / "a.glb")
    np.testing.assert_allclose(read_character(path).joints, standing[0], atol=1e-6)


@pytest.mark.parametrize("storage", ["file", "data"])
def test_documents_with_their_data_elsewhere(storage, asset, standing, tmp_path):
    path = rig_of(asset, named("unreal")).write().save(tmp_path / "a.gltf", storage)
    np.testing.assert_allclose(read_character(path).vertices, standing[1], atol=1e-6)


@pytest.mark.parametrize("version", ["VRM", "VRMC_vrm"])
def test_humanoid_maps_of_vrm(version, asset, standing, tmp_path):
    facing = np.diag([-1.0, 1.0, -1.0]) @ Y_UP if version == "VRM" else Y_UP  # 0.x faces -z
    out = rig_of(asset, [f"bone{i}" for i in range(22)], axes=facing).write()
    from piavatar_envs.avatar.body.rigs import VRM_JOINTS

    bones = {bone: joint_index(joint) + 1 for joint, bone in VRM_JOINTS.items()}
    bones |= {"spine": 4, "chest": 7, "upperChest": 10}
    humanoid = (
        {"humanBones": [{"bone": bone, "node": node} for bone, node in bones.items()]}
        if version == "VRM"
        else {"humanBones": {bone: {"node": node} for bone, node in bones.items()}}
    )
    out.document["extensions"] = {version: {"humanoid": humanoid}}
    character = read_character(out.save(tmp_path / "a.vrm"))
    np.testing.assert_allclose(character.joints, standing[0], atol=1e-6)


def test_a_rig_of_two_spine_joints_without_toes_neck_and_collars(asset, standing, tmp_path):
    lacks = {"spine2", "neck", "left_collar", "right_collar", "left_foot", "right_foot"}
    rig = rig_of(asset, named("kaykit"), axes=np.diag([-1.0, 1.0, -1.0]) @ Y_UP)
    kept = [
        i for i, joint in enumerate(named("kaykit")) if joint not in {named("kaykit")[joint_index(j)] for j in lacks}
    ]
    weights = rig.weights.copy()
    for joint in sorted((joint_index(name) for name in lacks), reverse=True):
        weights[:, PARENTS[joint]] += weights[:, joint]
    rig.names, rig.parents, rig.joints = without(lacks, rig.names, rig.parents, rig.joints)
    rig.weights = weights[:, kept]
    character = read_character(rig.write().save(tmp_path / "a.glb"))
    assert np.linalg.norm(character.joints - standing[0], axis=1).max() < 0.03
    assert "no spine2, left_foot, right_foot, neck, left_collar, right_collar" in " ".join(character.notes)
    body = body_of(character)
    assert body.volume([]) == pytest.approx(asset.volume(np.zeros(len(asset.shape_names))), rel=0.01)
    assert (dense_weights(body.skin_joints, body.skin_weights).sum(axis=0) > 1.0).all()  # every bone has flesh


def test_things_on_bones_are_held_and_scenery_is_left_out(asset, tmp_path):
    out = rig_of(asset, named("mixamo")).write()
    points = out.accessor(np.random.default_rng(0).normal(size=(3, 3)).astype(np.float32), "VEC3")
    mesh = out.add("meshes", {"primitives": [{"attributes": {"POSITION": points}}]})
    hand = 1 + joint_index("left_wrist")
    sword = out.add("nodes", {"name": "Head", "mesh": mesh, "translation": [0.0, 0.1, 0.0]})  # named as a joint
    out.document["nodes"][hand]["children"] = [sword]
    out.document["scenes"][0]["nodes"].append(out.add("nodes", {"name": "floor", "mesh": mesh}))
    character = read_character(out.save(tmp_path / "a.glb"))
    assert [(s.name, s.held) for s in character.surfaces] == [("Head", True), ("Body", False)] or [
        (s.name, s.held) for s in character.surfaces
    ] == [("Body", False), ("Head", True)]
    assert character.held.sum() == 1 and any("hang on no bone: floor" in note for note in character.notes)
    (held,) = (s for s in character.surfaces if s.held)
    corners = character.faces[held.first : held.last].ravel()
    assert (character.weights[corners, joint_index("left_wrist")] == 1.0).all()


def test_a_file_without_a_skin_is_another_source(asset, tmp_path):
    out = rig_of(asset, named("mixamo")).write()
    del out.document["nodes"][-1]["skin"]
    with pytest.raises(ValueError, match=r"no skinned mesh.*source .mesh"):
        read_character(out.save(tmp_path / "a.glb"))


def test_a_file_without_nodes_is_refused(tmp_path):
    path = tmp_path / "a.gltf"
    path.write_text('{"asset": {"version": "2.0"}}')
    with pytest.raises(ValueError, match="no skinned mesh"):
        read_character(path)


def test_mapping_and_errors_of_the_rig(asset, standing, tmp_path):
    names = [f"Bone.{index:03d}" for index in range(22)]
    path = rig_of(asset, names).write().save(tmp_path / "a.glb")
    with pytest.raises(ValueError, match=r"a\.glb: no node for head.*mapping="):
        load_asset("glb", path)
    mapping = tmp_path / "map.json"
    from piavatar_envs.avatar.body.skeleton import JOINT_NAMES

    mapping.write_text(json.dumps(dict(zip(JOINT_NAMES, names, strict=True))))
    body = load_asset("glb", path, mapping=str(mapping))
    np.testing.assert_allclose(body.mean_body().joints, standing[0], atol=1e-4)


@pytest.mark.parametrize(
    ("size", "factor"),
    [(1.75, 1.0), (0.3, 1.0), (3.0, 1.0), (175.0, 0.01), (69.0, 0.0254), (5.8, 0.3048), (0.0175, 100)],
)
def test_units_are_found_from_the_height(size, factor):
    assert scale_of(size, None, "a.glb")[0] == factor
    assert scale_of(size, 1.6, "a.glb")[0] == pytest.approx(1.6 / size)


@pytest.mark.parametrize("size", [0.2, 12.0, 1e9, 1e-9, 0.0, np.inf])
def test_other_heights_are_refused(size):
    with pytest.raises(ValueError, match=r"height=1\.75|tall"):
        scale_of(size, None, "a.glb")
    with pytest.raises(ValueError, match=r"height=0\.1 is outside"):
        scale_of(1.75, 0.1, "a.glb")


def test_a_million_triangles_are_read_in_seconds(asset, tmp_path):
    out = rig_of(asset, named("mixamo")).write()
    side = 708
    across, along = np.meshgrid(
        np.linspace(0.0, 1.0, side, dtype=np.float32), np.linspace(0.0, 1.0, side), indexing="ij"
    )
    corner = (np.arange(side - 1)[:, None] * side + np.arange(side - 1)).ravel()
    square = np.stack([corner, corner + side, corner + 1, corner + 1, corner + side, corner + side + 1], axis=1)
    cape = {
        "POSITION": out.accessor(np.stack([across, along, 0.0 * along], -1).reshape(-1, 3).astype("<f4"), "VEC3"),
        "JOINTS_0": out.accessor(np.full((side * side, 4), 9, "<u1"), "VEC4"),
        "WEIGHTS_0": out.accessor(np.full((side * side, 4), 0.25, "<f4"), "VEC4"),
    }
    indices = out.accessor(square.astype("<u4").ravel(), "SCALAR")
    mesh = out.add("meshes", {"primitives": [{"attributes": cape, "indices": indices}]})
    out.document["scenes"][0]["nodes"].append(out.add("nodes", {"name": "cape", "mesh": mesh, "skin": 0}))
    path = out.save(tmp_path / "a.glb")
    tracemalloc.start()
    begin = time.process_time()
    character = read_character(path)
    seconds, (_, peak) = time.process_time() - begin, tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert len(character.faces) > 1_000_000 and seconds < 20.0 and peak < 1e9


@pytest.fixture
def knight(asset, tmp_path):
    """Return the setting of a character in centimetres."""
    material = {"name": "skin", "pbrMetallicRoughness": {"baseColorFactor": [0.2, 0.5, 1.0, 1.0]}}
    path = rig_of(asset, named("mixamo"), unit=100.0, material=material).write().save(tmp_path / "knight.glb")
    return {"source": "glb", "path": str(path), "height": 1.75}


@pytest.mark.parametrize("task", ["PIAvatar/Reach-v0", "PIAvatar/KickBall-v0"])
def test_a_character_plays(task, knight, device):
    env = gym.make(task, avatar=knight, fidelity="tiny", device=device)
    env.reset(seed=0)
    env.action_space.seed(0)
    for _ in range(3):
        observation, _, terminated, _, info = env.step(env.action_space.sample())
        assert np.isfinite(observation).all() and not terminated, info
    env.close()


def test_characters_wrestle(knight, device):
    pytest.importorskip("pettingzoo", reason="needs the extra multi")
    from piavatar_envs.multi import sumo_v0

    game = sumo_v0.parallel_env(avatar=knight, fidelity="tiny", device=device)
    game.reset(seed=0)
    for _ in range(3):
        observations, *_ = game.step({agent: game.action_space(agent).sample() for agent in game.agents})
        assert len(observations) == 2 and all(np.isfinite(values).all() for values in observations.values())
    game.close()


def test_a_second_figure_is_left_out(asset, standing, tmp_path):
    out = rig_of(asset, named("mixamo")).write()
    document, count = out.document, len(out.document["nodes"])
    others = copy.deepcopy(document["nodes"])
    for node in others:
        node["children"] = [child + count for child in node.get("children", [])]
    others[0]["matrix"] = (
        np.block([[np.eye(3), np.array([[1.5], [0.0], [0.0]])], [0.0, 0.0, 0.0, 1.0]]).T.ravel().tolist()
    )
    others[-1] |= {"name": "Other", "skin": 1}
    document["nodes"] += others
    document["skins"].append(document["skins"][0] | {"joints": [j + count for j in document["skins"][0]["joints"]]})
    document["scenes"][0]["nodes"] += [root + count for root in document["scenes"][0]["nodes"]]
    character = read_character(out.save(tmp_path / "two.glb"))
    assert character.notes == ("left out, for they belong to another skeleton: Other",)
    np.testing.assert_allclose(character.vertices, standing[1], atol=1e-6)
