"""A fixed sequence of kernel launches, replayed as one captured graph, on a GPU and on a CPU alike.

Nothing is allocated, decided or synchronised when a graph runs, so a step costs its kernels and little more. (On a
CPU the graph saves some 5 us a launch, a tenth of a step at the default resolution.)

Kernels that are not in Warp's cache are compiled before a graph runs first. That takes seconds a module, and a world
has dozens: :func:`compile_graphs` gives one to every core.

How many cores there are to share.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from itertools import groupby, zip_longest
from typing import Any, TypeVar

import warp as wp

T = TypeVar("T")


@dataclass(frozen=True)
class Launch:
    """A launch that a graph will make; as for ``wp.launch``."""

    kernel: wp.Kernel
    dim: int | Sequence[int]
    inputs: list[Any]
    outputs: list[Any]
    block_dim: int
    fork: int = 0  # of the graph's forks, from 1 on; 0 if it is in none
    branch: int = 0  # of that fork

    def recorded(self, device: wp.Device) -> Callable[[], None]:
        """What makes the launch; the kernel is compiled if it is not."""
        arguments = {"inputs": self.inputs, "outputs": self.outputs, "block_dim": self.block_dim}
        return wp.launch(self.kernel, self.dim, **arguments, device=device, record_cmd=True).launch


class LaunchGraph:
    """Collects launches with :meth:`launch`, then replays them with :meth:`run`.

    Arrays are bound when a launch is recorded: write new values into them, never replace them.
    """

    def __init__(self, device: str | wp.Device, condition: wp.array | None = None) -> None:
        """Begin without launches.

        Args:
            device: where to run.
            condition: shape ``(1,)`` int32 on that device. Where it is 0 when the graph begins to run, its launches
                are not needed, and left out if graphs can branch there, which CUDA's can since 12.4. The host reads it
                only for :meth:`run_eager`; :meth:`timed` does not ask for it.

        Raises:
            ValueError: a condition of another shape or type.
        """
        if condition is not None and (condition.shape != (1,) or condition.dtype is not wp.int32):
            raise ValueError(f"a condition of shape {condition.shape} and type {condition.dtype}; use (1,) int32")
        self.device = wp.get_device(device)
        self._condition = condition
        self._launches: list[Launch] = []
        self._recorded: list[Callable[[], None]] = []  # of the first of these
        self._graph: Any = None
        self._streams: list[wp.Stream] = []  # of the branches of forks, one fork after the other

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

    def parallel(self, *branches: LaunchGraph) -> None:
        """Append what some graphs launch, beside each other; what is appended later waits for all of them.

        Where a GPU has no room for all of their threads, it takes those first whose launch could begin first. (Graphs
        that Warp captures have no priorities.) A CPU runs one graph after the other.

        Raises:
            RuntimeError: the graph has already run.
            ValueError: one of them has a fork or a condition, is on another device, is given twice, or is this graph.
        """
        if self._graph is not None:
            raise RuntimeError("cannot append a fork to a graph that has run; build a new one")
        if any(each._condition is not None or any(launch.fork for launch in each._launches) for each in branches):
            raise ValueError("a branch of a fork has a fork or a condition; append that to the graph itself")
        if len({id(each) for each in (self, *branches)}) <= len(branches) or any(
            each.device != self.device for each in branches
        ):
            raise ValueError(
                f"branches on {', '.join(str(each.device) for each in branches)} of a graph on {self.device}; "
                "give different ones on its device"
            )
        branches = tuple(each for each in branches if each)  # of an empty one there is nothing to wait for
        number = 1 + max((launch.fork for launch in self._launches), default=0) if len(branches) > 1 else 0
        for index, each in enumerate(branches):
            self._launches += [replace(launch, fork=number, branch=index) for launch in each._launches]

    def parallel_for_each(self, things: Iterable[T], record: Callable[[T, LaunchGraph], None]) -> None:
        """:meth:`fork` into what ``record`` appends for each of some ``things`` to a graph of its own."""
        self.parallel(*self.branches(things, record))

    def branches(self, things: Iterable[T], record: Callable[[T, LaunchGraph], None]) -> list[LaunchGraph]:
        """LaunchGraphs to :meth:`fork` into: what ``record`` appends for each of some ``things``."""
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
        """Whether it has run before: graphs are captured then, one at a time."""
        return self._graph is not None

    @property
    def names(self) -> list[str]:
        """Names of the kernels that are launched, in order."""
        return [launch.kernel.key for launch in self._launches]

    @property
    def launches(self) -> list[tuple[str, Callable[[], None]]]:
        """Every launch in order, the name of its kernel and what makes it; all are compiled."""
        self.compile()
        return list(zip(self.names, self._recorded, strict=True))

    @property
    def unbound(self) -> list[Launch]:
        """Launches whose kernels may not have been compiled yet."""
        return self._launches[len(self._recorded) :]

    def bind(self) -> None:
        """Bind the arguments of launches that are new."""
        self._recorded += [launch.recorded(self.device) for launch in self.unbound]

    def compile(self) -> None:
        """Compile what is launched, as :func:`compile_graphs`; the first run does, if nobody has before."""
        compile_graphs([self])

    def run_eager(self) -> None:
        """Launch one by one without a graph, to compare with :meth:`run`."""
        self.compile()
        with wp.ScopedDevice(self.device):
            self._launch_all()

    def timed(self, repeats: int = 1) -> dict[str, float]:
        """Seconds spent in each kernel over one run, by name (launches one by one, for profiling).

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
        """Launch one after the other, if the condition holds; into a graph, if one is being captured."""

        def launch_all() -> None:
            each = zip(self._launches, self._recorded, strict=True)
            for fork, launches in groupby(each, key=lambda pair: pair[0].fork):
                if fork == 0:
                    for _, launch in launches:
                        launch()
                else:
                    self._launch_fork(list(launches))

        if self._condition is None or not _can_branch(self._condition.device):
            launch_all()
        else:
            wp.capture_if(self._condition, launch_all)

    def _launch_fork(self, launches: list[tuple[Launch, Callable[[], None]]]) -> None:
        """Launch branches, on a GPU on streams; the last one on the graph's own."""
        branches = [list(each) for _, each in groupby(launches, key=lambda pair: pair[0].branch)]
        own = self._streams_for(len(branches) - 1)
        for stream in own:
            stream.wait_stream(self.device.stream)
        for branch, stream in zip_longest(branches, own):  # the last one has the graph's stream
            with wp.ScopedStream(stream, sync_enter=False):
                for _, launch in branch:
                    launch()
        for stream in own:
            self.device.stream.wait_stream(stream)

    def _streams_for(self, count: int) -> list[wp.Stream]:
        """That many streams; none on a CPU."""
        while self.device.is_cuda and len(self._streams) < count:
            self._streams.append(wp.Stream(self.device))
        return self._streams[:count]


def acquire(device: wp.Device) -> wp.Stream | None:
    """Have Warp begin with a device, before several threads come to it; returns a GPU's stream.

    The first to come to a GPU at the same time would each make its streams, and a process ends in a segmentation fault
    when those of the others are given back.
    """
    return device.stream if device.is_cuda else None


def compile_graphs(graphs: Iterable[LaunchGraph]) -> None:
    """Compile what graphs launch and is not in Warp's cache, modules side by side, then bind all arguments.

    Raises:
        Exception: a kernel that does not compile, or a launch with arguments that are not its kernel's, as Warp has it.
    """
    graphs = list(graphs)
    for graph in graphs:
        acquire(graph.device)
    with ThreadPoolExecutor(compiling_threads()) as pool:
        modules = {
            (new.kernel.module, each.device.alias, new.block_dim): None for each in graphs for new in each.unbound
        }
        loads = [pool.submit(wp.load_module, m, d, block_dim=dim, max_workers=0) for m, d, dim in modules]
        for load in loads:
            load.result()
    for graph in graphs:
        graph.bind()


def _can_branch(device: wp.Device) -> bool:
    """Whether graphs there have branches; CUDA's have them since 12.4."""
    return device.is_cpu or wp.is_conditional_graph_supported()


#: Modules that are compiled at the same time, at most: each takes some hundred megabytes.
MOST_AT_ONCE = 16


def available_cores() -> int:
    """Cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def compiling_threads() -> int:
    """Threads that compile kernels: one a core, at most ``MOST_AT_ONCE``."""
    return min(MOST_AT_ONCE, available_cores())
