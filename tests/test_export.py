"""Export of environments: the frames of a film are the states of a run."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest

from piavatar_envs.api.pictures import SceneReader
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


@pytest.mark.parametrize("view", ["gymnasium", "sb3"])
def test_a_recording_is_of_any_environment_of_a_vector(device, tmp_path, view):
    """The third of four environments in two groups."""
    settings = {"num_envs": 4, "fidelity": "tiny", "device": device, "num_threads": 2}
    if view == "gymnasium":
        vector = gymnasium.make_vec("PIAvatar/Reach-v0", **settings)
    else:
        vector = pytest.importorskip("piavatar_envs.api.sb3", exc_type=ImportError).SB3VecEnv("Reach-v0", **settings)
    vector.seed(0) if view == "sb3" else vector.reset(seed=0)
    if view == "sb3":
        vector.reset()
    with pytest.raises(ValueError, match=r"index=4 is outside \[0, 3\]"):
        Recording(vector, tmp_path / "none", index=4)
    recordings = [Recording(vector, str(tmp_path / f"{index}"), index=index) for index in (1, 2)]
    vector.step(np.stack([vector.action_space.sample()] * 4) if view == "sb3" else vector.action_space.sample())
    for recording in recordings:
        recording.add()
    host = vector.host if view == "sb3" else vector.unwrapped.host
    for index, recording in zip((1, 2), recordings, strict=True):
        batch, own = host.group_of(index)
        expected = SceneReader(batch).scene(own).bodies[0].vertices
        gltf = read_gltf(recording.finish()[0])
        written = gltf.accessor(gltf.json["meshes"][0]["primitives"][0]["attributes"]["POSITION"])
        np.testing.assert_allclose(written[:, [0, 2, 1]] * [1, -1, 1], expected, atol=1e-5)
    vector.close()


def test_a_recording_refuses_mistakes_before_the_first_frame(make_env, tmp_path):
    env = make_env("PIAvatar/Reach-v0")
    for wrong, message in (
        ({"kind": "fbx"}, "no format"),
        ({"color": "strain"}, "glTF"),
        ({"kind": "ply", "color": "pink"}, "no color"),
        ({"env": gymnasium.make("CartPole-v1")}, "not of this suite"),
        ({"index": 1}, "outside"),
    ):
        with pytest.raises(ValueError, match=message):
            Recording(**{"env": env, "folder": tmp_path / "new", **wrong})
    with pytest.raises(TypeError):
        Recording(env, None)
    for kind in ("glb", "ply"):
        with pytest.raises(ValueError, match="shows nothing"):
            Recording(env, tmp_path / "new", kind).finish()
    assert not (tmp_path / "new").exists()


def test_a_failed_simulation_leaves_no_body_in_a_recording(make_env, tmp_path):
    env = make_env("PIAvatar/Reach-v0")
    env.reset(seed=0)
    recording, x = Recording(env, tmp_path / "film", "ply"), env.batch.simulation.state.x
    recording.add()
    failed = x.numpy().copy()
    failed[0, ::5] = np.nan
    x.assign(failed)
    with pytest.warns(UserWarning, match="not finite"):
        recording.add()
    assert [file.name for file in (tmp_path / "film" / "body_0").iterdir()] == ["0000.ply"]
    env.reset(seed=0)


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
