"""The posterior of a study: what it predicts, its best point, and how often its intervals hold."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import qmc

from agents.fit.posterior import Posterior, ResidualPosterior


def test_it_goes_through_trials_without_noise_and_is_unsure_between_them():
    x = np.linspace(0.0, 1.0, 9)[:, None]
    posterior = Posterior(x, np.sin(6.0 * x[:, 0]))
    mean, deviation = posterior.predict(x)
    assert mean == pytest.approx(np.sin(6.0 * x[:, 0]), abs=2e-2) and posterior.noise < 0.05
    between = np.array([[0.45]])
    assert posterior.predict(between)[0] == pytest.approx(np.sin(2.7), abs=2e-2)
    alone = Posterior(x[[0, 1, 7, 8]], np.sin(6.0 * x[[0, 1, 7, 8], 0]))
    assert alone.predict(between)[1] > 3.0 * deviation.max()


def test_a_noisy_study_is_right_by_the_mean_where_its_luckiest_trial_promises_too_much():
    # 32 trials with noise as large as the score's fall over a third of the range, 10 times
    errors, claims, lucky, inside, covered = [], [], [], 0, 0
    for seed in range(10):
        rng = np.random.default_rng(seed)
        x = qmc.Sobol(1, seed=seed).random(32)
        place = rng.uniform(0.25, 0.75)

        def truth(at, place=place):
            return -4.0 * (at[:, 0] - place) ** 2

        y = truth(x) + rng.normal(0.0, 0.5, len(x))
        best = Posterior(x, y, seed).best(True, seed)
        errors.append(abs(best.place[0] - place))
        claims.append(best.mean - truth(best.place[None])[0])
        lucky.append(y.max() - truth(x[np.argmax(y)][None])[0])
        inside += bool(best.low[0] <= place <= best.high[0])
        covered += bool(best.interval[0] <= truth(best.place[None])[0] <= best.interval[1])
    assert np.mean(errors) < 0.15 and abs(np.mean(claims)) < 0.2
    assert np.mean(lucky) > 0.5
    assert inside >= 8 and covered >= 8


def test_the_best_may_lie_at_an_edge_and_be_a_minimum():
    x = qmc.Sobol(2, seed=0).random(32)
    best = Posterior(x, x[:, 0] + (x[:, 1] - 0.3) ** 2).best(False)
    assert best.place == pytest.approx([0.0, 0.3], abs=0.03)
    assert (best.low <= best.place).all() and (best.place <= best.high).all() and best.low[0] == 0.0
    assert best.mean == pytest.approx(0.0, abs=0.02)
    assert best.high[0] < 0.1 and best.high[1] - best.low[1] < 0.2


def test_one_trial_is_too_few():
    with pytest.raises(ValueError, match="1 trials with a score"):
        Posterior(np.zeros((1, 1)), np.zeros(1))
    flat = Posterior(np.array([[0.0], [0.5], [1.0]]), np.ones(3))
    assert np.isfinite(flat.best(True).mean)


def test_residuals_find_a_match_that_distances_miss():
    # 40 trials of a smooth vector of two parameters; its norm is a cone, whose tip a smooth score blunts
    x = qmc.Sobol(2, seed=1).random(64)[:40]
    place = np.array([0.37, 0.71])

    def vector(at):
        a, b = np.atleast_2d(at).T
        return np.stack([np.sin(2.0 * a), np.exp(b), a * b, a - 0.7 * b, (a + b) ** 2], axis=1)

    residuals = vector(x) - vector(place)
    distance = np.linalg.norm(residuals, axis=1)
    score = np.abs(Posterior(x, distance).best(False).place - place).max()
    found, low, high = ResidualPosterior(x, residuals).best()
    assert np.abs(found - place).max() < min(0.01, 0.5 * score + 1e-3)
    assert (low - 5e-3 <= place).all() and (place <= high + 5e-3).all() and (high - low < 0.05).all()
    # noise of the recording moves the match, and hardly by more than it must
    noisy = np.repeat(residuals, 200, axis=1) / np.sqrt(200.0)
    noisy = noisy + np.random.default_rng(0).normal(0.0, 0.1, noisy.shape[1]) / np.sqrt(200.0)
    assert np.abs(ResidualPosterior(x, noisy).best()[0] - place).max() < 0.05


def test_intervals_of_a_match_hold_with_a_noisy_recording(monkeypatch):
    # residuals of one parameter, and noise of the recording as large as what a third of the range changes
    monkeypatch.setattr("agents.fit.posterior.POINTS", 64)  # enough for one parameter
    x, count = qmc.Sobol(1, seed=2).random(16), 20
    inside, widths = 0, []
    for seed in range(count):
        rng = np.random.default_rng(seed)
        place = rng.uniform(0.25, 0.75)
        curve = np.repeat(np.stack([np.sin(2.0 * (x[:, 0] - place)), np.expm1(x[:, 0] - place)], 1), 50, axis=1)
        residuals = curve + rng.normal(0.0, 0.5, curve.shape[1])
        _, low, high = ResidualPosterior(x, residuals, seed, starts=1).best(seed)
        inside += bool(low[0] <= place <= high[0])
        widths.append(high[0] - low[0])
    assert inside >= 0.8 * count
    # least squares: 50 values each of slopes 2 and 1, with noise of 0.5
    assert np.mean(widths) == pytest.approx(2.0 * 1.96 * 0.5 / np.sqrt(50 * (2.0**2 + 1.0)), rel=0.2)
