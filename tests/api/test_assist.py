"""Help for the pelvis can be changed in every view, in the same words, and does the same in all of them."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest

from piavatar_envs.envs.parameters import ASSIST, PARAMETERS

STAND = "PIAvatar/Stand-v0"
SETTINGS = {"fidelity": "tiny", "control": "torque", "pose_noise": 0.0, "episode_seconds": 20.0}
STEPS = 30


def vector_view(device, **settings):
    return gymnasium.make_vec(STAND, num_envs=2, device=device, **settings)


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


def fights(device, num_envs: int, **settings):
    """Sumo of two as skrl sees it, or with ``num_envs=0`` as PettingZoo does."""
    pytest.importorskip("pettingzoo", reason="needs the extra multi")
    pytest.importorskip("torch", reason="needs the extra train or skrl")
    from piavatar_envs.api.skrl import AvatarSkrlMultiEnv
    from piavatar_envs.multi import sumo_v0

    if num_envs == 0:
        return sumo_v0.parallel_env(device=device, **settings)
    return AvatarSkrlMultiEnv(sumo_v0.TASK, num_envs, device, **settings)


def batches(env) -> list:
    """The environments behind a view."""
    if hasattr(env, "batch"):
        return [env.batch]
    return getattr(env, "vector", env).host.groups


def pelvis_heights(env, agent: int = 0) -> np.ndarray:
    groups = batches(env)
    return np.concatenate([group.simulation.avatars[agent].tracked.position.numpy()[:, 0, 2] for group in groups])


def let_be(env) -> None:
    """Steps without torques, behind the view: a body without assistance sinks down."""
    for group in batches(env):
        group.action.zero_()
        for _ in range(STEPS):
            group.step()


@pytest.mark.parametrize("view", [vector_view, sb3_view, skrl_view, rsl_view])
def test_every_environment_of_a_view_is_helped_by_itself(device, make_env, view):
    env = view(device, **SETTINGS)
    env.reset()
    env.assist_root(np.array([1.0, 0.0]))
    env.reset()  # which leaves it
    let_be(env)
    heights = pelvis_heights(env)
    assert heights[1] < 0.6 < 0.75 < heights[0]
    single = make_env(STAND, twin=1, **{name: value for name, value in SETTINGS.items() if name != "fidelity"})
    single.assist_root(1.0)
    single.reset(seed=0)
    let_be(single)
    assert pelvis_heights(single) == pytest.approx(heights[:1], abs=1e-6)
    env.assist_root(1.0)
    env.reset()
    let_be(env)
    assert (pelvis_heights(env) > 0.75).all()
    for bad in (np.zeros(3), 1.5, np.nan):
        with pytest.raises(ValueError, match=r"root_assist=.*one number or 2"):
            env.assist_root(bad)
    env.close()
    posed = view(device, **{**SETTINGS, "control": "pose"})
    with pytest.raises(ValueError, match="root wrench"):
        posed.assist_root(0.5)
    posed.close()


@pytest.mark.parametrize("num_envs", [0, 2])
def test_every_avatar_of_a_world_is_helped(device, num_envs):
    settings = {**SETTINGS, "place_noise": 0.0}
    env = fights(device, num_envs, **settings)
    env.reset(seed=0)
    env.assist_root(np.array([1.0, 0.0]) if num_envs else 1.0)
    let_be(env)
    for agent in range(2):
        heights = pelvis_heights(env, agent)
        assert heights[0] > 0.7 and (heights[1:] < 0.55).all()
    with pytest.raises(ValueError, match="root_assist="):
        env.assist_root(np.zeros(5))
    env.close()


@pytest.mark.parametrize("threads", [1, 2])
def test_a_masked_reset_shows_everybody_the_help_there_is_now(device, threads):
    """Also environments that go on, in whichever thread."""
    settings = {**SETTINGS, "observe_parameters": True, "autoreset_mode": "Disabled"}
    vector = gymnasium.make_vec(STAND, num_envs=2, device=device, num_threads=threads, **settings)
    vector.reset(seed=0)
    vector.unwrapped.assist_root(np.array([0.3, 0.9]))
    observation, _ = vector.reset(options={"reset_mask": np.array([True, False])})
    told = batches(vector.unwrapped)[0].layout[PARAMETERS]
    column = told.slice.start + [parameter.name for parameter in told.parameters].index(ASSIST.name)
    np.testing.assert_allclose(observation[:, column], 2.0 * np.array([0.3, 0.9]) - 1.0, atol=1e-6)
    vector.close()
