"""Pictures as observations: spaces, episodes and copies of every view, and the same bytes for the same state."""

from __future__ import annotations

import dataclasses

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.wrappers import FlattenObservation, FrameStackObservation, GrayscaleObservation, NormalizeObservation
from gymnasium.wrappers import vector as vector_wrappers

import piavatar_envs
from piavatar_envs.api.conformance import check_task
from piavatar_envs.avatar.body.sources import load_asset
from piavatar_envs.avatar.body.textures import Texture, Textures
from piavatar_envs.config import ConfigError, PixelsConfig
from piavatar_envs.multi import listed_games, load_game
from piavatar_envs.tasks import task_modules

REACH, KICK = "PIAvatar/Reach-v0", "PIAvatar/KickBall-v0"
SMALL = {"pixels.width": 24, "pixels.height": 16}
ALL = {"obs_mode": "pixels+state", "depth": True, "segmentation": True, **SMALL}


def play(env, seed: int, steps: int = 3) -> list:
    """Return the observations of a seeded episode under seeded actions."""
    env.action_space.seed(seed)
    seen = [env.reset(seed=seed)[0]]
    for _ in range(steps):
        seen.append(env.step(env.action_space.sample())[0])
    return seen


@pytest.mark.parametrize(
    ("settings", "shapes"),
    [
        ({"obs_mode": "pixels"}, (16, 24, 3)),
        ({"obs_mode": "pixels", "depth": True}, {"pixels": (16, 24, 3), "depth": (16, 24, 1)}),
        ({"obs_mode": "pixels+state"}, {"pixels": (16, 24, 3), "state": (280,)}),
    ],
)
def test_spaces_are_what_is_observed(make_env, settings, shapes):
    env = make_env(REACH, **SMALL, **settings)
    space = env.observation_space
    found = {name: own.shape for name, own in space.items()} if isinstance(shapes, dict) else space.shape
    assert found == shapes
    assert all(space.contains(seen) for seen in play(env, 0))
    pixels = space["pixels"] if isinstance(shapes, dict) else space
    assert pixels.dtype == np.uint8 and pixels.high.min() == 255


def test_depth_and_labels_are_in_their_space(make_env):
    env = make_env(REACH, **ALL, farthest=6.0)
    for seen in play(env, 0):
        assert env.observation_space.contains(seen)
        assert 0.0 < seen["depth"].min() < 5.0 and seen["depth"].max() <= 6.0
        assert {0, 1} <= set(seen["segmentation"].ravel())
        assert seen["depth"][seen["segmentation"] == 1].max() < 6.0, "the body is nearer than the sky"


def test_avatars_are_seen_in_their_textures(make_env):
    """A look in a red image, of which the colours at the vertices are green."""
    asset = load_asset()
    look, red = asset.drawn, np.full((4, 4, 3), (230, 10, 10), np.uint8)
    count = len(look.vertices)
    uv, white = np.full((count, 2), 0.5, np.float32), np.full((count, 3), 255, np.uint8)
    textures = Textures((Texture(red),), np.zeros(len(look.faces), np.int32), uv, white)
    green = np.full((count, 3), (10, 230, 10), np.uint8)
    asset = dataclasses.replace(asset, look=dataclasses.replace(look, colors=green, textures=textures))
    piavatar_envs.register_source("red", lambda: asset)
    env = make_env("PIAvatar/Stand-v0", **ALL, avatar={"source": "red"}, render_mode="rgb_array")
    seen = env.reset(seed=0)[0]
    body = seen["pixels"][seen["segmentation"][..., 0] == 1].astype(int)
    assert len(body) > 10 and np.median(body[:, 0] - body[:, 1]) > 100
    for picture, share in ((seen["pixels"], 0.01), (env.render(), 0.005)):
        far = picture[..., 0].astype(int) - picture[..., 1]
        assert (far > 100).mean() > share and (far < -50).sum() == 0


def test_labels_have_names(make_env, make_vec):
    names = ("ground", "agent_0", "ball", "markers")
    assert make_env(KICK, **ALL).segmentation_names == names
    vector = make_vec(KICK, **ALL)
    assert vector.segmentation_names == names and vector.get_attr("segmentation_names") == (names,) * vector.num_envs
    assert make_env(KICK).segmentation_names == ()


def test_every_environment_can_be_seen(make_env):
    for env_id in task_modules():
        env = make_env(env_id, obs_mode="pixels", **SMALL)
        first, *_, last = play(env, 0)
        assert env.observation_space.contains(last) and np.ptp(last) > 50, f"{env_id} shows nothing"
        assert (first != last).any(), f"{env_id} stands still"


def test_gymnasium_accepts_it(make_env):
    check_env(make_env(REACH, **ALL), skip_render_check=True)


@pytest.mark.parametrize("camera", ["task", "head"])
def test_the_same_seed_gives_the_same_bytes_in_a_batch_too(make_env, make_vec, equal, camera):
    settings = ALL | {"camera": camera}
    env, vector = make_env(KICK, **settings), make_vec(KICK, **settings)
    once, again, other = play(env, 5), play(env, 5), play(env, 6)
    assert all(equal(a[name], b[name]) for a, b in zip(once, again, strict=True) for name in a)
    assert not equal(once[-1]["pixels"], other[-1]["pixels"])
    started, _ = vector.reset(seed=4)
    assert all(equal(started[name][1], once[0][name]) for name in started)
    env.action_space.seed(5)
    for expected in once[1:]:
        seen = vector.step(np.tile(env.action_space.sample(), (3, 1)))[0]
        assert all(equal(seen[name][1], expected[name]) for name in seen)


def test_a_restored_state_gives_the_same_picture(make_env, equal):
    env, flat = make_env(KICK, **ALL), make_env(KICK)
    seen, state = play(env, 1)[-1], env.get_state()
    play(env, 2)
    assert all(equal(value, seen[name]) for name, value in env.set_state(state).items())
    flat.set_state(state)
    assert equal(flat.step(flat.action_space.sample() * 0.0)[0], env.step(env.action_space.sample() * 0.0)[0]["state"])


def test_what_is_returned_is_a_copy(make_vec, equal):
    vector = make_vec(REACH, **ALL)
    given = play(vector, 0, 2)
    kept = [{name: value.copy() for name, value in seen.items()} for seen in given]
    play(vector, 9, 2)
    assert all(equal(a[name], b[name]) for a, b in zip(given, kept, strict=True) for name in a)


def test_the_last_picture_of_an_episode_is_kept(make_vec, equal):
    settings = {"obs_mode": "pixels", "max_episode_steps": 3, **SMALL}
    same_step = make_vec(KICK, autoreset_mode="SameStep", **settings)
    disabled = make_vec(KICK, autoreset_mode="Disabled", **settings)
    actions = np.random.default_rng(0).uniform(-1, 1, (3, *same_step.action_space.shape)).astype(np.float32)
    same_step.reset(seed=2), disabled.reset(seed=2)
    for action in actions:
        seen, _, _, truncated, infos = same_step.step(action)
        last, *_ = disabled.step(action)
    assert truncated.all() and all(equal(infos["final_obs"][env], last[env]) for env in range(3))
    begun, _ = disabled.reset(options={"reset_mask": truncated})
    assert equal(seen, begun) and not equal(seen, last)


def test_a_failed_environment_is_in_its_space(make_env):
    env = make_env(REACH, **ALL)
    env.reset(seed=0)
    state = env.get_state()
    state["particles.x"][0, 0] = np.nan
    env.set_state(state)
    seen, _, terminated, _, info = env.step(env.action_space.sample())
    assert terminated and info["failure"] and env.observation_space.contains(seen)


def test_wrappers_of_gymnasium_run(make_env, make_vec):
    env, both = make_env(REACH, obs_mode="pixels", **SMALL), make_env(REACH, **ALL)
    stacked = FrameStackObservation(GrayscaleObservation(env), 4)
    assert stacked.reset(seed=0)[0].shape == (4, 16, 24)
    assert stacked.observation_space.contains(stacked.step(env.action_space.sample())[0])
    assert FlattenObservation(both).reset(seed=0)[0].shape == (280 + 16 * 24 * 5,)
    assert np.isfinite(NormalizeObservation(env).reset(seed=0)[0]).all()
    vector = make_vec(REACH, obs_mode="pixels", **SMALL)
    gray = vector_wrappers.GrayscaleObservation(vector)
    assert gray.reset(seed=0)[0].shape == (3, 16, 24)
    assert gray.observation_space.contains(gray.step(vector.action_space.sample())[0])


def test_torch_gets_bytes_on_the_device(make_vec):
    torch = pytest.importorskip("torch", reason="needs the extra train")
    vector, host = make_vec(REACH, array_api="torch", **ALL), make_vec(REACH, **ALL)
    seen, expected = vector.reset(seed=3)[0], host.reset(seed=3)[0]
    assert seen["pixels"].dtype == torch.uint8 and seen["depth"].dtype == torch.float32
    assert all(np.array_equal(value.cpu().numpy(), expected[name]) for name, value in seen.items())
    before = seen["pixels"].clone()
    vector.step(torch.zeros(vector.action_space.shape, device=seen["pixels"].device) + 1.0)
    assert torch.equal(seen["pixels"], before)


@pytest.mark.parametrize("name", listed_games())
def test_every_agent_of_a_game_sees(name, device, equal):
    pytest.importorskip("pettingzoo", reason="needs the extra multi")
    seen = {}
    for camera in ("task", "head"):
        env = load_game(name).parallel_env(device=device, fidelity="tiny", obs_mode="pixels", camera=camera, **SMALL)
        observed, _ = env.reset(seed=0)
        assert all(env.observation_space(agent).contains(own) for agent, own in observed.items())
        seen[camera] = list(observed.values())
        assert env.segmentation_names[: 1 + env.num_agents] == ("ground", *env.possible_agents)
        assert env.state().shape == env.state_space.shape
        env.close()
    assert equal(seen["task"][0], seen["task"][1]) and not equal(seen["head"][0], seen["head"][1])


@pytest.mark.parametrize(("mode", "policy"), [("pixels", "CnnPolicy"), ("pixels+state", "MultiInputPolicy")])
def test_stable_baselines3_learns_from_pictures(device, mode, policy):
    pytest.importorskip("stable_baselines3", reason="needs the extra train")
    from stable_baselines3 import PPO

    from piavatar_envs.api.sb3 import SB3VecEnv

    settings = {"obs_mode": mode, "episode_seconds": 0.2, "pixels.width": 36, "pixels.height": 36}
    vector = SB3VecEnv(REACH, 2, device=device, fidelity="tiny", **settings)
    assert vector.segmentation_names == ("ground", "agent_0", "markers")
    model = PPO(policy, vector, n_steps=8, batch_size=16, n_epochs=1, seed=0, device="cpu")
    before = [parameter.detach().clone() for parameter in model.policy.features_extractor.parameters()]
    model.learn(16)
    assert any(not a.equal(b) for a, b in zip(before, model.policy.features_extractor.parameters(), strict=True))
    vector.close()


def test_skrl_gets_pictures(device):
    pytest.importorskip("torch", reason="needs the extra skrl")
    import torch

    from piavatar_envs.api.skrl import AvatarSkrlEnv

    env = AvatarSkrlEnv(REACH, 2, device, fidelity="tiny", **ALL)
    seen = env.reset(seed=0)[0]["policy"]
    seen = env.step(torch.zeros(2, *env.single_action_space.shape, device=env.device))[0]["policy"]
    for row in range(2):
        own = {name: value[row].cpu().numpy() for name, value in seen.items()}
        assert env.single_observation_space["policy"].contains(own)
    env.close()


def test_rsl_rl_gets_pictures_as_groups(device):
    torch = pytest.importorskip("torch", reason="needs the extra rsl")
    for needed in ("rsl_rl", "tensordict"):
        pytest.importorskip(needed, reason="needs the extra rsl")
    from rsl_rl.models import CNNModel

    from piavatar_envs.api.rsl_rl import AvatarRslEnv

    env = AvatarRslEnv(REACH, 2, device, seed=0, fidelity="tiny", obs_mode="pixels", **SMALL)
    seen = env.step(torch.zeros(2, env.num_actions, device=env.device))[0]
    assert list(seen.keys()) == ["pixels"] and seen["pixels"].shape == (2, 3, 16, 24)
    assert seen["pixels"].dtype == torch.float32 and 0.0 <= seen["pixels"].min() <= seen["pixels"].max() <= 1.0
    convolution = {"output_channels": [4], "kernel_size": 3, "stride": 2, "activation": "elu"}
    network = CNNModel(seen, {"actor": ["pixels"]}, "actor", 5, (8,), cnn_cfg=convolution).to(env.device)
    assert network(seen).shape == (2, 5)
    env.close()
    with pytest.raises(ConfigError, match="'pixels' is that of the pictures"):
        AvatarRslEnv(REACH, 1, device, groups={"pixels": ["stress"]}, fidelity="tiny", obs_mode="pixels", **SMALL)


def test_a_task_keeps_its_contract_in_pictures(device):
    check_task(REACH, steps=4, device=device, **ALL)


@pytest.mark.parametrize("mosaic", [None, 3])
def test_a_vector_shows_many_environments(make_vec, mosaic):
    pytest.importorskip("PIL", reason="needs the extra render")
    vector = make_vec(REACH, 4, render_mode="rgb_array", width=32, height=24, mosaic=mosaic)
    vector.reset(seed=0)
    frames = vector.render()
    assert len(frames) == 4 and isinstance(frames, tuple)
    if mosaic:
        assert all(frame is frames[0] for frame in frames) and frames[0].shape == (48, 64, 3)
        tiles = frames[0][:24, :32], frames[0][:24, 32:], frames[0][24:, :32]
        assert all(np.ptp(tile) > 50 for tile in tiles) and not frames[0][24:, 32:].any()
    else:
        assert frames[0].shape == (24, 32, 3)


def test_a_mosaic_of_more_environments_than_there_are_is_refused(make_vec):
    with pytest.raises(ConfigError, match=r"render\.mosaic=5 of num_envs=3; use at most 3"):
        make_vec(REACH, 3, render_mode="rgb_array", mosaic=5)


def test_videos_of_a_vector_can_be_recorded(make_vec, tmp_path):
    pytest.importorskip("moviepy", reason="Gymnasium's RecordVideo needs it")
    vector = make_vec(REACH, 4, render_mode="rgb_array", width=32, height=32, mosaic=4)
    recorded = vector_wrappers.RecordVideo(vector, str(tmp_path), record_first_only=True, step_trigger=lambda s: s == 0)
    recorded.reset(seed=0)
    for _ in range(3):
        recorded.step(recorded.action_space.sample())
    recorded.stop_recording()
    assert list(tmp_path.glob("*.mp4"))


def test_a_picture_renders_as_an_observation_too(make_env):
    pytest.importorskip("PIL", reason="needs the extra render")
    env = gymnasium.wrappers.AddRenderObservation(make_env(REACH, render_mode="rgb_array", width=32, height=24))
    assert env.observation_space.contains(env.reset(seed=0)[0])


def test_pictures_that_do_not_fit_are_refused(monkeypatch):
    from piavatar_envs.envs import pixels

    class Small:
        is_cuda, free_memory = True, 2**30

        def __str__(self) -> str:
            return "cuda:0"

    monkeypatch.setattr(pixels.wp, "get_device", lambda _: Small())
    settings = PixelsConfig(width=1024, height=1024, depth=True)
    own, stage = pixels.bytes_of_pixels(settings, 1), 10**6
    assert own == 1024**2 * (pixels.BYTES_OF_PIXEL + pixels.BYTES_OF_DEPTH)
    assert pixels.bytes_of_pixels(settings, 1, has_splats=True) > own
    most = Small.free_memory // (own + stage)
    pixels.check_memory(most, own, stage, settings, "cuda:0")
    with pytest.raises(ValueError, match=rf"1024 x 1024 pixels of {most + 1} .* num_envs <= {most}, or less"):
        pixels.check_memory(most + 1, own, stage, settings, "cuda:0")
    with pytest.raises(ValueError, match=r"free; use less of"):
        pixels.check_memory(1, Small.free_memory, stage, settings, "cuda:0")


def test_memory_is_counted_before_surfaces_are_built(make_env, monkeypatch):
    from piavatar_envs.envs import pixels

    def refuse(*_):
        raise MemoryError

    def never(*_):
        raise AssertionError

    monkeypatch.setattr(pixels, "check_memory", refuse)
    monkeypatch.setattr(pixels, "Stage", never)
    with pytest.raises(MemoryError):
        make_env(REACH, obs_mode="pixels", pixels={"width": 40})


@pytest.mark.parametrize(("width", "height"), [(32, 96), (96, 32)])
def test_everything_is_in_pictures_of_any_shape(make_env, equal, width, height):
    settings = {"obs_mode": "pixels", "segmentation": True, "pixels": {"width": width, "height": height}}
    env, tall = make_env(KICK, **settings), make_env(KICK, width=48, height=480, **settings)
    seen, other = env.reset(seed=1)[0], tall.reset(seed=1)[0]
    assert all(equal(seen[name], other[name]) for name in seen), "render() has no part in it"
    labels = seen["segmentation"][..., 0]
    for subject in range(1, len(env.batch.pixels.stage.subjects)):
        rows, columns = np.nonzero(labels == subject)
        assert len(rows), subject
        assert 0 < rows.min() <= rows.max() < height - 1 and 0 < columns.min() <= columns.max() < width - 1
    rows, columns = np.nonzero(labels)
    assert max(np.ptp(rows) / height, np.ptp(columns) / width) > 0.4, "and it is not small"
