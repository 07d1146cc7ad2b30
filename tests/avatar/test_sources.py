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
from piavatar_envs.sim.world import Simulation

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


def test_a_source_reads_the_file_that_it_is_given(tmp_path):
    file = tmp_path / "factor.txt"
    file.write_text("0.5")
    assert np.ptp(load_asset("scaled", str(file)).vertices) == pytest.approx(0.5 * np.ptp(load_asset().vertices))
    assert load_asset("scaled", str(file)) is load_asset("scaled", str(file))


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
