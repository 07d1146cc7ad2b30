"""Checks of the physics against theory: what a check is, how it is judged, and the table that shows it.

A check is a function of the options that yields quantities: a measured number, the number that theory gives, and the
tolerance. It is registered under a name by :func:`check`::

    @check("wear_swing", "legs that swing at 1 Hz for 10 s")
    def wear_swing(options: Options) -> Iterator[Quantity]:
        ...
        yield at_most("mean strain", strain, 0.002, theory=0.0005)
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from benchmarks import runner

#: Comments around the table of a page.
MARKS = ("<!-- table of benchmarks/results/physics.json -->", "<!-- end of the table -->")
#: Verdicts: within the tolerance, or out of it or without a value.
HOLDS, FAILS = "holds", "fails"


@dataclass(frozen=True)
class Options(runner.Options):
    """Options of the checks."""

    #: names of the checks to run, or beginnings of such names; all if none is given
    only: tuple[str, ...] = ()
    #: resolution of the bodies
    fidelity: Literal["tiny", "coarse", "medium", "fine"] = "coarse"
    #: seconds for which limbs swing and bodies spin; 600 shows drift that ten seconds hide
    seconds: float = 10.0
    #: results of an earlier commit, to be shown beside the new ones
    before: str | None = None
    #: page of Markdown in which the table between the two comments of MARKS is replaced
    page: Path | None = None


@dataclass(frozen=True)
class Quantity:
    """One measured number beside theory.

    Attributes:
        name: what is measured.
        value: the measurement; NaN if the simulation failed.
        unit: its unit, empty for a pure number.
        theory: the number that theory gives, or None where only a bound is known.
        tolerance: largest deviation from ``theory``; where ``bound`` is not "=", the bound itself.
        bound: ``"="`` within ``theory +- tolerance``, ``"<="`` or ``">="`` the tolerance.
        note: what else a reader should know, such as the reason of a failure.
    """

    name: str
    value: float
    unit: str
    theory: float | None
    tolerance: float
    bound: Literal["=", "<=", ">="] = "="
    note: str = ""

    @property
    def verdict(self) -> str:
        """Return ``"holds"`` or ``"fails"``; a number that is not finite fails."""
        if not math.isfinite(self.value):
            return FAILS
        if self.bound == "=":
            return HOLDS if abs(self.value - self.theory) <= self.tolerance else FAILS
        return (
            HOLDS if (self.value <= self.tolerance if self.bound == "<=" else self.value >= self.tolerance) else FAILS
        )

    @property
    def limit(self) -> str:
        """Return the range in which the value must lie, as text."""
        if self.bound == "=":
            return f"± {_short(self.tolerance)}"
        return f"{'≤' if self.bound == '<=' else '≥'} {_short(self.tolerance)}"


def equal(name: str, value: float, theory: float, tolerance: float, unit: str = "") -> Quantity:
    """Return a quantity that must be within ``tolerance`` of ``theory``."""
    return Quantity(name, float(value), unit, float(theory), float(tolerance))


def at_most(name: str, value: float, limit: float, unit: str = "", theory: float | None = None) -> Quantity:
    """Return a quantity that must not exceed ``limit``."""
    return Quantity(name, float(value), unit, theory, float(limit), "<=")


def at_least(name: str, value: float, limit: float, unit: str = "", theory: float | None = None) -> Quantity:
    """Return a quantity that must not fall below ``limit``."""
    return Quantity(name, float(value), unit, theory, float(limit), ">=")


class SimulationFailed(RuntimeError):
    """The simulation of a check has failed, or its body was released."""


@dataclass(frozen=True)
class Check:
    """A registered check.

    Attributes:
        name: of the check.
        title: the situation, in a few words.
        measure: from the options to the quantities.
    """

    name: str
    title: str
    measure: Callable[[Any], Iterator[Quantity]]

    def rows(self, options: Any) -> Iterator[dict[str, Any]]:
        """Yield a row per quantity; one that fails with the reason if the simulation ends early."""
        try:
            for quantity in self.measure(options):
                yield self._row(quantity)
        except SimulationFailed as error:
            yield self._row(Quantity("simulation ends", math.nan, "", None, 0.0, "<=", str(error)))

    def _row(self, quantity: Quantity) -> dict[str, Any]:
        return {
            "case": f"{self.name}: {quantity.name}",
            "check": self.name,
            "title": self.title,
            "quantity": quantity.name,
            "unit": quantity.unit,
            "theory": quantity.theory,
            "limit": quantity.limit,
            "bound": quantity.bound,
            "tolerance": quantity.tolerance,
            "value": quantity.value if math.isfinite(quantity.value) else None,
            "verdict": quantity.verdict,
            "note": quantity.note,
        }


#: All checks by name, in the order in which their modules register them.
CHECKS: dict[str, Check] = {}


def check(
    name: str, title: str, among: dict[str, Check] = CHECKS
) -> Callable[[Callable[[Any], Iterator[Quantity]]], Check]:
    """Register a function as the check ``name`` among others."""

    def register(measure: Callable[[Any], Iterator[Quantity]]) -> Check:
        among[name] = Check(name, title, measure)
        return among[name]

    return register


def chosen(only: Iterable[str], among: Mapping[str, Check] | None = None) -> list[Check]:
    """Return the checks among some, or all of physics, whose names begin with one of ``only``; all if it is empty.

    Raises:
        SystemExit: a beginning fits no check.
    """
    among, only = CHECKS if among is None else among, tuple(only)
    for beginning in only:
        if not any(name.startswith(beginning) for name in among):
            raise SystemExit(f"--only {beginning}: no such check; the checks are {', '.join(among)}")
    return [found for name, found in among.items() if not only or name.startswith(only)]


def table(rows: Iterable[Mapping[str, Any]]) -> str:
    """Return rows as a table in Markdown; with a column ``before`` if a row has one."""
    rows = list(rows)
    with_before = any("before" in row for row in rows)
    header = ["check", "quantity", "theory", "limit", *(["before"] if with_before else []), "measured", "verdict"]
    lines, title = [header, ["---"] * len(header)], None
    for row in rows:
        unit = f" [{row['unit']}]" if row["unit"] else ""
        before = [_short(row.get("before"))] if with_before else []
        verdict = "holds" if row["verdict"] == HOLDS else "**fails**"
        note = f" ({row['note']})" if row["note"] else ""
        shown, title = "" if row["title"] == title else row["title"], row["title"]
        cells = [shown, f"{row['quantity']}{unit}", _short(row["theory"]), row["limit"], *before]
        lines.append([*cells, _short(row["value"]), verdict + note])
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def with_table(page: str, rows: Iterable[Mapping[str, Any]]) -> str:
    """Return the text of a page with the table between the comments of :data:`MARKS` replaced.

    Raises:
        ValueError: the page has no such comments.
    """
    before, first, rest = page.partition(MARKS[0])
    _, last, after = rest.partition(MARKS[1])
    if not (first and last):
        raise ValueError(f"the page must have the comments {MARKS[0]} and {MARKS[1]}")
    return f"{before}{first}\n\n{table(rows)}\n\n{last}{after}"


def _short(value: float | None) -> str:
    """Return a number with three significant digits, or a dash."""
    return "-" if value is None else f"{value:.4g}"
