"""Reports of a study: the table, plots, JSON, and the best settings as a configuration for ``gym.make``."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from agents.files import RESULTS, describe_run, plain, write_atomically, write_json
from agents.fit.config import FitConfig
from agents.fit.posterior import Best, Posterior, ResidualPosterior
from agents.fit.rollout import Player
from agents.fit.space import FACTORS, Space
from agents.fit.study import Trial
from piavatar_envs.config import EnvConfig, dump_yaml, replace

#: Least number of trials with a score of which there is a posterior, and points of a plotted curve.
LEAST_TRIALS, CURVE = 4, 201


def fit_posterior(space: Space, trials: Sequence[Trial], seed: int) -> Posterior | None:
    """Fit the posterior to the trials that have a score; None for too few of them."""
    scored = [trial for trial in trials if trial.score is not None]
    if len(scored) < LEAST_TRIALS:
        return None
    return Posterior(space.shares([trial.values for trial in scored]), np.array([t.score for t in scored]), seed)


def find_best(space: Space, trials: Sequence[Trial], posterior: Posterior, maximize: bool, seed: int) -> Best:
    """Return the best point: by the posterior of the score, or of the residuals where every scored trial has them."""
    scored = [trial for trial in trials if trial.score is not None]
    residuals = [trial.residuals for trial in scored if trial.residuals is not None]
    if maximize or len(residuals) < len(scored) or len({len(own) for own in residuals}) != 1:
        return posterior.best(maximize, seed)
    model = ResidualPosterior.near_match(posterior.x, posterior.y, np.array(residuals, np.float64), seed)
    return posterior.at(*model.best(seed))


def luckiest(trials: Sequence[Trial], maximize: bool) -> Trial | None:
    """Return the trial of the best score, or None without one."""
    scored = [trial for trial in trials if trial.score is not None]
    return (max if maximize else min)(scored, key=lambda trial: trial.score, default=None)


def summary(space: Space, best: Best | None, trials: Sequence[Trial], maximize: bool) -> dict[str, Any]:
    """Return what a study has found, for the JSON file."""
    lucky = luckiest(trials, maximize)
    found: dict[str, Any] = {
        "failed": sum(trial.score is None for trial in trials),
        "luckiest": lucky and {"trial": lucky.number, "values": lucky.values, "score": lucky.score},
    }
    if best is not None:
        low, high = space.values(best.low), space.values(best.high)
        found["best"] = {
            "values": space.values(best.place),
            "intervals": {name: [low[name], high[name]] for name in low},
            "score_mean": best.mean,
            "score_interval": list(best.interval),
        }
    found["results"] = [
        {
            "case": f"trial {t.number}",
            "values": t.values,
            "score": t.score,
            "scores": t.scores,
            "failure": t.failure or None,
        }
        for t in trials
    ]
    return found


def best_settings(player: Player, values: dict[str, float]) -> EnvConfig:
    """Return the settings of a trial, as ``gym.make`` takes them.

    Where trials share builds, whose time step is that of whole ranges, its substeps are set.
    """
    settings = player.space.settings(values)
    if any(axis.name in FACTORS for axis in player.space.shared):
        return replace(settings, player.time_step(values))
    return settings


def show(space: Space, config: FitConfig, found: dict[str, Any], unit: str, console: Console) -> None:
    """Print a table of the parameters, and the score."""
    count, failed = len(found["results"]), found["failed"]
    table = Table(
        title=f"{count} trials, {failed} of them without a score", title_justify="left", caption_justify="left"
    )
    best, lucky = found.get("best"), found["luckiest"]
    table.add_column("parameter", no_wrap=True)
    for column in ("range", "best", "95 % interval", "luckiest trial"):
        table.add_column(column, justify="right", no_wrap=True)
    for axis in space.axes:
        row = ["", "", ""]
        if best:
            low, high = best["intervals"][axis.name]
            row[:2] = f"{best['values'][axis.name]:.4g}", f"{low:.4g} to {high:.4g}"
        if lucky:
            row[2] = f"{lucky['values'][axis.name]:.4g}"
        table.add_row(axis.name, f"{axis.low:g} to {axis.high:g}{', log' * axis.log}", *row)
    if best:
        low, high = best["score_interval"]
        score = f"{best['score_mean']:.4g}", f"{low:.4g} to {high:.4g}", f"{lucky['score']:.4g}"
        table.add_row(escape(f"{config.scorer} [{unit}], {config.best_is}d"), "", *score)
        table.caption = "best: by the mean of the posterior, not the luckiest trial"
    console.print(table)


def draw(
    path: Path,
    space: Space,
    config: FitConfig,
    trials: Sequence[Trial],
    posterior: Posterior | None,
    best: Best | None,
    unit: str,
) -> None:
    """Draw the history of the scores, and the score against every parameter with the posterior through the best.

    Args:
        path: the PNG to write.
        space: of the study.
        config: of the study.
        trials: that are finished.
        posterior: of the score; None with too few trials.
        best: of the posterior.
        unit: of the score.
    """
    from matplotlib.figure import Figure

    scored = [trial for trial in trials if trial.score is not None]
    figure = Figure(figsize=(4.6 * (1 + len(space.axes)), 3.8), layout="constrained")
    history, *panels = figure.subplots(1, 1 + len(space.axes), squeeze=False)[0]
    numbers, scores = [trial.number for trial in scored], np.array([trial.score for trial in scored])
    history.plot(numbers, scores, "o", color="0.6", markersize=4, label="trial")
    if len(scores):
        running = (np.maximum if config.best_is == "maximize" else np.minimum).accumulate(scores)
        history.step(numbers, running, where="post", color="tab:red", label="best so far")
    for trial in trials:
        if trial.score is None:
            history.axvline(trial.number, color="0.8", linewidth=1, linestyle=":")
    if config.sampler == "gp":
        history.axvline(config.startup - 0.5, color="0.6", linewidth=1, linestyle="--", label="model begins")
    history.set(xlabel="trial", ylabel=f"{config.scorer} [{unit}], {config.best_is}d", title=config.question or None)
    history.legend(frameon=False, fontsize=8)
    curve = np.linspace(0.0, 1.0, CURVE)
    for index, (axis, panel) in enumerate(zip(space.axes, panels, strict=True)):
        panel.plot([trial.values[axis.name] for trial in scored], scores, "o", color="0.6", markersize=4)
        if best is not None:
            line = np.repeat(best.place[None], CURVE, axis=0)
            line[:, index] = curve
            mean, deviation = posterior.predict(line)
            values = [axis.value(share) for share in curve]
            panel.plot(values, mean, color="tab:blue", label="posterior through the best")
            panel.fill_between(values, mean - 1.96 * deviation, mean + 1.96 * deviation, color="tab:blue", alpha=0.15)
            panel.axvline(axis.value(best.place[index]), color="tab:red", linewidth=1.2, label="best")
            panel.axvspan(axis.value(best.low[index]), axis.value(best.high[index]), color="tab:red", alpha=0.1)
            panel.legend(frameon=False, fontsize=8)
        panel.set(xlabel=axis.name, xscale="log" if axis.log else "linear")
    figure.savefig(path, dpi=130)


def conclude(
    folder: Path, config: FitConfig, player: Player, trials: Sequence[Trial], unit: str, console: Console
) -> dict[str, Any]:
    """Write ``results.json``, ``best.yaml`` and ``study.png``, and print the table; returns the figures.

    Args:
        folder: of the study.
        config: of the study.
        player: of its trials.
        trials: that are finished.
        unit: of the score.
        console: to print to.
    """
    space = player.space
    posterior = fit_posterior(space, trials, config.seed)
    maximize = config.best_is == "maximize"
    best = find_best(space, trials, posterior, maximize, config.seed) if posterior else None
    about = describe_run("fit", player.device) | {"seed": config.seed, "config": config.model_dump(mode="json")}
    found = {**about, "unit": unit, **summary(space, best, trials, maximize)}
    if posterior:
        lengths = {axis.name: length for axis, length in zip(space.axes, posterior.lengths, strict=True)}
        found["posterior"] = {"lengths": lengths, "noise": posterior.noise}
        settings = best_settings(player, found["best"]["values"])
        write_atomically(folder / "best.yaml", lambda file: file.write(dump_yaml(settings).encode()))
    write_json(folder / RESULTS, plain(found, "results"))
    draw(folder / "study.png", space, config, trials, posterior, best, unit)
    show(space, config, found, unit, console)
    names = f"config.yaml, study.db, study.png, {RESULTS}" + (", best.yaml" if posterior else "")
    console.print(f"in {folder}: {names}")
    return found
