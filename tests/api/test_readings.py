"""What views return is the caller's own: no array is memory of the environments, and readings have one convention."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest
import warp as wp
from scipy.spatial.transform import Rotation

import piavatar_envs  # noqa: F401 - registers the ids
from piavatar_envs.api.readings import READINGS
from piavatar_envs.core.arrays import matrices_of
from tests.api.runs import arrays_in, on_host

BALL = {"name": "toy", "mass": 1.0, "position": [0.0, -0.6, 1.3], "rotation": [0.8, 0.6, 0.0, 0.0]}
TINY = {"fidelity": "tiny", "episode_seconds": 0.2, "scene": {"props": [BALL]}}


def single(device):
    env = gymnasium.make("PIAvatar/KickBall-v0", device=device, **TINY).unwrapped
    return env, lambda: [env.reset(seed=1)], lambda: [env.step(env.action_space.sample())]


def by_name(device):
    env = gymnasium.make("PIAvatar/Dodge-v0", device=device, obs_mode="dict", **TINY).unwrapped
    return env, lambda: [env.reset(seed=1)], lambda: [env.step(env.action_space.sample())]


def vector(device):
    env = gymnasium.make_vec("PIAvatar/KickBall-v0", 2, device=device, autoreset_mode="SameStep", **TINY).unwrapped
    return env, lambda: [env.reset(seed=1)], lambda: [env.step(env.action_space.sample()), env.call("get_state")]


def tensors(device):
    env = gymnasium.make_vec("PIAvatar/KickBall-v0", 2, device=device, array_api="torch", **TINY).unwrapped
    return env, lambda: [env.reset(seed=1)], lambda: [env.step(env.action_space.sample())]


def game(device):
    pytest.importorskip("pettingzoo", reason="needs the extra multi")
    from piavatar_envs.multi import pass_ball_v0

    env = pass_ball_v0.parallel_env(num_agents=2, device=device, fidelity="tiny")

    def step():
        return [env.step({name: env.action_space(name).sample() for name in env.agents}), env.state()]

    return env, lambda: [env.reset(seed=1)], step


def sb3(device):
    pytest.importorskip("stable_baselines3", reason="needs the extra train")
    from piavatar_envs.api.sb3 import SB3VecEnv

    env = SB3VecEnv("KickBall-v0", 2, device=device, **TINY)
    actions = np.zeros((2, *env.action_space.shape), np.float32)
    return env, lambda: [env.reset()], lambda: [env.step(actions), env.reset_infos, env.env_method("get_state")]


def skrl(device):
    torch = pytest.importorskip("torch", reason="needs the extra skrl")
    from piavatar_envs.api.skrl import AvatarSkrlEnv

    env = AvatarSkrlEnv("KickBall-v0", 2, device, **TINY)
    return env, lambda: [env.reset(1)], lambda: [env.step(torch.zeros(2, env.host.action_size, device=env.device))]


def skrl_game(device):
    torch = pytest.importorskip("torch", reason="needs the extra skrl")
    pytest.importorskip("pettingzoo", reason="needs the extra multi")
    from piavatar_envs.api.skrl import AvatarSkrlMultiEnv
    from piavatar_envs.multi import pass_ball_v0

    env = AvatarSkrlMultiEnv(pass_ball_v0.TASK, 2, device, fidelity="tiny", num_agents=2)
    still = torch.zeros(2, env.host.action_size, device=env.device)
    return env, lambda: [env.reset(1)], lambda: [env.step(dict.fromkeys(env.possible_agents, still)), env.state()]


def rsl(device):
    torch = pytest.importorskip("torch", reason="needs the extra rsl")
    pytest.importorskip("tensordict", reason="needs the extra rsl")
    from piavatar_envs.api.rsl_rl import AvatarRslEnv

    env = AvatarRslEnv("KickBall-v0", 2, device, seed=1, **TINY)
    still = torch.zeros(2, env.num_actions, device=env.device)
    return env, lambda: [env.reset(1)], lambda: [env.step(still), env.episode_length_buf, env.get_observations()]


VIEWS = [single, by_name, vector, tensors, game, sb3, skrl, skrl_game, rsl]


def host_of(view):
    return getattr(view, "vector", view).host


def readings_of(view) -> dict:
    names = host_of(view).task.agent_names
    agents = {name: names if reading.of_bones and len(names) > 1 else [None] for name, reading in READINGS.items()}
    return {(name, agent): view.read(name, agent) for name, own in agents.items() for agent in own}


def memory_of(host) -> list[np.ndarray]:
    """Return views of the arrays that steps write to: of states, of readings, and the outcome of a step."""
    names = ("observation", "reward", "terms", "metrics", "cost", "cost_terms", "terminated", "truncated", "failure")
    found = []
    for group in host.groups:
        arrays = [*group.arrays().values(), *(getattr(group, name) for name in names)]
        arrays += [READINGS[name].array_of(group.simulation, 0) for name in READINGS]
        found += [array.numpy() for array in arrays if array.size and array.device.is_cpu]
    return found


@pytest.mark.parametrize("build", VIEWS)
def test_nothing_that_a_view_returns_is_memory_of_the_environments(build, device):
    """Later steps change none of it on any device, and on a CPU none of it is a buffer."""
    view, reset, step = build(device)
    answers = [reset(), step(), step(), readings_of(view)]
    if hasattr(view, "get_state"):
        answers.append(view.get_state())
    arrays = [on_host(array) for array in arrays_in(answers) if array.dtype != object]
    before = [array.tobytes() for array in arrays]
    buffers = memory_of(host_of(view))
    assert [array for array in arrays for buffer in buffers if np.shares_memory(array, buffer)] == []
    for _ in range(8):  # over the end of an episode
        if build is game and not view.agents:
            reset()
        step()
    wp.synchronize()
    assert [array.tobytes() for array in arrays] == before
    view.close()


@pytest.mark.parametrize("build", [single, vector, tensors, game])
def test_readings_are_those_of_the_device_in_one_convention(build, device):
    view, reset, step = build(device)
    reset(), step()
    host = host_of(view)
    one = build in (single, game)
    for (name, agent), value in readings_of(view).items():
        value = on_host(value)[None] if one else on_host(value)
        index = 0 if agent is None else host.task.agent_names.index(agent)
        device_own = [READINGS[name].array_of(group.simulation, index).numpy() for group in host.groups]
        own = np.concatenate(device_own)
        if READINGS[name].kind == "matrix":
            own = matrices_of(own)
        if READINGS[name].kind == "quaternion":
            shape = (*own.shape[:-1], 3, 3)
            turned = Rotation.from_quat(value.reshape(-1, 4)[:, [1, 2, 3, 0]]).as_matrix().reshape(shape)
            np.testing.assert_allclose(
                turned, Rotation.from_quat(own.reshape(-1, 4)).as_matrix().reshape(shape), atol=1e-6
            )
        else:
            np.testing.assert_array_equal(value, own, name)


def test_a_prop_is_read_as_it_was_set(device):
    """The quaternion of the settings comes back: both are wxyz."""
    env = gymnasium.make("PIAvatar/Reach-v0", device=device, **TINY).unwrapped
    with pytest.raises(gymnasium.error.ResetNeeded, match="read"):
        env.read("prop_rotation")
    env.reset(seed=0)
    np.testing.assert_allclose(env.read("prop_rotation")[0], BALL["rotation"], atol=1e-3)
    np.testing.assert_allclose(env.read("prop_position")[0], BALL["position"], atol=1e-3)
    with pytest.raises(ValueError, match="bone_position"):
        env.read("bones")
    with pytest.raises(ValueError, match="agent_7"):
        env.read("bone_position", agent="agent_7")


def test_a_world_without_props_has_none_to_read(make_vec):
    env = make_vec("PIAvatar/Reach-v0", 2).unwrapped
    env.reset(seed=0)
    assert env.read("prop_position").shape == (2, 0, 3)
    assert [row.shape for row in env.call("read", "bone_rotation")] == [(22, 4)] * 2


def test_bones_of_a_game_need_the_agent(device):
    view, reset, _ = game(device)
    reset()
    with pytest.raises(ValueError, match="agent_0, agent_1"):
        view.read("bone_position")
    assert np.linalg.norm(view.read("bone_position", "agent_0") - view.read("bone_position", "agent_1")) > 1.0


def test_the_guide_lists_every_reading():
    from tests.test_docs import PAGES

    page = PAGES["docs/scenes.md"].read_text(encoding="utf-8")
    assert [name for name in READINGS if f"`{name}`" not in page] == []
