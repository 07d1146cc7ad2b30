"""Training runs of one seed play the same episodes in all libraries, no others do, evaluations play none of them."""

from __future__ import annotations

from itertools import pairwise

import pytest
from pydantic import Field
from stable_baselines3.common.vec_env import DummyVecEnv

from agents import config as seeds
from agents.batch_training import BatchTraining, load_batched, new_task
from agents.config import EvaluationSettings
from agents.sb3 import ppo, sac
from agents.sb3.config import load_training
from piavatar_envs.config import ConfigError
from piavatar_envs.tasks import load_task


class Training(BatchTraining):
    """A training run as any library on a batch has it."""

    env_id: str = Field("PIAvatar/Reach-v0", description="registered id")


def load_single(settings: dict) -> BatchTraining:
    return load_batched(Training, load_task, settings)


def test_no_two_trainings_play_the_same_episodes():
    """However many environments they have, and up to the greatest seed, which an int of 32 bits holds."""
    runs = [load_single({"seed": seed, "num_envs": seeds.MOST_ENVS}) for seed in (0, 1, 2, seeds.MOST_RUNS - 1)]
    played = [range(run.first_seed, run.first_seed + run.num_envs) for run in runs]
    assert all(a.stop <= b.start for a, b in pairwise(played)) and played[-1].stop <= 2**31
    assert load_training({"num_workers": 16_384, "vector": True}).num_workers <= seeds.MOST_ENVS


@pytest.mark.parametrize("load", [load_training, load_single])
def test_evaluations_play_no_episodes_of_a_training(load):
    """Not even the last episode of the longest evaluation that begins last; all agents play the same ones."""
    half = seeds.FIRST_TRAINED // 2
    last = load({"evaluation": {"first_seed": half - 1, "episodes": half}}).evaluation
    assert last.first_seed + last.episodes <= seeds.first_training_seed(0)
    for name, value in (("first_seed", half), ("episodes", half + 1)):
        with pytest.raises(ConfigError, match=rf"evaluation\.{name}"):
            load({"evaluation": {name: value}})
    assert load({"seed": 7}).evaluation == load({"seed": 0}).evaluation == EvaluationSettings()
    with pytest.raises(ConfigError, match=r"seed=1000 must be < 1000"):
        load({"seed": seeds.MOST_RUNS})


@pytest.mark.parametrize("algorithm", ["ppo", "sac"])
def test_environments_of_stable_baselines3_begin_with_the_run_s_episodes(countdown, algorithm):
    build, settings = {"ppo": (ppo.build, ppo.PPOSettings()), "sac": (sac.build, sac.SACSettings())}[algorithm]
    venv = DummyVecEnv([countdown] * 3)
    build(settings, venv, [0], 5)
    venv.reset()
    assert venv.get_attr("seed") == [seeds.first_training_seed(5) + env for env in range(3)]


def test_environments_of_rsl_rl_begin_with_the_run_s_episodes(device):
    for needed in ("rsl_rl", "tensordict", "git"):
        pytest.importorskip(needed, reason="needs the extra rsl")
    from agents.rsl_rl import train as rsl_ppo
    from agents.rsl_rl.policy import RslTraining

    config = load_batched(RslTraining, load_task, {"seed": 5, "num_envs": 3, "env": {"fidelity": "tiny"}})
    env = rsl_ppo.make_env(config, new_task(config, load_task), device)
    assert env.host.read(lambda group: group.seed).tolist() == [seeds.first_training_seed(5) + n for n in range(3)]
    env.close()
