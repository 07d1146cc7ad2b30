"""Root assistance is set in every view by the same call, with the same effect."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest

from piavatar_envs.envs.parameters import ASSIST, PARAMETERS

STAND = "PIAvatar/Stand-v0"
SETTINGS = {"fidelity": "tiny", "control": "torque", "pose_noise": 0.0, "episode_seconds": 20.0}
STEPS = 60


def vector_view(device, **settings):
    return gymnasium.make_vec(STAND, num_envs=2, device=device, num_threads=2, **settings).unwrapped


def sb3_view(device, **settings):
    pytest.importorskip("stable_baselines3", reason="needs the extra train")
    from piavatar_envs.api.sb3 import SB3VecEnv

    return SB3VecEnv(STAND, 2, device=device, **settings)


def skrl_view(device, **settings):
    pytest.importorskip("torch", reason="needs the extra train or skrl")
    from piavatar_envs.api.skrl import AvatarSkrlEnv

    return AvatarSkrlEnv(STAND, 2, device, **settings)


def rsl_view(device, **settings):
    for needed in ("torch", "rsl_rl", "tensordict"):
        pytest.importorskip(needed, reason="needs the extra rsl")
    from piavatar_envs.api.rsl_rl import AvatarRslEnv

    return AvatarRslEnv(STAND, 2, device, **settings)


def game_view(device, num_envs: int, **settings):
    """Make sumo of two as skrl sees it, or with ``num_envs=0`` as PettingZoo does."""
    pytest.importorskip("pettingzoo", reason="needs the extra multi")
    pytest.importorskip("torch", reason="needs the extra train or skrl")
    from piavatar_envs.api.skrl import AvatarSkrlMultiEnv
    from piavatar_envs.multi import sumo_v0

    if num_envs == 0:
        return sumo_v0.parallel_env(device=device, **settings)
    return AvatarSkrlMultiEnv(sumo_v0.TASK, num_envs, device, **settings)


def batches(env) -> list:
    """Return the batches behind a view."""
    if hasattr(env, "batch"):
        return [env.batch]
    return getattr(env, "vector", env).host.groups


def pelvis_heights(env, agent: int = 0) -> np.ndarray:
    groups = batches(env)
    return np.concatenate([group.simulation.avatars[agent].tracked.position.numpy()[:, 0, 2] for group in groups])


def step_without_torques(env) -> None:
    """Step the batches themselves: a body without assistance sinks down."""
    for group in batches(env):
        group.action.zero_()
        for _ in range(STEPS):
            group.step()


@pytest.mark.parametrize("view", [vector_view, sb3_view, skrl_view, rsl_view])
def test_each_environment_of_a_view_is_assisted_by_its_own_share(device, make_env, view):
    env = view(device, **SETTINGS)
    env.reset()
    env.assist_root(np.array([1.0, 0.0]))
    env.reset()  # keeps it
    step_without_torques(env)
    heights = pelvis_heights(env)
    assert heights[1] < 0.6 < 0.75 < heights[0]
    single = make_env(STAND, twin=1, **{name: value for name, value in SETTINGS.items() if name != "fidelity"})
    single.assist_root(1.0)
    single.reset(seed=0)
    step_without_torques(single)
    assert pelvis_heights(single) == pytest.approx(heights[:1], abs=1e-6)
    env.assist_root(1.0)
    assert [group.get_state()["controller_0.assist"].min() for group in batches(env)] == [1.0] * len(batches(env))
    for bad in (np.zeros(3), 1.5, np.nan):
        with pytest.raises(ValueError, match=r"root_assist="):
            env.assist_root(bad)
    env.close()


@pytest.mark.parametrize("num_envs", [0, 2])
def test_all_avatars_of_a_game_are_assisted(device, num_envs):
    env = game_view(device, num_envs, **SETTINGS, place_noise=0.0)
    env.reset(seed=0)
    env.assist_root(np.array([1.0, 0.0]) if num_envs else 1.0)
    step_without_torques(env)
    for agent in range(2):
        heights = pelvis_heights(env, agent)
        assert heights[0] > 0.7 and (heights[1:] < 0.55).all()
    with pytest.raises(ValueError, match="root_assist="):
        env.assist_root(np.zeros(5))
    env.close()


@pytest.mark.parametrize("threads", [1, 2])
def test_a_masked_reset_returns_observations_of_the_present_assistance(device, threads):
    """Also of the environments that go on, in any thread."""
    settings = {**SETTINGS, "observe_parameters": True, "autoreset_mode": "Disabled"}
    vector = gymnasium.make_vec(STAND, num_envs=2, device=device, num_threads=threads, **settings).unwrapped
    vector.reset(seed=0)
    vector.assist_root(np.array([0.3, 0.9]))
    observation, _ = vector.reset(options={"reset_mask": np.array([True, False])})
    term = batches(vector)[0].layout[PARAMETERS]
    column = term.slice.start + [parameter.name for parameter in term.parameters].index(ASSIST.name)
    np.testing.assert_allclose(observation[:, column], 2.0 * np.array([0.3, 0.9]) - 1.0, atol=1e-6)
    assert vector.call("assist_root", 0.25) == (None, None)
    assert vector.get_state()["controller_0.assist"].tolist() == [0.25, 0.25]
    with pytest.raises(ValueError, match="a share for each"):
        vector.call_some([0], "assist_root", 0.5)
    vector.close()
