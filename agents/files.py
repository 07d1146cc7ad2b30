"""Files that scripts read and write: atomic writes, folders of runs, and figures as JSON with their origin."""

from __future__ import annotations

import json
import math
import os
import platform
import subprocess
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from datetime import datetime, timezone
from pathlib import Path
from typing import IO, Any

import numpy as np
from pydantic import BaseModel

from piavatar_envs import doctor
from piavatar_envs.config import ConfigError, dump_yaml
from piavatar_envs.core.launch_graph import available_cores
from piavatar_envs.core.reading import reading
from piavatar_envs.core.writing import check_writable

try:
    import fcntl
except ImportError:  # Windows has no such locks, so two training runs in one folder go unnoticed
    fcntl = None

#: Files of a training run: checkpoint, policies, and the figures that are written last.
CHECKPOINT, POLICIES, RESULTS = "checkpoint.pt", ("policy.pt", "policy.zip"), "results.json"
#: Folders that this process holds, and by what; the system releases them however the process ends.
_HELD: dict[Path, int] = {}
ROOT = Path(__file__).resolve().parents[1]
#: Packages whose version is in every file of figures.
PACKAGES = ("numpy", "scipy", "warp-lang", "gymnasium", "stable-baselines3", "torch", "mujoco")


def write_atomically(path: Path, write: Callable[[IO[bytes]], None]) -> None:
    """Replace a file atomically: if the process is killed, either the old or the new content is there.

    Args:
        path: of the file. A killed process can leave half of a new one as ``NAME.partial``, and the
            next write replaces it; where a write fails, as on a full disk, nothing of it is left.
        write: given a file that is open for bytes.

    Raises:
        OSError: it cannot be written, as on a full disk.
    """
    partial = path.with_name(f"{path.name}.partial")
    try:
        with partial.open("wb") as file:
            write(file)
            file.flush()
            os.fsync(file.fileno())
        os.replace(partial, path)
    except BaseException as error:
        partial.unlink(missing_ok=True)
        # where a file takes no more, torch counts its bytes instead, and finds that there are too few
        cause = error.__context__ if isinstance(error, RuntimeError) else error
        if isinstance(cause, OSError):
            raise OSError(f"{path} cannot be written ({cause.strerror or cause})") from error
        raise
    if hasattr(os, "O_DIRECTORY"):  # the new name, too, must outlast a power cut; Windows has no such call
        folder = os.open(path.parent, os.O_RDONLY | os.O_DIRECTORY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)


def write_config(folder: Path, config: BaseModel) -> None:
    """Write the resolved configuration to the folder of a run; call it after all checks have passed."""
    write_atomically(folder / "config.yaml", lambda file: file.write(dump_yaml(config).encode()))


@contextmanager
def made(folder: Path) -> Iterator[None]:
    """Create a folder for the duration, and remove it again if it was new and is empty at the end.

    Raises:
        ValueError: nothing can be written there.
    """
    check_writable(folder / CHECKPOINT)
    new = not folder.exists()
    folder.mkdir(parents=True, exist_ok=True)
    try:
        yield
    finally:
        if new:
            with suppress(OSError):  # it is not empty
                folder.rmdir()


def hold(folder: Path) -> None:
    """Lock a folder against training by other processes for as long as this one lives.

    Raises:
        ConfigError: another one trains there.
    """
    path = folder.resolve()
    if fcntl is None or path in _HELD:
        return
    held = os.open(path, os.O_RDONLY)
    try:
        fcntl.flock(held, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        os.close(held)
        if isinstance(error, BlockingIOError):
            raise ConfigError(
                f"another training run writes to {folder}; end it, or write elsewhere with --out"
            ) from None
        return  # a file system without locks
    _HELD[path] = held


def read_json(path: Path) -> Any:
    """Read a JSON file.

    Raises:
        OSError: there is no such file.
        ValueError: it is no JSON.
    """
    with reading(path, "JSON"):
        return json.loads(path.read_text(encoding="utf-8"))


def check_figures(path: Path, script: str) -> None:
    """Refuse to overwrite anything but earlier figures of the same script.

    Args:
        path: of the JSON file.
        script: its name, without ``agents.``, as its figures have it for ``benchmark``.

    Raises:
        ConfigError: something else is there, or nothing can be written.
    """
    check_writable(path)
    if not path.exists():
        return
    try:
        found = read_json(path)["benchmark"]
    except (ValueError, KeyError, TypeError):
        found = "something else"
    if found != script:
        raise ConfigError(f"{path} is of {found}, not of {script}; write elsewhere with --out, or delete it to lose it")


def claim(folder: Path, script: str, own: tuple[str, ...] = ()) -> None:
    """Claim a folder, which need not exist, for a script that begins anew and replaces its own earlier results.

    Args:
        folder: of the run.
        script: as for :func:`check_figures`.
        own: files that come with results of this script, and are lost with them.

    Raises:
        ConfigError: it holds a training run, or another script's results; or nothing can be written.
    """
    results = folder / RESULTS
    check_figures(results, script)
    for name in (CHECKPOINT, *POLICIES):
        if (folder / name).exists() and not (name in own and results.exists()):
            raise ConfigError(
                f"{folder / name} is of a training run; write elsewhere with --out, or delete it with what was learned"
            )
    if folder.is_dir():
        hold(folder)


def describe_run(benchmark: str, device: str = "cpu") -> dict[str, Any]:
    """Describe a run: benchmark, commit, device, versions, date."""
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
    """Describe a device, and the CPU beside it.

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
    """Return the commit of a checkout, and whether its files differ from it; ("unknown", None) outside of one.

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
    """Convert ``value`` to what JSON can hold: NumPy types and tuples become numbers and lists.

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
    """Write figures as JSON; creates the folder."""
    text = json.dumps(content, indent=2, allow_nan=False, ensure_ascii=False) + "\n"
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, lambda file: file.write(text.encode()))
