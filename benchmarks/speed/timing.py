"""Clocks and memory of a device: graphs as a whole, their kernels one by one, bytes in use."""

from __future__ import annotations

import gc
import re
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import warp as wp

from piavatar_envs.core.launch_graph import LaunchGraph

wp.set_module_options({"enable_backward": False})

#: Warp's, at the end of a kernel's name.
HASH = re.compile(r"_[0-9a-f]{8}$")


@dataclass(frozen=True)
class KernelTime:
    """Time of a kernel in one run of a graph.

    Attributes:
        ms: time on the device in all of its launches [ms].
        launches: their number; None where only the sum is known.
    """

    ms: float
    launches: int | None


def wall_times(device: str, action: Callable[[], object], repeats: int) -> np.ndarray:
    """Return seconds of each of ``repeats`` calls, the device idle before and after; shape ``(repeats,)``."""
    seconds = np.empty(repeats)
    for index in range(repeats):
        wp.synchronize_device(device)
        start = time.perf_counter()
        action()
        wp.synchronize_device(device)
        seconds[index] = time.perf_counter() - start
    return seconds


def kernel_times(graph: LaunchGraph, repeats: int = 1) -> dict[str, KernelTime]:
    """Measure each kernel in one run, launched one by one; the state advances by ``repeats`` runs.

    On a GPU the times come from events around each launch. What events around a kernel that does nothing measure is
    taken off, so launches and the gaps between kernels are not in these times. On a CPU they are times of the calls,
    the median of the runs, because one thread that is interrupted says nothing about a kernel; elsewhere the mean.
    """
    device = graph.device
    if not device.is_cuda:
        runs = [graph.timed() for _ in range(repeats)]
        return {name: KernelTime(1e3 * float(np.median([run[name] for run in runs])), None) for name in runs[0]}
    nothing = LaunchGraph(device.alias)
    for _ in range(200):
        nothing.launch(do_nothing, 1, [], [])
    nothing.compile()  # outside of what is timed
    floor = float(np.median(_launch_times(nothing)["do_nothing"]))
    events: dict[str, list[float]] = {}
    for _ in range(repeats):
        for name, launches in _launch_times(graph).items():
            events.setdefault(name, []).extend(launches)
    return {
        name: KernelTime(float(np.maximum(np.array(ms) - floor, 0.0).sum()) / repeats, len(ms) // repeats)
        for name, ms in events.items()
    }


def _launch_times(graph: LaunchGraph) -> dict[str, list[float]]:
    """Return milliseconds of every launch of a run on a GPU, in sequence, by kernel, whatever the conditions are."""
    launches = graph.launches
    wp.timing_begin(wp.TIMING_ALL)
    with wp.ScopedDevice(graph.device):
        for _, launch in launches:  # not beside each other, as in forks
            launch()
    found: dict[str, list[float]] = {}
    for result in wp.timing_end():
        name = result.name.removeprefix("forward kernel ").removeprefix("builtin kernel ")
        found.setdefault(HASH.sub("", name), []).append(result.elapsed)
    return found


def array_bytes(device: str) -> int:
    """Return bytes in use: on a GPU those of Warp's memory pool, on a CPU those of the Warp arrays that are alive."""
    target = wp.get_device(device)
    gc.collect()  # else what is garbage now and gone later would count against what is measured in between
    if not target.is_cuda:
        own = (item for item in gc.get_objects() if type(item) is wp.array)  # not fixed arrays in kernels
        return sum(array.capacity for array in own if array.device == target and array.deleter is not None)
    wp.synchronize_device(target)  # the pool counts freed memory only once the device has reached the call
    if target.is_mempool_enabled:
        return int(wp.get_mempool_used_mem_current(target))
    return target.total_memory - target.free_memory


def device_bytes(device: str) -> int | None:
    """Return the bytes of a GPU that are not free, as ``nvidia-smi`` counts; None on a CPU."""
    target = wp.get_device(device)
    return target.total_memory - target.free_memory if target.is_cuda else None


def resident_bytes() -> int:
    """Return the resident memory of this process.

    Raises:
        RuntimeError: the system has no /proc.
    """
    try:
        status = Path("/proc/self/status").read_text(encoding="utf-8")
    except OSError:
        raise RuntimeError("resident memory is read from /proc, which this system does not have; use Linux") from None
    (kilobytes,) = (line.split()[1] for line in status.splitlines() if line.startswith("VmRSS:"))
    return 1024 * int(kilobytes)


@wp.kernel
def do_nothing():
    """Do nothing, to measure the overhead of a launch."""
