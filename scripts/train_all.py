"""Train published configurations, several seeds each: ``python -m scripts.train_all stand_rsl walk_sb3 --gpus 0 1``.

Every training is a process of its own, some at a time on each GPU, and leaves ``runs/<configuration>_<seed>``. Those
that have ended are left alone and those that were stopped, or were to be shorter, go on from their last checkpoint:
repeat the command after any interruption. ``scripts.keep_run`` copies scores and the median policy to the
committed results, ``agents.scores`` writes the table.
"""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from queue import SimpleQueue
from threading import Event
from typing import Annotated, Any

import tyro
from pydantic import BaseModel
from rich.progress import track

from agents.checkpoint import LENGTHS, settings_changed
from agents.files import read_json
from agents.sb3.config import load_training
from piavatar_envs.config import parse_assignments


def _load_rsl(source: Path | Mapping[str, Any], overrides: Mapping[str, Any] | None = None) -> BaseModel:
    from agents.rsl_rl.policy import load_rsl  # needs the extra rsl

    return load_rsl(source, overrides)


#: Training script and loader of a configuration, by the folder that it is in.
SCRIPTS = {"rsl_rl": "agents.rsl_rl.train", "sb3": "agents.sb3.train"}
LOADERS = {"rsl_rl": _load_rsl, "sb3": load_training}
CONFIGS = Path(__file__).resolve().parents[1] / "configs"
#: Interval between two checks of a training run [s].
WAIT = 0.2


@dataclass(frozen=True)
class Job:
    """Training with its configuration, seed and folder."""

    config: Path
    seed: int
    folder: Path

    def is_over(self, settings: tuple[str, ...]) -> bool:
        """Return whether the training is complete; its scores are the last file that it writes.

        Args:
            settings: that override the file's.

        Raises:
            ValueError: the scores in its folder are of something else; or a setting is refused.
        """
        load, path = LOADERS[self.config.parent.name], self.folder / "results.json"
        asked = load(self.config, parse_assignments((f"seed={self.seed}", *settings))).model_dump(mode="json")
        if not path.is_file():
            return False
        try:
            # settings that the file does not name had their defaults
            had = load(read_json(path)["config"]).model_dump(mode="json")
        except (ValueError, KeyError, TypeError) as error:
            raise ValueError(f"{path} is of no training of {self.config.stem} ({error}); remove it") from None
        for name, then, now in settings_changed(had, asked):
            raise ValueError(
                f"{path} is of a training run with {name}={then}, now it is {now}; give the same settings, or another "
                "folder with --runs"
            )
        longer = any(had[name] < asked[name] for name in LENGTHS if name in asked)
        return not longer and had["evaluation"] == asked["evaluation"]

    def command(self, device: str, settings: tuple[str, ...]) -> list[str]:
        """Return the command that trains, or resumes the training."""
        script = SCRIPTS[self.config.parent.name]
        where = ["--device", device, "--out", str(self.folder), "--resume"]
        return [sys.executable, "-m", script, str(self.config), f"seed={self.seed}", *settings, *where]

    def run(self, gpu: str | None, settings: tuple[str, ...], time_is_up: Callable[[], bool]) -> str:
        """Train on a GPU or the CPU until the training or the time is over, and return the error, if any."""
        if self.is_over(settings) or time_is_up():
            return ""
        self.folder.mkdir(parents=True, exist_ok=True)
        environment = dict(os.environ) if gpu is None else os.environ | {"CUDA_VISIBLE_DEVICES": gpu}
        with (self.folder / "log.txt").open("ab") as log:
            command = self.command("cpu" if gpu is None else "cuda", settings)
            process = subprocess.Popen(
                command, env=environment, stdin=subprocess.DEVNULL, stdout=log, stderr=log, start_new_session=True
            )
        while process.poll() is None and not time_is_up():
            time.sleep(WAIT)
        if process.poll() is None:
            end(process)
            return ""
        return "" if process.returncode == 0 else f"exit {process.returncode}; see {self.folder / 'log.txt'}"


def end(process: subprocess.Popen) -> None:
    """Kill a training run and its processes; its checkpoints are written atomically, so none is damaged."""
    if hasattr(os, "killpg"):
        with contextlib.suppress(ProcessLookupError):  # it has ended by itself
            os.killpg(process.pid, signal.SIGKILL)
    else:  # on Windows
        process.kill()
    process.wait()


def main(
    configs: Annotated[tuple[str, ...], tyro.conf.Positional] = (),
    settings: Annotated[tuple[str, ...], tyro.conf.arg(help="settings that override the files': iterations=10")] = (),
    seeds: Annotated[int, tyro.conf.arg(help="training runs of each configuration")] = 5,
    gpus: Annotated[tuple[str, ...], tyro.conf.arg(help="numbers of the GPUs to train on; none for the CPU")] = (),
    jobs_per_device: Annotated[int, tyro.conf.arg(help="training runs at a time on a GPU, or on the CPU")] = 3,
    minutes: Annotated[float | None, tyro.conf.arg(help="stop after so long; the same command goes on")] = None,
    runs: Annotated[Path, tyro.conf.arg(help="folder of the training runs")] = Path("runs"),
) -> int:
    """Train the configurations named, by default all of ``configs/rsl_rl`` and ``configs/sb3``.

    Args:
        configs: names of files there, without the ending.
        settings: for all of them.
        seeds: training runs of each configuration, from seed 0 on.
        gpus: as ``CUDA_VISIBLE_DEVICES`` names them.
        jobs_per_device: training runs at a time on a GPU, or on the CPU.
        minutes: after which all are stopped; no limit if not given.
        runs: folder to write to.

    Returns:
        0 if all have ended, or were stopped for the time; 1 if one failed; 130 if all were stopped by Ctrl-C.

    Raises:
        OSError: the training runs cannot be written there.
        ImportError: a configuration is for an extra that is not installed.
        ValueError: an unknown configuration, a number out of range, a setting that is refused, or a folder with the
            scores of a training run by other settings.
    """
    if seeds < 1 or jobs_per_device < 1:
        raise ValueError(f"seeds={seeds}, jobs_per_device={jobs_per_device}: both must be >= 1")
    if minutes is not None and not minutes >= 0.0:
        raise ValueError(f"minutes={minutes} must be >= 0")
    jobs = [Job(path, n, runs / f"{path.stem}_{n}") for path in find(configs) for n in range(seeds)]
    for job in jobs:
        job.is_over(settings)  # refuses settings, and other training runs' folders, before anything begins
    slots: SimpleQueue[str | None] = SimpleQueue()
    for _ in range(jobs_per_device):
        for gpu in gpus or (None,):
            slots.put(gpu)
    until, stopped = time.monotonic() + (float("inf") if minutes is None else 60.0 * minutes), Event()

    def train(job: Job) -> str:
        gpu = slots.get()
        try:
            return job.run(gpu, settings, lambda: stopped.is_set() or time.monotonic() >= until)
        finally:
            slots.put(gpu)

    with ThreadPoolExecutor(jobs_per_device * max(1, len(gpus))) as pool:
        try:
            said = list(track(pool.map(train, jobs), "training", len(jobs)))
        except KeyboardInterrupt:
            print("stopped; the same command goes on", file=sys.stderr)
            return 130
        finally:
            stopped.set()
    for job, words in zip(jobs, said, strict=True):
        if words or not job.is_over(settings):
            print(f"{job.folder}: {words or 'stopped; the same command goes on'}", file=sys.stderr)
    return int(any(said))


def find(names: tuple[str, ...]) -> list[Path]:
    """Return files of configurations by their names, each once, or all if there are no names.

    Raises:
        ValueError: there is none of a name.
    """
    known = {path.stem: path for folder in SCRIPTS for path in sorted((CONFIGS / folder).glob("*.yaml"))}
    for name in names:
        if name not in known:
            raise ValueError(f"no configuration {name!r}; there are {', '.join(known)}")
    return [known[name] for name in dict.fromkeys(names or known)]


def as_by_ctrl_c(*_: object) -> None:
    """Raise KeyboardInterrupt, so that training runs end with the terminal or at the system's request."""
    raise KeyboardInterrupt


if __name__ == "__main__":
    for name in ("SIGTERM", "SIGHUP"):
        if hasattr(signal, name):
            signal.signal(getattr(signal, name), as_by_ctrl_c)
    try:
        sys.exit(tyro.cli(main, description=__doc__))
    except (ValueError, OSError, ImportError) as error:
        sys.exit(f"error: {error}")
