"""Worlds of several agents: one PettingZoo module each, such as ``piavatar_envs.multi.sumo_v0`` (extra ``multi``).

A new file ``<name>_v<N>.py`` with a ``TASK``, a ``parallel_env`` and an ``env`` is found and tested without being
listed anywhere. Importing this package imports none of them.
"""

from __future__ import annotations

import pkgutil
import re

_MODULE = re.compile(r"[a-z0-9_]+_v\d+")


def multi_modules() -> tuple[str, ...]:
    """Dotted names of all modules, such as ``piavatar_envs.multi.sumo_v0``. Imports nothing."""
    names = sorted(module.name for module in pkgutil.iter_modules(__path__))
    return tuple(f"{__name__}.{name}" for name in names if _MODULE.fullmatch(name))
