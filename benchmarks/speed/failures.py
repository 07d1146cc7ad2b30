"""Failures in a long run under the harshest actions: of each id and control mode, how many, and how much was limited.

``python -m benchmarks.speed.failures --device cuda --out benchmarks/results/failures.json``: every action component is
-1 or 1 and held for some control steps; episodes that end begin anew, and nothing is read back before the end. A row
has the failures by name, and the matter whose motion was limited to a grid spacing a substep
(``info["limited_share"]``).
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import warp as wp

from benchmarks import runner
from benchmarks.speed.vector import advance_clock, make_task
from piavatar_envs.core.launch_graph import LaunchGraph
from piavatar_envs.envs.batch_env import BatchEnv
from piavatar_envs.mpm.types import FAILURE_NAMES
from piavatar_envs.multi import listed_games
from piavatar_envs.tasks import task_modules

wp.set_module_options({"enable_backward": False})


@dataclass(frozen=True)
class Options(runner.Options):
    """Options of the count of failures."""

    #: ids of environments, or modules of piavatar_envs.multi; all of them if not given
    worlds: tuple[str, ...] = ()
    #: control modes
    control: tuple[str, ...] = ("pose", "pd", "torque")
    #: settings besides, such as self_contact=true
    settings: tuple[str, ...] = ()
    #: environment steps of each case
    env_steps: int = 1_000_000
    #: environments
    num_envs: int = 2048
    #: control steps for which an action is held
    hold: int = 4
    #: resolution of the bodies
    fidelity: str = "coarse"


def cases(options: Options) -> Iterator[dict[str, Any]]:
    """Yield a row for each world and control mode."""
    every = [(w, c) for w in options.worlds or (*task_modules(), *listed_games()) for c in options.control]
    for world, control in runner.progress(every, "failures"):
        row = {"case": f"{world} {control}", "settings": list(options.settings)}
        try:
            task = make_task(world, options.fidelity, (f"control.mode={control}", *options.settings))
            batch = BatchEnv(task, options.num_envs, options.device)
        except (ValueError, MemoryError) as refusal:  # a task may not support a control mode
            yield row | {"refused": str(refusal)}
            continue
        yield row | {"refused": None} | run(batch, -(-options.env_steps // options.num_envs), options.hold)


def run(batch: BatchEnv, steps: int, hold: int) -> dict[str, Any]:
    """Step a batch under actions of -1 and 1 that change every ``hold`` steps, and return what has failed.

    Limited motion is counted in environment steps with any, and as share of the mass: mean over all steps, and most.
    """
    n, device = batch.num_envs, batch.device
    clock, failed = wp.zeros(1, dtype=int, device=device), wp.zeros(len(FAILURE_NAMES) + 1, dtype=int, device=device)
    limited = wp.zeros(n, dtype=wp.vec3, device=device)
    act, count = LaunchGraph(device), LaunchGraph(device)
    act.launch(draw_held_actions, batch.action.shape, [clock, hold], [batch.action])
    act.launch(advance_clock, 1, [], [clock])
    count.launch(count_step, n, [batch.failure, batch.simulation.sensors.limited], [failed, limited])
    batch.reset()
    start = time.perf_counter()
    for _ in range(steps):
        batch.find_ended()
        batch.reset_masked()
        act.run()
        batch.step()
        count.run()
    (*found, episodes), by_env = failed.numpy().tolist(), limited.numpy().astype(float)
    seconds = time.perf_counter() - start
    return {
        "env_steps": n * steps,
        "failures": {name: int(k) for name, k in zip(FAILURE_NAMES.values(), found, strict=True)},
        "failures_per_million": 1e6 * episodes / (n * steps),
        "limited_steps": int(by_env[:, 0].sum()),
        "limited_share_mean": float(by_env[:, 1].sum() / (n * steps)),
        "limited_share_max": float(by_env[:, 2].max()),
        "env_steps_per_s": n * steps / seconds,
        "num_substeps": batch.simulation.model.num_substeps,
    }


@wp.kernel
def draw_held_actions(clock: wp.array(dtype=int), hold: int, action: wp.array3d(dtype=float)):
    """Set every action component to -1 or 1, anew after ``hold`` readings of the clock."""
    e, agent, n = wp.tid()
    state = wp.rand_init(int(wp.rand_init(clock[0] // hold, e)), agent * action.shape[2] + n)
    action[e, agent, n] = wp.where(wp.randf(state) < 0.5, -1.0, 1.0)


@wp.kernel
def count_step(
    failure: wp.array(dtype=int),
    share: wp.array(dtype=float),
    # in and out
    failed: wp.array(dtype=int),
    limited: wp.array(dtype=wp.vec3),
):
    """Count failures by bit and, last, episodes with any; of each environment limited steps, sum and most of shares."""
    e = wp.tid()
    last = failed.shape[0] - 1
    for bit in range(last):
        if ((failure[e] >> bit) & 1) != 0:
            wp.atomic_add(failed, bit, 1)
    if failure[e] != 0:
        wp.atomic_add(failed, last, 1)
    so_far = limited[e]
    steps = so_far[0] + wp.where(share[e] > 0.0, 1.0, 0.0)
    limited[e] = wp.vec3(steps, so_far[1] + share[e], wp.max(so_far[2], share[e]))


if __name__ == "__main__":
    runner.main("failures", cases, Options)
