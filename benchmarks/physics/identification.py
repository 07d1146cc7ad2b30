"""Identification: hidden mass, stiffness and friction are found again from a recording, with and without noise.

``python -m benchmarks.physics.identification --out FILE.json`` plays configs/fit/identify.yaml. A seed draws the hidden
parameters and the recording's noise, and is that of the sampler. Rows hold the errors of the best point after some
numbers of trials, of the luckiest trial beside it, and the interval.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from agents.fit.config import load_fit
from agents.fit.record import READINGS, record
from agents.fit.report import find_best, fit_posterior, luckiest
from agents.fit.rollout import Player
from agents.fit.scorers import scorer_class
from agents.fit.space import Space
from agents.fit.study import Study
from benchmarks import runner
from piavatar_envs.config import load_config
from piavatar_envs.doctor import quiet_warp

STUDY = Path(__file__).resolve().parents[2] / "configs" / "fit" / "identify.yaml"
#: The part of every range, on its scale, that hidden parameters are drawn from.
HIDDEN = 0.2, 0.8


@dataclass(frozen=True)
class Options(runner.Options):
    """Options of the benchmark of identification."""

    #: seeds of hidden parameters, noise and sampler
    seeds: tuple[int, ...] = (0, 1, 2)
    #: standard deviations of the noise of bones, props and markers [m]
    noises: tuple[float, ...] = (0.0,)
    #: numbers of trials after which the errors are taken
    trials: tuple[int, ...] = (30, 45, 60)
    #: number of markers
    markers: int = 60


def identify(seed: int, noise: float, options: Options, folder: Path) -> Iterator[dict[str, Any]]:
    """Record an episode of hidden parameters, find them again, and yield the errors.

    Args:
        seed: of hidden parameters, noise and sampler.
        noise: standard deviation of the recording's noise [m].
        options: of the command line.
        folder: for recording and study.
    """
    path = folder / "motion.npz"
    study = {"seed": seed, "trials": max(options.trials), "scorers.recorded.path": str(path)}
    config = load_fit(STUDY, study)
    space = Space(config)
    hidden = space.values(np.random.default_rng(seed).uniform(*HIDDEN, len(space.axes)))
    player = Player(config, space, READINGS, device=options.device)
    np.savez(path, **record(player, hidden, options.markers, noise, seed))
    kind = scorer_class(config.scorer)
    scorer = kind(load_config(kind.Config, config.scorer_settings))
    scorer.connect(player.probe())
    list(runner.progress(Study(config, space, folder).run(player, scorer), f"seed {seed}", config.trials))
    player.close()
    trials = Study(config, space, folder).trials(residuals=True)
    for count in options.trials:
        posterior = fit_posterior(space, trials[:count], seed)
        best = find_best(space, trials[:count], posterior, False, seed)
        found, low, high = (space.values(place) for place in (best.place, best.low, best.high))
        row: dict[str, Any] = {"case": f"seed {seed}, {1e3 * noise:g} mm of noise, {count} trials"}
        row |= {"seed": seed, "noise_m": noise, "trials": count, "hidden": hidden, "found": found}
        row |= {"intervals": {name: [low[name], high[name]] for name in low}, "errors": errors(hidden, found)}
        lucky = luckiest(trials[:count], False)
        yield row | {"luckiest_errors": errors(hidden, lucky.values), "luckiest_score_m": lucky.score}


def errors(hidden: dict[str, float], found: dict[str, float]) -> dict[str, float]:
    """Return errors by parameter: relative ones of mass and modulus, the difference of friction."""
    return {
        name: found[name] - value if name.endswith("friction") else found[name] / value - 1.0
        for name, value in hidden.items()
    }


def cases(options: Options) -> Iterator[dict[str, Any]]:
    """Yield all rows."""
    quiet_warp()
    for noise in options.noises:
        for seed in options.seeds:
            with tempfile.TemporaryDirectory() as folder:
                yield from identify(seed, noise, options, Path(folder))


if __name__ == "__main__":
    runner.main("identification", cases, Options)
