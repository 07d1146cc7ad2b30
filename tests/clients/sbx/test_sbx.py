"""SBX: the algorithms of stable-baselines3 in JAX."""

from __future__ import annotations

import pytest
import sbx
from stable_baselines3.common.env_util import make_vec_env

ENV_ID = "piavatar_envs:PIAvatar/Reach-v0"
SETTINGS = {"fidelity": "tiny", "device": "cpu", "episode_seconds": 0.4}
REPLAY = {"learning_starts": 16, "batch_size": 16, "buffer_size": 1000}


@pytest.mark.parametrize("name", ["PPO", "SAC", "TD3", "DDPG", "TQC", "CrossQ"])
def test_algorithm_learns(name):
    envs = make_vec_env(ENV_ID, n_envs=2, seed=0, env_kwargs=SETTINGS)
    settings = {"n_steps": 16, "batch_size": 16, "n_epochs": 1} if name == "PPO" else REPLAY
    model = getattr(sbx, name)("MlpPolicy", envs, seed=0, **settings).learn(64)
    action, _ = model.predict(envs.reset(), deterministic=True)
    assert model.num_timesteps >= 64 and envs.action_space.contains(action[0])
    envs.close()
