"""The view of one environment: settings, seeds, refusals, infos and pictures."""

from __future__ import annotations

import importlib
import warnings
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import SimpleNamespace

import gymnasium
import numpy as np
import pytest

from piavatar_envs.api.gym_env import AvatarEnv
from piavatar_envs.api.host import EpisodeHost
from piavatar_envs.config import ConfigError, EnvConfig, load_config
from tests.api.runs import bytes_of

ROOT = Path(__file__).parents[2]
KICK = "PIAvatar/KickBall-v0"


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"bogus": 1}, ["bogus", "obs_mode"]),
        ({"fidelty": "tiny"}, ["fidelty", "physics.fidelity"]),
        ({"fidelity": "ultra"}, ["physics.fidelity='ultra'", "'tiny'", "'coarse'"]),
        ({"obs_mode": "image"}, ["obs_mode='image'", "'flat'", "'dict'"]),
        ({"control": "pose", "tone": 2.0}, ["control.tone=2.0", "<= 1"]),
        ({"root_assist": 1.0, "tone": 0.5}, ["control.root_assist=1.0", "control.mode='pd'"]),
        ({"config": {"control": {"tune": 1}}}, ["control.tune", "control.tone"]),
        ({"config": "no/such/file.yaml"}, ["no/such/file.yaml"]),
        ({"config": ROOT / "configs/sb3/reach_sb3.yaml"}, ["reach_sb3.yaml", "under its key env"]),
        ({"device": "cuda:99"}, ["device='cuda:99'", "cpu"]),
        ({"device": "tpu"}, ["device='tpu'", "cpu"]),
        ({"render_mode": "ansi"}, ["render_mode='ansi'", "rgb_array", "human"]),
        ({"task": "Fly-v0"}, ["'Fly-v0'", "PIAvatar/Reach-v0", "PIAvatar/TrackMotion-v0"]),
        ({"task": "sumo_v0"}, ["sumo_v0", "piavatar_envs.multi.sumo_v0.parallel_env"]),
        ({"shape.parameters": {"tallness": 0.5}}, ["shape.parameters", "'tallness'", "height"]),
        ({"mosaic": 4}, ["render.mosaic=4", "num_envs=1", "gym.make_vec"]),
        ({"young_modulus": 1e9, "num_substeps": 4}, ["CFL limit", "num_substeps >= "]),
        (
            {"camera_position": (0.0, 0.0, 1.0), "camera_target": (0, 0, 1), "render_mode": "rgb_array"},
            ["camera_position=[0.0, 0.0, 1.0]"],
        ),
    ],
)
def test_bad_settings_are_refused_in_one_line_with_the_alternatives(device, settings, words):
    with pytest.raises(ValueError) as caught:
        AvatarEnv(**{"task": "KickBall-v0", "device": device, "fidelity": "tiny", **settings})
    message = str(caught.value)
    assert "\n" not in message and all(word in message for word in words), message


@pytest.mark.parametrize("view", ["make", "make_vec", "pettingzoo", "sb3", "skrl", "rsl_rl"])
def test_an_unknown_keyword_is_a_type_error_too(device, view):
    """Libraries such as TorchRL try keywords of their own, and look for Python's own words to leave them out."""
    needed = {"pettingzoo": "pettingzoo", "sb3": "stable_baselines3", "skrl": "skrl", "rsl_rl": "rsl_rl"}
    if view in needed:
        pytest.importorskip(needed[view], reason="an optional extra")

    def make(**settings):
        settings = {"device": device, "fidelity": "tiny", **settings}
        if view.startswith("make"):
            return getattr(gymnasium, view)(KICK, **settings)
        module = importlib.import_module(f"piavatar_envs.api.{view}")
        name = {
            "pettingzoo": "AvatarParallelEnv",
            "sb3": "SB3VecEnv",
            "skrl": "AvatarSkrlEnv",
            "rsl_rl": "AvatarRslEnv",
        }
        return getattr(module, name[view])("KickBall-v0", **settings)

    if view == "sb3":
        pytest.importorskip("stable_baselines3")
    with pytest.raises(
        TypeError, match=r"got an unexpected keyword argument 'fidelty'; .*physics\.fidelity\?"
    ) as caught:
        make(fidelty="tiny")
    assert isinstance(caught.value, ConfigError) and "\n" not in str(caught.value)
    for settings in ({"tone": 2.0}, {"control": {"ton": 1.0}}, {"config": {"fidelty": "tiny"}}):
        with pytest.raises(ConfigError) as caught:
            make(**settings)
        assert not isinstance(caught.value, TypeError)


def test_a_yaml_file_and_keywords_configure(tmp_path, device):
    path = tmp_path / "run.yaml"
    path.write_text(
        "episode_seconds: 0.5\nphysics: {fidelity: tiny, control_dt: 0.02}\ncontrol: {mode: pose, tone: 0.25}\n"
    )
    env = gymnasium.make(KICK, device=device, config=path, alpha=0.2).unwrapped
    assert env.config.control.tone == 0.25 and env.config.control.alpha == 0.2
    assert env.batch.max_steps == 25
    assert env.metadata["render_fps"] == 50 and AvatarEnv.metadata["render_fps"] == 30


@pytest.mark.parametrize(("control_dt", "rate"), [(1.0 / 30.0, 30), (0.02, 50), (0.15, 1.0 / 0.15), (0.03, 1.0 / 0.03)])
def test_videos_run_as_fast_as_life(control_dt, rate):
    config = load_config(EnvConfig, None, {"control_dt": control_dt})
    found = EpisodeHost.frame_rate.fget(SimpleNamespace(config=config))
    assert found == rate and type(found) is type(rate)


def test_threads_build_and_step_environments_at_the_same_time(device, equal):
    """Warp captures one graph at a time, and records what other threads launch meanwhile instead of doing it."""

    def play(seed: int) -> list[np.ndarray]:
        env = gymnasium.make("PIAvatar/Reach-v0", device=device, fidelity="tiny", alpha=0.1 + 0.1 * (seed % 2))
        seen = [env.reset(seed=seed)[0]]
        seen += [env.step(np.full(env.action_space.shape, 0.3, np.float32))[0] for _ in range(5)]
        env.close()
        return seen

    with ThreadPoolExecutor(4) as pool:
        together = list(pool.map(play, range(4)))
    assert all(equal(ours, alone) for seed in range(4) for ours, alone in zip(together[seed], play(seed), strict=True))


BALL = {"name": "ball", "size": [0.15], "mass": 4, "position": [0, -1.2, 1.1], "young_modulus": 1e9}
HEAD = {"joints": ["head"], "beyond": 0.04, "young_modulus": 1e9}


@pytest.mark.parametrize(
    ("settings", "cause"),
    [
        ({"young_modulus": 1e9}, r"'agent_0' \(young_modulus=1e\+09 Pa\)"),
        ({"scene": {"props": [BALL]}}, r"'ball' \(young_modulus=1e\+09 Pa\)"),
        ({"scene": {"avatars": [{"regions": [HEAD]}]}}, r"'agent_0' \(young_modulus=1e\+09 Pa\)"),
        ({"num_substeps": 400}, r"num_substeps=400 is set"),
    ],
    ids=["flesh", "prop", "region", "number"],
)
def test_matter_that_makes_steps_slow_warns_with_its_name(device, settings, cause):
    with pytest.warns(UserWarning, match=rf"\d{{3,}} substeps, about [\d.]+ s .*: .*{cause}"):
        AvatarEnv("Reach-v0", device=device, fidelity="tiny", **settings)


def test_the_spec_gives_the_time_limit_and_calls_can_shorten_it(device):
    settings = {"device": device, "fidelity": "tiny"}
    env = gymnasium.make(KICK, episode_seconds=0.2, **settings)
    assert env.spec.max_episode_steps == 6 == gymnasium.make(env.spec).spec.max_episode_steps
    assert "TimeLimit" not in str(env), "the limit is part of the state"
    seen = gymnasium.wrappers.TimeAwareObservation(env)
    assert seen.observation_space.contains(seen.reset(seed=0)[0])
    single = gymnasium.make(KICK, max_episode_steps=2, **settings)
    vector = gymnasium.make_vec(KICK, 2, max_episode_steps=2, **settings)
    assert single.spec.max_episode_steps == vector.spec.max_episode_steps == 2
    for made in (single, vector):
        made.reset(seed=0)
        assert [np.all(made.step(np.zeros(made.action_space.shape, np.float32))[3]) for _ in range(2)] == [False, True]
    given = {"config": {"target_radius": np.float32(0.25)}, "tone": np.float64(0.5), "device": device}
    given |= {"scene.props": [{"name": "a", "position": np.array([1.0, 1.0, 1.0])}], "joints": None}
    env = gymnasium.make("PIAvatar/Reach-v0", **given, fidelity="tiny")
    read = gymnasium.envs.registration.EnvSpec.from_json(env.spec.to_json())
    assert gymnasium.make(read).unwrapped.config == env.unwrapped.config
    assert gymnasium.envs.registration.EnvSpec.from_json(vector.spec.to_json()).max_episode_steps == 2
    with pytest.raises(ValueError, match="max_episode_steps=0 "):
        gymnasium.make_vec(KICK, max_episode_steps=0, **settings)


def test_a_torch_device_is_accepted(device):
    torch = pytest.importorskip("torch")
    if device == "cpu":
        assert AvatarEnv("Reach-v0", device=torch.device("cpu"), fidelity="tiny").batch.device == "cpu"


def test_calls_before_the_first_reset_are_refused(device):
    env = AvatarEnv("Reach-v0", render_mode="rgb_array", device=device, fidelity="tiny")
    for call in (lambda: env.step(env.action_space.sample()), env.render):
        with pytest.raises(gymnasium.error.ResetNeeded):
            call()


@pytest.mark.parametrize("seed", [0, 2**31, 2**32 - 1])
def test_every_seed_of_gymnasium_and_stable_baselines3_is_accepted(make_env, equal, seed):
    env = make_env(KICK)
    first, again = env.reset(seed=seed)[0], env.reset(seed=seed)[0]
    assert equal(first, again)
    assert np.abs(env.reset(seed=(seed + 1) % 2**32)[0] - first).max() > 1e-4


@pytest.mark.parametrize(
    "arguments", [{"seed": -1}, {"seed": 2**32}, {"seed": "one"}, {"seed": 1, "options": {"pose": 1}}], ids=str
)
def test_bad_resets_are_refused_before_anything_changes(make_env, arguments):
    env = make_env(KICK)
    env.reset(seed=4, options={})
    generator, before = env.np_random, bytes_of(env.get_state())
    with pytest.raises((ValueError, gymnasium.error.Error), match=r"[sS]eed|pose"):
        env.reset(**arguments)
    assert env.np_random is generator and env.np_random_seed == 4 and bytes_of(env.get_state()) == before


def test_a_step_after_the_end_warns(device):
    env = AvatarEnv(KICK, device=device, fidelity="tiny", episode_seconds=0.05)
    env.reset(seed=0)
    action = np.zeros(env.action_space.shape, np.float32)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        while not any(env.step(action)[2:4]):
            pass
        state = env.get_state()
    with pytest.warns(UserWarning, match="call reset"):
        env.step(action)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        env.reset()
        env.step(action)
        env.set_state(state)
        env.step(action)


@pytest.mark.parametrize("action", [{"a": 1}, [[0.0], [0.0, 1.0]], "left"])
def test_an_action_that_is_no_array_is_refused(make_env, action):
    env = make_env(KICK)
    env.reset(seed=0)
    with pytest.raises(ValueError, match=r"action is a (dict|list|str).*array of shape"):
        env.step(action)


def test_the_dictionary_is_the_flat_vector_by_name(make_env, sample_id, equal):
    flat, named = make_env(sample_id), make_env(sample_id, obs_mode="dict")
    assert set(named.observation_space) == set(flat.observation_layout)
    pairs = [(flat.reset(seed=8)[0], named.reset(seed=8)[0])]
    rng = np.random.default_rng(8)
    for _ in range(3):
        action = rng.uniform(-1.0, 1.0, flat.action_space.shape)
        pairs.append((flat.step(action)[0], named.step(action)[0]))
    for vector, terms in pairs:
        assert named.observation_space.contains(terms)
        for name, term in flat.observation_layout.items():
            assert equal(terms[name], vector[term.slice]), name
            assert not np.shares_memory(terms[name], named.batch.observation.numpy())


def test_info_has_the_wrench_that_holds_the_body(make_env, sample_id):
    env = make_env(sample_id, control="pose")
    env.reset(seed=0)
    infos = [env.step(np.zeros(env.action_space.shape))[4] for _ in range(20)]
    weight = 9.81 * float(env.batch.simulation.flesh[0].points.mass.sum())
    for info in infos:
        assert info["failure"] == 0 and info["root_released"] is False and type(info["success"]) is bool
        assert info["root_force"].shape == info["root_torque"].shape == (3,)
    assert np.mean([info["root_force"][2] for info in infos]) == pytest.approx(weight, rel=0.2)


def make_pictured(device, env_id: str, size: tuple[int, int] = (64, 48), **settings):
    settings = {"render_mode": "rgb_array", "width": size[0], "height": size[1], **settings}
    return gymnasium.make(env_id, device=device, fidelity="tiny", **settings).unwrapped


def test_pictures_change_with_the_state_and_change_nothing(device, sample_id):
    env = make_pictured(device, sample_id)
    env.reset(seed=0)
    before = bytes_of(env.get_state())
    frames = [env.render()]
    assert bytes_of(env.get_state()) == before
    for _ in range(5):
        env.step(np.ones(env.action_space.shape))
    frames.append(env.render())
    assert all(frame.shape == (48, 64, 3) and frame.dtype == np.uint8 and np.ptp(frame) > 50 for frame in frames)
    assert not np.array_equal(*frames)
    env.close()
    env.close()


def test_the_camera_can_be_moved(device):
    """Look from the side, where the body is narrower than from the front, and from above, where it is smaller still."""
    cameras = {
        "front": {"camera_position": (0.0, -4.0, 0.9), "camera_target": (0.0, 0.0, 0.9), "camera_follows": False},
        "aside": {"camera_position": (4.0, 0.0, 0.9), "camera_target": (0.0, 0.0, 0.9)},
        "above": {"camera_position": (0.0, 0.0, 5.0), "camera_target": (0.0, 0.0, 0.0)},
    }
    shown = {}
    for name, camera in cameras.items():
        env = make_pictured(device, "PIAvatar/Stand-v0", (96, 96), control="torque", **camera)
        env.reset(seed=0)
        frame = env.render().astype(int)
        skin = frame[..., 0] - frame[..., 2] > 30  # redder than ground and sky
        shown[name] = np.ptp(np.argwhere(skin), axis=0) / 96.0
        assert (env.host.pictures._opened[0].renderer._follower.center == 0.0).all() or name != "front"
        env.close()
    assert shown["front"][0] > 0.6 and shown["front"][1] > 1.5 * shown["aside"][1] > 0.1
    assert 0.05 < shown["above"][0] < 0.3


def test_the_camera_follows_by_time_and_jumps_with_episodes_and_states(device):
    """Move the root aside, with a picture of every step or of the last one only."""

    def centre(env) -> np.ndarray:
        return env.host.pictures._opened[0].renderer._follower.center

    def go(env, aside: float, every: int) -> None:
        action = np.zeros(env.action_space.shape, np.float32)
        action[env.action_names.index("root.x")] = aside
        for step in range(12):
            env.step(action)
            if (step + 1) % every == 0:
                env.render()

    often, seldom = (make_pictured(device, "PIAvatar/PushBox-v0") for _ in range(2))
    for env, every in ((often, 1), (seldom, 12)):
        env.reset(seed=0)
        env.render()
        go(env, 1.0, every)
    right = centre(often).copy()
    assert abs(right[0]) > 0.03 and centre(seldom) == pytest.approx(right, abs=0.1 * abs(right[0]))
    before = often.render()
    assert np.array_equal(before, often.render()) and np.array_equal(centre(often), right)
    state = often.get_state()
    often.reset(seed=0)
    often.render()
    assert abs(centre(often)[0]) < 0.1 * abs(right[0])
    go(often, -1.0, 12)
    often.set_state(state)
    often.render()
    pelvis = often.batch.simulation.avatar.tracked.position.numpy()[0, 0, :2]
    assert centre(often) == pytest.approx(pelvis, abs=1e-6)
    often.close()
    seldom.close()


def test_without_a_render_mode_there_is_no_picture(make_env):
    env = make_env(KICK)
    env.reset(seed=0)
    with pytest.warns(UserWarning, match="render_mode"):
        assert env.render() is None
