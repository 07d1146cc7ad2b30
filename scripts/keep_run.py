"""Keep what a training has left beside the other results, without what only going on with it would need.

python -m scripts.keep_run runs/walk_sb3_1 --to benchmarks/results/ppo

Settings, scores and pictures are kept as they are. Of a ``policy.zip`` of stable-baselines3 the policy's parameters are
kept, which are a quarter of it and all that ``agents.play`` reads; ``PPO.load`` wants the rest, too. Of the curve of
returns, an episode a row, rows are averaged until there are at most :data:`ROWS`.
"""

from __future__ import annotations

import shutil
import sys
import zipfile
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro

#: Rows of a curve, at most.
ROWS = 1000
#: What must be there, and what may.
NEEDED, WELCOME = ("config.yaml", "results.json"), ("policy.pt", "curve.png")
_PARAMETERS = "policy.pth"


def main(
    runs: Annotated[tuple[Path, ...], tyro.conf.Positional],
    to: Annotated[Path, tyro.conf.arg(help="folder of the results")] = Path("benchmarks/results/ppo"),
) -> int:
    """Copy runs into a folder, each under its own name.

    Args:
        runs: folders of trainings that have ended.
        to: where to.

    Raises:
        ValueError: a folder holds no training that has ended, or is there already; nothing is written then.
    """
    for run in runs:
        missing = [name for name in NEEDED if not (run / name).is_file()]
        if missing:
            raise ValueError(f"{run} has no {missing[0]}: has the training ended?")
        if (to / run.name).exists():
            raise ValueError(f"{to / run.name} is there already; remove it first")
    for run in runs:
        keep(run, to / run.name)
        print(to / run.name)
    return 0


def keep(run: Path, folder: Path) -> None:
    """Copy one run into a folder, which it makes."""
    folder.mkdir(parents=True)
    for name in (*NEEDED, *WELCOME):
        if (run / name).is_file():
            shutil.copyfile(run / name, folder / name)
    if (run / "curve.csv").is_file():
        (folder / "curve.csv").write_text(shortened((run / "curve.csv").read_text(encoding="utf-8")), encoding="utf-8")
    if (run / "policy.zip").is_file():
        with zipfile.ZipFile(run / "policy.zip") as whole, zipfile.ZipFile(folder / "policy.zip", "w") as kept:
            kept.writestr(zipfile.ZipInfo(_PARAMETERS), whole.read(_PARAMETERS), zipfile.ZIP_DEFLATED)


def shortened(curve: str) -> str:
    """A curve as CSV, with rows averaged evenly: the last step of each, and the mean return of its episodes."""
    header, *rows = curve.split()
    values = np.array([[float(number) for number in row.split(",")] for row in rows]).reshape(len(rows), 2)
    if len(rows) <= ROWS:
        return curve
    parts = np.array_split(values, ROWS)
    return "\n".join([header, *(f"{part[-1, 0]:.0f},{part[:, 1].mean():.6g}" for part in parts)]) + "\n"


if __name__ == "__main__":
    try:
        sys.exit(tyro.cli(main, description=__doc__))
    except ValueError as error:
        sys.exit(f"error: {error}")
