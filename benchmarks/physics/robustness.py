"""Random full-scale actions on every registered environment: nothing that is not finite, no failure flag.

A row per environment and seed: steps taken, episodes, failures by name, values that are not finite, and how far the
flesh was strained. ``python -m benchmarks.physics.robustness --out FILE.json`` takes 10,000 steps in all at the default
resolution; a seed that ends an episode (a fall, a strayed motion, the clock) goes on with its next.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass

import gymnasium
import numpy as np

from benchmarks import runner
from piavatar_envs.core.arrays import matrices_of
from piavatar_envs.mpm.types import failure_name
from piavatar_envs.tasks import task_modules


@dataclass(frozen=True)
class Options(runner.Options):
    """Options of the robustness run; the defaults are 20 seeds, 10,000 steps in all."""

    #: environment steps in all, spread evenly over environments and seeds
    steps: int = 10_000
    #: seeds per environment
    seeds: int = 20
    #: resolution of the body
    fidelity: str = "coarse"


def numbers(value: object) -> Iterator[float]:
    """Yield every number in the results of a step."""
    if isinstance(value, dict):
        for entry in value.values():
            yield from numbers(entry)
    else:
        yield from np.ravel(np.asarray(value, dtype=np.float64))


def run_seed(env: gymnasium.Env, seed: int, steps: int) -> dict:
    """Run one seed's steps under actions that are uniform in even episodes, and at the corners in odd ones."""
    rng = np.random.default_rng([seed, 1])
    ends: Counter[str] = Counter()
    failures: Counter[str] = Counter()
    nonfinite, strain, speed = 0, 0.0, 0.0
    observation, _ = env.reset(seed=seed)
    episodes = 1
    state = env.batch.simulation.state
    for _ in range(steps):
        action = rng.uniform(-1.0, 1.0, env.action_space.shape)
        if episodes % 2 == 0:
            action = np.sign(action)
        observation, reward, terminated, truncated, info = env.step(action.astype(np.float32))
        nonfinite += int(not np.isfinite(list(numbers([observation]))).all())
        nonfinite += int(not np.isfinite(list(numbers({"reward": reward, "info": info}))).all())
        if info["failure"]:
            failures[failure_name(info["failure"])] += 1
        stretch = np.linalg.norm(matrices_of(state.F)[0] - np.eye(3, dtype=np.float32), axis=(1, 2))
        strain = max(strain, float(stretch.max()))
        speed = max(speed, float(np.linalg.norm(state.u.numpy()[0], axis=1).max()))
        if terminated or truncated:
            ends["failure" if info["failure"] else "terminated" if terminated else "truncated"] += 1
            env.reset()
            episodes += 1
    return {
        "steps": steps,
        "episodes": episodes,
        "ends": dict(ends),
        "failures": dict(failures),
        "nonfinite": nonfinite,
        "peak_deformation": strain,
        "peak_physical_speed_m_per_s": speed,
    }


def cases(options: Options) -> Iterator[dict]:
    """Yield a row per environment and seed, and one that sums them up."""
    jobs = [(env_id, seed) for env_id in task_modules() for seed in range(options.seeds)]
    each, rest = divmod(options.steps, len(jobs))
    envs: dict[str, gymnasium.Env] = {}
    total: Counter[str] = Counter()
    for index, (env_id, seed) in enumerate(runner.progress(jobs, "seeds")):
        if env_id not in envs:
            envs[env_id] = gymnasium.make(env_id, device=options.device, fidelity=options.fidelity).unwrapped
        row = run_seed(envs[env_id], seed, each + (index < rest))
        total += Counter({key: row[key] for key in ("steps", "episodes", "nonfinite")})
        total["failures"] += sum(row["failures"].values())
        yield {"case": f"{env_id}, seed {seed}", "env_id": env_id, "seed": seed, **row}
    names = ("steps", "episodes", "failures", "nonfinite")
    yield {"case": "all", "env_ids": list(envs), "seeds": options.seeds, **{name: total[name] for name in names}}


if __name__ == "__main__":
    runner.main("robustness", cases, Options)
