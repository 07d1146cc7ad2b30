"""Command line of studies: ``python -m agents.fit CONFIG.yaml [KEY=VALUE ...] [--out FOLDER]``.

The same command continues a study that was interrupted or killed; with more ``trials``, it extends a finished one.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

import tyro
from rich.console import Console
from tqdm import tqdm

from agents.command import one_line_errors, read_options
from agents.config import check_imports
from agents.files import RESULTS, check_figures, hold, made, write_config
from agents.fit.config import load_fit
from agents.fit.report import conclude
from agents.fit.rollout import Player
from agents.fit.scorers import Scorer, scorer_class
from agents.fit.space import Space
from agents.fit.study import Study
from piavatar_envs.config import load_config, parse_assignments, read_yaml
from piavatar_envs.doctor import quiet_warp


@dataclass(frozen=True)
class Options:
    """Find the settings of an environment that look right, do what was measured, or match a recording."""

    #: YAML file of the study, as in configs/fit
    config: tyro.conf.Positional[Path]
    #: settings that override the file's: trials=20, env.fidelity=tiny, scorers.vlm.path=FOLDER
    settings: tyro.conf.Positional[tuple[str, ...]] = ()
    #: folder of the study, by default runs/fit_ and the name of the file
    out: Path | None = None
    #: where to simulate
    device: str = "cpu"
    #: module of a task of your own, which the study may import
    imports: tuple[str, ...] = ()


def main(args: list[str] | None = None) -> None:
    """Run the command line."""
    options = read_options(Options, "fit", args)
    quiet_warp()
    folder = options.out or Path("runs") / f"fit_{options.config.stem}"
    with one_line_errors(ValueError, ImportError, OSError):
        overrides = parse_assignments(options.settings)
        check_imports(
            overrides.get("env_id", read_yaml(options.config).get("env_id", "")), options.config, options.imports
        )
        config = load_fit(options.config, overrides)
        space = Space(config)
        check_figures(folder / RESULTS, "fit")
        kind = scorer_class(config.scorer)
        scorer = kind(load_config(kind.Config, config.scorer_settings))
        with made(folder):
            hold(folder)
            player = Player(config, space, scorer.readings, scorer.pictures, options.device)
            scorer.connect(player.probe())
            study = Study(config, space, folder)
            write_config(folder, config)
            console = Console(highlight=False, soft_wrap=True, width=None if sys.stdout.isatty() else 120)
            try:
                _run(study, player, scorer, config.trials)
            except KeyboardInterrupt:
                done = len(study.trials())
                print(f"\ninterrupted after {done} trials; go on with the same command", file=sys.stderr)
            trials = study.trials(residuals=True)
            if trials:
                conclude(folder, config, player, trials, scorer.unit, console)
            player.close()


def _run(study: Study, player: Player, scorer: Scorer, trials: int) -> None:
    """Play the trials that are missing, with a progress bar."""
    done = study.trials()
    with tqdm(total=trials, initial=min(len(done), trials), desc="fit", unit="trial", dynamic_ncols=True) as bar:
        for trial in study.run(player, scorer):
            bar.set_postfix_str(
                f"trial {trial.number}: " + ("no score" if trial.score is None else f"{trial.score:.4g}")
            )
            bar.update()


if __name__ == "__main__":
    main()
