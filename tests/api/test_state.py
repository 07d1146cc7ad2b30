"""``get_state`` and ``set_state``: a run is saved, restored elsewhere and continued; unfit states are refused."""

from __future__ import annotations

import json
import pickle

import numpy as np
import pytest

from piavatar_envs.api.gym_env import AvatarEnv
from piavatar_envs.mpm.types import FAILURE_CFL
from tests.api.runs import bytes_of
from tests.conftest import SAMPLE, reward_terms

KICK, REACH = "PIAvatar/KickBall-v0", "PIAvatar/Reach-v0"
#: Tasks as they are, and under settings by which the state has more or other arrays; ``check_task`` has every task.
CASES = [(name, settings) for name in SAMPLE for settings in ({}, {"shape.randomize": True})]
CASES += [(KICK, {"control": "pose", "control.tone": 0.2, "root": "free", "decoupling": "paper"})]
#: A prop of a scene.
BALL = {"name": "ball", "position": (0.0, -1.0, 0.2), "mass": 0.4}


def run_on(env, steps: int, seed: int) -> list:
    rng = np.random.default_rng(seed)
    return [env.step(rng.uniform(-1.0, 1.0, env.action_space.shape)) for _ in range(steps)]


def assert_same_run(first, second, equal) -> None:
    for a, b in zip(first, second, strict=True):
        assert equal(a[0], b[0]) and equal(a[1], b[1]) and a[2:4] == b[2:4]
        assert reward_terms(a[4]) == reward_terms(b[4])
        assert equal(a[4]["root_force"], b[4]["root_force"])


def through_files(state, tmp_path) -> list[dict]:
    """Return the state itself, pickled, and from a file of NumPy."""
    path = tmp_path / "state.npz"
    np.savez(path, **state)
    with np.load(path, allow_pickle=False) as file:
        return [state, pickle.loads(pickle.dumps(state)), {name: file[name] for name in file.files}]


@pytest.mark.parametrize(("name", "settings"), CASES, ids=str)
def test_a_restored_run_is_the_same(make_env, equal, tmp_path, name, settings):
    """Restore in the same environment and in another one, after other episodes, into the next episode."""
    env, other = make_env(name, **settings), make_env(name, twin=1, **settings)
    env.reset(seed=6)
    env.reset()
    observation = run_on(env, 6, seed=0)[-1][0]
    state = env.get_state()
    before = bytes_of(state)
    expected = run_on(env, 6, seed=1)
    next_episode = env.reset()[0]
    other.reset(seed=77)
    run_on(other, 3, seed=2)
    for target, copy in zip((env, other, other), through_files(state, tmp_path), strict=True):
        restored = target.set_state(copy)
        assert equal(restored, observation) and not np.shares_memory(restored, target.batch.observation.numpy())
        assert_same_run(expected, run_on(target, 6, seed=1), equal)
        assert equal(target.reset()[0], next_episode)
    assert bytes_of(state) == before, "a state is a copy"


def test_a_restored_environment_needs_no_reset(device, make_env, equal):
    env = make_env(KICK)
    observation = env.reset(seed=1)[0]
    fresh = AvatarEnv(KICK, device=device, fidelity="tiny")
    assert equal(fresh.set_state(env.get_state()), observation)
    assert_same_run(run_on(env, 5, seed=0), run_on(fresh, 5, seed=0), equal)


def test_clock_and_failure_are_part_of_the_state(make_env, sample_id):
    env = make_env(sample_id, episode_seconds=0.3)
    env.reset(seed=0)
    run_on(env, 6, seed=0)
    state = env.get_state()
    env.reset(seed=1)
    env.set_state(state)
    assert [row[3] for row in run_on(env, 3, seed=0)] == [False, False, True]
    state["particles.u"][0, 0] = 1e6
    env.set_state(state)
    assert run_on(env, 1, seed=0)[0][4]["failure"] == FAILURE_CFL
    failed = env.get_state()
    env.reset(seed=0)
    env.set_state(failed)
    _, _, terminated, _, info = run_on(env, 1, seed=0)[0]
    assert terminated and info["failure"] == FAILURE_CFL


def replaced(name, change):
    """Return a change of one array of a state."""
    return lambda state: {**state, name: change(state[name].copy())}


def with_infinity(array):
    array.flat[0] = np.inf
    return array


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda state: {name: value for name, value in state.items() if name != "particles.F"}, "particles.F"),
        (lambda state: {**state, "particles.G": state["particles.F"]}, "particles.G"),
        (replaced("particles.x", lambda x: x[:, 1:]), "particles.x.*shape"),
        (replaced("env.step_count", lambda count: np.zeros(2, np.int32)), r"env.step_count.*\(2,\).*\(1,\)"),
        (replaced("particles.u", lambda u: u.astype(np.float64)), "particles.u.*float64.*float32"),
        (replaced("avatar_0.tracked.rotation", lambda q: q.astype(str)), "avatar_0.tracked.rotation"),
        (replaced("controller_0.motion", with_infinity), r"controller_0.motion.*inf"),
        (lambda state: {}, "missing"),
        (lambda state: None, "NoneType.*get_state"),
        (lambda state: [1, 2], "list.*get_state"),
        (lambda state: {name: value for name, value in state.items() if name != "env.settings"}, "env.settings"),
        (replaced("env.settings", lambda text: np.zeros((1, 4), np.int32)), "env.settings.*int32"),
        (replaced("env.settings", lambda text: np.full((1, 4), 255, np.uint8)), "env.settings"),
    ],
)
def test_malformed_states_are_refused_and_change_nothing(make_env, spoil, words):
    env = make_env(KICK)
    env.reset(seed=3)
    run_on(env, 2, seed=0)
    good = env.get_state()
    env.reset(seed=4)
    before, observed = bytes_of(env.get_state()), env.batch.observation.numpy().copy()
    with pytest.raises(ValueError, match=words):
        env.set_state(spoil(good))
    assert bytes_of(env.get_state()) == before
    assert np.array_equal(env.batch.observation.numpy(), observed)


@pytest.mark.parametrize(
    ("task", "name", "value"),
    [
        ("PIAvatar/Stand-v0", "controller_0.assist", 1e30),
        ("PIAvatar/Stand-v0", "controller_0.assist", np.nan),
        (KICK, "matter.mass", np.nan),
        (KICK, "matter.mass", -1.0),
    ],
)
def test_values_that_no_reset_overwrites_are_refused_even_of_a_failed_run(make_env, task, name, value):
    env = make_env(task)
    env.reset(seed=0)
    state = env.get_state()
    state["particles.failure"][:] = 1
    state[name].flat[0] = value
    with pytest.raises(ValueError, match=name):
        env.set_state(state)
    state[name] = env.get_state()[name]
    state["particles.u"][:] = np.nan  # of a failed run
    env.set_state(state)
    env.reset(seed=0)
    assert run_on(env, 1, seed=0)[0][4]["failure"] == 0


@pytest.mark.parametrize(
    ("name", "settings", "words"),
    [
        (REACH, {"friction": 0.3}, r"physics.friction=0.8.*0.3"),
        (REACH, {"gravity": 1.62}, r"physics.gravity=9.81.*1.62"),
        (REACH, {"control_dt": 0.03}, r"physics.control_dt=0.0333.*0.03"),
        (REACH, {"radius": 0.2}, r"radius=0.45.*0.2"),
        (REACH, {"mass_factor": (0.8, 1.25)}, r"randomize.mass_factor=\[1.0, 1.0\].*\[0.8, 1.25\]"),
        (REACH, {"shape.randomize": True}, r"shape.randomize=False.*True"),
        ("PIAvatar/Stand-v0", {"bone_contact": False}, r"control.bone_contact=True.*False"),
        (REACH, {"scene.props": [BALL]}, r"scene.props=\[\]"),
    ],
)
def test_states_of_other_settings_are_refused_and_change_nothing(make_env, name, settings, words):
    env, other = make_env(name), make_env(name, **settings)
    env.reset(seed=0)
    other.reset(seed=1)
    before, restarts = bytes_of(other.get_state()), other.batch.restarts
    with pytest.raises(ValueError, match=words) as caught:
        other.set_state(env.get_state())
    assert "\n" not in str(caught.value)
    assert bytes_of(other.get_state()) == before and other.batch.restarts == restarts


def test_a_differing_setting_of_a_scene_is_named(make_env):
    env, other = (make_env(REACH, **{"scene.props": [{**BALL, "mass": mass}]}) for mass in (0.4, 0.5))
    env.reset(seed=0)
    with pytest.raises(ValueError, match=r"scene.props.0.mass=0.4.*0.5"):
        other.set_state(env.get_state())


def test_states_from_before_a_file_was_replaced_are_refused(device, tmp_path):
    path = tmp_path / "clip.txt"
    made = []
    for height in (0.8, 0.85):
        frames = [[0.1, 0.0, height, 0.0, *(8 * [0.0])] + 32 * [0.0] for _ in range(3)]
        for row in frames:
            for start in (4, 8, 12, 16, 21, 25, 30, 35, 39):
                row[start] = 1.0
        path.write_text(json.dumps({"Loop": "none", "Frames": frames}))
        made.append(AvatarEnv("TrackMotion-v0", device=device, fidelity="tiny", motion=str(path)))
        made[-1].reset(seed=0)
    first, second = made
    first.set_state(first.get_state())
    with pytest.raises(ValueError, match=r"files\.motion="):
        second.set_state(first.get_state())


def test_settings_that_do_not_alter_the_dynamics_may_differ(make_env, equal):
    """Pictures, how observations are packed, and root assistance, which is part of the state."""
    env = make_env("PIAvatar/Stand-v0", control="pd", root_assist=0.4)
    other = make_env("PIAvatar/Stand-v0", control="pd", obs_mode="dict", width=64)
    observation = env.reset(seed=0)[0]
    seen = other.set_state(env.get_state())
    assert equal(np.concatenate([part.ravel() for part in seen.values()]), observation)
    assert other.batch.simulation.controllers[0].assist.numpy().tolist() == pytest.approx([0.4])


def test_settings_of_a_state_can_be_replaced_on_purpose(make_env):
    env, other = make_env(REACH), make_env(REACH, friction=0.3)
    env.reset(seed=0)
    state = env.get_state()
    other.set_state({**state, "env.settings": other.get_state()["env.settings"]})
    assert other.get_state()["particles.x"].tobytes() == state["particles.x"].tobytes()


def test_other_settings_in_one_row_of_a_vector_are_refused_before_any_has_changed(make_vec):
    """Also in the last row, which another thread restores."""
    vector, other = make_vec(REACH, 3), make_vec(REACH, 3, friction=0.3)
    vector.reset(seed=0)
    other.reset(seed=0)
    state = vector.get_state()
    vector.reset(seed=5)
    before, strange = bytes_of(vector.get_state()), state["env.settings"].copy()
    strange[2] = other.get_state()["env.settings"][2]
    for restore in (
        lambda: vector.set_state({**state, "env.settings": strange}),
        lambda: vector.set_state(other.get_state()),
        lambda: vector.call_some([2], "set_state", other.call("get_state")[0]),
    ):
        with pytest.raises(ValueError, match=r"physics.friction=0.3.*0.8"):
            restore()
        assert bytes_of(vector.get_state()) == before
