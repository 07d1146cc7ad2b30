"""The view for Stable-Baselines3 equals its vector of single environments; and it trains."""

from __future__ import annotations

import numpy as np
import pytest

from piavatar_envs.mpm.types import FAILURE_CFL

pytest.importorskip("stable_baselines3")
from stable_baselines3 import PPO
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecMonitor

from piavatar_envs.api.sb3 import SB3VecEnv
from tests.api.runs import SHORT


@pytest.fixture(scope="module")
def make_sb3(device):
    made = {}

    def make(task: str, num_envs: int = 2, **settings) -> SB3VecEnv:
        key = (task, num_envs, repr(sorted(settings.items())))
        if key not in made:
            settings = {"device": device, "fidelity": "tiny", "num_threads": 2, **SHORT, **settings}
            made[key] = SB3VecEnv(task, num_envs, **settings)
        return made[key]

    yield make
    for env in made.values():
        env.close()


@pytest.mark.parametrize("obs_mode", ["flat", "dict"])
def test_it_equals_their_vector_of_single_environments(make_sb3, make_env, sample_id, same, obs_mode):
    """Compare observations, rewards, ends, infos with terminal observations, and the infos of resets."""
    vector = make_sb3(sample_id, obs_mode=obs_mode)
    oracle = DummyVecEnv(
        [lambda twin=twin: make_env(sample_id, twin=twin, obs_mode=obs_mode, **SHORT) for twin in (0, 1)]
    )
    answers = []
    actions = np.random.default_rng(0).uniform(-1.0, 1.0, (9, 2, *vector.action_space.shape)).astype(np.float32)
    for env in (vector, oracle):
        assert env.seed(12) == [12, 13]
        answers.append([(dict(env.reset()) if obs_mode == "dict" else env.reset(), list(env.reset_infos))])
        for action in actions:
            observation, reward, done, infos = env.step(action)
            for info in infos:
                if "terminal_observation" in info:
                    assert info.pop("is_success", info["success"]) == info["success"]
            observation = dict(observation) if obs_mode == "dict" else observation
            answers[-1].append((observation, reward, done, list(infos), list(env.reset_infos)))
    for step, (a, b) in enumerate(zip(*answers, strict=True)):
        same(a, b, f"{step}")
    ends = [info for row in answers[0][1:] for info in row[3] if "terminal_observation" in info]
    assert len(ends) == 2 and all(info["TimeLimit.truncated"] for info in ends)


def test_a_failure_is_not_a_truncation(make_sb3):
    vector = make_sb3("Reach-v0")
    vector.seed(0)
    vector.reset()
    state = vector.vector.get_state()
    state["particles.u"][1] = 1e6
    vector.vector.set_state(state)
    vector.reset_infos = [{}, {}]
    _, _, done, infos = vector.step(np.zeros((2, *vector.action_space.shape)))
    assert done.tolist() == [False, True] and infos[1]["failure"] == FAILURE_CFL
    assert infos[1]["TimeLimit.truncated"] is False and infos[1]["is_success"] is False
    assert not vector.reset_infos[0] and vector.reset_infos[1]["failure"] == 0


def test_infos_of_steps_can_be_left_out(make_sb3):
    brief, full = make_sb3("Reach-v0", step_infos=False), make_sb3("Reach-v0")
    for env in (brief, full):
        env.seed(3)
        env.reset()
    for step in range(6):
        rows = [env.step(np.zeros((2, *env.action_space.shape)))[3] for env in (brief, full)]
        assert all(bool(info) == (step == 5) for info in rows[0]) and all(rows[1])
    assert rows[0][0].keys() == rows[1][0].keys() and "reward_reach" in rows[0][0]


def test_monitors_count_episodes(make_sb3):
    vector = VecMonitor(make_sb3("KickBall-v0"))
    vector.reset()
    total, found = np.zeros(2), []
    for _ in range(6):
        _, reward, _, infos = vector.step(np.zeros((2, *vector.action_space.shape)))
        total += reward
        found += [info["episode"] for info in infos if "episode" in info]
    assert [episode["l"] for episode in found] == [6, 6]
    assert [episode["r"] for episode in found] == pytest.approx(list(total), abs=1e-5)
    assert not any(vector.env_is_wrapped(Monitor))


def test_attributes_and_methods_are_those_of_the_vector(make_sb3, make_env, equal):
    vector, single = make_sb3("Reach-v0"), make_env("PIAvatar/Reach-v0", **SHORT)
    assert (
        vector.get_attr("action_names", [1]) == [single.action_names] and vector.get_attr("render_mode") == [None] * 2
    )
    assert vector.get_attr("observation_space") == [single.observation_space] * 2
    assert vector.has_attr("config") and not vector.has_attr("bogus")
    vector.set_attr("note", 3)
    assert vector.get_attr("note") == [3, 3]
    with pytest.raises(ValueError, match="share"):
        vector.set_attr("note", 4, indices=[1])
    assert len(vector.get_attr("note", [-1, 0])) == 2
    for call in (vector.get_attr, vector.env_method):
        with pytest.raises(IndexError, match=r"indices=\[2\]: there are num_envs=2; use 0 to 1"):
            call("action_names", indices=[1, 2])
    vector.seed(5)
    with pytest.raises(IndexError):
        vector.env_method("reset", indices=99)  # begins nothing
    observation = vector.reset()
    assert equal(observation[0], single.reset(seed=5)[0])
    assert equal(single.set_state(vector.env_method("get_state", indices=1)[0]), observation[1])
    others = vector.vector.get_state()["particles.x"][0]
    [(started, info)] = vector.env_method("reset", seed=9, indices=1)
    expected = single.reset(seed=9)
    assert equal(started, expected[0]) and info.keys() == expected[1].keys()
    assert np.array_equal(vector.vector.get_state()["particles.x"][0], others)
    with pytest.raises(ValueError, match="pose"):
        vector.env_method("reset", options={"pose": 1}, indices=0)
    with pytest.raises(AttributeError, match="'step' is not a call of single environments"):
        vector.env_method("step", None)
    vector.set_options({"pose": 1})
    with pytest.raises(ValueError, match="pose"):
        vector.reset()
    vector.set_options()


def test_pictures_are_tiled(device):
    vector = SB3VecEnv("Reach-v0", 2, "rgb_array", device, fidelity="tiny", width=32, height=32)
    vector.reset()
    assert vector.render().shape == (64, 32, 3) or vector.render().shape == (32, 64, 3)
    assert vector.env_method("render", indices=[1])[0].shape == (32, 32, 3)
    vector.close()


def test_ppo_learns_on_it(make_sb3):
    vector = VecMonitor(make_sb3("KickBall-v0"))
    model = PPO("MlpPolicy", vector, n_steps=16, batch_size=32, n_epochs=1, seed=0, device="cpu")
    before = [parameter.detach().clone() for parameter in model.policy.parameters()]
    model.learn(64)
    assert model.num_timesteps == 64 and len(model.ep_info_buffer) >= 4 and len(model.ep_success_buffer) >= 4
    assert any(not a.equal(b) for a, b in zip(before, model.policy.parameters(), strict=True))
    returns, lengths = evaluate_policy(model, vector, n_eval_episodes=2, return_episode_rewards=True)
    assert np.isfinite(returns).all() and lengths == [6, 6]
