"""Export of environments: the frames of a film are the states of a run."""

from __future__ import annotations

import numpy as np
import pytest

from piavatar_envs.avatar.gltf import read_gltf
from piavatar_envs.cli import main
from piavatar_envs.export import Recording, export


def test_a_recording_has_the_skin_of_every_state(make_env, tmp_path):
    env = make_env("PIAvatar/Reach-v0")
    env.reset(seed=0)
    recording, skins = Recording(env, tmp_path / "film"), []
    for _ in range(3):
        env.step(env.action_space.sample())
        recording.add()
        skins.append(recording._scenes.scene(0).bodies[0].vertices)
    gltf = read_gltf(recording.finish()[0])
    primitive = gltf.json["meshes"][0]["primitives"][0]
    base = gltf.accessor(primitive["attributes"]["POSITION"])
    for skin, target in zip(skins, (0.0, *primitive["targets"]), strict=True):
        moved = base + (gltf.accessor(target["POSITION"]) if target else 0.0)
        np.testing.assert_allclose(moved[:, [0, 2, 1]] * [1, -1, 1], skin, atol=1e-5)
    sampler = gltf.json["animations"][0]["samplers"][0]
    np.testing.assert_allclose(np.diff(gltf.accessor(sampler["input"])[:, 0]), env.config.physics.control_dt, rtol=1e-5)


def test_command_exports_a_game(tmp_path, capsys):
    pytest.importorskip("pettingzoo")
    out = tmp_path / "sumo"
    main(["export", "sumo_v0", "--out", str(out), "--format", "ply", "--steps", "2", "-c", "fidelity=tiny"])
    assert {"body_0", "body_1"} <= {folder.name for folder in out.iterdir()}
    assert [file.name for file in sorted((out / "body_1").iterdir())] == ["0000.ply", "0001.ply", "0002.ply"]
    assert str(out / "body_1") in capsys.readouterr().out


def test_mistakes_are_found_before_the_run(tmp_path, monkeypatch):
    def make(*_arguments):
        raise AssertionError("it was made")

    monkeypatch.setattr("piavatar_envs.export.make", make)
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "file").touch()
    for wrong, message in (
        ({"folder": tmp_path / "full"}, "not empty"),
        ({"folder": tmp_path / "full" / "file"}, "is a file"),
        ({"kind": "fbx"}, "no format"),
        ({"steps": 0}, "steps"),
        ({"color": "strain"}, "glTF"),
        ({"agent": "clever"}, "agent"),
    ):
        with pytest.raises(ValueError, match=message):
            export("PIAvatar/Reach-v0", **{"folder": tmp_path / "new", **wrong})
    assert not (tmp_path / "new").exists()
