"""Speed of a training run on one and several GPUs, and its time to shares of successes.

``python -m benchmarks.speed.ranks --device cuda --ranks 1 2 4 --out benchmarks/results/ranks.json``. Every row is a
training run by torchrun and rsl_rl, in which each rank has as many environments as the configuration says, so that the
batch grows with the ranks. A row has

- ``env_steps_per_s``: of training, over all ranks: control steps of a rollout by the median time of an iteration;
- ``collect_s`` and ``learn_s``: the medians of its two parts on rank 0, of which learning waits for the slowest rank;
- ``efficiency``: steps per second and rank, as a share of the first row's;
- ``seconds_to_success``: for each share of ``--success``, time of the iterations until that share of the episodes that
  ended in the latest ten has succeeded, under the actions that are drawn while it learns; None where it has not;
- ``trained_success``: share of the episodes in which the trained policy succeeds without that noise, and its interval.

With ``--device cuda:0`` all ranks share one GPU, over Gloo: a trial of the command, not a measure of scaling.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

from agents.files import ROOT, read_json
from benchmarks import runner

WARM_UP = 3  # iterations before a measurement
SMOOTH = 10  # iterations of the share of successes
TAIL = 3000  # characters of a failed training's output


@dataclass(frozen=True)
class Options(runner.Options):
    """Options of the benchmark of ranks."""

    #: numbers of ranks: processes, each with a GPU of its own
    ranks: tuple[int, ...] = (1,)
    #: configuration of a training run by rsl_rl
    config: Path = ROOT / "configs" / "rsl_rl" / "kick_ball_rsl.yaml"
    #: settings that override it, such as num_envs=1024
    settings: tuple[str, ...] = ()
    #: iterations of a measurement of speed
    iterations: int = 20
    #: shares of successful episodes to be reached by a run as long as the configuration says; none for speed alone
    success: tuple[float, ...] = ()


def cases(options: Options) -> Iterator[dict[str, Any]]:
    """Yield a row for each number of ranks."""
    first: float | None = None
    for count in runner.progress(options.ranks, "ranks"):
        with tempfile.TemporaryDirectory() as folder:
            row = measure(count, options, Path(folder) / "run")
        first = first or row["env_steps_per_s"] / count
        yield {
            "case": "1 rank" if count == 1 else f"{count} ranks",
            **row,
            "efficiency": row["env_steps_per_s"] / count / first,
        }


def measure(count: int, options: Options, folder: Path) -> dict[str, Any]:
    """Train on some ranks.

    Args:
        count: of ranks.
        options: of the benchmark.
        folder: to train in.

    Raises:
        RuntimeError: the training has failed.
    """
    settings = [*options.settings]
    if not options.success:
        length = [f"iterations={options.iterations}", f"checkpoint_every={options.iterations + 1}"]
        settings += [*length, "evaluation.episodes=2"]
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", f"--nproc-per-node={count}"]
    command += ["-m", "agents.rsl_rl.train", str(options.config), *settings]
    command += ["--device", options.device, "--out", str(folder)]
    environment = {"OMP_NUM_THREADS": "1"} | os.environ  # as torchrun sets it for several ranks
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(f"{' '.join(command)} has failed:\n{(done.stdout + done.stderr)[-TAIL:]}")
    results, logged = read_json(folder / "results.json"), scalars(folder / "rsl_rl")
    collect, learn = logged["Perf/collection_time"], logged["Perf/learning_time"]
    times = [sum(parts) for parts in zip(collect, learn, strict=True)]
    steps = results["train_steps"] / results["config"]["iterations"]
    row = {
        "ranks": count,
        "num_envs_of_a_rank": results["num_envs"],
        "env_steps_per_s": steps / median(times[WARM_UP:]),
        "collect_s": median(collect[WARM_UP:]),
        "learn_s": median(learn[WARM_UP:]),
        "training_s": results["training_s"],
    }
    if options.success:
        trained = next(row for row in results["results"] if row["case"] == "trained")
        row |= {
            "seconds_to_success": {str(share): time_to(share, times, logged) for share in options.success},
            "trained_success": trained["success_once"],
            "trained_success_interval": trained["success_once_interval"],
        }
    return row


def scalars(folder: Path) -> dict[str, list[float]]:
    """Read the figures of TensorBoard's files, by name and in the order of iterations."""
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    events = EventAccumulator(str(folder), size_guidance={"scalars": 0}).Reload()
    return {name: [event.value for event in events.Scalars(name)] for name in events.Tags()["scalars"]}


def time_to(share: float, times: Sequence[float], logged: Mapping[str, Sequence[float]]) -> float | None:
    """Return the time until a share of the episodes of the latest iterations has succeeded; None where it has not.

    Args:
        share: of the episodes.
        times: of the iterations [s].
        logged: shares of the environments whose episodes have ended, and succeeded, in a step of each iteration.
    """
    if len(times) < SMOOTH:
        return None
    ended, succeeded = (
        np.convolve(logged[f"Episodes/{name}"], np.ones(SMOOTH), mode="valid") for name in ("ended", "succeeded")
    )
    reached = np.flatnonzero((ended > 0.0) & (succeeded >= share * ended))
    return float(np.cumsum(times)[SMOOTH - 1 + reached[0]]) if len(reached) else None


if __name__ == "__main__":
    runner.main("ranks", cases, Options)
