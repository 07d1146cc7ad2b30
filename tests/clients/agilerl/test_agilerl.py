"""AgileRL: populations of PPO and DDPG on one agent, with tournaments and mutations, and of IPPO on a game."""

from __future__ import annotations

import numpy as np
from agilerl.algorithms import DDPG, IPPO, PPO
from agilerl.components.replay_buffer import ReplayBuffer
from agilerl.hpo.mutation import Mutations
from agilerl.hpo.tournament import TournamentSelection
from agilerl.training.train_multi_agent_on_policy import train_multi_agent_on_policy
from agilerl.training.train_off_policy import train_off_policy
from agilerl.training.train_on_policy import train_on_policy
from agilerl.utils.utils import make_vect_envs
from agilerl.vector.pz_async_vec_env import AsyncPettingZooVecEnv

from piavatar_envs.multi import sumo_v0

ENV_ID = "piavatar_envs:PIAvatar/Reach-v0"
SETTINGS = {"fidelity": "tiny", "device": "cpu", "episode_seconds": 0.4}
NETWORKS = {"encoder_config": {"hidden_size": [16]}}


def make_mutations() -> Mutations:
    """Return mutations of all kinds."""
    return Mutations(
        no_mutation=0.25, architecture=0.25, new_layer_prob=0.2, parameters=0.25, activation=0.0, rl_hp=0.0
    )


def make_tournament() -> TournamentSelection:
    """Return a tournament of two."""
    return TournamentSelection(tournament_size=2, elitism=True, population_size=2)


def test_ppo_population():
    envs = make_vect_envs(ENV_ID, num_envs=2, should_async_vector=False, **SETTINGS)
    spaces = envs.single_observation_space, envs.single_action_space
    population = PPO.population(2, *spaces, net_config=NETWORKS, learn_step=32, batch_size=16, num_envs=2)
    settings = {"tournament": make_tournament(), "mutation": make_mutations(), "verbose": False}
    trained, fitness = train_on_policy(
        envs, ENV_ID, "PPO", population, max_steps=128, evo_steps=32, eval_steps=16, **settings
    )
    envs.close()
    assert len(trained) == 2 and np.isfinite(fitness).all() and all(agent.steps >= 64 for agent in trained)


def test_ddpg_population():
    envs = make_vect_envs(ENV_ID, num_envs=2, should_async_vector=False, **SETTINGS)
    spaces = envs.single_observation_space, envs.single_action_space
    population = DDPG.population(2, *spaces, net_config=NETWORKS, learn_step=2, batch_size=16, vect_noise_dim=2)
    settings = {"tournament": make_tournament(), "mutation": make_mutations(), "verbose": False}
    trained, fitness = train_off_policy(
        envs,
        ENV_ID,
        "DDPG",
        population,
        memory=ReplayBuffer(max_size=1000),
        max_steps=128,
        evo_steps=32,
        eval_steps=16,
        **settings,
    )
    envs.close()
    assert len(trained) == 2 and np.isfinite(fitness).all()


def test_ippo_on_a_game():
    envs = AsyncPettingZooVecEnv([lambda: sumo_v0.parallel_env(**SETTINGS)] * 2)
    envs.reset()
    names = envs.agents
    observed = [envs.single_observation_space(name) for name in names]
    acted = [envs.single_action_space(name) for name in names]
    population = IPPO.population(
        1, observed, acted, agent_ids=list(names), net_config=NETWORKS, learn_step=32, batch_size=16
    )
    trained, fitness = train_multi_agent_on_policy(
        envs, "sumo_v0", "IPPO", population, max_steps=64, evo_steps=32, eval_steps=16, verbose=False
    )
    envs.close()
    assert len(trained) == 1 and np.isfinite(np.asarray(fitness, float)).all()
