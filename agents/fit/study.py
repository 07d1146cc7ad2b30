"""Studies: trials proposed by Optuna, played in batches, and kept in a SQLite file that outlasts a kill at any moment.

A trial is written in one transaction, once it has a score. What a batch proposes is a function of the configuration and
of the trials in the file before it: samplers are made anew for every trial, from the study's seed and the number of the
trial. So a study that was killed goes on with the trials that it would have had.
"""

from __future__ import annotations

import json
import os
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import qmc

from agents.files import write_atomically
from agents.fit.config import FitConfig
from agents.fit.posterior import ResidualPosterior
from agents.fit.rollout import Episode, Player
from agents.fit.scorers import Scorer, Unscored
from agents.fit.space import Space
from piavatar_envs.config import ConfigError
from piavatar_envs.core.extras import missing
from piavatar_envs.core.reading import UNREADABLE

try:
    import optuna
except ImportError:
    raise missing("python -m agents.fit", "optuna", "fit") from None

#: File of the trials, name of the study in it, and its attribute that holds the configuration.
FILE, NAME, ABOUT = "study.db", "fit", "config"
#: Folder of what the scorer compares, a file a trial.
RESIDUALS = "residuals"
#: One in so many trials is at the best match of a model of residuals, if there are any, once there are enough of them;
#: places closer than that, in the unit cube, are the same.
MATCHING, LEAST_MATCHED, SAME_PLACE = 3, 8, 0.002
#: Settings that may differ when a study goes on: the trials before are the same.
FREE = ("trials", "question")


@dataclass(frozen=True)
class Trial:
    """A finished trial.

    Attributes:
        number: in the order of the study, from 0.
        values: of the parameters by name.
        score: mean over its episodes; None if it has none.
        scores: of each episode.
        failure: cause, where there is no score.
        residuals: mean over its episodes of what the scorer compares, shape ``(K,)``; None if there is none.
    """

    number: int
    values: dict[str, float]
    score: float | None
    scores: tuple[float, ...] = ()
    failure: str = ""
    residuals: np.ndarray | None = field(default=None, compare=False, repr=False)


class Study:
    """A study and its file.

    Attributes:
        config: of the study.
        space: its parameters.
        maximize: whether the greatest score is the best.
    """

    def __init__(self, config: FitConfig, space: Space, folder: Path) -> None:
        """Open the file of a study, or create it.

        Raises:
            ConfigError: the file is of other settings, or none of a study.
        """
        optuna.logging.set_verbosity(optuna.logging.ERROR)
        self.folder = folder
        self.config, self.space, self.maximize = config, space, config.best_is == "maximize"
        self._distributions = {axis.name: _distribution(axis) for axis in space.axes}
        self._about = {k: v for k, v in config.model_dump(mode="json").items() if k not in FREE}
        self._about["scorers"] = {config.scorer: self._about["scorers"][config.scorer]}
        path = folder / FILE
        if not path.exists():
            self._create(path)
        try:
            self._study = optuna.load_study(study_name=NAME, storage=_storage(path))
            about = self._study.user_attrs[ABOUT]
        except Exception as error:  # of SQLite, SQLAlchemy and Optuna, each with its own
            raise ConfigError(
                f"{path} is not a file of a study ({type(error).__name__}); write elsewhere with --out"
            ) from None
        if about != self._about:
            differing = [key for key in self._about if about.get(key) != self._about[key]]
            raise ConfigError(
                f"{path} is of a study with other settings ({', '.join(differing)}); write elsewhere with --out, or "
                f"give those of {folder / 'config.yaml'}"
            )

    def _create(self, path: Path) -> None:
        """Create the file; it gets its name once it is complete."""
        partial = path.with_name(f"{path.name}.partial")
        partial.unlink(missing_ok=True)
        storage = _storage(partial)
        study = optuna.create_study(storage=storage, study_name=NAME, direction=self.config.best_is)
        study.set_user_attr(ABOUT, self._about)
        storage.remove_session()
        storage.engine.dispose()
        os.replace(partial, path)

    def trials(self, residuals: bool = False) -> list[Trial]:
        """Return the finished trials, in order, with their residuals if asked for."""
        found = []
        for trial in self._study.get_trials(deepcopy=False):
            attributes = trial.user_attrs
            complete = trial.state == optuna.trial.TrialState.COMPLETE
            score = float(trial.value) if complete else None
            scores, failure = tuple(attributes.get("scores", ())), attributes.get("failure", "")
            own = _read_residuals(self._residuals_of(trial.number)) if complete and residuals else None
            found.append(Trial(trial.number, dict(trial.params), score, scores, failure, own))
        return found

    def _residuals_of(self, number: int) -> Path:
        """Return the file of a trial's residuals."""
        return self.folder / RESIDUALS / f"{number:05d}.npy"

    def run(self, player: Player, scorer: Scorer) -> Iterator[Trial]:
        """Play and score the trials that are missing, and yield each once it is in the file.

        Raises:
            ConfigError: the file holds trials that these settings do not propose.
        """
        while (done := len(found := self.trials(hasattr(scorer, "residuals")))) < self.config.trials:
            first = done - done % self.config.batch
            count = min(self.config.batch, self.config.trials - first)
            proposed = self._propose(found[:first], count)
            for trial, values in zip(found[first:], proposed, strict=False):
                if trial.values != values:
                    raise ConfigError(
                        f"trial {trial.number} of {FILE} has other values than this machine proposes, as other "
                        "versions of libraries would; write elsewhere with --out"
                    )
            for index, episodes in player.play(proposed, range(done - first, count)):
                yield self._add(Trial(first + index, proposed[index], *_judge(scorer, episodes)))

    def _propose(self, before: Sequence[Trial], count: int) -> list[dict[str, float]]:
        """Propose the values of ``count`` trials after others."""
        memory = optuna.create_study(direction=self.config.best_is)
        scores = [trial.score for trial in before if trial.score is not None]
        # a trial without a score counts as the worst one: a model that did not see it would propose it again
        worst = (min if self.maximize else max)(scores, default=0.0)
        for trial in before:
            memory.add_trial(self._frozen(trial.values, worst if trial.score is None else trial.score))
        proposed, numbers = [], range(len(before), len(before) + count)
        # the first of a batch alone, since it would be the same place again
        matching = next(
            (number for number in numbers if number % MATCHING == 0 and number >= self.config.startup), None
        )
        for number in numbers:
            memory.sampler = self._sampler(number)
            if self.config.sampler == "gp" and number < self.config.startup:
                memory.enqueue_trial(self.space.values(self._startup()[number]))
            elif number == matching and (match := self._match(before)) is not None:
                memory.enqueue_trial(self.space.values(match))
            trial = memory.ask(self._distributions)
            proposed.append({axis.name: trial.params[axis.name] for axis in self.space.axes})
        return proposed

    def _match(self, before: Sequence[Trial]) -> np.ndarray | None:
        """Return the place at which a model of the residuals matches best, shape ``(parameters,)``.

        None for other samplers, for too few trials with residuals, or where the place was tried before.
        """
        matched = [trial for trial in before if trial.residuals is not None]
        if self.config.sampler != "gp" or len(matched) < LEAST_MATCHED or self.maximize:
            return None
        x, y = self.space.shares([trial.values for trial in matched]), np.array([trial.score for trial in matched])
        residuals = np.array([trial.residuals for trial in matched], np.float64)
        place = ResidualPosterior.near_match(x, y, residuals, self.config.seed, starts=1).least(self.config.seed)
        return None if np.abs(x - place).max(axis=1).min() < SAME_PLACE else place

    def _startup(self) -> np.ndarray:
        """Return the points of the first trials in the unit cube, shape ``(startup, parameters)``."""
        power = max(1, int(np.ceil(np.log2(self.config.startup))))
        return qmc.Sobol(len(self.space.axes), seed=self.config.seed).random_base2(power)

    def _sampler(self, number: int) -> optuna.samplers.BaseSampler:
        """Make the sampler of a trial."""
        seed = int(np.random.SeedSequence((self.config.seed, number)).generate_state(1)[0])
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
            if self.config.sampler == "gp":
                return optuna.samplers.GPSampler(
                    seed=seed, n_startup_trials=self.config.startup, deterministic_objective=False
                )
            if self.config.sampler == "tpe":
                return optuna.samplers.TPESampler(
                    seed=seed, n_startup_trials=self.config.startup, multivariate=True, constant_liar=True
                )
            return optuna.samplers.RandomSampler(seed=seed)

    def _frozen(self, values: Mapping[str, float], score: float | None, **attributes: Any) -> optuna.trial.FrozenTrial:
        """Return a finished trial as Optuna has it."""
        state = optuna.trial.TrialState.COMPLETE if score is not None else optuna.trial.TrialState.FAIL
        return optuna.trial.create_trial(
            state=state,
            value=score,
            params=dict(values),
            distributions=self._distributions,
            user_attrs=json.loads(json.dumps(attributes)),
        )

    def _add(self, trial: Trial) -> Trial:
        """Write a trial to the file, all of it or nothing."""
        if trial.residuals is not None:
            path = self._residuals_of(trial.number)
            path.parent.mkdir(exist_ok=True)
            write_atomically(path, lambda file: np.save(file, trial.residuals))
        attributes = {"scores": trial.scores} | ({"failure": trial.failure} if trial.failure else {})
        self._study.add_trial(self._frozen(trial.values, trial.score, **attributes))
        return trial


def _read_residuals(path: Path) -> np.ndarray | None:
    """Read the residuals of a trial; None where there are none."""
    try:
        return np.load(path, allow_pickle=False)
    except (OSError, *UNREADABLE):
        return None


def _judge(
    scorer: Scorer, episodes: Sequence[Episode]
) -> tuple[float | None, tuple[float, ...], str, np.ndarray | None]:
    """Score the episodes of a trial.

    Returns:
        Mean of the scores, each of them, the cause where one has none, and the mean of the residuals, if any.
    """
    scores, residuals = [], []
    for episode in episodes:
        if episode.failure:
            return None, (), f"the simulation failed: {episode.failure}", None
        try:
            score = float(scorer.score(episode))
            residuals += [scorer.residuals(episode)] if hasattr(scorer, "residuals") else []
        except Unscored as cause:
            return None, (), str(cause), None
        if not np.isfinite(score):
            return None, (), f"the score is {score}", None
        scores.append(score)
    return float(np.mean(scores)), tuple(scores), "", np.mean(residuals, axis=0) if residuals else None


def _distribution(axis: Any) -> optuna.distributions.BaseDistribution:
    """Return the range of a parameter as Optuna has it."""
    if axis.whole:
        return optuna.distributions.IntDistribution(int(axis.low), int(axis.high), log=axis.log)
    return optuna.distributions.FloatDistribution(axis.low, axis.high, log=axis.log)


def _storage(path: Path) -> optuna.storages.RDBStorage:
    """Return the storage of a SQLite file."""
    return optuna.storages.RDBStorage(f"sqlite:///{path.resolve()}")
