"""Avatar sources and motions of one's own: one function each, registered from outside the package."""

from __future__ import annotations

import dataclasses
import importlib.util

import gymnasium as gym
import numpy as np
import pytest

import piavatar_envs
from piavatar_envs.avatar.body.sources import list_sources, load_asset
from piavatar_envs.avatar.motion import list_motions, load_motion
from piavatar_envs.config import ConfigError, EnvConfig, load_config
from piavatar_envs.envs.pixels import SHOWN_HEIGHT, task_camera
from piavatar_envs.envs.state import file_digests
from piavatar_envs.sim.world import Simulation
from piavatar_envs.tasks.track_motion import TrackMotionConfig

REACH, TRACK = "PIAvatar/Reach-v0", "PIAvatar/TrackMotion-v0"

MODULE = """
import dataclasses

from piavatar_envs import register_motion, register_source
from piavatar_envs.avatar.body.sources import load_asset
from piavatar_envs.avatar.motion.keyframes import Key, animate


def scaled(path=None):
    factor = 0.9 if path is None else float(open(path).read())
    asset = load_asset()
    lengths = {name: factor * getattr(asset, name) for name in ("vertices", "joints", "shape_deltas", "shape_joints")}
    return dataclasses.replace(asset, name="scaled", **lengths)


def shrug(rest_joints):
    return animate("shrug", [Key(time=0.0), Key(time=1.0)], rest_joints)


register_source("scaled", scaled)
register_motion("shrug", shrug)
"""


@pytest.fixture(scope="module", autouse=True)
def registered(tmp_path_factory):
    """Load a module outside the package that registers a source and a motion."""
    file = tmp_path_factory.mktemp("own") / "own_bodies.py"
    file.write_text(MODULE)
    spec = importlib.util.spec_from_file_location("own_bodies", file)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)


def make(env_id: str, device: str, **settings):
    return gym.make(env_id, device=device, fidelity="tiny", disable_env_checker=True, **settings).unwrapped


def test_an_environment_runs_with_a_registered_source(device):
    assert {"embedded", "scaled"} <= set(list_sources())
    env, usual = make(REACH, device, avatar={"source": "scaled"}), make(REACH, device)
    heights = [np.ptp(e.batch.simulation.flesh[0].points.rest[0][:, 2]) for e in (env, usual)]
    assert heights[0] / heights[1] == pytest.approx(0.9, rel=0.02)
    env.reset(seed=0)
    for _ in range(3):
        observation, *_, info = env.step(np.zeros(env.action_space.shape, np.float32))
        assert np.isfinite(observation).all() and info["failure"] == 0
    env.close()
    usual.close()


def test_each_avatar_of_a_scene_may_have_a_source_of_its_own(device):
    from piavatar_envs.multi import sumo_v0

    avatars = [{}, {"avatar": {"source": "scaled"}}]
    avatars = [
        {"position": [0.0, y], "yaw": yaw, **own} for own, y, yaw in zip(avatars, (0.6, -0.6), (0.0, 3.14), strict=True)
    ]
    world = sumo_v0.parallel_env(device=device, fidelity="tiny", scene={"avatars": avatars})
    world.reset(seed=0)
    first, second = (np.ptp(flesh.points.rest[0][:, 2]) for flesh in world.unwrapped.batch.simulation.flesh)
    assert second / first == pytest.approx(0.9, rel=0.02)
    world.step({agent: np.zeros(world.action_space(agent).shape, np.float32) for agent in world.agents})
    world.close()


def test_random_shapes_are_refused_where_sources_have_other_parameters(device):
    # The parameters of one body would be observed under the names of another.
    asset = load_asset()
    names = tuple(f"own_{name}" for name in asset.shape_names)
    piavatar_envs.register_source("renamed", lambda: dataclasses.replace(asset, shape_names=names))
    avatars = [{}, {"position": [1.0, 0.0], "avatar": {"source": "renamed"}}]
    for shape in ({"randomize": True}, {"randomize": True, "pool": 2}):
        settings = {"fidelity": "tiny", "shape": shape, "scene": {"avatars": avatars}}
        with pytest.raises(ConfigError, match=r"shape\.randomize=True.*avatar\.source"):
            Simulation(load_config(EnvConfig, None, settings), 1, device)


def test_shapes_of_one_source_are_drawn_under_its_own_names(device):
    asset = load_asset()
    names = tuple(f"own_{name}" for name in asset.shape_names)
    piavatar_envs.register_source("renamed", lambda: dataclasses.replace(asset, shape_names=names))
    env = make(REACH, device, avatar={"source": "renamed"}, shape={"randomize": True}, observe_parameters=True)
    env.reset(seed=0)
    found = [p.name for p in env.batch.layout["parameters"].parameters]
    assert set(found) >= {f"shape_{name}" for name in names}
    assert np.ptp(env.batch.simulation.flesh[0].shape_parameters) > 0.1
    env.close()


def test_pictures_show_the_look_in_its_colours_unless_a_quantity_is_asked_for(device):
    asset = load_asset()
    green = np.tile(np.array([[30, 200, 40]], np.uint8), (len(asset.drawn.vertices), 1))
    looks = dataclasses.replace(asset, look=dataclasses.replace(asset.drawn, colors=green))
    piavatar_envs.register_source("green", lambda: looks)
    counts = []
    for color in ("skin", "strain"):
        env = make(REACH, device, render_mode="rgb_array", avatar={"source": "green"}, color=color)
        env.reset(seed=0)
        red, greens, blue = np.moveaxis(env.render().astype(int), -1, 0)
        counts.append(int((greens - np.maximum(red, blue) > 25).sum()))
        env.close()
    assert counts[0] > 1000 and counts[1] < 0.05 * counts[0]


def test_the_look_of_a_shape_stands_where_its_skin_does():
    asset = load_asset(appearance="skin")
    raised = dataclasses.replace(asset.drawn, vertices=asset.vertices + np.float32(0.05))
    dressed = dataclasses.replace(asset, look=raised)
    parameters = asset.parameters(height=0.7, weight=-0.4)
    shaped, drawn = dressed.shape(parameters), dressed.shape_drawn(parameters)
    np.testing.assert_allclose(drawn.vertices, shaped.vertices + 0.05, atol=1e-5)
    np.testing.assert_array_equal(drawn.joints, shaped.joints)


def test_settings_below_avatar_go_to_the_source(device):
    seen = []

    def tuned(path=None, height=1.7, betas=(), name="x"):
        seen.append((path, height, betas, name))
        return load_asset()

    piavatar_envs.register_source("tuned", tuned)
    make(REACH, device, avatar={"source": "tuned", "height": 1.5, "betas": [0.1, -2]}).close()
    assert seen[-1] == (None, 1.5, (0.1, -2), "x")
    config = load_config(EnvConfig, None, {"avatar.source": "tuned", "avatar.name": "y"})
    assert load_config(EnvConfig, config.model_dump(mode="json")) == config
    with pytest.raises(
        ConfigError, match=r"^avatar: .*'tuned' has no setting hight=2; it has path, height, betas, name"
    ):
        load_config(EnvConfig, None, {"avatar": {"source": "tuned", "hight": 2}})
    with pytest.raises(ConfigError, match=r"^scene\.avatars\.1\.avatar: .*'embedded'.*height"):
        load_config(EnvConfig, None, {"scene.avatars": [{}, {"avatar": {"height": 2.0}, "position": [1.0, 0.0]}]})
    # an avatar that names a source has none of the environment's settings; one that does not changes some
    own = {"scene.avatars": [{"avatar": {"source": "embedded"}}, {"avatar": {"height": 1.2}, "position": [1.0, 0.0]}]}
    config = load_config(EnvConfig, config, own)
    chosen = [config.avatar.of_avatar(avatar.avatar) for avatar in config.scene.avatars]
    assert [one.settings for one in chosen] == [{}, {"name": "y", "height": 1.2}]
    piavatar_envs.register_source("needy", lambda path: load_asset())
    with pytest.raises(ConfigError, match="'needy' needs the setting path"):
        load_config(EnvConfig, None, {"avatar.source": "needy"})


def test_a_file_that_changed_is_read_again(tmp_path):
    file = tmp_path / "factor.txt"
    file.write_text("0.5")
    before = load_asset("scaled", str(file))
    file.write_text("0.75")
    assert np.ptp(load_asset("scaled", str(file)).vertices) == pytest.approx(1.5 * np.ptp(before.vertices))


def test_a_changed_folder_and_files_beside_a_gltf_are_read_again(tmp_path):
    folder, gltf = tmp_path / "bones", tmp_path / "a.gltf"
    folder.mkdir()
    names = "".join(f'{{"uri" : "{name}"}}, ' for name in ("data:,x", "its%20data.bin", "/etc/hosts"))
    gltf.write_text(f'{{"buffers": [{names}[[[')  # and damaged behind
    read = []
    piavatar_envs.register_source("counted", lambda path: read.append(path) or load_asset())
    for path, file in ((folder, folder / "tibia_l.ply"), (gltf, tmp_path / "its data.bin")):
        file.write_text("0")
        config = load_config(EnvConfig, None, {"avatar": {"source": "counted", "path": str(path)}})
        digests = []
        for content in ("1", "1", "22"):
            file.write_text(content) if file.read_text() != content else None
            load_asset("counted", path)
            digests.append(file_digests(config)["avatar.path"])
        assert read == [str(path)] * 2 and digests[0] == digests[1] != digests[2]
        read.clear()


def test_folders_of_an_avatar_need_no_slash_to_be_part_of_a_state(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("bones", "embedded", "step"):
        (tmp_path / name).mkdir()
    config = load_config(TrackMotionConfig, None, {"avatar.skeleton": "bones", "motion": "step"})
    assert set(file_digests(config)) == {"avatar.skeleton"}


@pytest.mark.parametrize(
    ("source", "settings", "message"),
    [
        ("glb", {"height": "tall"}, "height='tall': it must be a valid number"),
        ("glb", {"height": True}, "height=True: it must be a valid number"),
        ("smplx", {"flat_hand": "no"}, "flat_hand='no': it must be a valid boolean"),
        ("smplx", {"betas": 1.0}, "betas=1.0: it must be a list"),
        ("smplx", {"num_betas": 2.5}, "num_betas=2.5: it must be a valid integer"),
    ],
)
def test_values_of_another_type_are_refused(source, settings, message):
    with pytest.raises(ConfigError, match=f"^avatar: avatar source '{source}' has {message}"):
        load_config(EnvConfig, None, {"avatar": {"source": source, "path": "a.glb", **settings}})


def test_bodies_without_shape_parameters_refuse_shapes(device):
    asset = load_asset()
    none = dataclasses.replace(
        asset, shape_names=(), shape_deltas=asset.shape_deltas[:0], shape_joints=asset.shape_joints[:0]
    )
    piavatar_envs.register_source("rigid", lambda: none)
    shapes = [{"randomize": True}, {"parameters": {"weight": 0.5}}]
    for shape, message in zip(shapes, ["no shape parameters; leave", "'weight'; this body has none"], strict=True):
        with pytest.raises(ConfigError, match=message):
            make(REACH, device, avatar={"source": "rigid"}, shape=shape)


@pytest.mark.parametrize("height", [1.1, 2.95])
def test_small_and_tall_bodies_have_room(device, height):
    asset = load_asset()
    factor = np.float32(height / np.ptp(asset.vertices[:, 2]))
    lengths = {name: factor * getattr(asset, name) for name in ("vertices", "joints", "shape_deltas", "shape_joints")}
    sized = dataclasses.replace(asset, **lengths)
    piavatar_envs.register_source("sized", lambda: sized)
    env = make(REACH, device, avatar={"source": "sized"})
    env.reset(seed=0)
    *_, info = env.step(np.zeros(env.action_space.shape, np.float32))
    assert info["failure"] == 0
    camera, shown = task_camera(env.batch, env.batch.task, 1.0), 2.95 / SHOWN_HEIGHT if height > 2.0 else 1.0
    np.testing.assert_allclose(camera.position, shown * np.array(env.batch.task.place_camera(1.0)[0]), rtol=0.05)
    env.close()
    place = (3.0, -2.0, 1.0)
    env = make(REACH, device, avatar={"source": "sized"}, camera_position=place)
    assert task_camera(env.batch, env.batch.task, 1.0).position == place
    env.close()


def test_a_source_reads_the_file_that_it_is_given(tmp_path):
    file = tmp_path / "factor.txt"
    file.write_text("0.5")
    assert np.ptp(load_asset("scaled", str(file)).vertices) == pytest.approx(0.5 * np.ptp(load_asset().vertices))
    assert load_asset("scaled", str(file)) is load_asset("scaled", str(file))


def test_every_refusal_of_a_file_names_it(tmp_path):
    (tmp_path / "person.dat").touch()

    def refusing(path: str) -> None:
        raise ValueError("the surface is too thin")

    piavatar_envs.register_source("refusing", refusing)
    with pytest.raises(ValueError, match=r"person\.dat: the surface is too thin"):
        load_asset("refusing", tmp_path / "person.dat")


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"source": "none"}, "avatar.source='none'.*embedded, .*scaled"),
        ({"path": "body.glb"}, "avatar.*embedded.*body.glb"),
        ({"source": "scaled", "path": "missing.txt"}, "avatar.*missing.txt"),
    ],
)
def test_bad_sources_are_refused(device, settings, message):
    with pytest.raises(ConfigError, match=message):
        make(REACH, device, avatar=settings)


def test_names_and_functions_are_checked():
    for register, own in ((piavatar_envs.register_source, "embedded"), (piavatar_envs.register_motion, "squat")):
        with pytest.raises(ValueError, match=own):
            register(own, lambda *_: None)
        with pytest.raises(TypeError, match="mine"):
            register("mine", "a string")
    piavatar_envs.register_source("broken", lambda: {})
    with pytest.raises(TypeError, match="AvatarAsset"):
        load_asset("broken")
    piavatar_envs.register_source("broken", load_asset)  # registered again, it is replaced
    assert load_asset("broken") is load_asset()


def test_an_environment_tracks_a_registered_motion(device):
    assert "shrug" in list_motions()
    assert load_motion("shrug").duration == pytest.approx(1.0)
    env = make(TRACK, device, motion="shrug")
    env.reset(seed=0)
    *_, info = env.step(np.zeros(env.action_space.shape, np.float32))
    assert info["failure"] == 0
    env.close()
