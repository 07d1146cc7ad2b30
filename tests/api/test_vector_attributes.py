"""Calls of single environments of a vector equal those of Gymnasium's own vector of them."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import SyncVectorEnv

from piavatar_envs.api.vector_env import AvatarVectorEnv

#: An episode of six steps.
SHORT = {"episode_seconds": 0.2}
REACH = "PIAvatar/Reach-v0"


@pytest.fixture
def pair(make_vec, make_env):
    """A vector, and Gymnasium's of the same environments."""
    singles = [make_env(REACH, twin=twin, **SHORT) for twin in range(2)]
    oracle = SyncVectorEnv([lambda env=env: env for env in singles])
    vector = make_vec(REACH, 2, **SHORT)
    for env in (vector, oracle):
        env.reset(seed=31)
    return vector, oracle


def test_attributes_are_those_of_single_environments(pair):
    vector, oracle = pair
    for name in ("action_names", "action_space", "observation_space", "config", "render_mode", "observation_layout"):
        assert vector.get_attr(name) == vector.call(name) == oracle.get_attr(name)
    assert vector.get_attr("np_random_seed") == oracle.get_attr("np_random_seed") == (31, 32)
    for name in ("bogus", "batch", "np_random"):
        with pytest.raises(AttributeError, match=name):
            vector.get_attr(name)


def test_methods_are_those_of_single_environments(pair, same):
    vector, oracle = pair
    action = vector.action_space.sample()
    for env in (vector, oracle):
        env.step(action)
    states = vector.call("get_state")
    same(states, oracle.call("get_state"))
    same(vector.call("set_state", states[1]), oracle.call("set_state", states[1]))
    same(vector.step(action), oracle.step(action))
    same(vector.call("reset", seed=5), oracle.call("reset", seed=5))
    same(vector.call("reset"), oracle.call("reset"))
    same(vector.step(action), oracle.step(action))
    with pytest.raises(ValueError, match='control="pose" has a root wrench'):
        vector.call("assist_root", 0.5)


def test_some_take_over_a_state_and_the_others_go_on(pair, equal):
    vector, _ = pair
    first = vector.get_state()
    [seen] = vector.call_some([1], "set_state", vector.call("get_state")[0])
    both = vector.host.observation()[:, 0]
    assert equal(seen, both[1]) and equal(both[0], both[1])
    assert equal(vector.get_state()["particles.x"][0], first["particles.x"][0])
    bad = vector.call("get_state")[0]
    for name, value in (("particles.F", None), ("particles.G", np.zeros((1, 3))), ("particles.x", np.zeros((1, 2, 3)))):
        wrong = {key: part for key, part in bad.items() if key != name} | ({} if value is None else {name: value})
        with pytest.raises(ValueError, match="state"):
            vector.call_some([1], "set_state", wrong)
    with pytest.raises(ValueError, match=r"expected \(1, "):
        vector.call("set_state", first)


def test_calls_that_single_environments_lack_are_refused(pair):
    vector, _ = pair
    for name in ("step", "close", "vector_step_wait"):
        with pytest.raises(AttributeError, match=name):
            vector.call(name, None)
    with pytest.raises(AttributeError, match="'assist_root', 'get_state', 'render', 'reset', 'set_state'"):
        vector.call("step", np.zeros(3))


def test_root_assistance_is_set_for_all(make_vec):
    vector = make_vec("PIAvatar/Stand-v0", 2)
    vector.reset(seed=0)
    assert vector.call("assist_root", 0.25) == (None, None)
    assert vector.get_state()["controller_0.assist"].tolist() == [0.25, 0.25]
    with pytest.raises(ValueError, match="a share for each"):
        vector.call_some([0], "assist_root", 0.5)


def test_users_attributes_are_shared(device):
    vector = AvatarVectorEnv(REACH, 2, device=device, fidelity="tiny")
    vector.set_attr("note", 3)
    vector.set_attr("list", [[1, 2], [1, 2]])
    vector.set_attr("note", (4, 4))
    assert vector.get_attr("note") == (4, 4) and vector.list == [1, 2]
    refused = {
        "note": ([1, 2], "share their attributes"),
        "list": ([1, 2, 3], "there are 3 values for num_envs=2"),
        "tone": (0.5, r"settings are fixed .* tone=\.\.\."),
        "control.tone": (0.5, "settings are fixed"),
        "config": (None, "part of the environments"),
        "render_mode": ("rgb_array", "part of the environments"),
        "observation_space": (None, "part of the environments"),
        "step": (None, "part of the environments"),
    }
    for name, (value, words) in refused.items():
        with pytest.raises(ValueError, match=words):
            vector.set_attr(name, value)
    assert vector.get_attr("note") == (4, 4)
    vector.close()


def test_some_begin_before_the_others_have(device):
    vector = AvatarVectorEnv(REACH, 2, device=device, fidelity="tiny", obs_mode="dict")
    with pytest.raises(gymnasium.error.ResetNeeded):
        vector.call_some([0], "set_state", {"particles.x": np.zeros((1, 2, 3), np.float32)})
    [(seen, info)] = vector.call_some([1], "reset", seed=3)
    assert seen["root_height"].shape == (1,) and info["failure"] is None
    vector.step(np.zeros(vector.action_space.shape))
    vector.close()


def test_tensors_are_split_by_environment(make_vec, equal):
    torch = pytest.importorskip("torch")
    vector, arrays = make_vec(REACH, 2, array_api="torch", **SHORT), make_vec(REACH, 2, **SHORT)
    for (seen, info), (expected, told) in zip(vector.call("reset", seed=3), arrays.call("reset", seed=3), strict=True):
        assert isinstance(seen, torch.Tensor) and equal(seen.cpu(), expected) and set(info) == set(told)
        assert info["success"] is told["success"] is False
