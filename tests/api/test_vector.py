"""The vector view: Gymnasium's own vector of single environments is what it must equal, in all autoreset modes."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from piavatar_envs.api.vector_env import AvatarVectorEnv

MODES = list(AutoresetMode)
#: An episode of six steps: several fit into a test.
SHORT = {"episode_seconds": 0.2}


def actions_of(vector, steps: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-1.0, 1.0, (steps, *vector.action_space.shape)).astype(np.float32)


def run(vector, actions) -> list:
    """Answers of a run with the resets that DISABLED leaves to the caller."""
    answers = []
    for action in actions:
        answers.append(vector.step(action))
        ended = answers[-1][2] | answers[-1][3]
        if vector.metadata["autoreset_mode"] == AutoresetMode.DISABLED and ended.any():
            answers.append(vector.reset(options={"reset_mask": ended}))
    return answers


@pytest.mark.parametrize(("mode", "obs_mode"), [(mode, "flat") for mode in MODES] + [(AutoresetMode.SAME_STEP, "dict")])
def test_it_is_gymnasiums_vector_of_single_environments(make_vec, make_env, env_id, same, mode, obs_mode):
    """Bit for bit, infos and all: through clocks that run out apart, a failure, and the episodes after these."""
    settings = {**SHORT, "obs_mode": obs_mode}
    vector = make_vec(env_id, 3, autoreset_mode=mode, **settings)
    singles = [make_env(env_id, twin=twin, **settings) for twin in range(3)]
    oracle = SyncVectorEnv([lambda env=env: env for env in singles], autoreset_mode=mode)
    # but for the live view, which is one environment's
    assert vector.metadata == {**oracle.metadata, "render_modes": ["rgb_array"]}
    for space in ("action_space", "observation_space", "single_action_space", "single_observation_space"):
        assert getattr(vector, space) == getattr(oracle, space)
    answers = [[env.reset(seed=31)] for env in (vector, oracle)]
    actions, last = actions_of(vector, 11), np.array([False, True, False])
    mask = {"reset_mask": last}
    for env, log in zip((vector, oracle), answers, strict=True):
        log += run(env, actions[:2])
        log.append(env.reset(options=dict(mask)))
        log += run(env, actions[2:4])
    # a blow-up: nothing in the batch but its own environment is to feel it
    state = vector.get_state()
    state["particles.u"][2] = 1e6
    vector.set_state(state)
    singles[2].set_state({name: value[2:3] for name, value in state.items()})
    for env, log in zip((vector, oracle), answers, strict=True):
        log += run(env, actions[4:])
    for step, (a, b) in enumerate(zip(*answers, strict=True)):
        same(a, b, f"{step}")
    failures = [row[-1].get("final_info", row[-1])["failure"][2] for row in answers[0]]
    assert "cfl" in failures


def test_bodies_and_worlds_that_differ_are_those_of_single_environments(make_vec, make_env, same):
    """Random numbers of an episode depend on seed and episode, and neither on the batch nor on its threads."""
    settings = {
        "shape.randomize": True,
        "randomize.mass_factor": (0.8, 1.25),
        "randomize.stiffness_factor": (0.8, 1.25),
    }
    settings |= SHORT
    vector = make_vec("PIAvatar/KickBall-v0", 3, autoreset_mode=AutoresetMode.SAME_STEP, **settings)
    singles = [make_env("PIAvatar/KickBall-v0", twin=twin, **settings) for twin in range(3)]
    oracle = SyncVectorEnv([lambda env=env: env for env in singles], autoreset_mode=AutoresetMode.SAME_STEP)
    same(vector.reset(seed=3), oracle.reset(seed=3))
    for step, action in enumerate(actions_of(vector, 8)):
        same(vector.step(action), oracle.step(action), f"{step}")
    state = vector.get_state()
    bodies = state["shape.0"]
    assert len({body.tobytes() for body in bodies}) == 3


@pytest.mark.parametrize("mode", MODES)
def test_the_terminal_observation_is_never_lost(make_vec, make_env, env_id, equal, mode):
    vector, single = make_vec(env_id, 3, autoreset_mode=mode, **SHORT), make_env(env_id, **SHORT)
    actions = actions_of(vector, 7)
    single.reset(seed=4)
    terminal = [single.step(action[1])[0] for action in actions[:6]][-1]
    vector.reset(seed=3)
    answers = [vector.step(action) for action in actions[:6]]
    observation, _, terminated, truncated, infos = answers[-1]
    assert not terminated.any() and truncated.all() and not any(row[3].any() for row in answers[:-1])
    if mode == AutoresetMode.SAME_STEP:
        assert infos["_final_obs"].all() and not equal(observation[1], terminal)
        observation = infos["final_obs"]
    assert equal(observation[1], terminal)


def test_next_step_ignores_the_action_of_what_begins_anew(make_vec, env_id, equal):
    vector = make_vec(env_id, 3, **SHORT)
    actions = actions_of(vector, 9)
    runs = []
    for scale in (1.0, -1.0):
        vector.reset(seed=1)
        changed = actions.copy()
        changed[6] *= scale
        answers = [vector.step(action) for action in changed]
        assert not answers[6][1].any() and not answers[6][2].any() and not answers[6][3].any()
        assert "reward_terms" not in answers[6][4] and answers[6][4]["_success"].all()
        runs.append([row[0] for row in answers])
    assert all(equal(a, b) for a, b in zip(*runs, strict=True))


def test_a_disabled_vector_does_not_step_on(make_vec, env_id):
    vector = make_vec(env_id, 3, autoreset_mode=AutoresetMode.DISABLED, **SHORT)
    actions = actions_of(vector, 8)
    vector.reset(seed=0)
    vector.step(actions[0])
    vector.reset(options={"reset_mask": np.array([True, False, True])})
    for action in actions[1:6]:
        vector.step(action)
    with pytest.raises(gymnasium.error.ResetNeeded, match=r"environments \[1\] have ended.*reset_mask"):
        vector.step(actions[6])
    vector.reset(options={"reset_mask": np.array([False, True, False])})
    assert vector.step(actions[6])[3].tolist() == [True, False, True]


def test_every_id_has_it(device):
    import piavatar_envs  # noqa: F401
    from piavatar_envs.tasks import task_modules

    assert all(gymnasium.spec(name).vector_entry_point for name in task_modules())
    vector = gymnasium.make_vec(
        "PIAvatar/Reach-v0", num_envs=2, device=device, fidelity="tiny", autoreset_mode="SameStep"
    )
    again = gymnasium.make_vec(vector.spec)
    assert (
        isinstance(vector, AvatarVectorEnv) and again.num_envs == 2 and again.autoreset_mode is AutoresetMode.SAME_STEP
    )
    assert again.config == vector.config and "Reach-v0" in repr(again)
    vector.close()
    vector.close()
    again.close()


@pytest.mark.parametrize(
    ("settings", "told"),
    [
        ({"num_envs": 0}, ["num_envs=0"]),
        ({"num_envs": 1.5}, ["num_envs=1.5", "whole number"]),
        ({"num_envs": True}, ["num_envs=True", "whole number"]),
        ({"cfl": 1.0}, ["cfl=1.0 must be <= 0.84"]),
        ({"array_api": "jax"}, ["array_api='jax'", "numpy", "torch"]),
        ({"autoreset_mode": "never"}, ["autoreset_mode='never'", "'NextStep'", "'SameStep'", "'Disabled'"]),
        ({"num_threads": 0}, ["num_threads=0"]),
        ({"render_mode": "human"}, ["render_mode='human'", "rgb_array"]),
        ({"device": "cuda:99"}, ["device='cuda:99'", "cpu"]),
        ({"fidelty": "tiny"}, ["fidelty is no setting of", "physics.fidelity"]),
    ],
)
def test_bad_settings_are_refused(device, settings, told):
    with pytest.raises(ValueError) as caught:
        AvatarVectorEnv("Reach-v0", **{"device": device, "fidelity": "tiny", **settings})
    assert all(part in str(caught.value) for part in told), caught.value


@pytest.mark.parametrize("seed", ["3", np.array(3), 1.5, [1, "2"]])
def test_what_is_no_seed_is_refused(make_vec, seed):
    vector = make_vec("PIAvatar/Reach-v0", 2)
    with pytest.raises(gymnasium.error.Error, match="Seed must be"):
        vector.reset(seed=seed)
    for negative in (-1, [1, -1]):
        with pytest.raises(ValueError, match="seed=-1 must be >= 0"):
            vector.reset(seed=negative)
    with pytest.raises(ValueError, match="seed=4294967295 must be >= 0 and <= 4294967294"):
        vector.reset(seed=2**32 - 1)  # of the second environment it would be 2^32


def test_a_refused_reset_leaves_its_mask(make_vec):
    """A second call with the same options resets the same environments, not all of them."""
    vector = make_vec("PIAvatar/Reach-v0", 2)
    vector.reset(seed=5)
    options = {"reset_mask": np.array([False, True])}
    with pytest.raises(ValueError, match="3 seeds"):
        vector.reset(seed=[1, 2, 3], options=options)
    vector.reset(seed=[1, 2], options=options)
    assert options == {} and vector.get_attr("np_random_seed") == (5, 2)
    with pytest.raises(TypeError, match="list"):
        vector.reset(options=["reset_mask"])


def test_a_closed_vector_goes_on(device, equal):
    """As closed single environments do: what is closed are windows and threads."""
    vector = AvatarVectorEnv("Reach-v0", 2, device=device, fidelity="tiny", num_threads=2)
    action = actions_of(vector, 1)[0]
    vector.reset(seed=0)
    before = [vector.step(action)[0] for _ in range(3)]
    vector.close()
    vector.reset(seed=0)
    assert all(equal(vector.step(action)[0], one) for one in before)


def test_a_yaml_file_configures(tmp_path, device):
    path = tmp_path / "run.yaml"
    path.write_text("episode_seconds: 0.5\nphysics: {fidelity: tiny, control_dt: 0.05}\n")
    vector = AvatarVectorEnv("Reach-v0", 2, device=device, config=path, alpha=0.2)
    assert vector.config.control.alpha == 0.2 and vector.metadata["render_fps"] == 20
    assert vector.host.groups[0].max_steps == 10
    vector.close()


def test_nothing_goes_before_the_first_reset(device):
    vector = AvatarVectorEnv("Reach-v0", 2, render_mode="rgb_array", device=device, fidelity="tiny")
    mask = {"reset_mask": np.array([True, False])}
    for call in (lambda: vector.step(vector.action_space.sample()), vector.render, lambda: vector.reset(options=mask)):
        with pytest.raises(gymnasium.error.ResetNeeded):
            call()
    vector.close()


def test_pictures_are_those_of_single_environments(device):
    pytest.importorskip("pyvista")
    settings = {"device": device, "fidelity": "tiny", "render_mode": "rgb_array", "width": 64, "height": 48}
    vector = AvatarVectorEnv("KickBall-v0", 3, num_threads=2, **settings)
    single = gymnasium.make("PIAvatar/KickBall-v0", **settings).unwrapped
    vector.reset(seed=5)
    single.reset(seed=7)
    for step in range(2):
        frames, expected = vector.render(), single.render()
        assert len(frames) == 3 and all(f.shape == (48, 64, 3) and f.dtype == np.uint8 for f in frames)
        assert np.abs(frames[2].astype(int) - expected).mean() <= (0.0 if device == "cpu" else 2.0), step
        assert not np.array_equal(frames[0], frames[2])
        actions = actions_of(vector, 1, seed=step)[0]
        vector.step(actions)
        single.step(actions[2])
    vector.close()
    single.close()


def test_no_pictures_without_a_render_mode(make_vec):
    vector = make_vec("PIAvatar/Reach-v0")
    vector.reset(seed=0)
    with pytest.warns(UserWarning, match="render_mode"):
        assert vector.render() is None


def test_gymnasiums_wrappers_go_around_it(device):
    from gymnasium.wrappers.vector import DictInfoToList, NormalizeObservation, RecordEpisodeStatistics

    for mode in MODES[:2]:
        vector = AvatarVectorEnv("Reach-v0", 2, device=device, fidelity="tiny", autoreset_mode=mode, **SHORT)
        # Gymnasium's own normalization does not know SAME_STEP
        normalized = NormalizeObservation(vector) if mode == AutoresetMode.NEXT_STEP else vector
        wrapped = DictInfoToList(RecordEpisodeStatistics(normalized))
        wrapped.reset(seed=0)
        lengths = []
        for action in actions_of(vector, 14):
            infos = wrapped.step(action)[4]
            assert len(infos) == 2 and all("root_force" in info for info in infos)
            lengths += [int(info["episode"]["l"]) for info in infos if "episode" in info]
        assert lengths == [6] * 4
        wrapped.close()
