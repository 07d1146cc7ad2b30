"""95 % intervals of shares: of episodes, and of trainings of several seeds."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import stats


def share_interval(outcomes: Sequence[bool]) -> list[float]:
    """Wilson's 95 % interval of the share of episodes with an outcome: not empty where all or none had it."""
    return wilson(float(np.mean(outcomes)), len(outcomes), float(stats.norm.ppf(0.975)))


def wilson(share: float, size: float, quantile: float) -> list[float]:
    """The interval of a share whose ends differ from it by ``quantile`` of their own standard errors.

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


def share_interval_over_seeds(shares: Sequence[float], episodes: int) -> list[float]:
    """The 95 % interval of a share that trainings of several seeds have on average.

    Episodes of one training are alike, so all of them together are worth fewer: as many as would scatter as much as the
    seeds' own shares do (Wilson's interval with the effective sample size; Franco, Little, Louis & Slud, "Comparative
    study of confidence intervals for proportions in complex sample surveys", J. Survey Stat. Methodol. 7, 2019). The
    quantile is Student's, of one degree of freedom less than there are seeds.

    Args:
        shares: of every seed.
        episodes: of every seed.
    """
    seeds, mean = len(shares), float(np.mean(shares))
    size, alone = float(seeds * episodes), mean * (1.0 - mean)
    if seeds > 1 and alone > 0.0:
        size = min(size, alone / max(float(np.var(shares, ddof=1)) / seeds, 1e-12))
    return wilson(mean, size, float(stats.t.ppf(0.975, seeds - 1)) if seeds > 1 else np.inf)
