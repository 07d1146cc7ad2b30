"""Run the checks of the physics against theory and print the table: ``python -m benchmarks.physics``."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from benchmarks import runner
from benchmarks.physics import damping, flesh, hits, loads  # noqa: F401  (register their checks)
from benchmarks.physics.checks import FAILS, Options, chosen, table, with_table


def cases(options: Options) -> Iterator[dict[str, Any]]:
    """Yield a row per quantity, with the value of an earlier commit beside it if there is one; then print the table."""
    earlier: dict[str, Any] = {}
    if options.before:
        results = json.loads(Path(options.before).read_text(encoding="utf-8"))["results"]
        earlier = {row["case"]: row["value"] for row in results}
    rows = []
    for found in runner.progress(chosen(options.only), "checks"):
        for row in found.rows(options):
            rows.append(row | ({"before": earlier.get(row["case"])} if options.before else {}))
            yield rows[-1]
    fails = sum(row["verdict"] == FAILS for row in rows)
    if options.page is not None:
        page = options.page.read_text(encoding="utf-8")
        options.page.write_text(with_table(page, rows), encoding="utf-8")
    print(f"{table(rows)}\n\n{len(rows) - fails} of {len(rows)} hold, {fails} fail")


if __name__ == "__main__":
    runner.main("physics", cases, Options)
