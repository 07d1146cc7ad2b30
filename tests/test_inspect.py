"""Reports on files of avatars: what ``python -m piavatar_envs inspect`` prints and draws."""

from __future__ import annotations

import json

import numpy as np
import pytest

from piavatar_envs import cli, inspection
from piavatar_envs.avatar.body.skeleton import joint_index
from piavatar_envs.avatar.body.sources import load_asset
from scripts.gltf_files import rig_of
from scripts.synthetic_character import character
from tests.avatar.test_rigs import named, without


@pytest.fixture(scope="module")
def knight(tmp_path_factory):
    """Write a body in centimetres without toes, with a skirt and a sword, and an animation."""
    path = tmp_path_factory.mktemp("own") / "knight.glb"
    rig = rig_of(load_asset(), named("mixamo"), unit=100.0, material={"name": "steel"})
    toes = {"left_foot", "right_foot"}
    for side in ("left", "right"):
        rig.weights[:, joint_index(f"{side}_ankle")] += rig.weights[:, joint_index(f"{side}_foot")]
    kept = [i for i in range(22) if i not in map(joint_index, toes)]
    rig.names, rig.parents, rig.joints = without(toes, rig.names, rig.parents, rig.joints)
    rig.weights = rig.weights[:, kept]
    out = rig.write()
    around = np.linspace(0.0, 2.0 * np.pi, 33)[:-1]
    ring = np.stack([30.0 * np.cos(around), np.zeros(32), 30.0 * np.sin(around)], axis=1)
    tube = np.concatenate([ring + [0.0, 50.0, 0.0], ring + [0.0, 90.0, 0.0]]).astype(np.float32)
    low, after = np.arange(32), np.roll(np.arange(32), -1)
    faces = np.concatenate([np.stack([low, after, low + 32], 1), np.stack([after, after + 32, low + 32], 1)])
    skirt = {
        "POSITION": out.accessor(tube, "VEC3"),
        "JOINTS_0": out.accessor(np.zeros((64, 4), np.uint8), "VEC4"),
        "WEIGHTS_0": out.accessor(np.tile(np.float32([1, 0, 0, 0]), (64, 1)), "VEC4"),
    }
    corners = out.accessor(faces.astype(np.uint16).ravel(), "SCALAR")
    mesh = out.add("meshes", {"primitives": [{"attributes": skirt, "indices": corners}]})
    sword = out.add("meshes", {"primitives": [{"attributes": {"POSITION": skirt["POSITION"]}, "indices": corners}]})
    hand = out.document["nodes"][rig.names.index("mixamorig:LeftHand") + 1]
    hand["children"] = [out.add("nodes", {"name": "sword", "mesh": sword})]
    out.document["scenes"][0]["nodes"].append(out.add("nodes", {"name": "skirt", "mesh": mesh, "skin": 0}))
    times = out.accessor(np.float32([0.0, 1.5]), "SCALAR")
    turns = out.accessor(np.float32([[0, 0, 0, 1], [0, 1, 0, 0]]), "VEC4")
    channel = {"sampler": 0, "target": {"node": 1, "path": "rotation"}}
    out.add("animations", {"name": "spin", "samplers": [{"input": times, "output": turns}], "channels": [channel]})
    return out.save(path)


def test_a_report_names_joints_size_and_what_is_worn(knight, capsys):
    cli.main(["inspect", str(knight), "--json", "-c", "avatar.height=1.75"])  # as for play and watch
    report = json.loads(capsys.readouterr().out)
    joints = ", ".join(report["joints"])
    assert "left_elbow = mixamorig:LeftForeArm" in joints and "spine3 = mixamorig:Spine2" in joints
    assert report["joints made"] == "left_foot, right_foot" and report["source"] == "glb"
    assert report["height"].startswith("1.75") and float(report["volume"].split()[0]) == pytest.approx(68.8, rel=0.01)
    assert report["mass"] == f"{float(report['volume'].split()[0]):.1f} kg at 1000 kg/m^3"
    assert report["body"] == ["Body (steel): 26756 of 26756 triangles"]
    assert report["worn"] == ["skirt: 64 of 64 triangles"] and report["held"] == ["sword: 64 of 64 triangles"]
    assert report["animations"] == ["spin: 1.50 s"]
    assert any("no left_foot, right_foot" in note for note in report["notes"])
    cli.main(["inspect", str(knight)])
    printed = capsys.readouterr().out
    assert "taken for centimetres" in " ".join(printed.split()) and "skirt" in printed


def test_a_picture_shows_the_body_and_its_skeleton(knight, tmp_path):
    image = pytest.importorskip("PIL.Image")
    inspection.examine(knight, picture=tmp_path / "knight.png")
    picture = np.asarray(image.open(tmp_path / "knight.png")).astype(float)
    assert picture.shape == (640, 1536, 3)
    red = (picture[..., 0] > 200) & (picture[..., 2] < 100)  # joints
    assert not red[:, :1024].any() and red[:, 1024:].sum() > 1000
    sides = [picture[:, first : first + 512] for first in (0, 512)]
    assert np.abs(sides[0] - sides[1]).mean() > 2.0


@pytest.mark.parametrize(
    ("name", "args", "words"),
    [
        ("a.fbx", [], "is FBX, which is not read; convert it to GLB by Blender"),
        ("a.xyz", [], "no avatar source reads"),
        ("a.glb", [], "is not a glTF file"),
        ("a.bvh", ["-c", "height=2"], "it has mapping"),
    ],
)
def test_mistakes_end_in_one_line(name, args, words, tmp_path, capsys):
    (tmp_path / name).write_bytes(b"?")
    with pytest.raises(SystemExit) as stop:
        cli.main(["inspect", str(tmp_path / name), *args])
    error = capsys.readouterr().err
    assert stop.value.code == 2 and words in error and error.count("\n") == 1


def test_another_source_may_be_named(knight, capsys):
    with pytest.raises(SystemExit):
        cli.main(["inspect", str(knight), "-c", "source=mash"])
    assert "unknown avatar source 'mash'" in capsys.readouterr().err
    with pytest.raises(ValueError, match="'mesh' has no setting mapping='a'"):
        inspection.examine(knight, {"source": "mesh", "mapping": "a"})


def test_unknown_settings_and_files_are_refused(knight, tmp_path):
    with pytest.raises(ValueError, match=r"no setting tall=2; it has path, height, mapping"):
        inspection.examine(knight, {"tall": 2})
    with pytest.raises(FileNotFoundError):
        inspection.examine(tmp_path / "none.glb")
    with pytest.raises(ValueError, match="is a folder"):
        inspection.examine(tmp_path)


def test_the_example_character_has_hair_of_its_body_and_a_worn_skirt(tmp_path):
    report = inspection.examine(character().save(tmp_path / "hero.glb"))
    assert report["joints made"] == "none" and report["height"].startswith("1.7")
    assert [row.partition(":")[0] for row in report["body"]] == ["Body", "Hair (hair)"]
    assert [row.partition(":")[0] for row in report["worn"]] == ["Skirt (cloth)"]
