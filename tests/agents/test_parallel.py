"""Folding: a slot is one agent and gets its own data; agents that have left do not reach the learner."""

from __future__ import annotations

import copy

import numpy as np
import pytest
import torch
from stable_baselines3.common.callbacks import BaseCallback, CallbackList
from stable_baselines3.common.vec_env import DummyVecEnv

from agents.evaluate import evaluate, zero_agent
from agents.sb3 import ppo
from agents.sb3.matches import seated
from agents.sb3.parallel import WAITING, AgentVecEnv, WorldFactory
from agents.sb3.ppo import MarkPlayed, PPOSettings
from tests.agents.games.ledger_v0 import LEAVES, TERMINATED, Ledger

LEDGER = WorldFactory("tests.agents.games.ledger_v0", {})
AUCTION = WorldFactory("tests.agents.games.auction_v0", {})
NAMES = Ledger.names
LAST = max(LEAVES.values())
SEED = 7000  # of the first training episode


@pytest.fixture
def folded() -> AgentVecEnv:
    """Six slots: two worlds of three agents."""
    venv = AgentVecEnv(DummyVecEnv([LEDGER] * 2))
    venv.seed(40)
    return venv


class Opponents:
    """Always bid the same, and remember what they saw."""

    def __init__(self, action: float) -> None:
        self.action, self.seen, self.draws = action, [], []

    def draw(self, world, rng):
        self.draws.append(world)

    def act(self, world, observation):
        self.seen.append((world, observation.copy()))
        return np.full((len(observation), 1), self.action, np.float32)


def test_observation_action_and_reward_are_those_of_the_slots_agent(folded):
    assert folded.num_envs == 6
    observation = folded.reset()
    seeds, agents = [40] * 3 + [41] * 3, [0, 1, 2] * 2
    np.testing.assert_array_equal(observation, np.transpose([seeds, [0] * 6, agents, [0] * 6]))
    actions = np.linspace(-1.0, 1.0, 6, dtype=np.float32)
    observation, rewards, dones, infos = folded.step(actions[:, None])
    np.testing.assert_array_equal(observation, np.transpose([seeds, [0] * 6, agents, [1] * 6]))
    np.testing.assert_allclose(rewards, 100.0 * np.array(agents) + 10.0 + actions, rtol=1e-6)
    assert not dones.any()
    assert [info["name"] for info in infos] == list(NAMES) * 2


def test_slots_of_agents_that_left_wait_for_their_world(folded):
    folded.reset()
    for episode in range(2):
        for time in range(1, LAST + 1):
            observation, rewards, dones, infos = folded.step(np.zeros((6, 1), np.float32))
            for slot, info in enumerate(infos):
                agent, leaves = slot % 3, LEAVES[NAMES[slot % 3]]
                assert dones[slot] == (time >= leaves)
                if time > leaves:
                    assert info == {WAITING: True}
                    assert rewards[slot] == 0.0
                    continue
                assert WAITING not in info
                assert info["TimeLimit.truncated"] == (time == leaves and NAMES[agent] != TERMINATED)
                assert ("terminal_observation" in info) == (time == leaves)
                if time == leaves:
                    np.testing.assert_array_equal(info["terminal_observation"], [40 + slot // 3, episode, agent, time])
        # all worlds were reset in the step that ended them
        np.testing.assert_array_equal(observation[:, 1], episode + 1)
        np.testing.assert_array_equal(observation[:, 3], 0)


class Peek(BaseCallback):
    """Keeps a rollout, and the policy that played it, from before the update."""

    def _on_step(self) -> bool:
        return True

    def _on_rollout_end(self) -> None:
        self.buffer, self.policy = copy.deepcopy((self.model.rollout_buffer, self.model.policy))


@pytest.fixture
def peek(folded) -> Peek:
    """Two whole episodes of both worlds, as the buffer has them, and their policy."""
    settings = PPOSettings(rollout_steps=2 * LAST, batch_size=10, epochs=1, hidden=(8,), discount=0.9, gae_lambda=0.8)
    model = ppo.build(settings, folded, range(4), seed=7)
    folded.seed(SEED)  # observations tell it, and a float32 rounds a training run's own
    peek = Peek()
    model.learn(2 * LAST * 6, callback=CallbackList([MarkPlayed(), peek]))
    return peek


def test_only_what_was_played_reaches_the_loss(peek):
    time = np.arange(2 * LAST)[:, None] % LAST
    leaves = np.array([LEAVES[name] for name in NAMES] * 2)
    np.testing.assert_array_equal(peek.buffer.played, time < leaves)
    batches = [batch.observations.numpy() for batch in copy.deepcopy(peek.buffer).get(7)]
    seen = np.concatenate(batches)
    expected = sorted(
        (SEED + world, episode, agent, step)
        for world in range(2)
        for episode in range(2)
        for agent, name in enumerate(NAMES)
        for step in range(LEAVES[name])  # an agent acts upon all observations but its last
    )
    assert sorted(map(tuple, seen)) == expected
    assert all(4 <= len(batch) <= 7 for batch in batches)  # of nearly equal sizes


def test_advantages_are_those_of_each_agents_own_episodes(peek):
    """Generalised advantage estimation, Schulman et al. (2016), eq. 16, of every agent's episode taken by itself."""
    discount, decay = 0.9, 0.8
    for slot in range(6):
        world, agent = divmod(slot, 3)
        length = LEAVES[NAMES[agent]]
        for episode in range(2):
            observed = [(SEED + world, episode, agent, time) for time in range(length + 1)]
            with torch.no_grad():
                values = peek.policy.predict_values(torch.as_tensor(observed, dtype=torch.float32))[:, 0].numpy()
            if NAMES[agent] == TERMINATED:
                values[-1] = 0.0  # nothing comes after; truncation alone bootstraps
            first = episode * LAST
            actions = np.clip(peek.buffer.actions[first : first + length, slot, 0], -1.0, 1.0)
            rewards = 100.0 * agent + 10.0 * np.arange(1, length + 1) + actions
            advantage, expected = 0.0, np.zeros(length)
            for t in reversed(range(length)):
                advantage = rewards[t] + discount * values[t + 1] - values[t] + discount * decay * advantage
                expected[t] = advantage
            found = peek.buffer.advantages[first : first + length, slot]
            np.testing.assert_allclose(found, expected, rtol=1e-4)


def test_opponents_act_for_those_who_do_not_learn():
    venv = AgentVecEnv(DummyVecEnv([AUCTION] * 3), num_duels=2)
    assert venv.num_envs == 2 + 1 + 1
    venv.opponents = Opponents(action=0.0)
    venv.seed(0)
    venv.reset()
    for bid, won in ((0.5, 1.0), (-0.5, 0.0)):
        _, rewards, _, infos = venv.step(np.full((4, 1), bid, np.float32))
        cost = 0.1 * (1.0 + bid) / 2.0
        np.testing.assert_allclose(rewards, [0.5 - cost] * 2 + [won - cost] * 2, rtol=1e-6)
        assert not any(WAITING in info for info in infos)
    # after the first round the learners led, and their opponents saw it from their side
    assert [world for world, _ in venv.opponents.seen] == [1, 2, 1, 2]
    np.testing.assert_allclose(venv.opponents.seen[2][1], [[0.25, -1.0]])


def test_a_duel_ends_with_its_learner_and_seats_are_drawn():
    venv = AgentVecEnv(DummyVecEnv([LEDGER]), num_duels=1)
    venv.opponents = Opponents(action=0.0)
    venv.seed(5)
    observation = venv.reset()
    seats = []
    for episode in range(30):
        seat = int(observation[0, 2])
        seats.append(seat)
        for time in range(1, LEAVES[NAMES[seat]] + 1):
            # the others that still play are seen by the opponents, the learner is not
            others = len(NAMES) - 1
            observation, _, dones, infos = venv.step(np.zeros((1, 1), np.float32))
            world, seen = venv.opponents.seen[-1]
            assert world == 0
            assert seen.shape[0] == others and seat not in seen[:, 2]
            assert dones[0] == (time == LEAVES[NAMES[seat]])
        np.testing.assert_array_equal(infos[0]["terminal_observation"], [5, episode, seat, time])
        assert observation[0, 1] == episode + 1  # the next episode, though others would have played on
    assert set(seats) == {0, 1, 2}
    assert venv.opponents.draws == [0] * 31


def test_an_evaluation_books_every_agent_until_it_leaves():
    worlds = DummyVecEnv([LEDGER] * 2)
    result = evaluate("zero", seated([zero_agent(1)] * 3), worlds, episodes=3, first_seed=9, progress=False)
    times = {name: np.arange(1, last + 1) for name, last in LEAVES.items()}
    totals = [(100.0 * agent + 10.0 * times[name]).sum() for agent, name in enumerate(NAMES)]
    for episode, seed in zip(result.episodes, (9, 10, 11), strict=True):
        assert (episode.seed, episode.steps, episode.failure) == (seed, LAST, False)
        np.testing.assert_allclose(episode.agent_totals, totals)
        np.testing.assert_array_equal(episode.agent_success, [False, False, True])  # of c's last step, long ago
        assert episode.total == pytest.approx(np.mean(totals))
        assert not episode.success_at_end  # not all had it
    np.testing.assert_allclose(result.row()["agent_return_mean"], totals)
