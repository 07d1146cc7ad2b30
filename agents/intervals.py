"""95 % intervals: of shares of episodes, and of what training runs of several seeds have on average."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy import stats

#: Quantile of the normal distribution for 95 %.
NORMAL = float(stats.norm.ppf(0.975))


class Estimate(NamedTuple):
    """Mean of a sample, and half the width of its 95 % confidence interval (infinite for a single value)."""

    mean: float
    half_width: float

    @property
    def low(self) -> float:
        """Return the lower end of the interval."""
        return self.mean - self.half_width

    @property
    def high(self) -> float:
        """Return the upper end of the interval."""
        return self.mean + self.half_width


def mean_and_interval(values: Sequence[float] | np.ndarray) -> Estimate:
    """Return the mean and its 95 % interval, by Student's t with n - 1 degrees of freedom.

    Args:
        values: independent measurements (seeds, not steps of one run), shape (n,).

    Raises:
        ValueError: no value, more than one dimension, or a value that is not finite.
    """
    sample = np.asarray(values, dtype=np.float64)
    if sample.ndim != 1 or sample.size == 0:
        raise ValueError(f"values have shape {sample.shape}; give one dimension of at least one value")
    if not np.isfinite(sample).all():
        first = int(np.flatnonzero(~np.isfinite(sample))[0])
        raise ValueError(f"values[{first}]={sample[first]} is not finite; drop or explain it before averaging")
    if sample.size == 1:
        return Estimate(float(sample[0]), math.inf)
    error = sample.std(ddof=1) / math.sqrt(sample.size)
    return Estimate(float(sample.mean()), float(stats.t.ppf(0.975, sample.size - 1) * error))


def share_interval(outcomes: Sequence[bool]) -> list[float]:
    """Return Wilson's 95 % interval of the share of episodes with an outcome."""
    return wilson(float(np.mean(outcomes)), len(outcomes), NORMAL)


def wilson(share: float, size: float, quantile: float) -> list[float]:
    """Return the interval of a share whose ends differ from it by ``quantile`` of their own standard errors.

    Wilson, "Probable inference, the law of succession, and statistical inference", J. Am. Stat. Assoc. 22, 1927.

    Args:
        share: that was found, in [0, 1].
        size: of the sample; need not be whole.
        quantile: of the normal, or of Student's distribution.
    """
    if np.isinf(quantile):
        return [0.0, 1.0]
    square = quantile**2 / size
    centre = (share + square / 2.0) / (1.0 + square)
    half = np.sqrt(square * (share * (1.0 - share) + square / 4.0)) / (1.0 + square)
    return [max(0.0, float(centre - half)), min(1.0, float(centre + half))]


def mean_over_seeds(means: Sequence[float], halves: Sequence[float], episodes: int) -> Estimate:
    """Return the mean of seeds that played the same episodes, with its 95 % interval over other seeds and episodes.

    The scatter of the seeds' means holds no information on the episodes, which are equally hard for all seeds. So the
    mean's variance is that of the seeds' means over their number, and that of one seed's mean over episodes, as if all
    scatter within a seed came of the episodes: at worst too large.

    Args:
        means: of every seed.
        halves: half the 95 % interval of each over its episodes.
        episodes: of every seed.
    """
    seeds = len(means)
    if seeds < 2 or episodes < 2:
        return Estimate(float(np.mean(means)), np.inf)
    of_seeds = float(np.var(means, ddof=1)) / seeds
    of_episodes = float(np.mean(np.square(halves))) / float(stats.t.ppf(0.975, episodes - 1)) ** 2
    variance, quantile = _scatter(of_seeds, of_episodes, seeds, episodes)
    return Estimate(float(np.mean(means)), quantile * float(np.sqrt(variance)))


def share_interval_over_seeds(shares: Sequence[float], episodes: int) -> list[float]:
    """Return the 95 % interval of a mean share of several seeds that played the same episodes.

    It is Wilson's, of as many episodes as would scatter as much as :func:`mean_over_seeds` finds: of those of one seed,
    at most (the effective sample size; Franco, Little, Louis & Slud, "Comparative study of confidence intervals for
    proportions in complex sample surveys", J. Survey Stat. Methodol. 7, 2019).

    Args:
        shares: of every seed.
        episodes: of every seed.
    """
    seeds, mean = len(shares), float(np.mean(shares))
    if seeds < 2 or episodes < 2:
        return wilson(mean, float(episodes), np.inf)
    within = float(np.mean([share * (1.0 - share) for share in shares]))
    variance, quantile = _scatter(float(np.var(shares, ddof=1)) / seeds, within / episodes, seeds, episodes)
    alone = mean * (1.0 - mean)
    return wilson(mean, alone / variance if alone > 0.0 else float(episodes), quantile)


def _scatter(of_seeds: float, of_episodes: float, seeds: int, episodes: int) -> tuple[float, float]:
    """Return the variance of a mean over seeds and episodes, and Student's quantile for it.

    Of two, whose interval is wider: of seeds and episodes together (degrees of freedom by Satterthwaite, "An
    approximate distribution of estimates of variance components", Biometrics 2, 1946), or of the few seeds alone.
    """
    alone, joint = float(stats.t.ppf(0.975, seeds - 1)), of_seeds + of_episodes
    if joint == 0.0:  # nothing has scattered
        return 0.0, alone
    freedom = joint**2 / (of_seeds**2 / (seeds - 1) + of_episodes**2 / (episodes - 1))
    quantile = float(stats.t.ppf(0.975, freedom))
    return (joint, quantile) if quantile**2 * joint > alone**2 * of_seeds else (of_seeds, alone)
