"""Fingerprint the dynamics of every environment: did a change alter what happens?

``python -m benchmarks.baseline --out before.json``, the same command after the change, and
``python -m benchmarks.baseline --compare before.json after.json`` names each case whose hashes differ. Every id and
every game runs under each control mode and resolution for a few steps of seeded random actions. A row has the SHA-256
of all observations and of the final state, and the median time of a step.

The hash of a state covers the bytes, shape and type of its arrays, but neither their names nor the settings that it
carries: renaming a setting or an array changes nothing that happens. Equal hashes are expected on one kind of
processor; another processor or compiler may round differently.
"""

from __future__ import annotations

import hashlib
import json
import sys
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from benchmarks import runner
from piavatar_envs.multi import listed_games, load_game
from piavatar_envs.tasks import task_modules

#: Seed of the environments and of the actions.
SEED = 7


@dataclass(frozen=True)
class Options(runner.Options):
    """Options of the fingerprint."""

    #: ids and names of games; all of them if not given
    envs: tuple[str, ...] = ()
    #: control modes
    control: tuple[str, ...] = ("pose", "pd", "torque")
    #: resolutions of the bodies
    fidelity: tuple[str, ...] = ("tiny", "coarse")
    #: control steps of a case
    steps: int = 20
    #: environments of a case; more than one for single-agent ids only, which then run as a vector environment
    num_envs: int = 1


def cases(options: Options) -> Iterator[dict[str, Any]]:
    """Yield a row for each environment, control mode and resolution; refused combinations say why."""
    games = listed_games() if options.num_envs == 1 else ()
    names = options.envs or (*task_modules(), *games)
    every = [(n, c, f) for f in options.fidelity for n in names for c in options.control]
    for name, control, fidelity in runner.progress(every, "baseline"):
        row = {"case": f"{name} {control} {fidelity}", "num_envs": options.num_envs}
        try:
            env = _make(name, options, control=control, fidelity=fidelity)
        except ValueError as error:  # a task may not support a control mode
            yield row | {"refused": f"{type(error).__name__}: {error}"}
            continue
        try:
            yield row | {"refused": None} | fingerprint(env, options.steps)
        finally:
            env.close()


def _make(name: str, options: Options, **settings: Any) -> Any:
    if "/" not in name:
        return load_game(name).parallel_env(device=options.device, **settings)
    if options.num_envs == 1:
        return gym.make(name, device=options.device, disable_env_checker=True, **settings).unwrapped
    return gym.make_vec(name, num_envs=options.num_envs, device=options.device, **settings).unwrapped


def fingerprint(env: Any, steps: int) -> dict[str, Any]:
    """Run ``steps`` seeded random actions and return both hashes and the median time of a step [ms].

    Args:
        env: a Gymnasium environment, single or vector, or a PettingZoo parallel environment.
        steps: control steps; a single environment that ends begins its next episode.
    """
    random = np.random.default_rng(SEED)
    seen, seconds = hashlib.sha256(), []
    observation, _ = env.reset(seed=SEED)
    _add(seen, observation)
    for _ in range(steps):
        action = _actions(env, random)
        start = time.perf_counter()
        observation, reward, terminated, truncated, _ = env.step(action)
        seconds.append(time.perf_counter() - start)
        for value in (observation, reward, terminated, truncated):
            _add(seen, value)
        if _over(env, terminated, truncated):
            observation, _ = env.reset()
            _add(seen, observation)
    return {
        "observations": seen.hexdigest(),
        "state": hash_state(env.get_state()),
        "ms_per_step": round(1e3 * float(np.median(seconds)), 3),
    }


def _actions(env: Any, random: np.random.Generator) -> Any:
    if hasattr(env, "possible_agents"):
        return {agent: _uniform(env.action_space(agent), random) for agent in env.agents}
    return _uniform(env.action_space, random)


def _uniform(space: gym.spaces.Box, random: np.random.Generator) -> np.ndarray:
    return random.uniform(-1.0, 1.0, space.shape).astype(np.float32)


def _over(env: Any, terminated: Any, truncated: Any) -> bool:
    if hasattr(env, "possible_agents"):
        return not env.agents
    return not hasattr(env, "num_envs") and bool(terminated or truncated)  # a vector environment resets by itself


def _add(digest: Any, value: Any) -> None:
    """Add the bytes of an observation, a reward or a flag, or of a dictionary of them, in the order of its keys."""
    if isinstance(value, Mapping):
        for key in sorted(value):
            digest.update(str(key).encode())
            _add(digest, value[key])
    else:
        digest.update(np.ascontiguousarray(value).tobytes())


def hash_state(state: Mapping[str, np.ndarray]) -> str:
    """Return the SHA-256 of a state's numbers, whatever their names: of the sorted hashes of its arrays."""
    hashes = []
    for name, array in state.items():
        if name == "env.settings":
            continue
        array = np.ascontiguousarray(array)
        hashes.append(hashlib.sha256(f"{array.dtype} {array.shape}".encode() + array.tobytes()).hexdigest())
    return hashlib.sha256("".join(sorted(hashes)).encode()).hexdigest()


def compare(before: Path, after: Path) -> int:
    """Print every case whose hashes differ or that only one file has; return their number."""
    old, new = ({row["case"]: row for row in json.loads(path.read_text())["results"]} for path in (before, after))
    keys = ("observations", "state")
    differing = 0
    for case in sorted({*old, *new}):
        if case not in old or case not in new:
            print(f"{case}: only in {before if case in old else after}")
            differing += 1
            continue
        # the words of a refusal may change, not that there is one
        unlike = [key for key in keys if old[case].get(key) != new[case].get(key)]
        if unlike:
            print(f"{case}: {' and '.join(unlike)} differ")
            differing += 1
    times = [new[case]["ms_per_step"] / old[case]["ms_per_step"] for case in old if "ms_per_step" in new.get(case, {})]
    ratio = f"; a step takes {float(np.median(times)):.3f} of the time (median)" if times else ""
    print(f"{differing} of {len({*old, *new})} cases differ{ratio}")
    return differing


if __name__ == "__main__":
    if sys.argv[1:2] == ["--compare"]:
        if len(sys.argv) != 4:
            sys.exit("usage: python -m benchmarks.baseline --compare BEFORE.json AFTER.json")
        sys.exit(bool(compare(Path(sys.argv[2]), Path(sys.argv[3]))))
    runner.main("baseline", cases, Options)
