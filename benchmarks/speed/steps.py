"""Time of a control step and of a substep as users reach them: ``gym.make``, ``gym.make_vec`` and PettingZoo.

``python -m benchmarks.speed.steps --device cuda --out benchmarks/results/steps.json``. One avatar is ``Reach``, several
are ``sumo_v0`` with as many agents. A step includes everything that a call of ``step`` does: actions in, control,
contact and sensors in every substep, observations out. Each row is measured in a process of its own, so that its memory
and the time of its first environment are its own; with ``--cold`` that process starts with an empty kernel cache.
"""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from typing import Any

import gymnasium as gym
import numpy as np
import warp as wp

import piavatar_envs  # noqa: F401 - registers the ids
from benchmarks import runner
from benchmarks.speed import timing
from benchmarks.speed.vector import torch_can_use
from piavatar_envs.doctor import quiet_warp
from piavatar_envs.envs.batch_env import BatchEnv
from piavatar_envs.multi import sumo_v0

#: World of one avatar.
ONE_AVATAR = "PIAvatar/Reach-v0"


@dataclass(frozen=True)
class Options(runner.Options):
    """Options of the benchmark of steps."""

    #: resolutions of the bodies; by default coarse, medium and, on a GPU, fine
    fidelity: tuple[str, ...] = ()
    #: avatars in an environment
    avatars: tuple[int, ...] = (1, 4)
    #: environments stepped together; more than one only with one avatar
    num_envs: tuple[int, ...] = (1,)
    #: control steps of one measurement
    steps: int = 30
    #: measurements; the row has their median
    repeats: int = 5
    #: start every row with an empty kernel cache, so that the first environment compiles all of its kernels
    cold: bool = False
    #: a smoke run: tiny bodies and few steps
    small: bool = False


def cases(options: Options) -> Iterator[dict[str, Any]]:
    """Yield a row for each fidelity, number of avatars and number of environments."""
    usual = ("coarse", "medium", "fine") if wp.get_device(options.device).is_cuda else ("coarse", "medium")
    fidelities = ("tiny",) if options.small else options.fidelity or usual
    steps, repeats = (3, 2) if options.small else (options.steps, options.repeats)
    jobs = [
        (fidelity, avatars, num_envs)
        for fidelity in fidelities
        for avatars in options.avatars
        for num_envs in options.num_envs
        if avatars == 1 or num_envs == 1
    ]
    for fidelity, avatars, num_envs in runner.progress(jobs, "steps"):
        row = {
            "case": f"{fidelity}, {avatars} avatar{'s' * (avatars > 1)}",
            "num_envs": num_envs,
            "fidelity": fidelity,
            "avatars": avatars,
            "kernel_cache": "empty" if options.cold else "as found",
        }
        yield row | _in_own_process(options.cold, fidelity, avatars, num_envs, options.device, steps, repeats)


def _in_own_process(cold: bool, *arguments: Any) -> dict[str, Any]:
    """Call :func:`measure` in a fresh process, if ``cold`` with a kernel cache that is empty and is removed."""
    with tempfile.TemporaryDirectory(prefix="kernels_") as empty:
        before = os.environ.get("WARP_CACHE_PATH")
        if cold:
            os.environ["WARP_CACHE_PATH"] = empty
        try:
            with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
                return pool.submit(measure, *arguments).result()
        finally:
            if cold:
                os.environ.pop("WARP_CACHE_PATH")
                if before is not None:
                    os.environ["WARP_CACHE_PATH"] = before


def measure(fidelity: str, avatars: int, num_envs: int, device: str, steps: int, repeats: int) -> dict[str, Any]:
    """Make the environment and step it.

    Returns:
        ``first_make_s`` (up to the end of a first step, with compiling or loading of kernels), ``ms_per_step``,
        ``ms_per_substep`` and its range, ``env_steps_per_s``, sizes, and memory: of the arrays, of the device, and of
        the process.
    """
    quiet_warp()
    wp.init()
    free, arrays = timing.device_bytes(device), timing.array_bytes(device)
    start = time.perf_counter()
    world = World(fidelity, avatars, num_envs, device)
    world.reset()
    world.step()
    wp.synchronize_device(device)
    first = time.perf_counter() - start
    seconds, failed = [], 0

    def play() -> None:
        for _ in range(steps):
            world.step()

    for _ in range(repeats):
        world.reset()
        world.step()
        seconds.append(timing.wall_times(device, play, 1)[0])
        failed += sum(int((batch.failure.numpy() != 0).sum()) for batch in world.groups)
    model = world.groups[0].simulation.model
    ms = 1e3 * np.array(seconds) / steps
    in_use = timing.device_bytes(device)
    row = {
        "through": world.through,
        "particles": model.num_particles,
        "substeps": model.num_substeps,
        "grid_spacing_m": model.grid.dx,
        "ms_per_step": float(np.median(ms)),
        "ms_per_substep": float(np.median(ms)) / model.num_substeps,
        "ms_per_substep_range": [float(ms.min()) / model.num_substeps, float(ms.max()) / model.num_substeps],
        "env_steps_per_s": 1e3 * num_envs / float(np.median(ms)),
        "first_make_s": first,
        "arrays_mb": (timing.array_bytes(device) - arrays) / 1e6,
        "device_mb": None if in_use is None else (in_use - free) / 1e6,
        "process_mb": timing.resident_bytes() / 1e6,
        "failed_envs": failed,
    }
    world.close()
    return row


class World:
    """One environment or a batch of them, under random actions, through the API that users call.

    Attributes:
        through: name of that API.
        groups: the batches behind it, one for each thread on a CPU.
    """

    def __init__(self, fidelity: str, avatars: int, num_envs: int, device: str) -> None:
        """Make the environment; several avatars are agents of one ``sumo_v0``."""
        rng = np.random.default_rng(0)
        if avatars > 1:
            self.through = "sumo_v0.parallel_env"
            self.env: Any = sumo_v0.parallel_env(num_agents=avatars, fidelity=fidelity, device=device)
            self.groups: list[BatchEnv] = [self.env.batch]
            size = self.env.action_space(self.env.possible_agents[0]).shape

            def draw() -> Any:
                return {name: rng.uniform(-1.0, 1.0, size).astype(np.float32) for name in self.env.agents}

        elif num_envs == 1:
            self.through = "gym.make"
            self.env = gym.make(ONE_AVATAR, fidelity=fidelity, device=device, disable_env_checker=True)
            self.groups = [self.env.unwrapped.batch]
            size = self.env.action_space.shape

            def draw() -> Any:
                return rng.uniform(-1.0, 1.0, size).astype(np.float32)

        else:
            api = "torch" if torch_can_use(device) else "numpy"
            self.through = f"gym.make_vec, {api}"
            self.env = gym.make_vec(ONE_AVATAR, num_envs=num_envs, fidelity=fidelity, device=device, array_api=api)
            self.groups = list(self.env.unwrapped.host.groups)
            size = self.env.action_space.shape

            def draw() -> Any:
                action = rng.uniform(-1.0, 1.0, size).astype(np.float32)
                if api == "numpy":
                    return action
                import torch

                return torch.as_tensor(action, device=wp.device_to_torch(wp.get_device(device)))

        self._draw: Callable[[], Any] = draw
        self._several = avatars > 1

    def reset(self) -> None:
        """Begin an episode."""
        self.env.reset(seed=0)

    def step(self) -> None:
        """Take one control step; an episode of several avatars that is over begins anew."""
        if self._several and not self.env.agents:
            self.reset()
        self.env.step(self._draw())

    def close(self) -> None:
        """Free the environment."""
        self.env.close()
        del self.env, self.groups


if __name__ == "__main__":
    runner.main("steps", cases, Options)
