"""Posterior of a study over its parameters: Gaussian processes, the best point, and intervals.

:class:`Posterior` models the score. Near a perfect match a distance is a cone, which a smooth process models poorly, so
:class:`ResidualPosterior` models the residuals themselves, in their principal components, and seeks the least of their
squares (Higdon, Gattiker, Williams & Rightley, "Computer model calibration using high-dimensional output", J. Am. Stat.
Assoc. 103, 2008).

Kernel: Matern 5/2 with a length scale for each parameter, and noise (Rasmussen & Williams, "Gaussian processes for
machine learning", 2006, eq. 4.17, 5.8 and algorithm 2.1). Its constants are those of the greatest posterior density
under log-normal priors.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy import linalg, optimize
from scipy.stats import norm, qmc

#: Medians of the priors of length scale and noise variance, in shares of range and of variance, and their spreads.
LENGTH, LENGTH_SPREAD = 0.5, 1.0
NOISE, NOISE_SPREAD = 1.0e-3, 2.5
#: Starts of the search for the constants, and points at which functions are drawn.
STARTS, POINTS, FUNCTIONS = 4, 512, 400
#: Principal components of residuals, at most, and the share of their variance that is modelled.
COMPONENTS, EXPLAINED = 10, 0.9999
#: Least number of trials a parameter that a model of residuals is fitted to.
NEAREST = 6
#: Distance in the unit cube below which trials crowd together.
CROWDED = 0.01


def matern(a: np.ndarray, b: np.ndarray, lengths: np.ndarray) -> np.ndarray:
    """Return the correlations of points ``(n, d)`` and ``(m, d)``, shape ``(n, m)``."""
    square = (((a[:, None] - b[None]) / lengths) ** 2).sum(axis=-1)
    r = np.sqrt(5.0 * square)
    return (1.0 + r + 5.0 / 3.0 * square) * np.exp(-r)


@dataclass(frozen=True)
class Best:
    """The best point of a posterior.

    Attributes:
        place: in the unit cube, shape ``(d,)``.
        mean: of the score there.
        interval: 95 % interval of the score there.
        low, high: 95 % interval of the place along every parameter, shape ``(d,)``.
    """

    place: np.ndarray
    mean: float
    interval: tuple[float, float]
    low: np.ndarray
    high: np.ndarray


class Posterior:
    """Gaussian process of a score, fitted to the trials.

    Attributes:
        x: places in the unit cube, shape ``(n, d)``.
        y: scores, shape ``(n,)``.
        lengths: length scales, shape ``(d,)``.
        noise: standard deviation of the score of a single trial.
    """

    def __init__(self, x: np.ndarray, y: np.ndarray, seed: int = 0, count: int = STARTS) -> None:
        """Fit the process.

        Args:
            x: places in the unit cube, shape ``(n, d)``.
            y: scores, shape ``(n,)``.
            seed: of the starts of the search.
            count: of these starts.

        Raises:
            ValueError: fewer than two trials.
        """
        if len(y) < 2:
            raise ValueError(f"there are {len(y)} trials with a score; a posterior needs at least two")
        self.x, self.y = np.asarray(x, np.float64), np.asarray(y, np.float64)
        self.center, self.spread = float(self.y.mean()), float(self.y.std()) or 1.0
        self._z = (self.y - self.center) / self.spread
        d = self.x.shape[1]
        prior = np.log([*[LENGTH] * d, 1.0, NOISE])
        spread = np.array([*[LENGTH_SPREAD] * d, 1.0, NOISE_SPREAD])
        bounds = [*[(np.log(0.01), np.log(30.0))] * d, (np.log(0.05), np.log(100.0)), (np.log(1e-7), 0.0)]
        starts = [prior, *(prior + spread * np.random.default_rng(seed).normal(0.0, 1.0, (count - 1, d + 2)))]
        lowest, highest = np.transpose(bounds)

        def density(constants: np.ndarray) -> float:
            """Return the negative logarithm of the posterior density of the constants."""
            likelihood = self._factor(constants)
            return likelihood + 0.5 * float((((constants - prior) / spread) ** 2).sum())

        found = [
            optimize.minimize(density, np.clip(start, lowest, highest), method="L-BFGS-B", bounds=bounds)
            for start in starts
        ]
        self._factor(min(found, key=lambda result: result.fun).x)

    def _factor(self, constants: np.ndarray) -> float:
        """Adopt constants; returns the negative logarithm of the likelihood."""
        self.lengths, variance, noise = np.exp(constants[:-2]), np.exp(constants[-2]), np.exp(constants[-1])
        self._variance, self.noise = variance, float(np.sqrt(noise)) * self.spread
        covariance = variance * matern(self.x, self.x, self.lengths) + (noise + 1e-9) * np.eye(len(self.x))
        self._cholesky = linalg.cholesky(covariance, lower=True)
        self._weights = linalg.cho_solve((self._cholesky, True), self._z)
        return 0.5 * float(self._z @ self._weights) + float(np.log(np.diag(self._cholesky)).sum())

    def predict(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return mean and standard deviation of the score without noise at places ``(m, d)``."""
        across = self._variance * matern(np.atleast_2d(x), self.x, self.lengths)
        solved = linalg.solve_triangular(self._cholesky, across.T, lower=True)
        variance = np.maximum(self._variance - (solved**2).sum(axis=0), 0.0)
        return self.center + self.spread * (across @ self._weights), self.spread * np.sqrt(variance)

    def draw(self, x: np.ndarray, count: int, seed: int = 0) -> np.ndarray:
        """Draw functions of the posterior at places ``(m, d)``, shape ``(count, m)``."""
        across = self._variance * matern(x, self.x, self.lengths)
        solved = linalg.solve_triangular(self._cholesky, across.T, lower=True)
        covariance = self._variance * matern(x, x, self.lengths) - solved.T @ solved
        values, vectors = linalg.eigh(covariance)
        root = vectors * np.sqrt(np.maximum(values, 0.0))
        normal = np.random.default_rng(seed).normal(size=(count, len(x)))
        return self.center + self.spread * (across @ self._weights + normal @ root.T)

    def best(self, maximize: bool, seed: int = 0) -> Best:
        """Return the point of the best mean, and where the best point of the true function may be.

        The latter is the spread of the best points of functions drawn from the posterior.
        """
        sign, d = (1.0 if maximize else -1.0), self.x.shape[1]
        spread = qmc.Sobol(d, seed=seed).random(POINTS)
        corners = np.array(np.meshgrid(*[[0.0, 1.0]] * d)).reshape(d, -1).T if d <= 6 else np.empty((0, d))
        everywhere = np.concatenate([spread, corners, self.x])
        order = np.argsort(-sign * self.predict(everywhere)[0])
        found = [
            optimize.minimize(
                lambda x: -sign * float(self.predict(x)[0][0]) / self.spread,
                start,
                method="L-BFGS-B",
                bounds=[(0, 1)] * d,
            )
            for start in everywhere[order[:3]]
        ]
        place = np.clip(min(found, key=lambda result: result.fun).x, 0.0, 1.0)
        points = np.concatenate([everywhere, place[None]])
        return self.at(place, *best_places(lambda at, s: sign * self.draw(at, FUNCTIONS, s), place, points, seed))

    def at(self, place: np.ndarray, low: np.ndarray, high: np.ndarray) -> Best:
        """Return a best point with the score there."""
        mean, deviation = (float(value[0]) for value in self.predict(place))
        half = float(norm.ppf(0.975)) * deviation
        return Best(place, mean, (mean - half, mean + half), np.minimum(low, place), np.maximum(high, place))


def best_places(
    draw: Callable[[np.ndarray, int], np.ndarray], place: np.ndarray, points: np.ndarray, seed: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return the 95 % interval of the best places of drawn functions, on points that close in on these.

    Args:
        draw: from points ``(m, d)`` and a seed to functions ``(count, m)``, of which the greatest value is the best.
        place: the best point of the mean, shape ``(d,)``.
        points: to begin with, shape ``(m, d)``.
        seed: of functions and points.
    """
    rng = np.random.default_rng(seed)
    for _ in range(3):
        best = points[np.argmax(draw(points, seed), axis=1)]
        width = np.maximum(2.0 * best.std(axis=0), 0.002)
        near = rng.normal(best[rng.integers(len(best), size=POINTS // 2)], 0.5 * width)
        points = np.unique(np.concatenate([np.clip(near, 0.0, 1.0), best, place[None]]), axis=0)
    best = points[np.argmax(draw(points, seed), axis=1)]
    return np.quantile(best, 0.025, axis=0), np.quantile(best, 0.975, axis=0)


class ResidualPosterior:
    """Gaussian processes of the residuals' principal components, whose sum of squares is to be least."""

    def __init__(self, x: np.ndarray, residuals: np.ndarray, seed: int = 0, starts: int = STARTS) -> None:
        """Fit the processes.

        Args:
            x: places in the unit cube, shape ``(n, d)``.
            residuals: of every trial, shape ``(n, K)``.
            seed: of the starts of the searches.
            starts: number of these for each component.
        """
        center = residuals.mean(axis=0)
        left, sizes, right = np.linalg.svd(residuals - center, full_matrices=False)
        share = np.cumsum(sizes**2) / max(float((sizes**2).sum()), 1e-300)
        count = min(COMPONENTS, 1 + int(np.searchsorted(share, EXPLAINED)))
        self._offsets = right[:count] @ center
        self.components = [Posterior(x, left[:, k] * sizes[k], seed, starts) for k in range(count)]
        # residuals that no parameter changes are errors of the recording; independent ones of the same sizes move the
        # match by that much along each component
        unexplained = center - self._offsets @ right[:count]
        self._recording_noise = np.sqrt(right[:count] ** 2 @ unexplained**2)

    @classmethod
    def near_match(
        cls, x: np.ndarray, y: np.ndarray, residuals: np.ndarray, seed: int = 0, starts: int = STARTS
    ) -> ResidualPosterior:
        """Fit to the third of the trials that match best, where residuals are smooth and nearly linear.

        Args:
            x: places in the unit cube, shape ``(n, d)``.
            y: distances, shape ``(n,)``.
            residuals: of every trial, shape ``(n, K)``.
            seed: of the starts of the searches.
            starts: number of these for each component.
        """
        # of trials that crowd together one is enough: the model needs some spread
        near: list[int] = []
        for index in np.argsort(y, kind="stable"):
            if all(np.abs(x[index] - x[other]).max() >= CROWDED for other in near):
                near.append(int(index))
        near = near[: max(len(y) // 3, NEAREST * x.shape[1])]
        return cls(x[near], residuals[near], seed, starts)

    def expected(self, x: np.ndarray) -> np.ndarray:
        """Return the expected sum of squares at places ``(m, d)``, but for a constant."""
        total = np.zeros(len(x))
        for offset, component in zip(self._offsets, self.components, strict=True):
            mean, deviation = component.predict(x)
            total += (offset + mean) ** 2 + deviation**2
        return total

    def draw(self, x: np.ndarray, count: int, seed: int) -> np.ndarray:
        """Draw functions of the sum of squares at places ``(m, d)``, shape ``(count, m)``.

        What is matched differs from the smooth functions as any trial does, and has the errors of the recording, so
        each draw has an offset like both.
        """
        total = np.zeros((count, len(x)))
        rng = np.random.default_rng((seed, 1))
        for index, (offset, component) in enumerate(zip(self._offsets, self.components, strict=True)):
            rough = rng.normal(0.0, np.hypot(component.noise, self._recording_noise[index]), (count, 1))
            total += (offset + rough + component.draw(x, count, seed + index)) ** 2
        return total

    def best(self, seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the place of the least expected sum of squares, and the 95 % interval of the place."""
        place, points = self.least(seed), self._points(seed)
        return place, *best_places(lambda at, s: -self.draw(at, FUNCTIONS // 2, s), place, points, seed)

    def _points(self, seed: int) -> np.ndarray:
        """Return points all over the unit cube, and those of the trials."""
        x = self.components[0].x
        return np.concatenate([qmc.Sobol(x.shape[1], seed=seed).random(POINTS), x])

    def least(self, seed: int = 0) -> np.ndarray:
        """Return the place of the least expected sum of squares, shape ``(d,)``."""
        points = self._points(seed)
        values = self.expected(points)
        scale = float(values.min()) or 1.0
        found = [
            optimize.minimize(
                lambda at: float(self.expected(at[None])[0]) / scale,
                start,
                method="L-BFGS-B",
                bounds=[(0.0, 1.0)] * points.shape[1],
            )
            for start in points[np.argsort(values)[:5]]
        ]
        return np.clip(min(found, key=lambda result: result.fun).x, 0.0, 1.0)
