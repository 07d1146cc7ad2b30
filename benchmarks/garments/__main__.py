"""Run the checks of garments, print the table and draw it: ``python -m benchmarks.garments``."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from benchmarks import runner
from benchmarks.garments import free, mpm, worn  # noqa: F401  (register their checks)
from benchmarks.garments.picture import draw
from benchmarks.garments.rows import CHECKS, Options
from benchmarks.physics.checks import FAILS, chosen, table


def cases(options: Options) -> Iterator[dict[str, Any]]:
    """Yield a row per quantity; then print the table, and draw it if a file is given."""
    rows = []
    for found in runner.progress(chosen(options.only, CHECKS), "garments"):
        for row in found.rows(options):
            rows.append(row)
            yield row
    fails = sum(row["verdict"] == FAILS for row in rows)
    if options.picture is not None:
        draw(rows, options.picture)
    print(f"{table(rows)}\n\n{len(rows) - fails} of {len(rows)} hold, {fails} fail")


if __name__ == "__main__":
    runner.main("garments", cases, Options)
