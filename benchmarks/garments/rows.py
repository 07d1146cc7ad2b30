"""Rows of the table of garments: its checks, and its options."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from benchmarks import runner
from benchmarks.physics import checks
from benchmarks.physics.checks import Check, Quantity

#: All checks of garments by name, in the order in which their modules register them.
CHECKS: dict[str, Check] = {}


@dataclass(frozen=True)
class Options(runner.Options):
    """Options of the checks of garments."""

    #: names of the checks to run, or beginnings of such names; all if none is given
    only: tuple[str, ...] = ()
    #: resolution of the bodies
    fidelity: Literal["tiny", "coarse", "medium", "fine"] = "coarse"
    #: picture of the measured values over their tolerances to write
    picture: Path | None = None


def check(name: str, title: str) -> Callable[[Callable[[Options], Iterator[Quantity]]], Check]:
    """Register a function as the check ``name`` of garments."""
    return checks.check(name, title, CHECKS)
