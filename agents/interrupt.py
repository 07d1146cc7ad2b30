"""Ctrl-C in training runs: the first one ends a training run where it can be resumed, the second one at once."""

from __future__ import annotations

import os
import shlex
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from agents.ranks import Ranks  # which needs torch

_NOTICE = b"\nstopping after this rollout, so that the run can be resumed; Ctrl-C again stops it at once\n"


class StopRequest:
    """Request to end a training run, made by Ctrl-C while :meth:`listening`.

    Attributes:
        made: whether there was one in this process.
        reached: how far the training had got when it ended.
    """

    def __init__(self, ranks: Ranks | None = None) -> None:
        """Begin without a request.

        Args:
            ranks: processes that end together; None for one alone.
        """
        self.made, self.reached, self._ranks = False, "", ranks

    def asked(self) -> bool:
        """Return whether any rank has had a request; to be called on all of them."""
        return self.made if self._ranks is None else self._ranks.any(self.made)

    @contextmanager
    def listening(self) -> Iterator[None]:
        """Take Ctrl-C as the request for the duration; the second one raises KeyboardInterrupt.

        Signals reach the main thread only: in other threads this does nothing.
        """
        if threading.current_thread() is not threading.main_thread():
            yield
            return

        def request(number: int, frame: Any) -> None:
            if self.made:
                signal.default_int_handler(number, frame)
            self.made = True
            if self._ranks is None or self._ranks.first:
                os.write(2, _NOTICE)  # a signal may interrupt a print, which cannot be entered again

        before = signal.signal(signal.SIGINT, request)
        try:
            yield
        finally:
            signal.signal(signal.SIGINT, before)

    def obey(self, reached: str) -> None:
        """End the training if there was a request; call it where no work is lost, and on all ranks.

        Args:
            reached: what the training has had.

        Raises:
            KeyboardInterrupt: there was one.
        """
        if self.asked():
            self.reached = reached
            raise KeyboardInterrupt


@contextmanager
def ended_by_interrupt(remedy: Callable[[], str], silent: bool = False) -> Iterator[None]:
    """End the script by Ctrl-C with one line and exit status 130, instead of a traceback.

    Args:
        remedy: returns the rest of the line: what was reached, and how to go on.
        silent: leave the line to another rank.

    Raises:
        SystemExit: Ctrl-C.
    """
    try:
        yield
    except KeyboardInterrupt:
        if not silent:
            print(f"\ninterrupted {remedy()}", file=sys.stderr)  # a bar may have the line before
        raise SystemExit(128 + signal.SIGINT) from None


def command(script: str, args: Sequence[str] | None, *more: str, ranks: Ranks | None = None) -> str:
    """Return the command line of a script as it was given, plus options that it lacks.

    Args:
        script: its name, without ``agents.``.
        args: as given to its ``main``: None for the process's own.
        *more: options to add.
        ranks: processes that torchrun has started; of several machines, each has the same command.
    """
    given = list(sys.argv[1:] if args is None else args)
    given += [option for option in more if option not in given]
    launcher = ["python"]
    if ranks is not None and ranks.size > 1:
        machines = ranks.size // ranks.local_size
        launcher = ["torchrun", f"--nnodes={machines}", f"--nproc-per-node={ranks.local_size}"]
    return shlex.join([*launcher, "-m", f"agents.{script}", *given])
