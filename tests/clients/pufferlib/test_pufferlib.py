"""PufferLib's core: its emulation of single environments and of games, and its vectors in this and other processes."""

from __future__ import annotations

import gymnasium
import numpy as np
import pufferlib.emulation
import pufferlib.vector
import pytest

from piavatar_envs.multi import sumo_v0

SETTINGS = {"fidelity": "tiny", "device": "cpu", "episode_seconds": 0.4}


def make_env(**settings) -> pufferlib.emulation.GymnasiumPufferEnv:
    """Return the environment as PufferLib wraps one."""
    return pufferlib.emulation.GymnasiumPufferEnv(
        env_creator=gymnasium.make, env_args=["piavatar_envs:PIAvatar/Reach-v0"], env_kwargs=SETTINGS, **settings
    )


def make_game(**settings) -> pufferlib.emulation.PettingZooPufferEnv:
    """Return a game as PufferLib wraps one."""
    return pufferlib.emulation.PettingZooPufferEnv(env_creator=sumo_v0.parallel_env, env_kwargs=SETTINGS, **settings)


@pytest.mark.parametrize("backend", ["Serial", "Multiprocessing"])
@pytest.mark.parametrize(("make", "agents"), [(make_env, 1), (make_game, 2)], ids=["single", "game"])
def test_vector_steps_over_the_end_of_episodes(make, agents, backend):
    workers = {"num_workers": 2} if backend == "Multiprocessing" else {}
    vector = pufferlib.vector.make(make, num_envs=2, backend=backend, seed=1, **workers)
    observation, _ = vector.reset(seed=1)
    assert observation.shape[0] == 2 * agents
    ends = 0
    for _ in range(16):
        observation, reward, terminated, truncated, _ = vector.step(vector.action_space.sample())
        assert np.isfinite(observation).all() and np.isfinite(reward).all()
        ends += int((terminated | truncated).sum())
    vector.close()
    assert ends >= 2 * agents
