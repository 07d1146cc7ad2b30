"""Ctrl-C while a command imports its modules, which takes seconds on a busy machine: one line, no traceback."""

from __future__ import annotations

import shlex
import sys
from pathlib import Path
from types import TracebackType


def report_interrupts() -> None:
    """Report Ctrl-C in one line if this process is this package's command; change nothing in other programs."""
    # "-m" is there while Python looks for any module that it runs
    module = sys.argv[:1] == ["-m"] and any(word.removeprefix("-m") == "piavatar_envs" for word in sys.orig_argv)
    if module or Path(sys.argv[0] if sys.argv else "").stem == "piavatar-envs":
        sys.excepthook = _in_one_line


def again(args: list[str]) -> str:
    """Return the command line that runs the command again."""
    return shlex.join(["python", "-m", "piavatar_envs", *args])


def _in_one_line(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
    if isinstance(error, KeyboardInterrupt):
        print(f"\ninterrupted before the first step; begin again with {again(sys.argv[1:])}", file=sys.stderr)
    else:
        sys.__excepthook__(kind, error, trace)
