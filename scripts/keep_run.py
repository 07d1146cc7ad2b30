"""Keep what a training has left beside the other results, and no more than is needed there.

python -m scripts.keep_run runs/walk_sb3_1 --to benchmarks/results/ppo

Settings, scores, pictures and a ``policy.pt`` are kept as they are. Of a ``policy.zip`` of stable-baselines3 that is
the parameters of the policy, a quarter of it and all that ``agents.play`` reads; ``PPO.load`` wants the rest, too. Of
the curve of returns, an episode a row, rows are averaged until there are at most :data:`ROWS`.
"""

from __future__ import annotations

import io
import sys
import zipfile
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
import yaml

from agents.checkpoint import differences
from agents.curve import Curve
from agents.folders import read_json
from agents.sb3_policy import PARAMETERS

#: Rows of a curve, at most.
ROWS = 1000
#: What must be there, and what may.
NEEDED, WELCOME = ("config.yaml", "results.json"), ("policy.pt", "curve.png", "evaluation.json")


def main(
    runs: Annotated[tuple[Path, ...], tyro.conf.Positional],
    to: Annotated[Path, tyro.conf.arg(help="folder of the results")] = Path("benchmarks/results/ppo"),
) -> int:
    """Copy runs into a folder, each under its own name.

    Args:
        runs: folders of trainings that have ended.
        to: where to.

    Raises:
        ValueError: no runs, or two of one name; a folder holds no training that has ended, or something unreadable; or
            its name is taken there. Nothing is written then.
    """
    if not runs:
        raise ValueError("no runs; name their folders")
    found: dict[Path, dict[str, bytes]] = {}
    for run in runs:
        folder = to / run.resolve().name
        if folder in found or folder.exists():
            raise ValueError(f"{folder} is there already; remove it first, or name {run} otherwise")
        found[folder] = kept(run)
    for folder, files in found.items():
        folder.mkdir(parents=True)
        for name, content in files.items():
            (folder / name).write_bytes(content)
        print(folder)
    return 0


def kept(run: Path) -> dict[str, bytes]:
    """What is kept of a run, by the names of files.

    Raises:
        ValueError: it has not ended, or not as its configuration says; or something in it cannot be read.
    """
    missing = [name for name in NEEDED if not (run / name).is_file()]
    if missing:
        raise ValueError(f"{run} has no {missing[0]}: has the training ended?")
    files = {name: (run / name).read_bytes() for name in (*NEEDED, *WELCOME) if (run / name).is_file()}
    check_ended(run)
    try:
        if (run / "curve.csv").is_file():
            files["curve.csv"] = shortened((run / "curve.csv").read_text(encoding="utf-8")).encode()
        if (run / "policy.zip").is_file():
            files["policy.zip"] = parameters_of((run / "policy.zip").read_bytes())
    except (ValueError, KeyError, zipfile.BadZipFile) as error:
        raise ValueError(f"{run} has something else than a training leaves: {error}") from error
    return files


def check_ended(run: Path) -> None:
    """Refuse a run that goes on, in which scores are left that it has had before.

    Raises:
        ValueError: the scores are of other settings than the configuration, or one of them cannot be read.
    """
    try:
        had = read_json(run / "results.json")["config"]
        asked = yaml.safe_load((run / "config.yaml").read_text(encoding="utf-8"))
        unlike = differences(had["env"] if "design" in had else had, asked)  # the PID agent's are its environment's
    except (ValueError, KeyError, TypeError, AttributeError, yaml.YAMLError) as error:
        raise ValueError(f"{run} has something else than a training leaves: {error}") from error
    for name, then, now in unlike:
        raise ValueError(
            f"{run / 'results.json'} is of {name}={then}, and config.yaml says {now}: go on with the training "
            "(--resume), and keep it when it has ended"
        )


def parameters_of(policy: bytes) -> bytes:
    """A ``policy.zip`` with the policy's parameters only, as bytes."""
    left = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(policy)) as whole, zipfile.ZipFile(left, "w") as file:
        file.writestr(zipfile.ZipInfo(PARAMETERS), whole.read(PARAMETERS), zipfile.ZIP_DEFLATED)
    return left.getvalue()


def shortened(curve: str) -> str:
    """A curve as CSV, with rows averaged evenly: the last step of each, and the mean return of its episodes."""
    if not curve.split():
        raise ValueError("curve.csv is empty")
    _, *rows = curve.split()
    values = np.array([[float(number) for number in row.split(",")] for row in rows]).reshape(len(rows), 2)
    if len(rows) <= ROWS:
        return curve
    parts = np.array_split(values, ROWS)
    return Curve([int(part[-1, 0]) for part in parts], [part[:, 1].mean() for part in parts]).csv()


if __name__ == "__main__":
    try:
        sys.exit(tyro.cli(main, description=__doc__))
    except (ValueError, OSError) as error:
        sys.exit(f"error: {error}")
