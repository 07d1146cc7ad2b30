"""The views for skrl equal the other views, step by step, while agents leave and episodes end."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest
import warp as wp

from tests.api.runs import arrays_in, on_host
from tests.conftest import only_one_process

torch = pytest.importorskip("torch", reason="needs the extra train or skrl")

from piavatar_envs.api.skrl import AvatarSkrlEnv, AvatarSkrlMultiEnv  # noqa: E402

STEPS = 9  # of an episode
SETTINGS = {"fidelity": "tiny", "episode_seconds": 0.3}
REACH = "PIAvatar/Reach-v0"


@pytest.fixture(scope="module")
def sumo(device):
    """The module of a game whose agents leave one by one, its kernels compiled."""
    pytest.importorskip("pettingzoo", reason="needs the extra multi")
    with only_one_process("kernels"):
        from piavatar_envs.multi import sumo_v0

        wp.force_load(device)
    return sumo_v0


@pytest.fixture(scope="module")
def arena(sumo, device):
    """Two environments of three agents."""
    env = AvatarSkrlMultiEnv(sumo.TASK, 2, device, num_agents=3, **SETTINGS)
    yield env
    env.close()


@pytest.fixture(scope="module")
def ring(sumo, device):
    """One environment of three agents, of PettingZoo."""
    env = sumo.parallel_env(device=device, num_agents=3, **SETTINGS)
    yield env
    env.close()


@pytest.fixture(scope="module")
def reachers(device):
    """Two environments of one avatar."""
    env = AvatarSkrlEnv(REACH, 2, device, **SETTINGS)
    yield env
    env.close()


def drawn(env, rng) -> dict:
    """Return random actions of all agents."""
    size = env.action_spaces[env.agents[0]].shape[0]
    rows = rng.uniform(-1.0, 1.0, (len(env.agents), env.num_envs, size)).astype(np.float32)
    return {name: torch.from_numpy(row).to(env.device) for name, row in zip(env.agents, rows, strict=True)}


def knock_down(env, *where: tuple[int, int]) -> None:
    """Release the roots of these agents, given as (environment, agent)."""
    state = env.get_state()
    for row, agent in where:
        state[f"avatar_{agent}.state.released"][row] = 1
    env.set_state(state)


@pytest.mark.parametrize("row", [0, 1])
def test_every_environment_equals_that_of_pettingzoo(arena, ring, equal, row):
    """Compare bit for bit into the next episode; in environment 1 an agent goes down while the others fight on."""
    rng = np.random.default_rng(3)
    actions = [drawn(arena, rng) for _ in range(STEPS + 3)]
    expected, _ = ring.reset(seed=40 + row)
    observed, infos = arena.reset(seed=40)
    for name in ring.possible_agents:
        assert equal(on_host(observed[name][row]), expected[name]) and infos["alive"][name][row]
    resets = 0
    for step, act in enumerate(actions):
        if step == 2:
            knock_down(arena.host, (1, 1))
            if row == 1:
                knock_down(ring, (0, 1))
        playing = list(ring.agents)
        expected, rewards, terminations, truncations, agent_infos = ring.step(
            {name: on_host(act[name][row]) for name in playing}
        )
        observed, reward, terminated, truncated, infos = arena.step(act)
        over = not ring.agents
        assert bool(infos["_final_obs"][row]) == over
        assert equal(on_host(infos["final_state"][row]), ring.state())
        for name in ring.possible_agents:
            assert bool(infos["acted"][name][row]) == (name in playing)
            if name not in playing:
                assert reward[name][row] == 0.0 and terminated[name][row] and not truncated[name][row]
                continue
            assert equal(on_host(infos["final_obs"][name][row]), expected[name])
            assert equal(on_host(reward[name][row]), np.float32(rewards[name]))
            assert bool(terminated[name][row]) == terminations[name]
            assert bool(truncated[name][row]) == truncations[name]
            assert bool(infos[name]["success"][row]) == agent_infos[name]["success"]
            assert infos[name]["rim_distance"][row].item() == pytest.approx(agent_infos[name]["rim_distance"], abs=2e-3)
        if over:
            resets += 1
            expected, _ = ring.reset()
        for name in ring.agents:
            assert equal(on_host(observed[name][row]), expected[name]) and infos["alive"][name][row]
        assert equal(on_host(arena.state()[row]), ring.state())
    assert resets == 1


def test_an_environment_ends_with_its_last_agent_and_is_reset(arena):
    arena.reset(seed=1)
    still = {name: torch.zeros_like(action) for name, action in drawn(arena, np.random.default_rng(0)).items()}
    knock_down(arena.host, (0, 0), (0, 1), (0, 2), (1, 2))
    observed, _, terminated, truncated, infos = arena.step(still)
    assert infos["_final_obs"].tolist() == [True, False]
    for index, name in enumerate(arena.agents):
        assert terminated[name].tolist() == [True, index == 2] and truncated[name].tolist() == [False, False]
        assert infos["acted"][name].tolist() == [True, True]
        assert infos["alive"][name].tolist() == [True, index < 2], "the first environment was reset"
        changed = (infos["final_obs"][name] != observed[name]).any(dim=1).tolist()
        assert changed == [True, False], "the other environment was not reset"
    assert arena.agents == arena.possible_agents, "a trainer resets where there are no agents"
    *_, terminated, _, infos = arena.step(still)
    assert terminated["agent_2"].tolist() == [False, True] and infos["acted"]["agent_2"].tolist() == [True, False]
    assert infos["_final_obs"].tolist() == [False, False]


def test_shapes_types_and_devices(arena, reachers):
    rng = np.random.default_rng(0)
    arena.reset(seed=0)
    observed, reward, terminated, truncated, infos = arena.step(drawn(arena, rng))
    for name in arena.possible_agents:
        assert observed[name].shape == (2, *arena.observation_spaces[name].shape)
        assert reward[name].shape == terminated[name].shape == truncated[name].shape == (2,)
        assert observed[name].dtype == reward[name].dtype == torch.float32
        assert terminated[name].dtype == truncated[name].dtype == infos["alive"][name].dtype == torch.bool
    distance = torch.stack([infos[name]["rim_distance"] for name in arena.agents])
    assert infos["episode"]["Task/rim_distance"].item() == pytest.approx(distance.mean().item(), rel=1e-5)
    assert arena.state().shape == infos["final_state"].shape == (2, *arena.state_space.shape)
    reachers.reset(seed=0)
    single = reachers.step(torch.zeros(2, *reachers.single_action_space.shape, device=reachers.device))
    assert single[0]["policy"].shape == (2, *reachers.single_observation_space["policy"].shape)
    assert [value.shape for value in single[1:4]] == [(2,)] * 3
    for found in ((observed, reward, terminated, truncated, infos, arena.state()), single):
        assert len(list(arrays_in(found))) > 15
        assert all(tensor.device == arena.device == reachers.device for tensor in list(arrays_in(found)))


def test_returned_tensors_are_copies(arena):
    rng = np.random.default_rng(0)
    returned = list(arrays_in((*arena.reset(seed=0), arena.state())))
    returned += list(arrays_in((*arena.step(drawn(arena, rng)), arena.state())))
    before = [tensor.clone() for tensor in returned]
    for index, tensor in enumerate(returned):
        tensor.copy_(tensor == 0)
        assert all(torch.equal(kept, was) for kept, was in zip(returned[index + 1 :], before[index + 1 :], strict=True))
        tensor.copy_(before[index])
    for _ in range(2):
        arena.step(drawn(arena, rng))
    assert all(torch.equal(kept, was) for kept, was in zip(returned, before, strict=True))


def test_bad_actions_are_refused(arena, sumo, device):
    rng = np.random.default_rng(0)
    arena.reset(seed=0)
    before, good = arena.state(), drawn(arena, rng)
    size = arena.action_spaces["agent_0"].shape[0]
    for bad, words in [
        ({"agent_0": good["agent_0"]}, "agent_0, agent_1, agent_2"),
        (good | {"referee": good["agent_0"]}, "referee"),
        (good | {"agent_1": good["agent_1"][:1]}, rf"shape \(1, {size}\), expected \(2, {size}\)"),
        ({name: action.double() for name, action in good.items()}, "float64"),
    ]:
        with pytest.raises(ValueError, match=words):
            arena.step(bad)
    assert torch.equal(arena.state(), before)
    with pytest.raises((ValueError, gymnasium.error.Error)):
        arena.reset(seed=-1)
    fresh = AvatarSkrlMultiEnv(sumo.TASK, 1, device, num_agents=3, **SETTINGS)
    for call in (fresh.state, lambda: fresh.step({name: action[:1] for name, action in good.items()})):
        with pytest.raises(gymnasium.error.ResetNeeded):
            call()
    fresh.close()


def test_a_nonfinite_action_ends_its_environment_only(arena):
    arena.reset(seed=0)
    actions = drawn(arena, np.random.default_rng(0))
    actions["agent_1"][0, 2] = torch.nan
    observed, reward, terminated, _, infos = arena.step(actions)
    assert all(terminated[name].tolist() == [True, False] for name in arena.agents)
    assert infos["_final_obs"].tolist() == [True, False] and (infos["agent_0"]["failure"] != 0).tolist() == [
        True,
        False,
    ]
    assert all(torch.isfinite(tensor).all() for tensor in list(arrays_in((observed, reward, infos))))


def test_one_avatar_equals_that_of_gymnasium(reachers, make_env, equal):
    single, rng = make_env(REACH, **{"episode_seconds": SETTINGS["episode_seconds"]}), np.random.default_rng(2)
    size = reachers.single_action_space.shape[0]
    actions = rng.uniform(-1.0, 1.0, (STEPS + 3, 2, size)).astype(np.float32)
    for row in range(2):
        observed, _ = reachers.reset(seed=6)
        expected, _ = single.reset(seed=6 + row)
        assert equal(on_host(observed["policy"][row]), expected)
        ends = []
        for step, action in enumerate(actions):
            observed, reward, terminated, truncated, info = reachers.step(torch.from_numpy(action).to(reachers.device))
            expected, *outcome, single_info = single.step(action[row])
            assert equal(on_host(info["final_obs"]["policy"][row]), expected)
            assert equal(on_host(reward[row]), np.float32(outcome[0]))
            assert [bool(terminated[row]), bool(truncated[row])] == outcome[1:]
            assert info["distance"][row].item() == pytest.approx(single_info["distance"], abs=2e-3)
            mean = info["distance"].mean().item()
            assert info["episode"]["Task/distance"].item() == pytest.approx(mean, rel=1e-5)
            if any(outcome[1:]):
                ends.append(step)
                expected, _ = single.reset()
            assert bool(info["_final_obs"][row]) == any(outcome[1:])
            assert equal(on_host(observed["policy"][row]), expected)
        assert ends == [STEPS - 1]


def test_skrls_wrapper_accepts_several_agents(arena):
    pytest.importorskip("skrl", reason="needs the extra skrl")
    from skrl.envs.wrappers.torch import wrap_env

    env = wrap_env(arena, wrapper="isaaclab-multi-agent", verbose=False)
    size, seen = arena.action_spaces["agent_0"].shape[0], arena.observation_spaces["agent_0"].shape[0]
    assert (env.num_envs, env.num_agents, env.max_num_agents) == (2, 3, 3) and env.device == arena.device
    assert env.possible_agents == env.agents == ["agent_0", "agent_1", "agent_2"]
    env.reset()
    for _ in range(STEPS):
        observed, reward, terminated, truncated, infos = env.step(drawn(arena, np.random.default_rng(1)))
    assert all(value.shape == (2, 1) for flags in (reward, terminated, truncated) for value in flags.values())
    assert all(observed[name].shape == (2, seen) and env.state()[name].shape == (2, 3 * seen) for name in env.agents)
    assert all(value.all() for value in truncated.values()) and infos["_final_obs"].all()
    assert env.action_space("agent_1").shape == (size,)


def test_skrls_wrapper_accepts_one_agent_and_dictionaries(reachers, device):
    pytest.importorskip("skrl", reason="needs the extra skrl")
    from skrl.envs.wrappers.torch import wrap_env

    named = AvatarSkrlEnv(REACH, 1, device, obs_mode="dict", **SETTINGS)
    for bare, size in ((reachers, 2), (named, 1)):
        env = wrap_env(bare, wrapper="isaaclab-single-agent", verbose=False)
        assert env.num_envs == size and env.state_space is None and env.state() is None
        first, _ = env.reset()
        assert first.shape == (size, bare.observation_layout.size)
        step = env.step(torch.zeros(size, *env.action_space.shape, device=env.device))
        assert step[0].shape == first.shape and [value.shape for value in step[1:4]] == [(size, 1)] * 3
    terms, _ = named.reset(seed=3)
    assert tuple(terms["policy"]) == tuple(named.observation_layout)
    named.close()
