"""The single-environment view: what it takes, what it refuses and how, what it returns."""

from __future__ import annotations

import warnings
from pathlib import Path

import gymnasium
import numpy as np
import pytest

from piavatar_envs.api.gym_env import AvatarEnv
from piavatar_envs.config import ConfigError

ROOT = Path(__file__).parents[2]


def refusal(env_id: str, settings: dict) -> str:
    with pytest.raises(ValueError) as caught:
        gymnasium.make(env_id, **settings)
    message = str(caught.value)
    assert "\n" not in message
    return message


@pytest.mark.parametrize(
    ("settings", "told"),
    [
        ({"bogus": 1}, ["bogus is no setting of", "obs_mode"]),
        ({"fidelty": "tiny"}, ["fidelty is no setting of", "physics.fidelity"]),
        ({"fidelity": "ultra"}, ["physics.fidelity='ultra'", "'tiny'", "'coarse'"]),
        ({"obs_mode": "pixels"}, ["obs_mode='pixels'", "'flat'", "'dict'"]),
        ({"control": "pose", "tone": 2.0}, ["control.tone=2.0", "<= 1"]),
        ({"config": {"control": {"tune": 1}}}, ["control.tune is no setting of", "control.tone"]),
        ({"config": "no/such/file.yaml"}, ["no/such/file.yaml"]),
        ({"device": "cuda:99"}, ["device='cuda:99'", "cpu"]),
        ({"device": "tpu"}, ["device='tpu'", "cpu"]),
        ({"task": "Fly-v0"}, ["'Fly-v0'", "PIAvatar/Reach-v0", "PIAvatar/TrackMotion-v0"]),
        ({"shape.parameters": {"tallness": 0.5}}, ["shape.parameters", "'tallness'", "height"]),
        ({"young_modulus": 1e9, "num_substeps": 4, "control": "pose"}, ["CFL limit", "num_substeps >= "]),
    ],
)
def test_bad_settings_are_refused_in_one_line_with_what_is_allowed(device, env_id, settings, told):
    message = refusal(env_id, {"device": device, "fidelity": "tiny", **settings})
    assert all(part in message for part in told), message


def test_unknown_render_mode_is_refused(device, env_id):
    with pytest.raises(ValueError, match=r"render_mode='ansi' is not known; use None, rgb_array or human"):
        AvatarEnv(env_id, render_mode="ansi", device=device, fidelity="tiny")


def test_a_yaml_file_and_keywords_configure(tmp_path, device, env_id):
    path = tmp_path / "run.yaml"
    path.write_text("episode_seconds: 0.5\nphysics: {fidelity: tiny}\ncontrol: {mode: pose, tone: 0.25, alpha: 0.1}\n")
    env = gymnasium.make(env_id, device=device, config=path, alpha=0.2).unwrapped
    assert env.config.control.tone == 0.25 and env.config.control.alpha == 0.2
    assert env.batch.max_steps == 15


def test_control_rate_is_in_the_metadata(device, env_id):
    env = gymnasium.make(env_id, device=device, fidelity="tiny", control_dt=0.02).unwrapped
    assert env.metadata["render_fps"] == 50 and AvatarEnv.metadata["render_fps"] == 30


def test_nothing_goes_before_the_first_reset(device, env_id):
    env = AvatarEnv(env_id, render_mode="rgb_array", device=device, fidelity="tiny")
    for call in (lambda: env.step(env.action_space.sample()), env.render):
        with pytest.raises(gymnasium.error.ResetNeeded):
            call()


@pytest.mark.parametrize("options", [{"pose": 1}, {"shape": "tall", "pose": 1}])
def test_unknown_reset_options_are_refused_before_anything_changes(make_env, env_id, equal, options):
    env = make_env(env_id)
    env.reset(seed=0)
    before = env.get_state()
    with pytest.raises(ValueError, match=r"pose.*there are none"):
        env.reset(seed=1, options=options)
    after = env.get_state()
    assert all(before[name].tobytes() == after[name].tobytes() for name in before)
    env.reset(seed=0, options={})


@pytest.mark.parametrize("seed", [0, 2**31 - 1, 2**31, 2**32 - 1])
def test_every_seed_of_gymnasium_and_stable_baselines3_is_taken(make_env, env_id, equal, seed):
    env = make_env(env_id)
    first, again = env.reset(seed=seed)[0], env.reset(seed=seed)[0]
    assert equal(first, again)
    assert np.abs(env.reset(seed=(seed + 1) % 2**32)[0] - first).max() > 1e-4


@pytest.mark.parametrize(("seed", "error"), [(-1, ValueError), (2**32, ValueError), ("one", gymnasium.error.Error)])
def test_other_seeds_are_refused_before_anything_changes(make_env, env_id, seed, error):
    env = make_env(env_id)
    env.reset(seed=4)
    generator, before = env.np_random, env.get_state()
    with pytest.raises(error, match=r"seed=|Seed must be"):
        env.reset(seed=seed)
    after = env.get_state()
    assert env.np_random is generator and env.np_random_seed == 4
    assert all(before[name].tobytes() == after[name].tobytes() for name in before)


def test_a_step_after_the_end_warns(device, env_id):
    env = AvatarEnv(env_id, device=device, fidelity="tiny", episode_seconds=0.05)
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
def test_what_is_no_action_is_refused(make_env, env_id, action):
    env = make_env(env_id)
    env.reset(seed=0)
    with pytest.raises(ValueError, match=r"action is a (dict|list|str).*array of shape"):
        env.step(action)


@pytest.mark.parametrize(
    ("task", "settings", "line"),
    [
        ("Stand-v0", {"tone": 0.0, "strength": 0.5}, r"control\.tone=0\.0 belongs to control\.mode='pose'"),
        ("Reach-v0", {"root_assist": 1.0, "tone": 0.5}, r"control\.root_assist=1\.0 belongs to control\.mode='pd'"),
        ("Reach-v0", {"control": "pd", "alpha": 0.1}, r"control\.alpha=0\.1 belongs to control\.mode='pose'"),
    ],
)
def test_settings_of_another_mode_are_refused(device, task, settings, line):
    with pytest.raises(ConfigError, match=line):
        AvatarEnv(task, device=device, fidelity="tiny", **settings)


def test_a_torch_device_is_taken(device, env_id):
    torch = pytest.importorskip("torch")
    if device == "cpu":
        assert AvatarEnv(env_id, device=torch.device("cpu"), fidelity="tiny").batch.device == "cpu"


def test_what_is_no_task_of_one_agent_says_where_it_is(device):
    with pytest.raises(ValueError, match=r"sumo_v0.*several agents.*piavatar_envs.multi.sumo_v0.parallel_env"):
        AvatarEnv("sumo_v0", device=device)


def test_files_of_trainings_are_refused_in_one_sentence(device, env_id):
    with pytest.raises(ConfigError, match=r"reach_sb3.yaml is the file of a training.*under its key env") as caught:
        AvatarEnv(env_id, device=device, config=ROOT / "configs" / "sb3" / "reach_sb3.yaml")
    assert len(str(caught.value)) < 250


def test_dictionary_is_the_flat_vector_by_name(make_env, env_id, equal):
    flat, named = make_env(env_id), make_env(env_id, obs_mode="dict")
    assert set(named.observation_space) == set(flat.observation_layout)
    pairs = [(flat.reset(seed=8)[0], named.reset(seed=8)[0])]
    rng = np.random.default_rng(8)
    for _ in range(5):
        action = rng.uniform(-1.0, 1.0, flat.action_space.shape)
        pairs.append((flat.step(action)[0], named.step(action)[0]))
    for vector, terms in pairs:
        assert named.observation_space.contains(terms)
        for name, term in flat.observation_layout.items():
            assert equal(terms[name], vector[term.slice]), name
            assert not np.shares_memory(terms[name], named.batch.observation.numpy())


def test_info_says_what_held_the_body(make_env, env_id):
    env = make_env(env_id, control="pose")
    env.reset(seed=0)
    infos = [env.step(np.zeros(env.action_space.shape))[4] for _ in range(20)]
    weight = 9.81 * float(env.batch.simulation.flesh[0].points.mass.sum())
    for info in infos:
        assert info["failure"] is None and info["root_released"] is False and type(info["success"]) is bool
        assert info["root_force"].shape == info["root_torque"].shape == (3,)
    assert np.mean([info["root_force"][2] for info in infos]) == pytest.approx(weight, rel=0.2)


def test_pictures(device, env_id):
    pytest.importorskip("pyvista")
    env = gymnasium.make(env_id, device=device, fidelity="tiny", render_mode="rgb_array", width=64, height=48).unwrapped
    env.reset(seed=0)
    before = env.get_state()
    frames = [env.render()]
    assert all(before[name].tobytes() == value.tobytes() for name, value in env.get_state().items())
    for _ in range(5):
        env.step(np.ones(env.action_space.shape))
    frames.append(env.render())
    assert all(frame.shape == (48, 64, 3) and frame.dtype == np.uint8 and np.ptp(frame) > 50 for frame in frames)
    assert not np.array_equal(*frames)
    env.close()
    env.close()


def test_the_camera_can_be_moved(device):
    """To the side, where the body is narrower than from the front, or straight above, where it is smaller still."""
    pytest.importorskip("pyvista")
    aside = {"camera_position": (4.0, 0.0, 0.9), "camera_target": (0.0, 0.0, 0.9)}
    above = {"camera_position": (0.0, 0.0, 5.0), "camera_target": (0.0, 0.0, 0.0)}
    front = {"camera_position": (0.0, -4.0, 0.9), "camera_target": (0.0, 0.0, 0.9), "camera_follows": False}
    shown = {}
    for name, camera in (("front", front), ("aside", aside), ("above", above), ("task", {})):
        made = {"fidelity": "tiny", "render_mode": "rgb_array", "width": 96, "height": 96, "control": "torque"}
        env = gymnasium.make("PIAvatar/Stand-v0", device=device, **made, **camera)
        env.reset(seed=0)
        frame = env.render().astype(int)
        skin = frame[..., 0] - frame[..., 2] > 30  # redder than ground and sky
        shown[name] = np.ptp(np.argwhere(skin), axis=0) / 96.0 if skin.any() else np.zeros(2)
        assert (env.unwrapped.host.pictures._opened[0].renderer._follower.center == 0.0).all() or camera is not front
        env.close()
    assert shown["front"][0] > 0.6 and shown["front"][1] > 1.5 * shown["aside"][1] > 0.1
    assert 0.05 < shown["above"][0] < 0.3 and shown["task"][0] > 0.5
    nowhere = {"camera_position": (0.0, 0.0, 1.0), "camera_target": (0, 0, 1)}
    with pytest.raises(ConfigError, match=r"camera_position=\[0.0, 0.0, 1.0\] is where it looks"):
        gymnasium.make("PIAvatar/Stand-v0", device=device, **made, **nowhere)


def test_the_camera_is_where_time_has_brought_it(device):
    """Whatever was shown on the way; and it jumps where an episode, or the same one, begins again."""
    pytest.importorskip("pyvista")

    def make():
        size = {"width": 64, "height": 48}
        return gymnasium.make(
            "PIAvatar/PushBox-v0", device=device, fidelity="tiny", render_mode="rgb_array", **size
        ).unwrapped

    def centre(env) -> np.ndarray:
        return env.host.pictures._opened[0].renderer._follower.center

    def go(env, aside: float, every: int) -> None:
        action = np.zeros(env.action_space.shape, np.float32)
        action[env.action_names.index("root.x")] = aside
        for step in range(12):
            env.step(action)
            if (step + 1) % every == 0:
                env.render()

    often, seldom = make(), make()
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
    assert abs(centre(often)[0]) < 0.1 * abs(right[0]), "the same episode from its beginning"
    go(often, -1.0, 12)
    often.set_state(state)
    often.render()
    pelvis = often.batch.simulation.avatar.tracked.position.numpy()[0, 0, :2]
    assert centre(often) == pytest.approx(pelvis, abs=1e-6), "a moment that was kept"
    often.close()
    seldom.close()


def test_no_picture_without_a_render_mode(make_env, env_id):
    env = make_env(env_id)
    env.reset(seed=0)
    with pytest.warns(UserWarning, match="render_mode"):
        assert env.render() is None
