"""TorchRL: checks of specs, collectors in this and in other processes, vectors, games, and a PPO update."""

from __future__ import annotations

import gymnasium
import pytest
import torch
from tensordict.nn import NormalParamExtractor, TensorDictModule
from torch import nn
from torchrl.collectors import Collector, MultiSyncCollector
from torchrl.data import LazyTensorStorage, ReplayBuffer
from torchrl.envs import GymEnv, GymWrapper, ParallelEnv, PettingZooWrapper, SerialEnv, TransformedEnv
from torchrl.envs.transforms import Compose, DoubleToFloat, ObservationNorm, StepCounter
from torchrl.envs.utils import check_env_specs
from torchrl.modules import ProbabilisticActor, TanhNormal, ValueOperator
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

import piavatar_envs  # noqa: F401 - registers the ids
from piavatar_envs.multi import boxing_v0, high_five_v0, pass_ball_v0, sumo_v0

ENV_ID = "PIAvatar/Reach-v0"
#: Worker processes have to import the package, which this form of an id does.
WORKER_ID = f"piavatar_envs:{ENV_ID}"
SETTINGS = {"fidelity": "tiny", "device": "cpu", "episode_seconds": 0.4}
STEPS = 16  # longer than an episode of SETTINGS


def make_env() -> GymEnv:
    """Return the environment by its id."""
    return GymEnv(WORKER_ID, **SETTINGS)


@pytest.mark.parametrize("task", ["Reach", "KickBall", "TrackMotion"])
def test_specs_hold(task):
    env = GymEnv(f"PIAvatar/{task}-v0", **SETTINGS)
    check_env_specs(env)
    env.close()


@pytest.mark.parametrize("game", [sumo_v0, high_five_v0, boxing_v0, pass_ball_v0], ids=lambda game: game.__name__[-12:])
def test_specs_of_games_hold(game):
    env = PettingZooWrapper(game.parallel_env(**SETTINGS))
    check_env_specs(env)
    env.close()


def test_ppo_with_collector_and_buffer():
    env = TransformedEnv(make_env(), Compose(DoubleToFloat(), ObservationNorm(in_keys=["observation"]), StepCounter()))
    env.transform[1].init_stats(num_iter=STEPS)
    num_actions = env.action_spec.shape[-1]
    net = nn.Sequential(nn.LazyLinear(16), nn.Tanh(), nn.LazyLinear(2 * num_actions), NormalParamExtractor())
    actor = ProbabilisticActor(
        TensorDictModule(net, ["observation"], ["loc", "scale"]),
        in_keys=["loc", "scale"],
        spec=env.action_spec,
        distribution_class=TanhNormal,
        return_log_prob=True,
    )
    critic = ValueOperator(nn.LazyLinear(1), in_keys=["observation"])
    example = env.reset()
    actor(example.clone()), critic(example.clone())
    collector = Collector(env, actor, frames_per_batch=2 * STEPS, total_frames=4 * STEPS)
    advantage, loss = GAE(gamma=0.9, lmbda=0.8, value_network=critic), ClipPPOLoss(actor, critic)
    optimizer = torch.optim.Adam(loss.parameters(), 1e-3)
    buffer = ReplayBuffer(storage=LazyTensorStorage(2 * STEPS), batch_size=STEPS)
    batches = 0
    for batch in collector:
        done = batch["next", "done"].squeeze(-1)
        assert batch["next", "step_count"][done].unique().tolist() == [12]
        advantage(batch)
        buffer.extend(batch.reshape(-1))
        losses = loss(buffer.sample())
        total = losses["loss_objective"] + losses["loss_critic"] + losses["loss_entropy"]
        optimizer.zero_grad()
        total.backward()
        optimizer.step()
        batches += 1
        assert torch.isfinite(total)
    collector.shutdown()
    assert batches == 2


def test_vectors_processes_and_collectors():
    vector = GymWrapper(gymnasium.make_vec(ENV_ID, num_envs=2, autoreset_mode="SameStep", **SETTINGS))
    rollout = vector.rollout(STEPS, break_when_any_done=False)
    assert rollout.shape == (2, STEPS) and rollout["next", "done"].squeeze(-1).sum(-1).tolist() == [1, 1]
    vector.close()
    serial = SerialEnv(2, make_env)
    assert serial.rollout(3).shape == (2, 3)
    serial.close()
    parallel = ParallelEnv(2, make_env, mp_start_method="spawn")
    assert parallel.rollout(3).shape == (2, 3)
    parallel.close()


def test_collector_with_worker_processes():
    collector = MultiSyncCollector([make_env, make_env], frames_per_batch=2 * STEPS, total_frames=2 * STEPS)
    (batch,) = list(collector)
    collector.shutdown()
    assert batch.numel() == 2 * STEPS and batch["next", "reward"].isfinite().all()
