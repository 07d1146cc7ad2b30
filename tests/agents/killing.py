"""Trainings that are killed: by an exception in this process, or by SIGKILL in one of their own.

``python -m tests.agents.killing sb3.train step 40 ARGS`` is ``python -m agents.sb3.train ARGS`` until its 40th step of
the environments, and ``... write 5 ARGS`` until it has written half of what its fifth ``fsync`` is of: its
configuration, and then each checkpoint, synchronises its file, then its folder, so this is the second checkpoint.
"""

from __future__ import annotations

import importlib
import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import torch
from stable_baselines3.common.callbacks import BaseCallback

ROOT = Path(__file__).resolve().parents[2]
#: What takes a step of all environments, in the process that learns.
_STEPS = {
    "sb3.train": ("stable_baselines3.common.vec_env", "VecMonitor", "step_wait"),
    "rsl_rl.train": ("piavatar_envs.api.rsl_rl", "AvatarRslEnv", "step"),
}


class Killed(Exception):
    """A training has been killed."""


class KillAt(BaseCallback):
    """Kills a training in this process as soon as it has had some steps."""

    def __init__(self, steps: int) -> None:
        super().__init__()
        self.steps = steps

    def _on_step(self) -> bool:
        if self.num_timesteps >= self.steps:
            raise Killed
        return True


def run_killed(script: str, when: str, count: int, *args: str) -> None:
    """Run a training that is killed, and see that it was."""
    command = [sys.executable, "-m", "tests.agents.killing", script, when, str(count), *args]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=300)
    assert done.returncode == -signal.SIGKILL, done.stdout[-2000:] + done.stderr[-2000:]


def flat(value: Any, name: str = "") -> dict[str, str]:
    """Leaves of nested containers by dotted name: the bits of arrays and tensors, everything else as it is written."""
    if isinstance(value, (dict, list, tuple)):
        items = value.items() if isinstance(value, dict) else enumerate(value)
        return {key: bits for part, item in items for key, bits in flat(item, f"{name}.{part}").items()}
    if isinstance(value, torch.Tensor):
        value = value.cpu()
    return {name: repr(value) if np.isscalar(value) or value is None else np.asarray(value).tobytes().hex()}


def main(script: str, when: str, count: int, args: list[str]) -> None:
    """Be killed."""
    training = importlib.import_module(f"agents.{script}")
    left = count

    def counting(original):
        def counted(*arguments, **keywords):
            nonlocal left
            left -= 1
            if left == 0:
                if when == "write":
                    os.ftruncate(arguments[0], os.fstat(arguments[0]).st_size // 2)
                os.kill(os.getpid(), signal.SIGKILL)
            return original(*arguments, **keywords)

        return counted

    if when == "write":
        folders = importlib.import_module("agents.files")
        folders.os.fsync = counting(os.fsync)
    else:
        module, views, method = _STEPS[script]
        view = getattr(importlib.import_module(module), views)
        setattr(view, method, counting(getattr(view, method)))
    training.main(args)


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2], int(sys.argv[3]), sys.argv[4:])
