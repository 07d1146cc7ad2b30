"""Studies that are killed by SIGKILL at random moments: ``python -m tests.agents.killed_study FOLDER``.

Each run is a fork of this process, whose libraries are loaded once. A study is played whole in ``FOLDER/whole``, then
again in ``FOLDER/killed_0``, ``killed_1`` and so on, with 20 kills in all.
"""

from __future__ import annotations

import os
import signal
import sys
import time
from pathlib import Path

import numpy as np

from tests.agents.test_fit import KILLED, ToyMatch, play_toy, study

KILLS = 20


class Slow(ToyMatch):
    """Takes as long for a trial as a proposal takes, so that kills fall between the trials of a batch, too."""

    def score(self, values):
        """Return the score."""
        time.sleep(0.03)
        return super().score(values)


def play(folder: Path, seconds: float | None = None) -> bool:
    """Play the study in a process of its own, which is killed after some seconds; returns whether it was."""
    child = os.fork()
    if not child:
        play_toy(study(**KILLED), folder, scorer=Slow)
        os._exit(0)
    if seconds is not None:
        time.sleep(seconds)
        os.kill(child, signal.SIGKILL)
    status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    if status not in (0, -signal.SIGKILL):
        raise RuntimeError(f"a run ended with status {status}")
    return status != 0


def main(folder: Path) -> None:
    """Play the studies."""
    play_toy(study(**KILLED | {"trials": 8}), folder / "first")  # loads what is imported late
    begun = time.perf_counter()
    play(folder / "whole")
    whole = time.perf_counter() - begun
    kills, studies, rng = 0, 0, np.random.default_rng()
    while kills < KILLS:
        killed = play(folder / f"killed_{studies}", rng.uniform(0.0, whole / 2.0))
        kills, studies = kills + killed, studies + (not killed)
    play(folder / f"killed_{studies}")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
