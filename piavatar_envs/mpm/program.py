"""A fixed sequence of kernel launches, replayed as one captured graph, on a GPU and on a CPU alike.

Nothing is allocated, decided or synchronised when a program runs, so a step costs its kernels and little more. (On a
CPU the graph saves some 5 us a launch, a tenth of a step at the default resolution.)
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import warp as wp


class Program:
    """Collects launches with :meth:`launch`, then replays them with :meth:`run`.

    Arrays are bound when a launch is recorded: write new values into them, never replace them.
    """

    def __init__(self, device: str, condition: wp.array | None = None) -> None:
        """Begin without launches.

        Args:
            device: where to run.
            condition: shape ``(1,)`` int32 on that device. Where it is 0 when the program begins to run, its launches
                are not needed, and left out if graphs can branch there, which CUDA's can since 12.4. The host reads it
                only for :meth:`run_eager`; :meth:`timed` does not ask for it.

        Raises:
            ValueError: a condition of another shape or type.
        """
        if condition is not None and (condition.shape != (1,) or condition.dtype is not wp.int32):
            raise ValueError(f"a condition of shape {condition.shape} and type {condition.dtype}; use (1,) int32")
        self.device = wp.get_device(device)
        self._condition = condition
        self._launches: list[Callable[[], None]] = []
        self._names: list[str] = []
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
            RuntimeError: the program has already run.
        """
        if self._graph is not None:
            raise RuntimeError(f"cannot append {kernel.key} to a program that has run; build a new one")
        arguments = {"inputs": list(inputs), "outputs": list(outputs), "block_dim": block_dim}
        self._launches.append(wp.launch(kernel, dim, **arguments, device=self.device, record_cmd=True).launch)
        self._names.append(kernel.key)

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

    def run_eager(self) -> None:
        """Launch one by one without a graph, to compare with :meth:`run`."""
        with wp.ScopedDevice(self.device):
            self._launch_all()

    def timed(self, repeats: int = 1) -> dict[str, float]:
        """Seconds spent in each kernel over one run, by name (launches one by one, for profiling).

        The state advances by ``repeats`` runs.
        """
        import time

        seconds: dict[str, float] = dict.fromkeys(self._names, 0.0)
        with wp.ScopedDevice(self.device):
            for _ in range(repeats):
                for name, launch in zip(self._names, self._launches, strict=True):
                    wp.synchronize_device(self.device)
                    start = time.perf_counter()
                    launch()
                    wp.synchronize_device(self.device)
                    seconds[name] += (time.perf_counter() - start) / repeats
        return seconds

    def _capture(self) -> None:
        with wp.ScopedDevice(self.device), wp.ScopedCapture(self.device) as capture:
            self._launch_all()
        self._graph = capture.graph

    def _launch_all(self) -> None:
        """Launch one after the other, if the condition holds; into a graph, if one is being captured."""

        def launch_all() -> None:
            for launch in self._launches:
                launch()

        if self._condition is None or not _can_branch(self._condition.device):
            launch_all()
        else:
            wp.capture_if(self._condition, launch_all)


def _can_branch(device: wp.Device) -> bool:
    """Whether graphs there have branches; CUDA's have them since 12.4."""
    return device.is_cpu or wp.is_conditional_graph_supported()
