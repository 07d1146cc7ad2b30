"""Third-party clients with unchanged classes: CleanRL's chain of wrappers, TorchRL, Tianshou, SuperSuit, BenchMARL.

`make clients-light` runs this file in an environment of its own, with the versions of ``requirements.txt``. Each test
takes a client through its smallest whole path: build, collect over the end of an episode, learn once.
"""

from __future__ import annotations

import copy

import gymnasium
import numpy as np
import pytest
import supersuit
import torch
from benchmarl.algorithms import MappoConfig
from benchmarl.environments.common import TaskClass
from benchmarl.experiment import Experiment, ExperimentConfig
from benchmarl.models.mlp import MlpConfig
from stable_baselines3 import PPO
from tensordict.nn import NormalParamExtractor, TensorDictModule
from tianshou import algorithm as tianshou_algorithm
from tianshou import env as tianshou_env
from tianshou.algorithm.modelfree.reinforce import ProbabilisticActorPolicy
from tianshou.algorithm.optim import AdamOptimizerFactory
from tianshou.data import Collector as TianshouCollector
from tianshou.data import VectorReplayBuffer
from tianshou.trainer import OnPolicyTrainerParams
from tianshou.utils.net.common import Net
from tianshou.utils.net.continuous import ContinuousActorProbabilistic, ContinuousCritic
from torch import nn
from torchrl.collectors import Collector
from torchrl.envs import GymEnv, GymWrapper, ParallelEnv, PettingZooWrapper, TransformedEnv, default_info_dict_reader
from torchrl.envs.transforms import Compose, DoubleToFloat, StepCounter
from torchrl.envs.utils import check_env_specs
from torchrl.modules import ProbabilisticActor, TanhNormal, ValueOperator
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

import piavatar_envs  # noqa: F401 - registers the ids
from piavatar_envs.multi import sumo_v0

ENV_ID = "PIAvatar/Reach-v0"
#: Worker processes have to import the package, which this form of an id does.
WORKER_ID = f"piavatar_envs:{ENV_ID}"
SETTINGS = {"fidelity": "tiny", "device": "cpu", "episode_seconds": 0.4}
STEPS = 16  # longer than an episode of SETTINGS


def make_sumo():
    """Return a parallel environment of two agents with short episodes."""
    return sumo_v0.parallel_env(**SETTINGS)


def ppo_loss(policy, critic, observations, actions, log_probs, advantages, returns) -> torch.Tensor:
    """Return the clipped loss of PPO (Schulman et al. 2017, equation 9) with a coefficient of 0.5 for values."""
    ratio = (policy(observations).log_prob(actions).sum(-1) - log_probs).exp()
    surrogate = torch.minimum(ratio * advantages, ratio.clamp(0.8, 1.2) * advantages)
    return 0.5 * (critic(observations)[..., 0] - returns).pow(2).mean() - surrogate.mean()


def cleanrl_env(gamma: float = 0.99) -> gymnasium.Env:
    """Return the environment in the chain of wrappers of CleanRL's continuous PPO."""
    env = gymnasium.make(ENV_ID, **SETTINGS)
    env = gymnasium.wrappers.FlattenObservation(env)
    env = gymnasium.wrappers.RecordEpisodeStatistics(env)
    env = gymnasium.wrappers.ClipAction(env)
    env = gymnasium.wrappers.NormalizeObservation(env)
    env = gymnasium.wrappers.TransformObservation(env, lambda obs: np.clip(obs, -10, 10), env.observation_space)
    env = gymnasium.wrappers.NormalizeReward(env, gamma=gamma)
    return gymnasium.wrappers.TransformReward(env, lambda reward: float(np.clip(reward, -10, 10)))


@pytest.mark.parametrize("mode", list(gymnasium.vector.AutoresetMode)[:2])
def test_cleanrl_wrappers_and_update(mode):
    torch.manual_seed(0)
    envs = gymnasium.vector.SyncVectorEnv([cleanrl_env] * 2, autoreset_mode=mode)
    num_obs, num_actions = envs.single_observation_space.shape[0], envs.single_action_space.shape[0]
    mean, critic = nn.Linear(num_obs, num_actions), nn.Linear(num_obs, 1)
    log_std = nn.Parameter(torch.zeros(num_actions))
    optimizer = torch.optim.Adam([*mean.parameters(), *critic.parameters(), log_std], lr=1e-3)

    def policy(observations):
        return torch.distributions.Normal(mean(observations), log_std.exp())

    observation, _ = envs.reset(seed=1)
    kept, episodes = [], []
    for _ in range(2 * STEPS):
        x = torch.as_tensor(observation, dtype=torch.float32)
        with torch.no_grad():
            action = policy(x).sample()
            log_prob = policy(x).log_prob(action).sum(-1)
        observation, reward, terminated, truncated, info = envs.step(action.numpy())
        assert np.isfinite(observation).all() and np.abs(observation).max() <= 10.0
        kept.append((x, action, log_prob, torch.as_tensor(reward, dtype=torch.float32), terminated | truncated))
        ended = info if mode == gymnasium.vector.AutoresetMode.NEXT_STEP else info.get("final_info", {})
        if "episode" in ended:
            episodes += list(ended["episode"]["l"][ended["_episode"]])
    envs.close()
    assert len(episodes) >= 4 and set(episodes) == {12}
    xs, actions, log_probs, rewards = (torch.stack([entry[i] for entry in kept]) for i in range(4))
    done = torch.as_tensor(np.stack([entry[4] for entry in kept]), dtype=torch.float32)
    returns = torch.zeros_like(rewards)
    for t in reversed(range(len(rewards))):
        returns[t] = rewards[t] + (0.99 * returns[t + 1] * (1.0 - done[t]) if t + 1 < len(rewards) else 0.0)
    before = copy.deepcopy(mean.weight)
    for _ in range(2):
        advantages = returns - critic(xs)[..., 0].detach()
        loss = ppo_loss(policy, critic, xs, actions, log_probs, advantages, returns)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    assert torch.isfinite(loss) and not torch.equal(before, mean.weight)


def torchrl_actor(env):
    """Return a Gaussian actor and a critic for a TorchRL environment."""
    num_actions = env.action_spec.shape[-1]
    net = nn.Sequential(nn.LazyLinear(2 * num_actions), NormalParamExtractor())
    actor = ProbabilisticActor(
        TensorDictModule(net, ["observation"], ["loc", "scale"]),
        in_keys=["loc", "scale"],
        spec=env.action_spec,
        distribution_class=TanhNormal,
        return_log_prob=True,
    )
    return actor, ValueOperator(nn.LazyLinear(1), in_keys=["observation"])


def test_torchrl_gym_env_collector_and_ppo():
    env = TransformedEnv(GymEnv(ENV_ID, **SETTINGS), Compose(DoubleToFloat(), StepCounter()))
    check_env_specs(env)
    actor, critic = torchrl_actor(env)
    example = env.reset()
    actor(example.clone()), critic(example.clone())
    collector = Collector(env, actor, frames_per_batch=2 * STEPS, total_frames=2 * STEPS)
    (batch,) = list(collector)
    done = batch["next", "done"].squeeze(-1)
    assert batch.shape == (2 * STEPS,) and batch["next", "step_count"][done].unique().tolist() == [12]
    GAE(gamma=0.99, lmbda=0.95, value_network=critic)(batch)
    losses = ClipPPOLoss(actor, critic)(batch)
    loss = losses["loss_objective"] + losses["loss_critic"] + losses["loss_entropy"]
    loss.backward()
    assert torch.isfinite(loss) and all(torch.isfinite(p.grad).all() for p in actor.parameters())
    collector.shutdown()


def test_torchrl_reads_infos_and_wraps_vectors_and_games():
    env = GymWrapper(gymnasium.make(ENV_ID, **SETTINGS))
    env.set_info_dict_reader(default_info_dict_reader(["reward_reach", "distance"]))
    rollout = env.rollout(STEPS)
    assert rollout.shape == (12,) and rollout["next", "reward_reach"].any()
    env.close()
    vector = GymWrapper(gymnasium.make_vec(ENV_ID, num_envs=2, autoreset_mode="SameStep", **SETTINGS))
    rollout = vector.rollout(STEPS, break_when_any_done=False)
    assert rollout.shape == (2, STEPS) and rollout["next", "done"].squeeze(-1).sum(-1).tolist() == [1, 1]
    vector.close()
    parallel = ParallelEnv(2, lambda: GymEnv(WORKER_ID, **SETTINGS), mp_start_method="spawn")
    assert parallel.rollout(3).shape == (2, 3)
    parallel.close()
    game = PettingZooWrapper(make_sumo())
    check_env_specs(game)
    game.close()


@pytest.mark.parametrize("vector", ["DummyVectorEnv", "SubprocVectorEnv"])
def test_tianshou_collects_and_trains(vector):
    single = gymnasium.make(ENV_ID, **SETTINGS)
    shape, actions = single.observation_space.shape, single.action_space.shape
    envs = getattr(tianshou_env, vector)([lambda: gymnasium.make(WORKER_ID, **SETTINGS)] * 2)
    actor = ContinuousActorProbabilistic(
        preprocess_net=Net(state_shape=shape, hidden_sizes=[16]), action_shape=actions, unbounded=True
    )
    critic = ContinuousCritic(preprocess_net=Net(state_shape=shape, hidden_sizes=[16]))
    policy = ProbabilisticActorPolicy(
        actor=actor,
        dist_fn=lambda loc_scale: torch.distributions.Independent(torch.distributions.Normal(*loc_scale), 1),
        action_space=single.action_space,
    )
    algorithm = tianshou_algorithm.PPO(policy=policy, critic=critic, optim=AdamOptimizerFactory(lr=1e-3))
    buffer = VectorReplayBuffer(8 * STEPS, 2)
    collector = TianshouCollector(algorithm, envs, buffer)
    collector.reset()
    stats = collector.collect(n_step=2 * STEPS)
    assert stats.n_collected_steps == 2 * STEPS and set(stats.lens) == {12}
    assert not buffer[:].info.failure.any() and not buffer.hasnull()
    test = TianshouCollector(algorithm, tianshou_env.DummyVectorEnv([lambda: single]))
    params = {"max_epochs": 1, "epoch_num_steps": 2 * STEPS, "collection_step_num_env_steps": 2 * STEPS}
    result = algorithm.run_training(
        OnPolicyTrainerParams(training_collector=collector, test_collector=test, batch_size=STEPS, **params)
    )
    assert result.update_step > 0 and np.isfinite(result.best_score)
    envs.close()


def test_supersuit_reaches_stable_baselines3():
    game = supersuit.black_death_v3(supersuit.clip_actions_v0(make_sumo()))
    vector = supersuit.pettingzoo_env_to_vec_env_v1(game)
    vector = supersuit.concat_vec_envs_v1(vector, 2, num_cpus=0, base_class="stable_baselines3")
    assert vector.num_envs == 4
    observation = vector.reset()
    ends = 0
    for _ in range(STEPS):
        observation, reward, done, infos = vector.step(np.stack([vector.action_space.sample()] * 4))
        assert np.isfinite(observation).all() and np.isfinite(reward).all() and len(infos) == 4
        ends += int(done.sum())
    assert ends >= 4
    model = PPO("MlpPolicy", vector, n_steps=8, batch_size=16, n_epochs=1, device="cpu")
    model.learn(64)
    assert model.num_timesteps == 64


class Sumo(TaskClass):
    """The task of a game of ours, as BenchMARL's guide adds an environment."""

    def get_env_fun(self, num_envs, continuous_actions, seed, device):
        return lambda: PettingZooWrapper(make_sumo(), seed=seed, device=device)

    def supports_continuous_actions(self):
        return True

    def supports_discrete_actions(self):
        return False

    def has_render(self, env):
        return False

    def max_steps(self, env):
        return STEPS

    def group_map(self, env):
        return env.group_map

    def observation_spec(self, env):
        spec = env.observation_spec.clone()
        for group in self.group_map(env):
            for key in [key for key in spec[group] if key != "observation"]:
                del spec[group][key]
        return spec

    def info_spec(self, env):
        return None

    def action_spec(self, env):
        return env.full_action_spec

    def action_mask_spec(self, env):
        return None

    def state_spec(self, env):
        return None

    @staticmethod
    def env_name():
        return "piavatar"


def test_benchmarl_experiment(tmp_path):
    config = ExperimentConfig.get_from_yaml()
    config.sampling_device = config.train_device = config.buffer_device = "cpu"
    config.max_n_iters, config.loggers, config.create_json = 1, [], False
    config.on_policy_collected_frames_per_batch = config.on_policy_minibatch_size = 2 * STEPS
    config.on_policy_n_envs_per_worker, config.on_policy_n_minibatch_iters = 1, 1
    config.evaluation, config.render, config.checkpoint_interval = True, False, 0
    config.evaluation_interval, config.evaluation_episodes = 2 * STEPS, 1
    config.save_folder = str(tmp_path)
    model = MlpConfig(num_cells=[16], activation_class=nn.Tanh, layer_class=nn.Linear)
    experiment = Experiment(
        task=Sumo("SUMO", {}),
        algorithm_config=MappoConfig.get_from_yaml(),
        model_config=model,
        critic_model_config=model,
        seed=0,
        config=config,
    )
    experiment.run()
    assert experiment.n_iters_performed == 1 and experiment.total_frames == 2 * STEPS
