"""stable-baselines3 and sb3-contrib: their algorithms, wrappers of environments and of vectors, saved and loaded."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest
import sb3_contrib
import stable_baselines3
from sb3_contrib.common.wrappers import TimeFeatureWrapper
from stable_baselines3.common.env_checker import check_env
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import SubprocVecEnv, VecCheckNan, VecFrameStack, VecMonitor, VecNormalize

#: Worker processes have to import the package, which this form of an id does.
ENV_ID = "piavatar_envs:PIAvatar/Reach-v0"
SETTINGS = {"fidelity": "tiny", "device": "cpu", "episode_seconds": 0.4}
ROLLOUT = {"n_steps": 16, "batch_size": 16, "n_epochs": 1}
REPLAY = {"learning_starts": 16, "batch_size": 16, "buffer_size": 1000}
ALGORITHMS = {
    "PPO": (stable_baselines3, ROLLOUT),
    "A2C": (stable_baselines3, {"n_steps": 8}),
    "SAC": (stable_baselines3, REPLAY),
    "TD3": (stable_baselines3, REPLAY),
    "DDPG": (stable_baselines3, REPLAY),
    "TQC": (sb3_contrib, REPLAY),
    "CrossQ": (sb3_contrib, REPLAY),
    "TRPO": (sb3_contrib, {"n_steps": 16, "batch_size": 16}),
    "RecurrentPPO": (sb3_contrib, ROLLOUT),
}


def make_env(**settings) -> gymnasium.Env:
    """Return the environment with short episodes."""
    return gymnasium.make(ENV_ID, **SETTINGS, **settings)


def test_check_env_accepts_it():
    check_env(make_env().unwrapped, warn=False)


@pytest.mark.parametrize("name", ALGORITHMS)
def test_algorithm_learns_and_is_loaded_again(name, tmp_path):
    library, settings = ALGORITHMS[name]
    algorithm = getattr(library, name)
    envs = make_vec_env(ENV_ID, n_envs=2, seed=0, env_kwargs=SETTINGS)
    policy = "MlpLstmPolicy" if name == "RecurrentPPO" else "MlpPolicy"
    model = algorithm(policy, envs, seed=0, device="cpu", **settings).learn(64)
    assert model.num_timesteps >= 64
    model.save(tmp_path / "model")
    again = algorithm.load(tmp_path / "model", env=envs, device="cpu")
    observation = envs.reset()
    expected, _ = model.predict(observation, deterministic=True)
    np.testing.assert_array_equal(again.predict(observation, deterministic=True)[0], expected)
    mean, _ = evaluate_policy(again, envs, n_eval_episodes=2)
    assert np.isfinite(mean)
    envs.close()


def test_wrappers_of_vectors_and_processes():
    envs = make_vec_env(ENV_ID, n_envs=2, env_kwargs=SETTINGS, vec_env_cls=SubprocVecEnv)
    envs = VecNormalize(VecFrameStack(VecCheckNan(VecMonitor(envs), raise_exception=True), 2), gamma=0.9)
    observation = envs.reset()
    lengths = []
    for _ in range(16):
        observation, reward, _, infos = envs.step(np.zeros((2, envs.action_space.shape[0]), np.float32))
        lengths += [info["episode"]["l"] for info in infos if "episode" in info]
        assert np.isfinite(observation).all() and np.isfinite(reward).all()
    assert lengths == [12, 12]
    envs.close()


def test_time_feature_reads_the_limit():
    env = TimeFeatureWrapper(Monitor(make_env()))
    observation, _ = env.reset(seed=0)
    times = [observation[-1]]
    for _ in range(12):
        observation, _, _, truncated, info = env.step(env.action_space.sample())
        times.append(observation[-1])
    assert truncated and info["episode"]["l"] == 12
    assert times[0] == 1.0 and times[-1] == 0.0 and (np.diff(times) < 0.0).all()
    env.close()
