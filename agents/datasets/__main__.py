"""Record a dataset: ``python -m agents.datasets PIAvatar/Walk-v0 --level expert --episodes 256 --out runs/datasets``.

Writes a Minari dataset such as ``piavatar/walk/expert-v0`` below the folder; with that folder in the variable
``MINARI_DATASETS_PATH``, ``minari.load_dataset`` loads it by this name. Episodes are complete, and their seeds are
those of training runs: evaluations play others.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import tyro

from agents.command import one_line_errors, read_options
from agents.config import FIRST_TRAINED
from agents.datasets.levels import open_source
from agents.datasets.record import check_new, dataset_id, import_minari, record, write
from piavatar_envs.config import ConfigError
from piavatar_envs.core.rng import check_seeds
from piavatar_envs.core.writing import check_writable
from piavatar_envs.doctor import quiet_warp
from piavatar_envs.tasks import listed_name

#: Episodes that one dataset can have, a hundred times those of the largest published one.
MOST_EPISODES = 100_000


@dataclass(frozen=True)
class Options:
    """Record episodes of expert, medium or random play as a Minari dataset."""

    #: registered id
    env_id: tyro.conf.Positional[str]
    #: settings of the environment: fidelity=tiny
    settings: tyro.conf.Positional[tuple[str, ...]] = ()
    #: level of play
    level: Literal["expert", "medium", "random"] = "expert"
    #: complete episodes
    episodes: int = 100
    #: folder of the datasets
    out: Path = Path("runs/datasets")
    #: seed of the first episode
    first_seed: int = FIRST_TRAINED
    #: environments that play at a time
    num_envs: int = 256
    #: where to simulate
    device: str = "cpu"
    #: folder of a training run of your own, whose policy plays instead
    run: Path | None = None
    #: standard deviation of noise on its actions, instead of the level's
    noise: float | None = None


def main(args: list[str] | None = None) -> None:
    """Run the command line."""
    options = read_options(Options, "datasets", args)
    quiet_warp()
    with one_line_errors(ValueError, ImportError, OSError, RuntimeError):
        import_minari()  # before episodes are played, not after
        env_id = listed_name(options.env_id)
        if not 1 <= options.episodes <= MOST_EPISODES or options.num_envs < 1:
            raise ConfigError(
                f"episodes={options.episodes} must be >= 1 and <= {MOST_EPISODES}, and num_envs={options.num_envs} >= 1"
            )
        check_seeds(options.first_seed, options.episodes, "first_seed")
        name = dataset_id(env_id, options.level)
        check_new(options.out, name)
        check_writable(options.out / name / "data")
        source = open_source(env_id, options.level, options.settings, options.run, options.noise)
        plays = record(source, options.episodes, options.first_seed, options.num_envs, options.device)
        write(options.out, name, env_id, source, plays)
    returns = [float(play.rewards.sum()) for play in plays]
    steps = sum(len(play.rewards) for play in plays)
    print(f"{len(plays)} episodes, {steps} steps, mean return {np.mean(returns):.1f}, by {source.name}")
    print(
        f'in {options.out}: load it by minari.load_dataset("{name}") with MINARI_DATASETS_PATH={options.out.resolve()}'
    )


if __name__ == "__main__":
    main()
