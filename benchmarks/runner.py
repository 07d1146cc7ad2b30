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
import math
import os
import platform
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from datetime import datetime, timezone
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np
import tyro
from scipy import stats
from tqdm import tqdm

from piavatar_envs import doctor
from piavatar_envs.core.launch_graph import available_cores

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("numpy", "scipy", "warp-lang", "gymnasium", "stable-baselines3", "torch", "mujoco")
Item = TypeVar("Item")


@dataclass(frozen=True)
class Options:
    """What every benchmark understands; a benchmark adds its own in a subclass."""

    #: JSON file to write; without it the results go to the terminal
    out: Path | None = None
    #: where to simulate: cpu, cuda, cuda:1, ...
    device: str = "cpu"


class Estimate(NamedTuple):
    """Mean of a sample, and half the width of its 95 % confidence interval (infinite for a single value)."""

    mean: float
    half_width: float

    @property
    def low(self) -> float:
        """Lower end of the interval."""
        return self.mean - self.half_width

    @property
    def high(self) -> float:
        """Upper end of the interval."""
        return self.mean + self.half_width


def mean_and_interval(values: Sequence[float] | np.ndarray) -> Estimate:
    """Mean and 95 % interval of the mean, by Student's t with n - 1 degrees of freedom.

    Args:
        values: independent measurements (seeds, not steps of one run), shape (n,).

    Raises:
        ValueError: no value, more than one dimension, or a value that is not finite.
    """
    sample = np.asarray(values, dtype=np.float64)
    if sample.ndim != 1 or sample.size == 0:
        raise ValueError(f"values have shape {sample.shape}; give one dimension of at least one value")
    if not np.isfinite(sample).all():
        first = int(np.flatnonzero(~np.isfinite(sample))[0])
        raise ValueError(f"values[{first}]={sample[first]} is not finite; drop or explain it before averaging")
    if sample.size == 1:
        return Estimate(float(sample[0]), math.inf)
    error = sample.std(ddof=1) / math.sqrt(sample.size)
    return Estimate(float(sample.mean()), float(stats.t.ppf(0.975, sample.size - 1) * error))


def progress(items: Iterable[Item], description: str, total: int | None = None) -> Iterable[Item]:
    """``items`` with a progress bar on stderr; silent where stderr is not a terminal."""
    return tqdm(items, desc=description, total=total, disable=None, dynamic_ncols=True)


def main(
    benchmark: str,
    cases: Callable[[Any], Iterable[Mapping[str, Any]]],
    options: type[Options] = Options,
    args: Sequence[str] | None = None,
) -> dict[str, Any]:
    """Parse the command line, run all cases, write the JSON; returns what was written.

    Args:
        benchmark: its name, as in ``python -m benchmarks.NAME``.
        cases: from the options to the rows; each has ``"case"`` and plain numbers, strings, lists or None.
        options: :class:`Options` or a subclass.
        args: command line, by default the process's own.
    """
    chosen = tyro.cli(options, prog=f"python -m benchmarks.{benchmark}", args=args)
    report = describe_run(benchmark, chosen.device)
    settings = {key: value for key, value in asdict(chosen).items() if key not in ("out", "device")}
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


def describe_run(benchmark: str, device: str = "cpu") -> dict[str, Any]:
    """Everything but the results: benchmark, commit, device, versions, date."""
    commit, dirty = git_commit()
    versions = {name: version for name in PACKAGES if (version := doctor.package_version(name))}
    return {
        "benchmark": benchmark,
        "commit": commit,
        "dirty": dirty,
        "device": device_info(device),
        "versions": {"python": platform.python_version(), **versions},
        "date": datetime.now(timezone.utc).isoformat(timespec="seconds"),
    }


def device_info(device: str) -> dict[str, Any]:
    """The device that is measured, and the CPU beside it.

    Raises:
        ValueError: Warp has no such device.
    """
    found = {entry["alias"]: entry for entry in doctor.devices()}
    alias = "cuda:0" if device == "cuda" else device
    if alias not in found:
        raise ValueError(f"no device {device!r} on this machine; there are {', '.join(found)}")
    used = {key: value for key, value in found[alias].items() if key != "free_gib"}
    return {**used, "cpu": doctor.cpu_model(), "cpu_cores": available_cores()}


def git_commit(root: Path = ROOT) -> tuple[str, bool | None]:
    """Commit of a checkout, and whether its files differ from it; ("unknown", None) outside of one.

    ``PIAVATAR_COMMIT`` names the commit of a copy whose history stayed behind or is another. Results do not count as
    a difference, or writing one benchmark would taint the next.
    """

    def git(*command: str) -> str:
        run = subprocess.run(["git", *command], cwd=root, capture_output=True, text=True, timeout=30, check=True)
        return run.stdout.strip()

    if named := os.environ.get("PIAVATAR_COMMIT"):
        return named, None
    try:
        commit = git("rev-parse", "HEAD")
        return commit, bool(git("status", "--porcelain", "--", ".", ":(exclude)benchmarks/results"))
    except (OSError, subprocess.SubprocessError):
        return "unknown", None


def plain(value: Any, where: str) -> Any:
    """``value`` as JSON can hold it: NumPy and tuples become numbers and lists.

    Raises:
        ValueError: a number is not finite (JSON has none such), or the type has no JSON form.
    """
    if isinstance(value, Mapping):
        return {str(key): plain(entry, f"{where}: {key}") for key, entry in value.items()}
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, (list, tuple, np.ndarray)):
        return [plain(entry, f"{where}[{index}]") for index, entry in enumerate(value)]
    if isinstance(value, float) and not math.isfinite(value):
        raise ValueError(f"{where} is {value}; write None where there is no value")
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    if isinstance(value, Path):
        return str(value)
    raise ValueError(f"{where} is of type {type(value).__name__}; a result holds numbers, strings, lists and None")


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Write ``content`` so that a reader finds the old file or the new one, never a half."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    text = json.dumps(content, indent=2, allow_nan=False, ensure_ascii=False) + "\n"
    handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.", suffix=".tmp")
    try:
        with os.fdopen(handle, "w", encoding="utf-8") as stream:
            stream.write(text)
            stream.flush()
            os.fsync(stream.fileno())
        os.chmod(temporary, 0o644)  # mkstemp's files are private
        os.replace(temporary, path)
    except BaseException:
        Path(temporary).unlink(missing_ok=True)
        raise
