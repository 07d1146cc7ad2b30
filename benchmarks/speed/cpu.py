"""Cost of a step on one CPU core: the suite's tasks beside Gymnasium's ``Humanoid-v5`` in the same run.

``python -m benchmarks.speed.cpu --out benchmarks/results/cpu.json``. Every measurement runs in a process of its own,
pinned to one core, so that peak memory is that of one environment; the cases take turns, so that a slower minute of the
machine hits all of them.
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

import piavatar_envs  # noqa: F401 - registers the ids
from benchmarks import runner

#: Environments measured, with the steps of one repeat: about a second and a half each.
ENVIRONMENTS: dict[str, int] = {"PIAvatar/Reach-v0": 60, "PIAvatar/TrackMotion-v0": 60, "Humanoid-v5": 3000}
EXPECTED_STEPS, EXPECTED_MICROSECONDS = 50.0, 0.35  # of Reach, on one core
WARM_UP = 5
CONTINUUM = ("p2g", "update_grid", "g2p")  # kernels of an MPM substep
ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


@dataclass(frozen=True)
class Options(runner.Options):
    """Options of the CPU benchmark."""

    #: how often the cases take turns
    rounds: int = 3
    #: repeats of each case in a round
    repeats: int = 5
    #: core to run on; the highest-numbered one that this process may use if not given
    core: int | None = None
    #: a minute's smoke run
    quick: bool = False


def cases(options: Options) -> Iterator[dict[str, Any]]:
    """Yield a row for every environment, and one for the time of each of Reach's stages.

    Raises:
        ValueError: the device is not the CPU.
    """
    if options.device != "cpu":
        raise ValueError(f"device={options.device!r}: this benchmark measures one CPU core; leave --device out")
    rounds, repeats = (1, 2) if options.quick else (options.rounds, options.repeats)
    core = options.core if options.core is not None else _last_core()
    jobs = [("warm-up", name) for name in ENVIRONMENTS] + [("run", name) for name in list(ENVIRONMENTS) * rounds]
    found: dict[str, list[dict[str, Any]]] = {name: [] for name in ENVIRONMENTS}
    for kind, name in runner.progress(jobs, "cpu"):
        # the warm-up compiles the kernels: neither its time nor its memory counts
        steps = ENVIRONMENTS[name] if kind == "run" and not options.quick else 10
        result = _in_own_process(measure, name, steps, repeats if kind == "run" else 1, core)
        if kind == "run":
            found[name].append(result)
    for name, results in found.items():
        yield summarize(name, results, core)
    yield from _in_own_process(stages, "PIAvatar/Reach-v0", 10 if options.quick else 60, core)


def summarize(name: str, results: list[dict[str, Any]], core: int | None) -> dict[str, Any]:
    """Sum up the rounds of a case in a row: medians, quartiles and ends of the sample."""
    rates = np.concatenate([result["env_steps_per_s"] for result in results])
    cpu_rates = np.concatenate([result["env_steps_per_cpu_s"] for result in results])
    particles, substeps = results[0]["particles"], results[0]["substeps"]
    rate = float(np.median(rates))
    work = particles * substeps if particles else None
    row: dict[str, Any] = {
        "case": name,
        "env_steps_per_s": rate,
        "us_per_particle_substep": 1e6 / (rate * work) if work else None,
        "particles": particles,
        "substeps": substeps,
        "peak_memory_mb": float(np.median([result["peak_memory_mb"] for result in results])),
        "env_steps_per_s_quartiles": np.percentile(rates, [25, 75]).tolist(),
        "env_steps_per_s_range": [float(rates.min()), float(rates.max())],
        # of the core's time that the process was given: what a core kept busy by others would do if it were free
        "env_steps_per_cpu_s": float(np.median(cpu_rates)),
        "measurements": len(rates),
        "cfl": results[0]["cfl"],
        "imports_mb": float(np.median([result["imports_mb"] for result in results])),
        "core": core,
        "load_average": [result["load_average"] for result in results],
    }
    if name == "PIAvatar/Reach-v0":
        row["expected"] = {
            "env_steps_per_s": EXPECTED_STEPS,
            "us_per_particle_substep": EXPECTED_MICROSECONDS,
        }
    return row


def measure(name: str, steps: int, repeats: int, core: int | None) -> dict[str, Any]:
    """Measure environment steps per second under full-scale random actions, through ``gym.make``."""
    pin(core)
    prepare(name)
    imports = peak_memory_mb()
    env = gym.make(name)
    env.reset(seed=0)
    env.action_space.seed(0)
    actions = [env.action_space.sample() for _ in range(steps)]
    for action in actions[:WARM_UP]:
        step(env, action)
    rates, cpu_rates = [], []
    for _ in range(repeats):
        start, cpu_start = time.perf_counter(), time.process_time()
        for action in actions:
            step(env, action)
        rates.append(steps / (time.perf_counter() - start))
        cpu_rates.append(steps / max(1e-9, time.process_time() - cpu_start))
    result = {
        "env_steps_per_s": rates,
        "env_steps_per_cpu_s": cpu_rates,
        "peak_memory_mb": peak_memory_mb(),
        "imports_mb": imports,
        "load_average": os.getloadavg()[0] if hasattr(os, "getloadavg") else None,
        **size(env),
    }
    env.close()
    return result


def stages(name: str, steps: int, core: int | None) -> list[dict[str, Any]]:
    """Return rows of the time of each kernel in one step of an environment."""
    pin(core)
    prepare(name)
    env = gym.make(name)
    env.reset(seed=0)
    env.action_space.seed(0)
    batch = env.unwrapped.batch
    seconds: dict[str, list[float]] = {}
    for _ in range(steps):
        batch.action.assign(env.action_space.sample().reshape(1, 1, -1))
        for kernel, time_taken in batch.step_graph.timed().items():
            seconds.setdefault(kernel, []).append(time_taken)
        if batch.terminated.numpy()[0] or batch.truncated.numpy()[0]:
            env.reset()
    milliseconds = {kernel: 1e3 * float(np.median(times)) for kernel, times in seconds.items()}
    ordered = dict(sorted(milliseconds.items(), key=lambda item: -item[1]))
    known = size(env)
    material = sum(value for kernel, value in ordered.items() if kernel in ("p2g", "update_grid", "g2p"))
    work = known["particles"] * known["substeps"]
    total = sum(ordered.values())
    env.close()
    return [
        {
            "case": f"{name}: stages of a step",
            "env_steps_per_s": None,
            "us_per_particle_substep": 1e3 * total / work,
            "us_per_particle_substep_of_the_continuum": 1e3 * material / work,
            "particles": known["particles"],
            "substeps": known["substeps"],
            "peak_memory_mb": None,
            "stages_ms": ordered,
            "launches": len(batch.step_graph),
        }
    ]


def prepare(name: str) -> None:
    """Import the libraries of an environment, so that their memory is counted apart."""
    if name.startswith("PIAvatar/"):
        import warp as wp

        import piavatar_envs.api.gym_env  # noqa: F401

        wp.config.quiet = True
    else:
        import gymnasium.envs.mujoco  # noqa: F401


def step(env: Any, action: np.ndarray) -> None:
    """Take one step; an episode that ends begins anew."""
    _, _, terminated, truncated, _ = env.step(action)
    if terminated or truncated:
        env.reset()


def size(env: Any) -> dict[str, Any]:
    """Return particles, substeps and Courant number of one of the suite's environments; None for others."""
    batch = getattr(env.unwrapped, "batch", None)
    if batch is None:
        return {"particles": None, "substeps": None, "cfl": None}
    model = batch.simulation.model
    return {
        "particles": model.num_particles,
        "substeps": model.num_substeps,
        "cfl": model.sound_speed * model.step.dt / model.grid.dx,
    }


def pin(core: int | None) -> None:
    """Keep this process on one core, where the system allows it."""
    if core is not None and hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {core})


def peak_memory_mb() -> float | None:
    """Return the largest resident memory of this process so far [MB]; None where it is unknown."""
    try:
        status = Path("/proc/self/status").read_text()
    except OSError:
        return _peak_memory_by_getrusage()
    # not ru_maxrss, which on Linux a new process inherits from the one that started it
    (kilobytes,) = (line.split()[1] for line in status.splitlines() if line.startswith("VmHWM:"))
    return int(kilobytes) * 1024 / 1e6


def _peak_memory_by_getrusage() -> float | None:
    try:
        import resource
    except ImportError:
        return None
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / 1e6 if sys.platform == "darwin" else peak * 1024 / 1e6


def _last_core() -> int | None:
    return max(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else None


def _in_own_process(function: Any, *arguments: Any) -> Any:
    """Call a function in a fresh process with one thread for every library."""
    before = {name: os.environ.get(name) for name in ONE_THREAD}
    os.environ.update(dict.fromkeys(ONE_THREAD, "1"))
    try:
        with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
            return pool.submit(function, *arguments).result()
    finally:
        for name, value in before.items():
            os.environ.pop(name) if value is None else os.environ.update({name: value})


if __name__ == "__main__":
    runner.main("cpu", cases, Options)
