"""get_state and set_state: a run can be left, carried elsewhere, and taken up again."""

from __future__ import annotations

import pickle

import numpy as np
import pytest

#: Settings under which the state holds more or other things.
SETTINGS = [
    {},
    {"shape.randomize": True},
    {"control": "pose", "drive.tone": 0.2, "root": "free", "decoupling": "paper"},
]


def run_on(env, steps: int, seed: int) -> list:
    rng = np.random.default_rng(seed)
    return [env.step(rng.uniform(-1.0, 1.0, env.action_space.shape)) for _ in range(steps)]


def assert_same_run(first, second, equal) -> None:
    for a, b in zip(first, second, strict=True):
        assert equal(a[0], b[0]) and equal(a[1], b[1]) and a[2:4] == b[2:4]
        assert a[4]["reward_terms"] == pytest.approx(b[4]["reward_terms"], abs=1e-2 if equal(0.0, 1e-6) else 0.0)
        assert equal(a[4]["root_force"], b[4]["root_force"])


def through_files(state, tmp_path) -> dict[str, dict]:
    """The same state by every way that users keep dictionaries of arrays."""
    path = tmp_path / "state.npz"
    np.savez(path, **state)
    with np.load(path, allow_pickle=False) as file:
        loaded = {name: file[name] for name in file.files}
    return {"itself": state, "pickle": pickle.loads(pickle.dumps(state)), "npz": loaded}


@pytest.mark.parametrize("settings", SETTINGS, ids=str)
def test_a_run_taken_up_again_is_the_same(make_env, env_id, equal, tmp_path, settings):
    env, other = make_env(env_id, **settings), make_env(env_id, twin=1, **settings)
    env.reset(seed=6)
    env.reset()
    run_on(env, 12, seed=0)
    state = env.get_state()
    expected = run_on(env, 20, seed=1)
    next_episode = env.reset()[0]
    # elsewhere, after other things happened there
    other.reset(seed=77)
    run_on(other, 3, seed=2)
    for copy in through_files(state, tmp_path).values():
        for target in (env, other):
            target.set_state(copy)
            assert_same_run(expected, run_on(target, 20, seed=1), equal)
            assert equal(target.reset()[0], next_episode)


def test_a_restored_environment_needs_no_reset(device, make_env, env_id, equal):
    from piavatar_envs.api.gymnasium import AvatarEnv

    env = make_env(env_id)
    observation = env.reset(seed=1)[0]
    fresh = AvatarEnv(env_id, device=device, fidelity="tiny")
    assert equal(fresh.set_state(env.get_state()), observation)
    assert_same_run(run_on(env, 5, seed=0), run_on(fresh, 5, seed=0), equal)


def test_set_state_returns_the_observation_of_that_moment(make_env, env_id, equal):
    env = make_env(env_id)
    env.reset(seed=2)
    observation = run_on(env, 5, seed=0)[-1][0]
    state = env.get_state()
    run_on(env, 5, seed=1)
    restored = env.set_state(state)
    assert equal(restored, observation)
    assert not np.shares_memory(restored, env.batch.observation.numpy())


def test_a_state_is_a_copy(make_env, env_id):
    env = make_env(env_id)
    env.reset(seed=2)
    state = env.get_state()
    kept = {name: value.copy() for name, value in state.items()}
    run_on(env, 3, seed=0)
    assert all(kept[name].tobytes() == value.tobytes() for name, value in state.items())
    env.set_state(state)
    run_on(env, 3, seed=0)
    assert all(kept[name].tobytes() == value.tobytes() for name, value in state.items())


def test_the_clock_and_the_end_are_part_of_the_state(make_env, env_id):
    env = make_env(env_id, episode_seconds=0.3)
    assert env.batch.max_steps == 9
    env.reset(seed=0)
    run_on(env, 6, seed=0)
    state = env.get_state()
    env.reset(seed=1)
    env.set_state(state)
    assert [row[3] for row in run_on(env, 3, seed=0)] == [False, False, True]


def test_a_failed_run_stays_failed(make_env, env_id):
    env = make_env(env_id)
    env.reset(seed=0)
    state = env.get_state()
    state["particles.u"][0, 0] = 1e6
    env.set_state(state)
    info = run_on(env, 1, seed=0)[0][4]
    assert info["failure"] == "cfl"
    failed = env.get_state()
    env.reset(seed=0)
    env.set_state(failed)
    _, _, terminated, _, info = run_on(env, 1, seed=0)[0]
    assert terminated and info["failure"] == "cfl"


def spoil(state, how):
    state = {name: value.copy() for name, value in state.items()}
    if how == "missing":
        del state["particles.F"]
    elif how == "unknown":
        state["particles.G"] = state["particles.F"]
    elif how == "fewer particles":
        state["particles.x"] = state["particles.x"][:, 1:]
    elif how == "one environment more":
        state["env.step_count"] = np.zeros(2, np.int32)
    elif how == "double precision":
        state["particles.u"] = state["particles.u"].astype(np.float64)
    elif how == "text":
        state["tracked_0.rotation"] = state["tracked_0.rotation"].astype(str)
    elif how == "nothing":
        state = {}
    elif how == "infinity":
        state["drive_0.motion"].flat[0] = np.inf
    return state


@pytest.mark.parametrize(
    ("how", "told"),
    [
        ("missing", "particles.F"),
        ("unknown", "particles.G"),
        ("fewer particles", "particles.x.*shape.*expected"),
        ("one environment more", r"env.step_count.*\(2,\).*\(1,\)"),
        ("double precision", "particles.u.*float64.*float32"),
        ("text", "tracked_0.rotation"),
        ("nothing", "missing"),
        ("infinity", r"drive_0.motion.*\[0, .*inf.*finite"),
    ],
)
def test_malformed_states_are_refused_and_change_nothing(make_env, env_id, how, told):
    env = make_env(env_id)
    env.reset(seed=3)
    run_on(env, 2, seed=0)
    good = env.get_state()
    env.reset(seed=4)
    before, observed = env.get_state(), env.batch.observation.numpy().copy()
    with pytest.raises(ValueError, match=told):
        env.set_state(spoil(good, how))
    after = env.get_state()
    assert all(before[name].tobytes() == after[name].tobytes() for name in before)
    assert np.array_equal(env.batch.observation.numpy(), observed)


@pytest.mark.parametrize(("state", "told"), [(None, "is a NoneType"), ([1, 2], "is a list")])
def test_what_is_no_state_is_refused(make_env, state, told):
    env = make_env("PIAvatar/Reach-v0")
    env.reset(seed=3)
    before = env.get_state()
    with pytest.raises(ValueError, match=f"{told}.*get_state"):
        env.set_state(state)
    after = env.get_state()
    assert all(before[name].tobytes() == after[name].tobytes() for name in before)


def test_states_of_another_environment_are_refused(make_env, env_id):
    env, other = make_env(env_id), make_env(env_id, **{"shape.randomize": True})
    env.reset(seed=0)
    other.reset(seed=0)
    with pytest.raises(ValueError, match=r"of another environment.*missing.*body"):
        other.set_state(env.get_state())
    with pytest.raises(ValueError, match=r"of another environment.*unknown.*body"):
        env.set_state(other.get_state())
