"""Environment steps per second and memory of an environment, for batches of one to thousands.

``python -m benchmarks.speed.vector --device cuda --out benchmarks/results/vector.json``. Full-scale random actions are
written on the device; episodes that end begin anew. A row has three speeds:

- ``env_steps_per_s``: actions, step, and new episodes where one has ended, all on the device (``BatchEnv``);
- ``step_only``: actions and step; what has ended goes on as it is;
- ``with_autoreset``: what a trainer sees (``step_and_reset``, SAME_STEP): actions of its own, copies of observations,
  terminal observations, rewards, flags and infos. Torch tensors on the device, or, where torch cannot use it, NumPy
  arrays on the host (``array_api``).
"""

from __future__ import annotations

import gc
import importlib
import importlib.util
import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import warp as wp

from benchmarks import runner
from benchmarks.speed import timing
from piavatar_envs.api.host import EpisodeHost
from piavatar_envs.config import load_config, parse_assignments
from piavatar_envs.core.launch_graph import LaunchGraph, available_cores
from piavatar_envs.envs.batch_env import BatchEnv
from piavatar_envs.envs.task import Task
from piavatar_envs.tasks import load_task

wp.set_module_options({"enable_backward": False})

WORLDS = ("PIAvatar/Reach-v0", "PIAvatar/KickBall-v0", "sumo_v0")
BATCHES_ON_GPU = (1, 4, 16, 64, 256, 1024, 2048, 4096, 8192)
BATCHES_ON_CPU = (1, 4, 16)
WARM_UP = 3  # steps before a measurement
LEAST_STEPS, MOST_STEPS = 3, 2000  # of one measurement


@dataclass(frozen=True)
class Options(runner.Options):
    """Options of the benchmark of batches."""

    #: worlds: ids of environments, or modules of piavatar_envs.multi
    worlds: tuple[str, ...] = WORLDS
    #: numbers of environments; by default up to 8192 on a GPU and up to 16 on a CPU
    num_envs: tuple[int, ...] = ()
    #: resolution of the bodies
    fidelity: str = "coarse"
    #: least time of one measurement [s]
    seconds: float = 0.5
    #: measurements of each speed; the row has their median
    repeats: int = 5
    #: further settings of the environments, such as control.resistance=joints
    settings: tuple[str, ...] = ()


def cases(options: Options) -> Iterator[dict[str, Any]]:
    """Yield a row for each world and number of environments; on a CPU one more about threads."""
    on_gpu = wp.get_device(options.device).is_cuda
    batches = options.num_envs or (BATCHES_ON_GPU if on_gpu else BATCHES_ON_CPU)
    for world in runner.progress(options.worlds, "vector"):
        for num_envs in batches:
            row = {"case": world, "num_envs": num_envs} | measure(world, num_envs, options)
            yield row
            if row["refused"]:
                break  # a larger batch would be refused, too
    if not on_gpu:
        yield scaling(options.worlds[0], max(batches), options)


def make_task(world: str, fidelity: str, settings: Sequence[str] = ()) -> Task:
    """Build the task of a world at a resolution, with settings such as ``control.bone_contact=false``.

    Raises:
        ValueError: there is no such world or setting.
    """
    if "/" in world:
        task = load_task(world)
    else:
        task = importlib.import_module(f"piavatar_envs.multi.{world}").TASK
    return task(load_config(task.Config, None, {"fidelity": fidelity, **parse_assignments(settings)}))


class Stepper:
    """Batch under random actions, everything on the device.

    Attributes:
        batch: what is stepped.
        failed: episodes that ended in a failure, shape ``(1,)`` int32 on the device.
    """

    def __init__(self, batch: BatchEnv) -> None:
        self.batch = batch
        device = batch.simulation.device
        self.failed, self._clock = wp.zeros(1, dtype=int, device=device), wp.zeros(1, dtype=int, device=device)
        self._note, self._act = LaunchGraph(device), LaunchGraph(device)
        self._note.launch(count_failures, batch.num_envs, [batch.mask, batch.failure], [self.failed])
        for graph in (self._note, self._act):
            graph.launch(draw_actions, batch.action.shape, [self._clock], [batch.action])
            graph.launch(advance_clock, 1, [], [self._clock])

    def step(self) -> None:
        """Begin new episodes where one has ended, and take a control step under random actions."""
        self.batch.find_ended()
        self._note.run()
        self.batch.reset_masked()
        self.batch.step()

    def step_only(self) -> None:
        """Take one control step under random actions, without resets."""
        self._act.run()
        self.batch.step()


class Trainer:
    """Batch as a trainer steps it: its own actions in, copies out, SAME_STEP."""

    def __init__(self, batched: EpisodeHost) -> None:
        self.batched = batched
        shape = (batched.num_envs, batched.num_agents, batched.action_size)
        if batched.api.name == "torch":
            import torch

            device = wp.device_to_torch(batched.device)
            self._draw: Callable[[], Any] = lambda: 2.0 * torch.rand(shape, device=device) - 1.0
        else:
            rng = np.random.default_rng(0)
            self._draw = lambda: rng.uniform(-1.0, 1.0, shape).astype(np.float32)

    def step(self) -> None:
        """Take one step, copy everything that a learner stores, and begin new episodes where one has ended."""
        self.batched.step_and_reset(self._draw())


def rates(step: Callable[[], None], num_envs: int, options: Options) -> np.ndarray:
    """Measure environment steps per second in each repeat; shape ``(repeats,)``."""
    device = options.device
    timing.wall_times(device, step, WARM_UP)  # captures the graphs, compiles what there is
    once = float(np.median(timing.wall_times(device, step, WARM_UP)))
    steps = int(np.clip(np.ceil(options.seconds / once), LEAST_STEPS, MOST_STEPS))

    def many() -> None:
        for _ in range(steps):
            step()

    return num_envs * steps / timing.wall_times(device, many, options.repeats)


def torch_can_use(device: str) -> bool:
    """Return whether torch can use the device; on a CPU NumPy serves as well."""
    if not wp.get_device(device).is_cuda or importlib.util.find_spec("torch") is None:
        return False
    import torch

    return torch.cuda.is_available()


def measure(world: str, num_envs: int, options: Options) -> dict[str, Any]:
    """Measure speeds and memory of one batch, or return the reason for its refusal."""
    gc.collect()  # what the batch before has left
    before = timing.array_bytes(options.device)
    api = "torch" if torch_can_use(options.device) else "numpy"
    try:
        task = make_task(world, options.fidelity, options.settings)
        batched = EpisodeHost(task, num_envs, options.device, api, num_threads=1)
        batched.reset([*range(num_envs)])
        (batch,) = batched.groups
        stepper = Stepper(batch)
        found = rates(stepper.step, num_envs, options)
    except (ImportError, ValueError, RuntimeError, MemoryError) as refusal:
        return {"refused": str(refusal), "env_steps_per_s": None, "particle_substeps_per_s": None, "mb_per_env": None}
    memory, failed = timing.array_bytes(options.device) - before, int(stepper.failed.numpy()[0])
    model, speed = batch.simulation.model, float(np.median(found))
    used = timing.device_bytes(options.device)
    return {
        "refused": None,
        "env_steps_per_s": speed,
        "env_steps_per_s_range": [float(found.min()), float(found.max())],
        "particle_substeps_per_s": speed * model.num_particles * model.num_substeps,
        "mb_per_env": memory / num_envs / 1e6,
        "mb_of_the_device": None if used is None else used / 1e6,
        "ms_per_step": 1e3 * num_envs / speed,
        "step_only": float(np.median(rates(stepper.step_only, num_envs, options))),
        "with_autoreset": float(np.median(rates(Trainer(batched).step, num_envs, options))),
        "array_api": api,
        "agents": batch.num_agents,
        "particles": model.num_particles,
        "substeps": model.num_substeps,
        "cfl": model.sound_speed * model.step.dt / model.grid.dx,
        "launches_per_step": len(batch.step_graph),
        "failed_envs": failed,
    }


def scaling(world: str, num_envs: int, options: Options) -> dict[str, Any]:
    """Measure the speed-up of two threads over one, in turns, so that a slower minute of the machine hits both."""

    def batch(threads: int) -> EpisodeHost:
        task = make_task(world, options.fidelity, options.settings)
        return EpisodeHost(task, num_envs, options.device, "numpy", threads)

    trainers = {threads: Trainer(batch(threads)) for threads in (1, 2)}
    for trainer in trainers.values():
        trainer.batched.reset([*range(num_envs)])
    once = replace(options, repeats=1)
    turns = [[rates(trainer.step, num_envs, once)[0] for trainer in trainers.values()] for _ in range(options.repeats)]
    for trainer in trainers.values():
        trainer.batched.close()
    one, two = np.array(turns).T
    return {
        "case": "cpu_scaling",
        "world": world,
        "num_envs": num_envs,
        "cores": available_cores(),
        "env_steps_per_s": float(np.median(two)),
        "env_steps_per_s_one_thread": float(np.median(one)),
        "speed_up": float(np.median(two / one)),
        "speed_up_range": [float((two / one).min()), float((two / one).max())],
        "load_average": os.getloadavg()[0] if hasattr(os, "getloadavg") else None,
    }


@wp.kernel
def draw_actions(clock: wp.array(dtype=int), action: wp.array3d(dtype=float)):
    """Draw actions uniform in [-1, 1], different at every reading of the clock."""
    e, agent, n = wp.tid()
    seed = int(wp.rand_init(clock[0], e))
    state = wp.rand_init(seed, agent * action.shape[2] + n)
    action[e, agent, n] = 2.0 * wp.randf(state) - 1.0


@wp.kernel
def advance_clock(clock: wp.array(dtype=int)):
    """Advance the clock."""
    clock[0] = clock[0] + 1


@wp.kernel
def count_failures(ended: wp.array(dtype=wp.bool), failure: wp.array(dtype=int), failed: wp.array(dtype=int)):
    """Add the episodes that a failure has ended."""
    e = wp.tid()
    if ended[e] and failure[e] != 0:
        wp.atomic_add(failed, 0, 1)


if __name__ == "__main__":
    runner.main("vector", cases, Options)
