"""Launch graph: a fixed sequence of kernel launches, replayed as one captured CUDA graph, or as one call on a CPU.

Nothing is allocated, decided or synchronised while a graph runs, so a step costs its kernels and little more.

Kernels missing from Warp's cache are compiled before the first run. That takes seconds a module, and a world has
dozens of modules: :func:`compile_graphs` compiles them in parallel, one per core.
"""

from __future__ import annotations

import multiprocessing
import os
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, as_completed
from dataclasses import dataclass, replace
from functools import partial
from itertools import groupby, zip_longest
from typing import Any, TypeVar

import warp as wp

from piavatar_envs.core.kernel_cache import load_module

T = TypeVar("T")
#: Most modules compiled at the same time: each takes some hundred megabytes.
MAX_COMPILING_THREADS = 16


@dataclass(frozen=True)
class Launch:
    """A recorded launch, with the arguments of ``wp.launch``."""

    kernel: wp.Kernel
    dim: int | Sequence[int]
    inputs: list[Any]
    outputs: list[Any]
    block_dim: int
    section: int = 0  # index of the parallel section, from 1 on; 0 for launches in sequence
    branch: int = 0  # index of the branch within its section

    @property
    def name(self) -> str:
        """Name of the kernel."""
        return self.kernel.key

    def recorded(self, device: wp.Device) -> Callable[[], None]:
        """Return a callable that makes the launch; compiles the kernel if needed."""
        arguments: dict[str, Any] = {"inputs": self.inputs, "outputs": self.outputs, "block_dim": self.block_dim}
        return wp.launch(self.kernel, self.dim, **arguments, device=device, record_cmd=True).launch


@dataclass(frozen=True)
class PairSort:
    """A recorded stable sort of the first ``count`` pairs of two arrays by the lowest bits of their keys."""

    keys: wp.array
    values: wp.array
    count: int
    bits: int
    section: int = 0
    branch: int = 0

    @property
    def name(self) -> str:
        """Name beside those of kernels."""
        return "sort_pairs"

    def recorded(self, device: wp.Device) -> Callable[[], None]:
        """Return a callable that sorts."""
        return partial(wp.utils.radix_sort_pairs, self.keys, self.values, self.count, 0, self.bits)


class LaunchGraph:
    """Collects launches with :meth:`launch`, then replays them with :meth:`run`.

    Arrays are bound when a launch is recorded: write new values into them, never replace them.
    """

    def __init__(self, device: str | wp.Device, condition: wp.array | None = None) -> None:
        """Create an empty graph.

        Args:
            device: device to run on.
            condition: int32 array of shape ``(1,)`` on that device. If it is 0 when the graph begins to run, its
                launches are skipped where graphs support conditions (CUDA 12.4 and later, and CPUs).
                :meth:`run_eager` reads it on the host; :meth:`timed` ignores it.

        Raises:
            ValueError: the condition has another shape or type.
        """
        if condition is not None and (condition.shape != (1,) or condition.dtype is not wp.int32):
            raise ValueError(f"a condition of shape {condition.shape} and type {condition.dtype}; use (1,) int32")
        self.device = wp.get_device(device)
        self._condition = condition
        self._launches: list[Launch | PairSort] = []
        self._recorded: list[Callable[[], None]] = []  # bound launches, the first of these
        self._graph: Any = None

    def launch(
        self,
        kernel: wp.Kernel,
        dim: int | Sequence[int],
        inputs: Sequence[Any],
        outputs: Sequence[Any] = (),
        block_dim: int = 256,
    ) -> None:
        """Append a launch. Arguments as for ``wp.launch``.

        Raises:
            RuntimeError: the graph has already run.
        """
        if self._graph is not None:
            raise RuntimeError(f"cannot append {kernel.key} to a graph that has run; build a new one")
        self._launches.append(Launch(kernel, dim, list(inputs), list(outputs), block_dim))

    def sort_pairs(self, keys: wp.array, values: wp.array, count: int, bits: int) -> None:
        """Append a stable sort, in place, of the first ``count`` values by the lowest ``bits`` of their keys.

        Args:
            keys: uint32, ``2 count`` of them; the second half is a workspace.
            values: int32, likewise.
            count: number of pairs.
            bits: of a key that count, 32 at most.

        Raises:
            RuntimeError: the graph has already run.
            ValueError: an array is too short or of another type.
        """
        if self._graph is not None:
            raise RuntimeError("cannot append sort_pairs to a graph that has run; build a new one")
        for name, array, dtype in (("keys", keys, wp.uint32), ("values", values, wp.int32)):
            if array.dtype is not dtype or array.size < 2 * count:
                given = f"{array.dtype.__name__} of shape {array.shape}"
                raise ValueError(f"{name} {given}; give {2 * count} {dtype.__name__}")
        self._launches.append(PairSort(keys, values, count, bits))

    def parallel(self, *branches: LaunchGraph) -> None:
        """Append graphs as parallel branches; launches appended later wait for all of them.

        A GPU that has no room for all threads starts the launches that became ready first (captured graphs have no
        priorities). A CPU runs one branch after another.

        Raises:
            RuntimeError: the graph has already run.
            ValueError: a branch has parallel branches or a condition itself, is on another device, is given twice, or
                is this graph.
        """
        if self._graph is not None:
            raise RuntimeError("cannot append branches to a graph that has run; build a new one")
        if any(each._condition is not None or any(launch.section for launch in each._launches) for each in branches):
            raise ValueError("a parallel branch has branches or a condition itself; append it to the graph in sequence")
        if len({id(each) for each in (self, *branches)}) <= len(branches) or any(
            each.device != self.device for each in branches
        ):
            raise ValueError(
                f"branches on {', '.join(str(each.device) for each in branches)} of a graph on {self.device}; "
                "give different ones on its device"
            )
        branches = tuple(each for each in branches if each)
        section = 1 + max((launch.section for launch in self._launches), default=0) if len(branches) > 1 else 0
        for index, each in enumerate(branches):
            self._launches += [replace(launch, section=section, branch=index) for launch in each._launches]

    def parallel_for_each(self, things: Iterable[T], record: Callable[[T, LaunchGraph], None]) -> None:
        """Append as parallel branches what ``record`` appends for each of ``things`` to a graph of its own."""
        self.parallel(*self.branches(things, record))

    def branches(self, things: Iterable[T], record: Callable[[T, LaunchGraph], None]) -> list[LaunchGraph]:
        """Return a graph for each of ``things``, filled by ``record``, to pass to :meth:`parallel`."""
        graphs = []
        for each in things:
            graphs.append(LaunchGraph(self.device))
            record(each, graphs[-1])
        return graphs

    def __len__(self) -> int:
        return len(self._launches)

    def run(self) -> None:
        """Replay every launch in order."""
        if self._graph is None:
            self._capture()
        wp.capture_launch(self._graph)

    @property
    def is_captured(self) -> bool:
        """Whether the graph has run, and therefore is captured and closed to new launches."""
        return self._graph is not None

    @property
    def names(self) -> list[str]:
        """Names of the launches, in order: of their kernels, or ``sort_pairs``."""
        return [launch.name for launch in self._launches]

    @property
    def launches(self) -> list[tuple[str, Callable[[], None]]]:
        """Name and callable of every launch, in order; compiles all kernels."""
        self.compile()
        return list(zip(self.names, self._recorded, strict=True))

    @property
    def unbound(self) -> list[Launch | PairSort]:
        """Launches appended since the last :meth:`bind`, whose kernels may not be compiled yet."""
        return self._launches[len(self._recorded) :]

    def bind(self) -> None:
        """Bind the arguments of :attr:`unbound` launches."""
        self._recorded += [launch.recorded(self.device) for launch in self.unbound]

    def compile(self) -> None:
        """Compile the kernels of this graph; the first run does so otherwise."""
        compile_graphs([self])

    def run_eager(self) -> None:
        """Launch one kernel after another without a captured graph, to compare with :meth:`run`."""
        self.compile()
        with wp.ScopedDevice(self.device):
            self._launch_all()

    def timed(self, repeats: int = 1) -> dict[str, float]:
        """Return the seconds spent in each kernel over one run, by name; launches one by one, for profiling.

        The state advances by ``repeats`` runs.
        """
        import time

        launches = self.launches
        seconds: dict[str, float] = dict.fromkeys(self.names, 0.0)
        with wp.ScopedDevice(self.device):
            for _ in range(repeats):
                for name, launch in launches:
                    wp.synchronize_device(self.device)
                    start = time.perf_counter()
                    launch()
                    wp.synchronize_device(self.device)
                    seconds[name] += (time.perf_counter() - start) / repeats
        return seconds

    def _capture(self) -> None:
        self.compile()
        with wp.ScopedDevice(self.device), wp.ScopedCapture(self.device) as capture:
            self._launch_all()
        self._graph = capture.graph

    def _launch_all(self) -> None:
        """Launch everything in order, subject to the condition; into a graph if one is being captured."""

        def launch_all() -> None:
            each = zip(self._launches, self._recorded, strict=True)
            for section, launches in groupby(each, key=lambda pair: pair[0].section):
                if section == 0:
                    for _, launch in launches:
                        launch()
                else:
                    self._launch_section(list(launches))

        if self._condition is None or not _can_branch(self._condition.device):
            launch_all()
        else:
            wp.capture_if(self._condition, launch_all)

    def _launch_section(self, launches: list[tuple[Launch | PairSort, Callable[[], None]]]) -> None:
        """Launch parallel branches, on a GPU on streams of their own, the last one on the graph's stream."""
        branches = [list(each) for _, each in groupby(launches, key=lambda pair: pair[0].branch)]
        own = _branch_streams(self.device, len(branches) - 1)
        for stream in own:
            stream.wait_stream(self.device.stream)
        for branch, stream in zip_longest(branches, own):  # no stream is left for the last one: it has the graph's
            with wp.ScopedStream(stream, sync_enter=False):
                for _, launch in branch:
                    launch()
        for stream in own:
            self.device.stream.wait_stream(stream)


#: Streams on which parallel branches are captured, by alias of the device. They live as long as the process, because
#: Warp's list of streams has no lock: a thread that destroys one can make another thread's capture fail.
_STREAMS: dict[str, list[wp.Stream]] = {}


def _branch_streams(device: wp.Device, count: int) -> list[wp.Stream]:
    """Return ``count`` streams that all graphs of a device share; none on a CPU."""
    streams = _STREAMS.setdefault(device.alias, [])
    while device.is_cuda and len(streams) < count:
        streams.append(wp.Stream(device))
    return streams[:count]


def acquire(device: wp.Device) -> wp.Stream | None:
    """Initialise a device before several threads use it; returns a GPU's stream.

    Threads that initialise a GPU at the same time create its streams more than once, and the process crashes when the
    surplus ones are destroyed.
    """
    return device.stream if device.is_cuda else None


def compile_graphs(graphs: Iterable[LaunchGraph]) -> None:
    """Compile what the graphs launch and Warp's cache lacks, modules in parallel, then bind all arguments.

    Raises:
        KernelCacheError: Warp's cache cannot be written.
        Exception: a kernel does not compile, or a launch has arguments of the wrong types, as Warp reports it.
    """
    graphs = list(graphs)
    for graph in graphs:
        acquire(graph.device)
    launches = [(each, new) for each in graphs for new in each.unbound if isinstance(new, Launch)]
    modules = {(new.kernel.module, each.device.alias, new.block_dim): None for each, new in launches}
    pool = ThreadPoolExecutor(compiling_threads())
    try:
        loads = [pool.submit(load_module, module, wp.get_device(d), dim) for module, d, dim in modules]
        for load in _shown(loads):
            load.result()
    finally:
        pool.shutdown(cancel_futures=True)  # after an error, or Ctrl-C, modules that wait are not compiled
    for graph in graphs:
        graph.bind()


def _shown(loads: Sequence[Future]) -> Iterator[Future]:
    """Yield the loads as they end, beside a bar where they take longer than a second; in the first process only."""
    from tqdm import tqdm

    a_terminal = sys.stderr is not None and sys.stderr.isatty()
    yield from tqdm(
        as_completed(loads),
        "kernels, compiled once",
        len(loads),
        unit="module",
        delay=1.0,
        mininterval=0.1 if a_terminal else 1.0,
        disable=multiprocessing.parent_process() is not None,
    )


def _can_branch(device: wp.Device | None) -> bool:
    """Return whether captured graphs support conditions on the device."""
    return (device is not None and device.is_cpu) or wp.is_conditional_graph_supported()


def available_cores() -> int:
    """Return the number of cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def compiling_threads() -> int:
    """Return the number of threads that compile kernels: one per core, at most :data:`MAX_COMPILING_THREADS`."""
    return min(MAX_COMPILING_THREADS, available_cores())
