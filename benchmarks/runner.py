"""The one runner of all benchmarks: arguments, progress, statistics, and a JSON file that says how it came about.

A benchmark is a module with options and a generator of rows::

    @dataclass(frozen=True)
    class Options(runner.Options):
        poses: int = 20  #: random poses

    def cases(options: Options) -> Iterator[dict]:
        for pose in runner.progress(range(options.poses), "poses"):
            yield {"case": f"pose {pose}", "mean_distance_m": ...}

    if __name__ == "__main__":
        runner.main("tracking", cases, Options)

Rows are written as they come, so that a run that is stopped keeps the cases it finished (``"complete": false``).
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, TypeVar

import tyro
from tqdm import tqdm

from agents.files import ROOT, describe_run, plain, write_json
from piavatar_envs.cli import print_any_text

Item = TypeVar("Item")


@dataclass(frozen=True)
class Options:
    """Options of every benchmark; a benchmark adds its own in a subclass."""

    #: JSON file to write; without it the results go to the terminal
    out: Path | None = None
    #: where to simulate: cpu, cuda, cuda:1, ...
    device: str = "cpu"


def progress(items: Iterable[Item], description: str, total: int | None = None) -> Iterable[Item]:
    """Wrap ``items`` in a progress bar on stderr; silent where stderr is not a terminal."""
    return tqdm(items, desc=description, total=total, disable=None, dynamic_ncols=True)


def relative(value: Any) -> Any:
    """Return a path inside of the checkout relative to it, so that results name no machine's folders."""
    return value.relative_to(ROOT) if isinstance(value, Path) and value.is_relative_to(ROOT) else value


def main(
    benchmark: str,
    cases: Callable[[Any], Iterable[Mapping[str, Any]]],
    options: type[Options] = Options,
    args: Sequence[str] | None = None,
) -> dict[str, Any]:
    """Parse the command line, run all cases, write the JSON, and return what was written.

    Args:
        benchmark: its name in the JSON.
        cases: from the options to the rows; each has ``"case"`` and plain numbers, strings, lists or None.
        options: :class:`Options` or a subclass.
        args: command line, by default the process's own.
    """
    print_any_text()
    spec = sys.modules["__main__"].__spec__
    program = spec.name if spec and spec.name.startswith("benchmarks.") else f"benchmarks.{benchmark}"
    chosen = tyro.cli(options, prog=f"python -m {program}", args=args)
    report = describe_run(benchmark, chosen.device)
    settings = {key: relative(value) for key, value in asdict(chosen).items() if key not in ("out", "device")}
    report |= {"options": plain(settings, "options"), "complete": False, "results": []}
    for row in cases(chosen):
        if "case" not in row:
            raise ValueError(f"a row of {benchmark} has no 'case': {dict(row)}")
        report["results"].append(plain(row, str(row["case"])))
        if chosen.out is not None:
            write_json(chosen.out, report)
        else:
            tqdm.write(json.dumps(report["results"][-1]), file=sys.stdout)
    report["complete"] = True
    if chosen.out is not None:
        write_json(chosen.out, report)
        print(f"{len(report['results'])} results in {chosen.out}")
    return report
