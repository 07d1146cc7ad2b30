"""Copy finished training runs to the committed results: ``python -m scripts.keep_run runs/walk_rsl_*``.

The runs of one call are seeds of one configuration. The scores of all of them are kept (``results.json``,
``evaluation.json``), and of the seed with the median return also the policy with its ``config.yaml``: an ordinary
one, which is what a reader should play. A ``policy.pt`` is copied as it is. Of a ``policy.zip`` of stable-baselines3
only the actor's parameters are kept, an eighth of the file: enough for ``agents.play``, not for ``PPO.load``.
"""

from __future__ import annotations

import io
import sys
import zipfile
from pathlib import Path
from typing import Annotated

import torch
import tyro
import yaml

from agents.checkpoint import differences
from agents.files import read_json
from agents.sb3.policy import CRITICS, PARAMETERS
from piavatar_envs.core.reading import UNREADABLE

#: Files of every run, and files of the one whose policy is kept.
NEEDED, SCORES, POLICY = ("config.yaml", "results.json"), ("results.json", "evaluation.json"), "policy.pt"


def main(
    runs: Annotated[tuple[Path, ...], tyro.conf.Positional],
    to: Annotated[Path, tyro.conf.arg(help="folder of the results")] = Path("benchmarks/results/ppo"),
) -> int:
    """Copy the seeds of a training run into a folder, each under its own name.

    Args:
        runs: folders of finished training runs that differ in their seed.
        to: destination.

    Raises:
        ValueError: there are no runs, or two of one name; a folder holds no finished run, or an unreadable file;
            or its name is taken at the destination. Nothing is written then.
    """
    if not runs:
        raise ValueError("no runs; name their folders")
    for run in runs:
        check_ended(run)
    median = runs[0] if len(runs) == 1 else sorted(runs, key=returned)[len(runs) // 2]  # a PID agent is a run alone
    found: dict[Path, dict[str, bytes]] = {}
    for run in runs:
        folder = to / run.resolve().name
        if folder in found or folder.exists():
            raise ValueError(f"{folder} exists; remove it first, or rename {run}")
        found[folder] = kept(run, run == median)
    for folder, files in found.items():
        folder.mkdir(parents=True)
        for name, content in files.items():
            (folder / name).write_bytes(content)
        print(folder)
    return 0


def returned(run: Path) -> float:
    """Return the policy's mean return, from the last evaluation of the run.

    Raises:
        ValueError: the scores have no row of a policy.
    """
    path = next(path for path in (run / "evaluation.json", run / "results.json") if path.is_file())
    try:
        (row,) = (row for row in read_json(path)["results"] if row["case"] == "trained")
        return float(row["return_mean"])
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{path} holds no score of a policy: {error}") from error


def kept(run: Path, with_policy: bool) -> dict[str, bytes]:
    """Return the contents of the files to keep, by name.

    Raises:
        ValueError: a policy cannot be read.
    """
    names = (*SCORES, "config.yaml", POLICY) if with_policy else SCORES
    files = {name: (run / name).read_bytes() for name in names if (run / name).is_file()}
    if with_policy and (run / "policy.zip").is_file():
        try:
            files["policy.zip"] = actor_of((run / "policy.zip").read_bytes())
        except UNREADABLE as error:
            raise ValueError(f"{run / 'policy.zip'} holds no policy: {error}") from error
    return files


def check_ended(run: Path) -> None:
    """Refuse a run without scores, or with scores of other settings than its configuration (it was continued).

    Raises:
        ValueError: as said, or one of the two files cannot be read.
    """
    missing = [name for name in NEEDED if not (run / name).is_file()]
    if missing:
        raise ValueError(f"{run} has no {missing[0]}: has the training ended?")
    try:
        had = read_json(run / "results.json")["config"]
        asked = yaml.safe_load((run / "config.yaml").read_text(encoding="utf-8"))
        unlike = differences(had["env"] if "design" in had else had, asked)  # the PID agent's are its environment's
    except (ValueError, KeyError, TypeError, AttributeError, yaml.YAMLError) as error:
        raise ValueError(f"{run} has unreadable settings or scores: {error}") from error
    for name, then, now in unlike:
        raise ValueError(
            f"{run / 'results.json'} is of {name}={then}, and config.yaml says {now}: continue the training "
            "(--resume), and keep it when it has ended"
        )


def actor_of(policy: bytes) -> bytes:
    """Return a ``policy.zip`` that holds the actor's parameters only."""
    with zipfile.ZipFile(io.BytesIO(policy)) as whole:
        parameters = torch.load(io.BytesIO(whole.read(PARAMETERS)), map_location="cpu", weights_only=True)
    held, left = io.BytesIO(), io.BytesIO()
    torch.save({name: value for name, value in parameters.items() if not name.startswith(CRITICS)}, held)
    with zipfile.ZipFile(left, "w") as file:
        file.writestr(zipfile.ZipInfo(PARAMETERS), held.getvalue(), zipfile.ZIP_DEFLATED)
    return left.getvalue()


if __name__ == "__main__":
    try:
        sys.exit(tyro.cli(main, description=__doc__))
    except (ValueError, OSError) as error:
        sys.exit(f"error: {error}")
