"""``apply_force`` of the views: what it takes and refuses, batches of NumPy and torch, states, copies."""

from __future__ import annotations

import copy

import gymnasium
import numpy as np
import pytest

from piavatar_envs.mpm.types import FAILURE_FORCE
from piavatar_envs.sim.forces import SLOTS
from tests.api.runs import actions_of, bytes_of

KICK = "PIAvatar/KickBall-v0"
PUSH = np.array([0.0, 30.0, 5.0])
#: Settings of this file alone, because environments that are shared with other files would keep their forces' arrays.
OWN = {"episode_seconds": 1.7}

BAD = {
    "unknown target": (
        {"target": "nose"},
        r"no target 'nose'; use a bone \(pelvis, .*wrist\) or.* a prop \(ball\)",
    ),
    "a part": ({"target": "left_arm"}, "no target 'left_arm'"),
    "unknown agent": ({"agent": "referee"}, "agent='referee' is not one of agent_0"),
    "a prop of an agent": ({"target": "ball", "agent": "agent_0"}, r"without agent, a prop \(ball\)"),
    "two numbers": ({"force": [1.0, 2.0]}, r"force has shape \(2,\); use shape \(3,\)"),
    "not finite": ({"force": [0.0, np.nan, 0.0]}, r"force\[1\] is nan"),
    "too large": ({"force": [0.0, 0.0, 1e39]}, r"force\[2\] is inf"),
    "text": ({"force": "up"}, "force is a str"),
    "a point in a plane": ({"point": [1.0, 2.0]}, r"point has shape \(2,\)"),
    "a point nowhere": ({"point": [1.0, np.inf, 0.0]}, r"point\[1\] is inf"),
    "no steps": ({"steps": 0}, "steps=0"),
    "half a step": ({"steps": 0.5}, r"steps=0\.5"),
    "no such environment": ({"envs": [7]}, r"envs=\[7\]"),
    "a long mask": ({"envs": np.ones(9, bool)}, r"envs has shape \(9,\)"),
}


def run(view, steps: int, seed: int = 0) -> list:
    return [view.step(action) for action in actions_of(view, steps, seed)]


@pytest.mark.parametrize("case", BAD)
def test_what_is_wrong_is_refused_and_changes_nothing(make_env, make_vec, case):
    arguments, message = BAD[case]
    for view in (make_env(KICK, **OWN), make_vec(KICK, **OWN)):
        view.reset(seed=0)
        before = bytes_of(view.get_state())
        with pytest.raises(ValueError, match=message):
            view.apply_force(**{"target": "head", "force": PUSH, **arguments})
        assert bytes_of(view.get_state()) == before


def test_it_needs_a_reset_before(device):
    env = gymnasium.make(KICK, device=device, fidelity="tiny").unwrapped
    with pytest.raises(gymnasium.error.ResetNeeded, match=r"before apply_force"):
        env.apply_force("head", PUSH)
    env.close()


def test_more_forces_than_slots_are_refused(make_env):
    env = make_env(KICK, **OWN, gravity=9.0)
    env.reset(seed=0)
    for _ in range(SLOTS):
        env.apply_force("head", PUSH, steps=2)
    before = bytes_of(env.get_state())
    with pytest.raises(ValueError, match=rf"environments \[0\] have {SLOTS} forces"):
        env.apply_force("ball", PUSH)
    assert bytes_of(env.get_state()) == before
    run(env, 2)
    env.apply_force("ball", PUSH)  # those have ended


def test_environments_of_a_vector_equal_single_ones(make_env, make_vec, same):
    vector, single = make_vec(KICK, **OWN), make_env(KICK, **OWN, twin=1)
    forces, actions = np.stack([PUSH, 2.0 * PUSH, -PUSH]), actions_of(vector, 4)
    at = np.array([0.1, -0.1, 1.4])
    vector.reset(seed=5)
    vector.apply_force("head", forces, at, steps=2, envs=[0, 2])
    vector.apply_force("ball", PUSH, envs=np.array([False, True, True]))
    observations = [vector.step(action)[0] for action in actions]
    for env in range(3):
        single.reset(seed=5 + env)
        if env != 1:
            single.apply_force("head", forces[env], at, steps=2)
        if env != 0:
            single.apply_force("ball", PUSH, agent=None)
        for action, seen in zip(actions, observations, strict=True):
            same(single.step(action[env])[0], seen[env])


def test_single_environments_are_pushed_by_name(make_vec):
    vector = make_vec(KICK, **OWN)
    remaining = {}
    for how in ("call", "envs"):
        vector.reset(seed=1)
        if how == "call":
            assert vector.call("apply_force", "head", PUSH, steps=4) == (None,) * 3
            vector.call_some([1], "apply_force", "ball", PUSH)
        else:
            vector.apply_force("head", PUSH, steps=4)
            vector.apply_force("ball", PUSH, envs=1)
        state = vector.get_state()
        remaining[how] = state["forces.remaining"][:, :2].tolist()
    assert remaining["call"] == remaining["envs"] == [[4, 0], [4, 1], [4, 0]]


def test_stable_baselines_environments_are_pushed(device):
    pytest.importorskip("stable_baselines3")
    from piavatar_envs.api.sb3 import SB3VecEnv

    vector = SB3VecEnv(KICK, 2, device=device, fidelity="tiny")
    vector.reset()
    vector.apply_force("head", PUSH, steps=4, envs=[1])
    assert vector.env_method("apply_force", "ball", PUSH, steps=2, indices=[0, 1]) == [None, None]
    assert vector.vector.get_state()["forces.remaining"][:, :2].tolist() == [[2, 0], [4, 2]]
    vector.close()


def test_tensors_push_as_arrays_do(make_vec, same):
    torch = pytest.importorskip("torch")
    found = {}
    for api in ("numpy", "torch"):
        vector = make_vec(KICK, **OWN, array_api=api)
        vector.reset(seed=2)
        force, mask = np.float32([PUSH, 2.0 * PUSH, -PUSH]), np.array([True, False, True])
        if api == "torch":
            device = vector.host.api.device
            force, mask = torch.tensor(force, device=device), torch.tensor(mask, device=device)
            for wrong in (force.double(), force[:2], force.flatten()):
                with pytest.raises(ValueError, match=r"^force "):
                    vector.apply_force("head", wrong)
            with pytest.raises(ValueError, match=r"envs is a mask of shape \(2,\)"):
                vector.apply_force("head", force, envs=mask[:2])
        vector.apply_force("head", force, steps=2, envs=mask)
        vector.apply_force("ball", PUSH, envs=torch.tensor([1]) if api == "torch" else [1])
        for action in actions_of(vector, 3):
            observation = vector.step(action)[0]
        found[api] = np.asarray(observation.cpu() if api == "torch" else observation)
    same(found["torch"], found["numpy"])


def test_a_tensor_that_is_not_finite_ends_its_environment(make_vec):
    torch = pytest.importorskip("torch")
    vector = make_vec(KICK, **OWN, array_api="torch")
    vector.reset(seed=2)
    force = torch.tensor(np.float32([PUSH, [np.nan, 0.0, 0.0], PUSH]), device=vector.host.api.device)
    vector.apply_force("head", force)
    _, _, terminated, _, infos = vector.step(actions_of(vector, 1)[0])
    assert terminated.tolist() == [False, True, False]
    assert infos["failure"].tolist() == [0, FAILURE_FORCE, 0]


@pytest.mark.parametrize("twin", ["same", "without forces"])
def test_a_state_holds_the_forces_that_act(make_env, same, twin):
    env = make_env(KICK, **OWN)
    env.reset(seed=3)
    run(env, 1)
    env.apply_force("left_knee", PUSH, steps=3)
    run(env, 1, seed=1)
    state = env.get_state()
    expected = run(env, 4, seed=2)
    other = env if twin == "same" else make_env(KICK, **OWN, twin=3)
    if twin != "same":
        other.reset(seed=0)
        assert not any(name.startswith("forces.") for name in other.get_state())
    other.set_state(state)
    for step, seen in zip(run(other, 4, seed=2), expected, strict=True):
        same(step[0], seen[0])


def test_a_state_without_forces_ends_them(make_env):
    env, plain = make_env(KICK, **OWN), make_env(KICK, **OWN, twin=2)
    plain.reset(seed=4)
    env.reset(seed=0)
    env.apply_force("head", PUSH, steps=50)
    env.set_state(plain.get_state())
    assert not env.get_state()["forces.remaining"].any()


def test_a_single_state_leaves_the_forces_of_others(make_env, make_vec):
    vector, plain = make_vec(KICK, **OWN), make_env(KICK, **OWN, twin=2)
    plain.reset(seed=4)
    vector.reset(seed=0)
    vector.apply_force("head", PUSH, steps=50)
    vector.call_some([1], "set_state", plain.get_state())
    assert vector.get_state()["forces.remaining"][:, 0].tolist() == [50, 0, 50]


def test_a_copy_is_pushed_on(make_env, same):
    env = make_env(KICK, **OWN)
    env.reset(seed=6)
    env.apply_force("head", PUSH, steps=3)
    run(env, 1)
    other = copy.deepcopy(env)
    for a, b in zip(run(env, 3), run(other, 3), strict=True):
        same(a[0], b[0])
    other.close()


def test_a_reset_ends_them(make_env, same):
    env = make_env(KICK, **OWN)
    env.reset(seed=7)
    expected = run(env, 2)
    env.apply_force("head", 10.0 * PUSH, steps=50)
    run(env, 1)
    env.reset(seed=7)
    for a, b in zip(run(env, 2), expected, strict=True):
        same(a[0], b[0])
