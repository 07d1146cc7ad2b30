"""Cost of a batch that was not measured: time of a control step, memory, and network traffic of data-parallel PPO.

``python -m benchmarks.speed.model --world PIAvatar/KickBall-v0 --num-envs 1000000 --gpus 64``. The constants come from
the committed results of :mod:`benchmarks.speed.vector`, :mod:`benchmarks.speed.pixels` and a training run, all on one
H200; the formulas are in ``docs/scaling.md``.
"""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import tyro

RESULTS = Path(__file__).parents[1] / "results"
#: Environment steps, epochs and seconds of the training from which the time of a learner is taken.
TRAINING = "kick_ball"


@dataclass(frozen=True)
class World:
    """Cost of a world on one GPU.

    Attributes:
        name: id of the environment, or module of ``piavatar_envs.multi``.
        particles, substeps: of an environment.
        latency_ms: time of a step, however few environments take it.
        us_per_env: time that an environment adds to it.
        mb_per_env: device memory that an environment takes.
        mb_of_process: device memory of a process without environments.
    """

    name: str
    particles: int
    substeps: int
    latency_ms: float
    us_per_env: float
    mb_per_env: float
    mb_of_process: float

    @property
    def ns_per_particle_substep(self) -> float:
        """Time of a particle's substep in a large batch."""
        return 1e3 * self.us_per_env / (self.particles * self.substeps)

    def ms_per_step(self, num_envs: int) -> float:
        """Return the time of a control step of a batch on one GPU."""
        return self.latency_ms + 1e-3 * self.us_per_env * num_envs

    def scaled(self, particles: int, substeps: int) -> World:
        """Return the cost of a world of the same kind with another number of particles and of substeps."""
        share = particles / self.particles
        work = share * substeps / self.substeps
        return World(
            f"{self.name}, scaled", particles, substeps, self.latency_ms * substeps / self.substeps,
            self.us_per_env * work, self.mb_per_env * share, self.mb_of_process,
        )  # fmt: skip


def measured_rows(benchmark: str) -> list[dict[str, Any]]:
    """Return the rows of a committed result."""
    return json.loads((RESULTS / f"{benchmark}.json").read_text(encoding="utf-8"))["results"]


def measured_world(name: str) -> World:
    """Return the cost of a world from its smallest and its largest measured batch.

    Raises:
        ValueError: it was not measured.
    """
    rows = [row for row in measured_rows("vector") if row["case"] == name and row["refused"] is None]
    if not rows:
        known = sorted({row["case"] for row in measured_rows("vector")})
        raise ValueError(f"world={name!r} was not measured; use one of {', '.join(known)}, scaled to the particles")
    small, large = min(rows, key=lambda row: row["num_envs"]), max(rows, key=lambda row: row["num_envs"])
    ms, count = large["ms_per_step"] - small["ms_per_step"], large["num_envs"] - small["num_envs"]
    return World(
        name=name,
        particles=large["particles"],
        substeps=large["substeps"],
        latency_ms=small["ms_per_step"] - ms / count * small["num_envs"],
        us_per_env=1e3 * ms / count,
        mb_per_env=large["mb_per_env"],
        mb_of_process=large["mb_of_the_device"] - large["num_envs"] * large["mb_per_env"],
    )


def drawing_us(size: int) -> float:
    """Return the time of a picture of ``size`` x ``size`` pixels in a large batch, from two measured sizes [us]."""
    rows = [row for row in measured_rows("pixels") if row["case"] == "PIAvatar/Reach-v0" and row["refused"] is None]
    most = max(row["num_envs"] for row in rows)
    rows = [row for row in rows if row["num_envs"] == most]
    pixels = [row["size"] ** 2 for row in rows]
    slope, fixed = np.polyfit(pixels, [1e3 * row["drawing_ms"] / most for row in rows], 1)
    return float(fixed + slope * size**2)


def learner_us() -> float:
    """Return the time that PPO takes for an environment step in one epoch of a rollout [us].

    It is what a training run took beyond its simulation, for networks of 512, 256 and 128 units.
    """
    run = json.loads((RESULTS / TRAINING / "results.json").read_text(encoding="utf-8"))
    steps, batch = run["train_steps"], run["num_envs"]
    simulated = measured_world(run["config"]["env_id"]).ms_per_step(batch) * 1e-3 * steps / batch
    return 1e6 * (run["training_s"] - simulated) / (steps * run["config"]["ppo"]["epochs"])


def network_parameters(inputs: int, outputs: int, hidden: Sequence[int]) -> int:
    """Return the weights and biases of an actor and a critic with the same hidden layers."""

    def layers(last: int) -> int:
        sizes = [inputs, *hidden, last]
        return sum((a + 1) * b for a, b in pairwise(sizes))

    return layers(outputs) + layers(1)


def gradient_bytes(parameters: int, gpus: int) -> float:
    """Return what each GPU sends to average a gradient in single precision over all, in a ring [bytes].

    Patarasuk & Yuan, "Bandwidth optimal all-reduce algorithms for clusters of workstations" (2009).
    """
    return 2.0 * (gpus - 1) / gpus * 4.0 * parameters


@dataclass(frozen=True)
class Plan:
    """Training by data-parallel PPO: an equal share of the environments, and a copy of the networks, on each GPU."""

    #: world, as benchmarks.speed.vector measured it
    world: str = "PIAvatar/Reach-v0"
    #: environments of all GPUs
    num_envs: int = 1_000_000
    #: one process each
    gpus: int = 64
    #: particles of an environment, if not those that were measured
    particles: int | None = None
    #: substeps of a control step, likewise
    substeps: int | None = None
    #: width and height of the picture that each environment draws in a step; 0 for none
    pictures: int = 0
    #: control steps of a rollout
    rollout_steps: int = 12
    #: epochs over a rollout
    epochs: int = 8
    #: gradients of an epoch
    minibatches: int = 4
    #: numbers that the networks read
    observations: int = 128
    #: numbers that the actor writes
    actions: int = 27
    #: hidden layers of both networks
    hidden: tuple[int, ...] = (512, 256, 128)
    #: bandwidth between GPUs in one direction [GB/s]; 50 is one port of 400 Gbit/s a GPU
    bandwidth: float = 50.0
    #: time of a message between neighbours in the ring [us]
    message_us: float = 10.0

    def predict(self) -> dict[str, float]:
        """Return times, rates, memory and traffic by name.

        Raises:
            ValueError: a count is not positive, or the world was not measured.
        """
        if min(self.num_envs, self.gpus, self.rollout_steps, self.epochs, self.minibatches) < 1:
            raise ValueError(f"num_envs={self.num_envs}, gpus={self.gpus} and the counts of PPO must be positive")
        world = measured_world(self.world)
        world = world.scaled(self.particles or world.particles, self.substeps or world.substeps)
        share = math.ceil(self.num_envs / self.gpus)
        step = world.ms_per_step(share)
        drawing = 1e-3 * drawing_us(self.pictures) * share if self.pictures else 0.0
        gradients = self.epochs * self.minibatches / self.rollout_steps  # of a control step
        sent = gradient_bytes(network_parameters(self.observations, self.actions, self.hidden), self.gpus)
        hops = 2 * (self.gpus - 1)
        network = gradients * (1e3 * sent / (1e9 * self.bandwidth) + 1e-3 * hops * self.message_us)
        learner = 1e-3 * learner_us() * self.epochs * share
        whole = step + drawing + learner + network
        return {
            "envs_per_gpu": share,
            "particles": float(world.particles) * self.num_envs,
            "simulation_ms": step,
            "drawing_ms": drawing,
            "learner_ms": learner,
            "network_ms": network,
            "env_steps_per_s_simulated": 1e3 * self.num_envs / (step + drawing),
            "env_steps_per_s_trained": 1e3 * self.num_envs / whole,
            "efficiency": (whole - network) / whole,
            "gb_per_gpu": 1e-3 * (world.mb_of_process + world.mb_per_env * share),
            "sent_mb_per_step": 1e-6 * gradients * sent,
            "ns_per_particle_substep": world.ns_per_particle_substep,
        }


def main(args: Sequence[str] | None = None) -> None:
    """Print a prediction, a line a number."""
    plan = tyro.cli(Plan, args=args, description=__doc__)
    try:
        found = plan.predict()
    except ValueError as error:
        sys.exit(f"model: {error}")
    for name, value in found.items():
        print(f"{name:28s} {value:,.4g}" if value < 1e4 else f"{name:28s} {value:,.0f}")


if __name__ == "__main__":
    main()
