"""Avatars of every source under random actions, in batches: nothing fails, and every number is finite.

``python -m benchmarks.physics.sources --avatars body.npz hero.glb scan.ply --out FILE.json`` reads each file by the
source that its ending names; ``person.ply#gaussian`` names the source, and ``embedded`` needs no file. A row per avatar
and world has the failures by name, the episodes that ended otherwise, and the environment steps after which anything of
the state, the observation or the reward was not finite. In games all avatars are of that source.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from benchmarks import runner
from benchmarks.speed.vector import make_task
from piavatar_envs.api.host import EpisodeHost
from piavatar_envs.avatar.body.sources import source_of
from piavatar_envs.mpm.types import FAILURE_NAMES

WORLDS = ("PIAvatar/Reach-v0", "PIAvatar/KickBall-v0", "sumo_v0")


@dataclass(frozen=True)
class Options(runner.Options):
    """Options of the run over sources."""

    #: files, each with ``#SOURCE`` if its ending does not say how it is read; ``embedded`` is the package's own body
    avatars: tuple[str, ...] = ("embedded",)
    #: ids of environments, or modules of piavatar_envs.multi
    worlds: tuple[str, ...] = WORLDS
    #: settings besides, such as avatar.height=1.75
    settings: tuple[str, ...] = ()
    #: environments
    num_envs: int = 64
    #: control steps
    steps: int = 60
    #: resolution of the bodies
    fidelity: Literal["tiny", "coarse", "medium", "fine"] = "coarse"


def cases(options: Options) -> Iterator[dict[str, Any]]:
    """Yield a row for each avatar and world."""
    every = [(avatar, world) for avatar in options.avatars for world in options.worlds]
    for avatar, world in runner.progress(every, "sources"):
        source, chosen = settings_of(avatar)
        task = make_task(world, options.fidelity, (*chosen, *options.settings))
        start = time.perf_counter()
        host = EpisodeHost(task, options.num_envs, options.device, num_threads=1)
        built = time.perf_counter() - start
        name = Path(avatar.partition("#")[0]).name
        yield {"case": f"{name} {world}", "source": source, "world": world, "build_s": built} | run(host, options.steps)


def settings_of(avatar: str) -> tuple[str, tuple[str, ...]]:
    """Return the source of an avatar, and the settings that choose it."""
    path, _, source = avatar.partition("#")
    if path == "embedded":
        return path, ("avatar.source=embedded",)
    source = source or source_of(path)
    return source, (f"avatar.source={source}", f"avatar.path={path}")


def run(host: EpisodeHost, steps: int) -> dict[str, Any]:
    """Step all environments under actions uniform in the action space, and return what went wrong.

    Raises:
        AssertionError: an observation is not in the observation space.
    """
    rng, space = np.random.default_rng(0), host.observation_space()
    host.reset([*range(host.num_envs)])
    failures: Counter[str] = Counter()
    nonfinite, ended = 0, 0
    start = time.perf_counter()
    for _ in range(steps):
        action = rng.uniform(-1.0, 1.0, (host.num_envs, host.num_agents, host.action_size)).astype(np.float32)
        host.step(action)
        observation, bits = host.observation(), host.status(0)["failure"]
        finite = np.isfinite(observation).all(axis=(1, 2)) & np.isfinite(host.reward()).all(axis=1)
        states = [group.simulation.state.numpy() for group in host.groups]
        for name in states[0]:
            values = np.concatenate([state[name] for state in states])
            finite &= np.isfinite(values.reshape(host.num_envs, -1)).all(axis=1)
        nonfinite += int((~finite).sum())
        for seen in observation.reshape(-1, observation.shape[-1]):
            assert space.contains(seen), "an observation is not in the observation space"
        failures.update({name: int(((bits & bit) != 0).sum()) for bit, name in FAILURE_NAMES.items()})
        ended += int((host.find_ended() & (bits == 0)).sum())
        host.reset_ended()
    simulation = host.groups[0].simulation
    return {
        "num_envs": host.num_envs,
        "steps": steps,
        "agents": host.num_agents,
        "particles": simulation.model.num_particles,
        "substeps": simulation.model.num_substeps,
        "failures": {name: count for name, count in failures.items() if count},
        "nonfinite": nonfinite,
        "ended": ended,
        "step_s": time.perf_counter() - start,
    }


if __name__ == "__main__":
    runner.main("sources", cases, Options)
