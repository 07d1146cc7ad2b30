"""How many cores there are to share."""

from __future__ import annotations

import os

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
