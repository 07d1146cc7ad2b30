"""RLlib's unchanged classes on the ids and on the games: sample, learn, evaluate, save and restore."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("ray", reason="needs RLlib: make test-rllib")
pytest.importorskip("pettingzoo", reason="needs the extra multi")

import gymnasium as gym
from pettingzoo.utils import BaseParallelWrapper
from ray.rllib.algorithms.ppo import PPOConfig
from ray.rllib.env.multi_agent_env_runner import MultiAgentEnvRunner
from ray.rllib.env.single_agent_env_runner import SingleAgentEnvRunner
from ray.rllib.env.wrappers.pettingzoo_env import ParallelPettingZooEnv
from ray.tune.registry import register_env

import piavatar_envs  # noqa: F401 - registers the ids
from piavatar_envs.api.rllib import JointTruncation, distinct_seeds, multi_agent_env
from piavatar_envs.multi import parallel_env

ENV_ID = "PIAvatar/Reach-v0"
#: Env runners in processes of their own have to import the package, which this form of an id does.
WORKER_ID = f"piavatar_envs:{ENV_ID}"
SETTINGS = {"fidelity": "tiny", "episode_seconds": 0.4}
STEPS = 12  # of an episode of SETTINGS
BATCH = gym.VectorizeMode.VECTOR_ENTRY_POINT
pytestmark = pytest.mark.usefixtures("local_ray")


def reach(env_id: str = ENV_ID, runners: int = 0, envs: int = 2, mode: gym.VectorizeMode = BATCH) -> PPOConfig:
    """Return PPO on Reach with the smallest batches."""
    return (
        PPOConfig()
        .environment(env_id, env_config=SETTINGS)
        .env_runners(num_env_runners=runners, num_envs_per_env_runner=envs, gym_env_vectorize_mode=mode)
        .training(train_batch_size_per_learner=48, minibatch_size=24, num_epochs=1)
        .debugging(seed=7)
    )


def game(name: str, shared: bool = False, create=multi_agent_env) -> PPOConfig:
    """Return PPO on a game, with one policy for all agents or one for each."""
    register_env("game", create)
    policies = {"all"} if shared else {"agent_0", "agent_1"}
    return (
        PPOConfig()
        .environment("game", env_config={"game": name, **SETTINGS})
        .env_runners(num_env_runners=0, num_envs_per_env_runner=2)
        .training(train_batch_size_per_learner=48, minibatch_size=24, num_epochs=1)
        .multi_agent(policies=policies, policy_mapping_fn=lambda agent, _, **__: "all" if shared else agent)
        .debugging(seed=7)
    )


def weights(algorithm) -> dict[str, dict[str, np.ndarray]]:
    """Return the parameters by module."""
    state = algorithm.learner_group.get_weights()
    return {name: {key: np.array(value) for key, value in module.items()} for name, module in state.items()}


@pytest.mark.parametrize(
    ("name", "runners", "mode"),
    [(ENV_ID, 0, BATCH), (ENV_ID, 0, gym.VectorizeMode.SYNC), (WORKER_ID, 1, BATCH)],
    ids=["own process", "own process, one by one", "worker"],
)
def test_ppo_learns_from_a_registered_id_with_settings(name, runners, mode):
    algorithm = reach(name, runners, mode=mode).build_algo()
    before = weights(algorithm)["default_policy"]
    for iteration in (1, 2):
        result = algorithm.train()
        assert result["num_env_steps_sampled_lifetime"] == 48 * iteration
    assert result["env_runners"]["num_episodes_lifetime"] == 96 // STEPS
    after = weights(algorithm)["default_policy"]
    assert any((before[key] != after[key]).any() for key in before)
    found = algorithm.env_runner_group.foreach_env_runner(
        lambda runner: runner.env and runner.env.unwrapped.get_attr("config")[0].physics.fidelity
    )
    assert "tiny" in found and set(found) <= {"tiny", None}
    algorithm.stop()


def test_a_batch_and_single_environments_give_the_same_episodes():
    episodes = {}
    for mode in (gym.VectorizeMode.SYNC, BATCH):
        runner = SingleAgentEnvRunner(config=reach(mode=mode), worker_index=0)
        episodes[mode] = runner.sample(num_episodes=4)
        runner.stop()
    assert [len(one) for one in episodes[BATCH]] == [STEPS] * 4
    for single, batched in zip(*episodes.values(), strict=True):
        assert single.is_truncated and batched.is_truncated and not batched.is_terminated
        np.testing.assert_array_equal(single.get_observations(), batched.get_observations())
        np.testing.assert_array_equal(single.get_rewards(), batched.get_rewards())


def test_an_algorithm_is_evaluated_saved_and_restored(tmp_path):
    config = reach().evaluation(
        evaluation_duration=3,
        evaluation_duration_unit="episodes",
        evaluation_config={"explore": False, "num_envs_per_env_runner": 1},
    )
    algorithm = config.build_algo()
    algorithm.train()
    scored = algorithm.evaluate()["env_runners"]
    assert scored["num_episodes"] == 3 and scored["episode_len_mean"] == STEPS
    path = algorithm.save_to_path(tmp_path / "checkpoint")
    saved = weights(algorithm)["default_policy"]
    algorithm.stop()
    restored = type(algorithm).from_checkpoint(path)
    found = weights(restored)["default_policy"]
    assert all((found[name] == saved[name]).all() for name in saved)
    result = restored.train()
    assert result["training_iteration"] == 2 and result["num_env_steps_sampled_lifetime"] == 96
    restored.stop()


@pytest.mark.parametrize("shared", [True, False], ids=["shared", "independent"])
@pytest.mark.parametrize("name", ["high_five_v0", "sumo_v0"])
def test_policies_of_a_game_are_shared_or_independent(name, shared):
    algorithm = game(name, shared).build_algo()
    before = weights(algorithm)
    assert set(before) == ({"all"} if shared else {"agent_0", "agent_1"})
    result = algorithm.train()["env_runners"]
    after = weights(algorithm)
    for module, old in before.items():
        assert any((old[key] != after[module][key]).any() for key in old), f"{module} has learned nothing"
    counted = result["num_module_steps_sampled"]
    assert counted["all"] == 96 if shared else (counted["agent_0"], counted["agent_1"]) == (48, 48)
    assert set(result["agent_episode_returns_mean"]) == {"agent_0", "agent_1"}
    algorithm.stop()


def ends(config: PPOConfig, **sampled: int) -> list[tuple]:
    """Return the length and the flags of the complete episodes of an env runner, each with those of its agents."""
    runner = MultiAgentEnvRunner(config=config, worker_index=0)
    done = [one for one in runner.sample(**sampled) if one.is_done]
    runner.stop()
    return [
        (
            len(one),
            (one.is_terminated, one.is_truncated),
            {name: (len(own), own.is_terminated, own.is_truncated) for name, own in one.agent_episodes.items()},
        )
        for one in done
    ]


def adapted(wrap):
    """Return a creator of a game between RLlib's wrapper and ``wrap`` of it."""

    def create(settings):
        own = dict(settings)
        return ParallelPettingZooEnv(wrap(parallel_env(own.pop("game"), **own)))

    return create


def test_a_time_out_of_a_game_is_no_termination():
    own = STEPS, False, True
    assert (
        ends(game("sumo_v0"), num_timesteps=2 * STEPS) == [(STEPS, (False, True), {"agent_0": own, "agent_1": own})] * 2
    )
    # RLlib alone takes it for one; where it does not any more, JointTruncation can go
    alone = game("sumo_v0", create=adapted(lambda env: env))
    assert ends(alone, num_timesteps=2 * STEPS)[0][1] == (True, True)


class Leaving(BaseParallelWrapper):
    """A game whose first agent terminates in a given step."""

    left_in, steps = STEPS, 0

    @property
    def agents(self) -> list[str]:
        return self.env.agents[1:] if self.steps >= self.left_in else self.env.agents

    def reset(self, *arguments, **named):
        self.steps = 0
        return self.env.reset(*arguments, **named)

    def step(self, actions):
        acting = self.agents
        inside = {name: actions.get(name, np.zeros(self.action_space(name).shape)) for name in self.env.agents}
        self.steps += 1
        done = [{name: values[name] for name in acting} for values in self.env.step(inside)]
        if self.steps == self.left_in:
            done[2]["agent_0"], done[3]["agent_0"] = True, False
        return tuple(done)


@pytest.mark.parametrize("left_in", [3, STEPS], ids=["early", "with the clock"])
def test_an_agent_may_leave_before_or_with_the_clock(monkeypatch, left_in):
    """Let agent_0 terminate, and the clock end the episode of agent_1."""
    monkeypatch.setattr(Leaving, "left_in", left_in)
    config = game("sumo_v0", create=adapted(lambda env: JointTruncation(Leaving(env))))
    found = ends(config, num_timesteps=6 * STEPS)
    assert [length for length, *_ in found] == [STEPS] * 6
    for _, (terminated, truncated), agents in found:
        assert not terminated and truncated
        assert agents["agent_0"][:2] == (left_in, True) and agents["agent_1"] == (STEPS, False, True)


def test_env_runners_play_different_episodes():
    """Compare the seeds of two env runners of two environments, which RLlib would let overlap."""
    seeds = {}
    for name, config in (("own", reach()), ("distinct", reach().callbacks(on_environment_created=distinct_seeds))):
        seeds[name] = []
        for index in (1, 2):
            runner = SingleAgentEnvRunner(config=config, worker_index=index, num_workers=2)
            runner.sample(num_timesteps=2)
            seeds[name] += runner.env.unwrapped.get_attr("np_random_seed")
            runner.stop()
    assert seeds == {"own": [8, 9, 9, 10], "distinct": [7, 8, 9, 10]}


def test_a_game_must_be_named():
    with pytest.raises(ValueError, match="names no game"):
        multi_agent_env({"fidelity": "tiny"})
