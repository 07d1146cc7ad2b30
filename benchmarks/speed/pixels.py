"""Pictures a second of environments that are observed as pixels, beside the simulation and by themselves.

``python -m benchmarks.speed.pixels --device cuda --out benchmarks/results/pixels.json``. Full-scale random actions are
written on the device, episodes that end begin anew, and nothing leaves the device. A row has four speeds:

- ``frames_per_s``: pictures that are observed in steps, new episodes included: what a learner gets;
- ``drawing_only``: pictures of a state that stands still, without the simulation;
- ``without_pixels``: environment steps of the same environments observed as vectors;
- ``with_autoreset``: as ``frames_per_s``, with all copies that a learner stores (``step_and_reset``, torch tensors).
"""

from __future__ import annotations

import gc
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from benchmarks import runner
from benchmarks.speed import timing
from benchmarks.speed.vector import Options as VectorOptions
from benchmarks.speed.vector import Stepper, Trainer, make_task, rates, torch_can_use
from piavatar_envs.api.host import EpisodeHost
from piavatar_envs.core.launch_graph import LaunchGraph

WORLDS = ("PIAvatar/Reach-v0", "PIAvatar/KickBall-v0")
SIZES, BATCHES_ON_GPU, BATCHES_ON_CPU = (64, 128), (256, 1024), (1,)


@dataclass(frozen=True)
class Options(VectorOptions):
    """Options of the benchmark of pictures."""

    #: worlds: ids of environments, or modules of piavatar_envs.multi
    worlds: tuple[str, ...] = WORLDS
    #: widths and heights of the pictures [pixel]
    sizes: tuple[int, ...] = SIZES
    #: numbers of environments; by default 256 and 1024 on a GPU and one on a CPU
    num_envs: tuple[int, ...] = ()


def cases(options: Options) -> Iterator[dict[str, Any]]:
    """Yield a row for each world, number of environments and size."""
    on_gpu = wp.get_device(options.device).is_cuda
    batches = options.num_envs or (BATCHES_ON_GPU if on_gpu else BATCHES_ON_CPU)
    for world in runner.progress(options.worlds, "pixels"):
        for num_envs in batches:
            plain = speed_without(world, num_envs, options)
            for size in options.sizes:
                row = {"case": world, "num_envs": num_envs, "size": size}
                yield row | measure(world, num_envs, size, options) | {"without_pixels": plain}


def build(world: str, num_envs: int, settings: list[str], options: Options) -> EpisodeHost:
    """Build environments and begin their first episodes."""
    api = "torch" if torch_can_use(options.device) else "numpy"
    task = make_task(world, options.fidelity, settings)
    batched = EpisodeHost(task, num_envs, options.device, api, num_threads=1)
    batched.reset([*range(num_envs)])
    return batched


def speed_without(world: str, num_envs: int, options: Options) -> float:
    """Measure environment steps per second without pictures."""
    gc.collect()  # what the batch before has left
    settings = [setting for setting in options.settings if not setting.startswith("pixels.")]
    (batch,) = build(world, num_envs, settings, options).groups
    return float(np.median(rates(Stepper(batch).step, num_envs, options)))


def measure(world: str, num_envs: int, size: int, options: Options) -> dict[str, Any]:
    """Measure one batch, or return the reason for its refusal."""
    gc.collect()  # what the batch before has left
    before = timing.array_bytes(options.device)
    settings = [*options.settings, "obs_mode=pixels", f"pixels.width={size}", f"pixels.height={size}"]
    try:
        batched = build(world, num_envs, settings, options)
        (batch,) = batched.groups
        found = rates(Stepper(batch).step, num_envs, options)
    except (ImportError, ValueError, RuntimeError, MemoryError) as refusal:
        return {"refused": str(refusal), "frames_per_s": None}
    used, speed = timing.array_bytes(options.device) - before, float(np.median(found))
    drawing = LaunchGraph(batch.device)
    batch.pixels.record(drawing)
    drawn = rates(drawing.run, num_envs, options)
    return {
        "refused": None,
        "frames_per_s": speed,
        "frames_per_s_range": [float(found.min()), float(found.max())],
        "ms_per_step": 1e3 * num_envs / speed,
        "drawing_only": float(np.median(drawn)),
        "drawing_ms": 1e3 * num_envs / float(np.median(drawn)),
        "with_autoreset": float(np.median(rates(Trainer(batched).step, num_envs, options))),
        "array_api": batched.api.name,
        "mb_per_env": used / num_envs / 1e6,
        "launches_of_drawing": len(drawing),
        "drawing_ms_by_kernel": {name: 1e3 * seconds for name, seconds in drawing.timed().items()},
    }


if __name__ == "__main__":
    runner.main("pixels", cases, Options)
