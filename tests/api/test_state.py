"""get_state and set_state: a run can be left, carried elsewhere, and taken up again."""

from __future__ import annotations

import pickle

import numpy as np
import pytest

#: Settings under which the state holds more or other things.
SETTINGS = [
    {},
    {"shape.randomize": True},
    {"control": "pose", "control.tone": 0.2, "root": "free", "decoupling": "paper"},
]

#: Of a scene, beside the avatar.
BALL = {"name": "ball", "position": (0.0, -1.0, 0.2), "mass": 0.4}


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
    from piavatar_envs.api.gym_env import AvatarEnv

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
        state["avatar_0.tracked.rotation"] = state["avatar_0.tracked.rotation"].astype(str)
    elif how == "nothing":
        state = {}
    elif how == "infinity":
        state["avatar_0.state.motion"].flat[0] = np.inf
    return state


@pytest.mark.parametrize(
    ("how", "told"),
    [
        ("missing", "particles.F"),
        ("unknown", "particles.G"),
        ("fewer particles", "particles.x.*shape.*expected"),
        ("one environment more", r"env.step_count.*\(2,\).*\(1,\)"),
        ("double precision", "particles.u.*float64.*float32"),
        ("text", "avatar_0.tracked.rotation"),
        ("nothing", "missing"),
        ("infinity", r"avatar_0.state.motion.*\[0, .*inf.*finite"),
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


@pytest.mark.parametrize(
    ("task", "name", "value", "told"),
    [
        ("Stand-v0", "controller_0.assist", 1e30, r"must be >= 0 and <= 1"),
        ("Stand-v0", "controller_0.assist", np.nan, "not finite"),
        ("KickBall-v0", "matter.mass", np.nan, "not finite"),
        ("KickBall-v0", "matter.mass", -1.0, r"matter.mass.*=-1.0 must be >= 0;"),
    ],
)
def test_what_no_reset_would_mend_is_refused_even_of_a_failed_run(make_env, task, name, value, told):
    env = make_env(f"PIAvatar/{task}")
    env.reset(seed=0)
    state = env.get_state()
    state["particles.failure"][:] = 1
    state[name].flat[0] = value
    with pytest.raises(ValueError, match=told):
        env.set_state(state)
    state[name] = env.get_state()[name]
    state["particles.u"][:] = np.nan  # of a failed run
    env.set_state(state)
    env.reset(seed=0)
    assert run_on(env, 1, seed=0)[0][4]["failure"] is None


@pytest.mark.parametrize(("state", "told"), [(None, "is a NoneType"), ([1, 2], "is a list")])
def test_what_is_no_state_is_refused(make_env, state, told):
    env = make_env("PIAvatar/Reach-v0")
    env.reset(seed=3)
    before = env.get_state()
    with pytest.raises(ValueError, match=f"{told}.*get_state"):
        env.set_state(state)
    after = env.get_state()
    assert all(before[name].tobytes() == after[name].tobytes() for name in before)


def bytes_of(state) -> dict[str, bytes]:
    return {name: value.tobytes() for name, value in state.items()}


@pytest.mark.parametrize(
    ("name", "settings", "told"),
    [
        ("Reach-v0", {"friction": 0.3}, r"physics.friction=0.8, this environment has 0.3; make one"),
        ("Reach-v0", {"young_modulus": 9e4}, r"physics.young_modulus=100000.0, .* has 90000.0"),
        ("Reach-v0", {"gravity": 1.62}, r"physics.gravity=9.81, .* has 1.62"),
        ("Reach-v0", {"control_dt": 0.03}, r"physics.control_dt=0.0333\d*, .* has 0.03"),
        ("Reach-v0", {"radius": 0.2}, r"with radius=0.45, .* has 0.2"),
        ("Reach-v0", {"mass_factor": (0.8, 1.25)}, r"randomize.mass_factor=\[1.0, 1.0\], .* has \[0.8, 1.25\]"),
        ("Reach-v0", {"shape.randomize": True}, r"shape.randomize=False, .* has True"),
        ("Stand-v0", {"bone_contact": False}, r"control.bone_contact=True, .* has False"),
        ("Reach-v0", {"scene.props": [BALL]}, r"scene.props=\[\], .* has \[{'"),
    ],
)
def test_states_of_other_settings_are_refused_and_change_nothing(make_env, name, settings, told):
    env, other = make_env(f"PIAvatar/{name}"), make_env(f"PIAvatar/{name}", **settings)
    env.reset(seed=0)
    other.reset(seed=1)
    before, restarts = bytes_of(other.get_state()), other.batch.restarts
    with pytest.raises(ValueError, match=told) as caught:
        other.set_state(env.get_state())
    assert "\n" not in str(caught.value)
    assert bytes_of(other.get_state()) == before and other.batch.restarts == restarts


def test_of_things_in_a_scene_the_setting_is_named(make_env):
    env, other = (make_env("PIAvatar/Reach-v0", **{"scene.props": [{**BALL, "mass": mass}]}) for mass in (0.4, 0.5))
    env.reset(seed=0)
    with pytest.raises(ValueError, match=r"scene.props.0.mass=0.4, .* has 0.5"):
        other.set_state(env.get_state())


def test_settings_that_decide_nothing_may_differ(make_env, equal):
    """Pictures, how observations are packed, and help that the state has as it is."""
    env = make_env("PIAvatar/Stand-v0", control="pd", root_assist=0.4)
    other = make_env("PIAvatar/Stand-v0", control="pd", obs_mode="dict", width=64)
    observation = env.reset(seed=0)[0]
    seen = other.set_state(env.get_state())
    assert equal(np.concatenate([part.ravel() for part in seen.values()]), observation)
    assert other.batch.simulation.controllers[0].assist.numpy().tolist() == pytest.approx([0.4])


def test_one_may_go_on_under_other_settings_on_purpose(make_env):
    env, other = make_env("PIAvatar/Reach-v0"), make_env("PIAvatar/Reach-v0", friction=0.3)
    env.reset(seed=0)
    state = env.get_state()
    other.set_state({**state, "env.settings": other.get_state()["env.settings"]})
    assert other.get_state()["particles.x"].tobytes() == state["particles.x"].tobytes()


@pytest.mark.parametrize(
    ("settings", "told"),
    [
        (None, r"of another environment: missing \['env.settings'\], unknown \[\]"),
        (np.zeros((1, 4), np.int32), r"'env.settings'\] has shape \(1, 4\) and type int32; use what get_state"),
        (np.full((1, 4), 255, np.uint8), r"'env.settings'\] is no text of settings; use what get_state"),
    ],
)
def test_a_state_without_its_settings_is_refused(make_env, settings, told):
    env = make_env("PIAvatar/Reach-v0")
    env.reset(seed=0)
    state = {name: value for name, value in env.get_state().items() if name != "env.settings"}
    with pytest.raises(ValueError, match=told):
        env.set_state(state if settings is None else {**state, "env.settings": settings})


def test_a_vector_of_other_settings_in_one_place_is_refused_before_any_has_changed(make_vec):
    """Also in the last of them, which another thread has."""
    vector, other = make_vec("PIAvatar/Reach-v0", 3), make_vec("PIAvatar/Reach-v0", 3, friction=0.3)
    for each in (vector, other):
        each.reset(seed=0)
    state = vector.get_state()
    vector.reset(seed=5)
    before, strange = bytes_of(vector.get_state()), state["env.settings"].copy()
    strange[2] = other.get_state()["env.settings"][2]
    for bad in ({**state, "env.settings": strange}, other.get_state()):
        with pytest.raises(ValueError, match=r"physics.friction=0.3, this environment has 0.8"):
            vector.set_state(bad)
        assert bytes_of(vector.get_state()) == before
    with pytest.raises(ValueError, match=r"physics.friction=0.3, this environment has 0.8"):
        vector.call_some([2], "set_state", other.call("get_state")[0])
    assert bytes_of(vector.get_state()) == before
