"""The protocol: the same episodes for every agent, however many workers play them."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats
from stable_baselines3.common.vec_env import DummyVecEnv

from agents.evaluate import Episode, Evaluation, evaluate, random_agent, separated, zero_agent


def ones(observation):
    return np.ones((len(observation), 2), np.float32)


@pytest.mark.parametrize("workers", [1, 2, 3, 7])
def test_every_seed_is_played_once_to_its_end(countdown, workers):
    venv = DummyVecEnv([countdown] * workers)
    result = evaluate("ones", ones, venv, episodes=6, first_seed=11, progress=False)
    assert [e.seed for e in result.episodes] == [11, 12, 13, 14, 15, 16]
    lengths = [2 + seed % 4 for seed in range(11, 17)]
    assert [e.steps for e in result.episodes] == lengths
    # each step pays 1, the last one the seed in addition
    np.testing.assert_allclose(result.returns, [n + seed for n, seed in zip(lengths, range(11, 17), strict=True)])


def test_success_once_at_the_end_and_its_share(countdown):
    row = evaluate("zero", zero_agent(2), DummyVecEnv([countdown] * 2), 4, first_seed=4, progress=False).row()
    assert row["success_once"] == 1.0
    assert row["success_at_end"] == 0.5
    # lengths 2, 3, 4, 5 of seeds 4..7, one success at the start of each and one at the end of 4 and 6
    assert row["success_share_of_steps"] == pytest.approx((2 / 2 + 1 / 3 + 2 / 4 + 1 / 5) / 4)
    assert row["mean_distance_m"] == pytest.approx(0.5)
    assert row["failures"] == 0
    assert row["episodes"] == 4


def test_the_interval_is_students_t():
    values = [3.0, 5.0, 10.0, 2.0]
    result = Evaluation("x", [Episode(i, total=v, steps=1) for i, v in enumerate(values)])
    low, high = result.row()["return_interval"]
    expected = stats.t.interval(0.95, 3, loc=np.mean(values), scale=stats.sem(values))
    np.testing.assert_allclose((low, high), expected)


def test_separated_asks_for_whole_intervals():
    def evaluation(values):
        return Evaluation("x", [Episode(i, total=v, steps=1) for i, v in enumerate(values)])

    low, wide, high = evaluation([1.0, 1.1, 0.9]), evaluation([-5.0, 5.0, 3.0]), evaluation([9.0, 9.1, 8.9])
    assert separated(high, [low])
    assert not separated(high, [low, wide])  # a better mean is not enough
    assert not separated(low, [high])


def test_random_actions_fill_the_action_space_and_repeat():
    observation = np.zeros((5, 3))
    first, again, other = (random_agent(40, seed)(observation) for seed in (1, 1, 2))
    assert first.shape == (5, 40)
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first, other)
    assert first.min() < -0.9 and first.max() > 0.9 and np.abs(first).max() <= 1.0
