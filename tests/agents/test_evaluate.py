"""The protocol: the same episodes for every agent, however many workers play them."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats
from stable_baselines3.common.vec_env import DummyVecEnv

from agents.evaluate import (
    Episode,
    Evaluation,
    by_push,
    evaluate,
    over_seeds,
    play,
    zero_agent,
)
from agents.intervals import mean_and_interval, mean_over_seeds, share_interval, share_interval_over_seeds, wilson
from agents.sb3.matches import seated
from piavatar_envs.api.host import EpisodeHost
from piavatar_envs.config import load_config
from piavatar_envs.tasks import load_task


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


@pytest.mark.parametrize("by_time", [False, True])
def test_an_episode_whose_time_is_over_has_not_ended_before_it(countdown, by_time):
    """Else all that stand to the end would count as fallen."""

    class Timed(countdown):
        def step(self, action):
            observation, reward, terminated, truncated, info = super().step(action)
            over = terminated or truncated
            return observation, reward, over and not by_time, over and by_time, info

    result = evaluate("ones", ones, DummyVecEnv([Timed] * 2), episodes=3, first_seed=11, progress=False)
    assert [episode.terminated for episode in result.episodes] == [not by_time] * 3


class Remembering:
    """Pays attention to when episodes begin: its first action of each is 1, the others are 0."""

    def __init__(self):
        self.rounds, self.fresh = [], None

    def begin(self, num_envs):
        self.rounds.append(num_envs)
        self.fresh = np.ones((num_envs, 2), np.float32)

    def __call__(self, observation):
        action, self.fresh = self.fresh, np.zeros_like(self.fresh)
        return action


def test_all_episodes_of_a_round_begin_with_a_reset_of_all_and_none_begins_in_between(countdown):
    resets = []

    class Watched(countdown):
        def reset(self, **arguments):
            resets.append(arguments["seed"] if arguments.get("seed") is not None else None)
            return super().reset(**arguments)

    agent = Remembering()
    result = evaluate("x", agent, DummyVecEnv([Watched] * 3), episodes=7, first_seed=20, progress=False)
    assert agent.rounds == [3, 3, 3]
    # each episode got the action of its beginning once, the seed at its end, and nothing else
    np.testing.assert_allclose(result.returns, [1.0 + seed for seed in range(20, 27)])
    assert [seed for seed in resets if seed is not None] == list(range(20, 29))  # two of the last round do not count
    lengths = [2 + seed % 4 for seed in range(20, 27)]
    assert [episode.steps for episode in result.episodes] == lengths
    assert result.row()["mean_steps"] == pytest.approx(np.mean(lengths))
    low, high = result.row()["steps_interval"]
    np.testing.assert_allclose((low, high), stats.t.interval(0.95, 6, np.mean(lengths), stats.sem(lengths)))
    with pytest.raises(ValueError, match="only agents without memory can be seated"):
        seated([agent, agent])


def test_success_once_at_the_end_and_its_share(countdown):
    row = evaluate("zero", zero_agent(2), DummyVecEnv([countdown] * 2), 4, first_seed=4, progress=False).row()
    assert row["success_once"] == 1.0
    assert row["success_at_end"] == 0.5
    # lengths 2, 3, 4, 5 of seeds 4..7, one success at the start of each and one at the end of 4 and 6
    assert row["success_share_of_steps"] == pytest.approx((2 / 2 + 1 / 3 + 2 / 4 + 1 / 5) / 4)
    assert row["mean_distance_m"] == pytest.approx(0.5)
    assert row["failures"] == 0
    assert row["episodes"] == 4


def test_tracking_is_measured_in_the_terms_of_phc(device):
    """Two motions under strong pushes: figures of the steps until an episode is given up; it is followed if none is."""
    task = load_task("PIAvatar/TrackMotion-v0")
    settings = {"motion": ["idle", "kick"], "fidelity": "tiny", "episode_seconds": 0.4, "impulse": 120.0}
    settings |= {"impulse_interval": 0.3, "fail_distance": 0.08}
    host = EpisodeHost(task(load_config(task.Config, settings)), 6, device)
    evaluation = play("zero", lambda seen: np.zeros((*seen.shape[:2], host.action_size), np.float32), host, 3)
    lasted = [not episode.terminated for episode in evaluation.episodes]
    assert 0 < sum(lasted) < 6
    row = evaluation.row()
    assert row["followed"] == pytest.approx(np.mean(lasted)) and row["followed_interval"][0] < row["followed"]
    host.reset([3 + env for env in range(6)])
    seen, playing = [[] for _ in range(6)], np.ones(6, bool)
    while playing.any():
        host.step(np.zeros((6, 1, host.action_size), np.float32))
        metrics = host.read(lambda group: group.metrics)[:, 0]
        for env in np.flatnonzero(playing):
            seen[env].append(metrics[env])
        playing &= ~host.find_ended()
    means = np.mean([np.mean(steps, axis=0) for steps in seen], axis=0)
    names = dict(zip(task.metric_names, means, strict=True))
    assert row["g_mpjpe_mm"] == pytest.approx(1000.0 * names["mpjpe"], rel=1e-5)
    assert row["mpjpe_mm"] == pytest.approx(1000.0 * names["local_mpjpe"], rel=1e-5)
    assert row["acceleration_error_mm"] == pytest.approx(names["acceleration_error"], rel=1e-5)
    own = [episode for episode in evaluation.episodes if episode.motion == 1]
    shares = [one["followed"] for one in row["by_motion"]]
    assert shares == sorted(shares) and {one["motion"] for one in row["by_motion"]} == {"idle", "kick"}
    kick = next(one for one in row["by_motion"] if one["motion"] == "kick")
    assert kick["episodes"] == len(own) and kick["followed"] == np.mean([not episode.terminated for episode in own])
    assert kick["g_mpjpe_mm"] == pytest.approx(np.mean([1000.0 * episode.tracking["mpjpe"] for episode in own]))
    lost = [{**one, "followed": 0.0} for one in row["by_motion"]]
    summed = over_seeds([row, {**row, "followed": 0.0, "mpjpe_mm": 0.0, "by_motion": lost}])
    halved = {one["motion"]: one["followed"] for one in summed["by_motion"]}
    assert halved == {one["motion"]: one["followed"] / 2 for one in row["by_motion"]}
    assert summed["followed"] == pytest.approx(row["followed"] / 2) and len(summed["followed_interval"]) == 2
    assert summed["mpjpe_mm"] == pytest.approx(row["mpjpe_mm"] / 2)


def test_wilsons_interval_is_scipys_and_is_not_empty_at_the_ends():
    for successes, size in ((0, 12), (5, 12), (12, 12), (99, 100)):
        expected = stats.binomtest(successes, size).proportion_ci(0.95, method="wilson")
        found = share_interval([True] * successes + [False] * (size - successes))
        np.testing.assert_allclose(found, [expected.low, expected.high], atol=1e-12)


def rows(returns, once, episodes=40, case="trained", half=0.5):
    """Rows of seeds, whose mean returns are known to ``half`` from their episodes."""
    return [
        {
            "case": case, "episodes": episodes, "return_mean": value, "mean_steps": 10.0 * value,
            "return_interval": [value - half, value + half],
            "steps_interval": [10.0 * (value - half), 10.0 * (value + half)],
            "success_once": share, "success_at_end": share / 2.0, "failures": 1,
        }
        for value, share in zip(returns, once, strict=True)
    ]  # fmt: skip


def test_over_seeds_seeds_and_episodes_are_samples():
    values, shares = [3.0, 5.0, 10.0, 2.0, 4.0], [0.95, 0.95, 0.975, 0.925, 0.95]
    row = over_seeds(rows(values, shares, half=0.0))
    assert (row["case"], row["seeds"], row["episodes"], row["failures"]) == ("trained", 5, 40, 5)
    assert row["success_once"] == pytest.approx(0.95) and row["success_at_end"] == pytest.approx(0.475)
    # where episodes are all alike, seeds are the sample
    interval = stats.t.interval(0.95, 4, np.mean(values), stats.sem(values))
    np.testing.assert_allclose(row["return_interval"], interval)
    np.testing.assert_allclose(row["steps_interval"], 10.0 * np.array(interval))
    # where seeds are all alike, five are no more certain than one: they have played the same episodes
    alike = over_seeds(rows([4.0] * 5, [0.95] * 5))
    np.testing.assert_allclose(alike["return_interval"], [3.5, 4.5])
    np.testing.assert_allclose(alike["success_once_interval"], wilson(0.95, 40.0, stats.t.ppf(0.975, 39)))
    both = over_seeds(rows(values, shares, half=3.0))["return_interval"]
    assert both[0] < interval[0] and both[1] > interval[1]
    # two more numbers that hardly scatter do not make five seeds more than five
    np.testing.assert_allclose(over_seeds(rows(values, shares))["return_interval"], interval)
    # of endless episodes seeds alone scatter: p (1 - p) / n is to be the variance of their mean, 0.0025 / 5
    apart = over_seeds(rows(values, [1.0, 0.9, 0.95, 1.0, 0.9], episodes=10**9))["success_once_interval"]
    np.testing.assert_allclose(apart, wilson(0.95, 0.95 * 0.05 / 0.0005, stats.t.ppf(0.975, 4)), rtol=1e-6)
    assert over_seeds(rows([1.0], [0.5]))["success_once_interval"] == [0.0, 1.0]  # one seed says nothing
    assert over_seeds(rows([1.0], [0.5]))["return_interval"] is None
    all_won = over_seeds(rows(values, [1.0] * 5))["success_once_interval"]
    np.testing.assert_allclose(all_won, wilson(1.0, 40.0, stats.t.ppf(0.975, 4)))
    with pytest.raises(ValueError, match="rows of one agent"):
        over_seeds(rows([1.0], [0.5]) + rows([1.0], [0.5], case="zero"))


def coverage(intervals, truth) -> float:
    """Share of intervals that hold the truth."""
    return float(np.mean([low <= truth <= high for low, high in intervals]))


@pytest.mark.parametrize("of_episodes", [0.0, 0.5, 1.0])
def test_intervals_cover_what_they_say_where_all_seeds_play_the_same_episodes(of_episodes):
    """Of scatter that episodes, seeds, and both together bring; seeds alone would not cover it."""
    rng = np.random.default_rng(1)
    seeds, episodes, trials = 5, 64, 1500
    easy = np.sqrt(of_episodes) * rng.standard_normal((trials, 1, episodes))
    good = 0.05 * rng.standard_normal((trials, seeds, 1))
    values = 3.0 + good + easy + np.sqrt(1.0 - of_episodes) * rng.standard_normal((trials, seeds, episodes))
    one = stats.t.ppf(0.975, episodes - 1) * stats.sem(values, axis=2)
    means = values.mean(2)
    found = [mean_over_seeds(*row, episodes) for row in zip(means, one, strict=True)]
    assert coverage([(estimate.low, estimate.high) for estimate in found], 3.0) > 0.93
    shares = (values > 2.5).mean(2)
    truth = float(stats.norm.cdf(0.5 / np.sqrt(1.0 + 0.05**2)))
    assert coverage([share_interval_over_seeds(row, episodes) for row in shares], truth) > 0.93
    if of_episodes == 1.0:
        of_seeds_alone = [mean_and_interval(row) for row in means]
        assert coverage([(estimate.low, estimate.high) for estimate in of_seeds_alone], 3.0) < 0.7


def test_pushes_fall_into_classes_and_pool_over_seeds():
    pushes = [(0.0, False), (4.9, False), (5.0, True), (12.0, False), (13.0, True), (14.0, True)]
    episodes = [Episode(i, steps=1, push=push, terminated=fell) for i, (push, fell) in enumerate(pushes)]
    rows = by_push(episodes)
    assert [(row["impulse_n_s"], row["episodes"]) for row in rows] == [([0, 5], 2), ([5, 10], 1), ([10, 15], 3)]
    assert [row["lasted"] for row in rows] == pytest.approx([1.0, 0.0, 1.0 / 3.0])
    assert rows[2]["lasted_interval"] == share_interval([True, False, False])
    one = Evaluation("x", episodes).row()
    assert one["by_push"] == rows
    pooled = over_seeds([one, one])["by_push"]
    assert [row["episodes"] for row in pooled] == [4, 2, 6]
    assert [row["lasted"] for row in pooled] == pytest.approx([1.0, 0.0, 1.0 / 3.0])
    # both have played the same episodes, so they are no more certain than one
    assert pooled[2]["lasted_interval"] == pytest.approx(share_interval([True, False, False]))
