"""Training runs that are killed: by an exception in this process, or by SIGKILL in one of their own.

``python -m tests.agents.killing 5 ARGS`` is ``python -m agents.sb3.train ARGS`` until it has written half of the file
of its fifth ``fsync``: the configuration and each checkpoint synchronise their file, then its folder, so this is the
second checkpoint.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from stable_baselines3.common.callbacks import BaseCallback


class Killed(Exception):
    """A training run has been killed."""


class KillAt(BaseCallback):
    """Kills a training run in this process as soon as it has had some steps."""

    def __init__(self, steps: int) -> None:
        super().__init__()
        self.steps = steps

    def _on_step(self) -> bool:
        if self.num_timesteps >= self.steps:
            raise Killed
        return True


@contextmanager
def killed_in_step(views: type, count: int) -> Iterator[None]:
    """Kill a training run in this process in the ``count``-th step of its environments, and check that it was."""
    step, left = views.step, count

    def killed(self: Any, actions: Any) -> Any:
        nonlocal left
        left -= 1
        if left == 0:
            raise Killed
        return step(self, actions)

    with pytest.MonkeyPatch.context() as patch, pytest.raises(Killed):
        patch.setattr(views, "step", killed)
        yield


def run_killed(count: int, *args: str) -> None:
    """Run a training run that is killed in a write, and check that it was."""
    command = [sys.executable, "-m", "tests.agents.killing", str(count), *args]
    root = Path(__file__).resolve().parents[2]
    done = subprocess.run(command, cwd=root, capture_output=True, text=True, timeout=300)
    assert done.returncode == -signal.SIGKILL, done.stdout[-2000:] + done.stderr[-2000:]


def flat(value: Any, name: str = "") -> dict[str, str]:
    """Return leaves of nested containers by dotted name: the bits of arrays and tensors, ``repr`` of all else."""
    if isinstance(value, (dict, list, tuple)):
        items = value.items() if isinstance(value, dict) else enumerate(value)
        return {key: bits for part, item in items for key, bits in flat(item, f"{name}.{part}").items()}
    if isinstance(value, torch.Tensor):
        value = value.cpu()
    return {name: repr(value) if np.isscalar(value) or value is None else np.asarray(value).tobytes().hex()}


def main(count: int, args: list[str]) -> None:
    """Train until the ``count``-th ``fsync``."""
    from agents import files
    from agents.sb3 import train

    left, fsync = count, os.fsync

    def counted(descriptor: int) -> None:
        nonlocal left
        left -= 1
        if left == 0:
            os.ftruncate(descriptor, os.fstat(descriptor).st_size // 2)
            os.kill(os.getpid(), signal.SIGKILL)
        fsync(descriptor)

    files.os.fsync = counted
    train.main(args)


if __name__ == "__main__":
    main(int(sys.argv[1]), sys.argv[2:])
