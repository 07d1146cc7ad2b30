"""Lock that lets several threads use environments, because Warp records one graph at a time in a process.

While a graph is captured on a CPU, Warp records what any thread launches or copies instead of doing it. Building
environments and first runs, which capture, therefore exclude everything else; later steps run side by side.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager


class CaptureLock:
    """Readers-writer lock; a thread that holds it exclusively may take it again in either way.

    A thread that shares it must not ask for it exclusively: two of them would wait for each other.
    """

    def __init__(self) -> None:
        """Make a lock that is free."""
        self.reset()

    def reset(self) -> None:
        """Forget all holders, as in a forked process, which has none of their threads."""
        self._changed = threading.Condition()
        self._sharing, self._owner, self._depth = 0, 0, 0

    @contextmanager
    def exclusive(self) -> Iterator[None]:
        """Hold the lock alone."""
        own = threading.get_ident()
        with self._changed:
            if self._owner != own:
                self._changed.wait_for(lambda: not self._owner and not self._sharing)
                self._owner = own
            self._depth += 1
        try:
            yield
        finally:
            with self._changed:
                self._depth -= 1
                if not self._depth:
                    self._owner = 0
                    self._changed.notify_all()

    @contextmanager
    def shared(self) -> Iterator[None]:
        """Hold the lock beside other threads that share it."""
        if self._owner == threading.get_ident():
            yield
            return
        with self._changed:
            self._changed.wait_for(lambda: not self._owner)
            self._sharing += 1
        try:
            yield
        finally:
            with self._changed:
                self._sharing -= 1
                if not self._sharing:
                    self._changed.notify_all()


#: The lock of this process.
CAPTURE = CaptureLock()
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=CAPTURE.reset)
