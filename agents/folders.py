"""Where scripts write: files are whole, what is there is not lost, and what cannot be written is refused early."""

from __future__ import annotations

import json
import os
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Any

from pydantic import BaseModel

from piavatar_envs.config import ConfigError, dump_yaml

try:
    import fcntl
except ImportError:  # on Windows nobody finds out that two train in one folder
    fcntl = None

#: What a training goes on from, what it has learned, and the figures that come last.
CHECKPOINT, POLICIES, RESULTS = "checkpoint.pt", ("policy.pt", "policy.zip"), "results.json"
#: Folders that this process holds, and by what; the system lets go of them however the process ends.
_HELD: dict[Path, int] = {}


def write_whole(path: Path, write: Callable[[IO[bytes]], None]) -> None:
    """Replace a file by what ``write`` writes: whoever is killed in between, the old one or the new one is there.

    Args:
        path: of the file. A half of a new one, left by whoever was killed, lies beside it as ``NAME.partial``, and the
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
    """Leave the resolved configuration in the folder of a run; to be called when nothing more can be refused."""
    write_whole(folder / "config.yaml", lambda file: file.write(dump_yaml(config).encode()))


@contextmanager
def made(folder: Path) -> Iterator[None]:
    """Have a folder; one that was not there before is gone again where nothing has come to lie in it."""
    new = not folder.exists()
    folder.mkdir(parents=True, exist_ok=True)
    try:
        yield
    finally:
        if new:
            with suppress(OSError):  # it is not empty
                folder.rmdir()


def hold(folder: Path) -> None:
    """Keep other processes from training in a folder as long as this one lives.

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
            raise ConfigError(f"another training writes to {folder}; end it, or write elsewhere with --out") from None
        return  # a file system that knows no locks
    _HELD[path] = held


def check_writable(path: Path) -> None:
    """Refuse a file that could not be written, before there is anything to write; leaves everything as it is.

    Raises:
        ConfigError: it is a folder, or nothing can be written there.
    """
    try:
        if path.is_dir():
            raise ConfigError(f"{path} is a folder; name a file in it")
        if path.exists():
            path.open("ab").close()
        nearest = next(folder for folder in path.absolute().parents if folder.exists())
        tempfile.TemporaryFile(dir=nearest).close()  # tells more than asking for permissions does
    except OSError as error:
        raise ConfigError(f"{path} cannot be written ({error.strerror}); write elsewhere") from None


def read_json(path: Path) -> Any:
    """What a file of figures holds.

    Raises:
        OSError: there is no such file.
        ValueError: it is no JSON.
    """
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise ValueError(f"{path} is no JSON ({error}); write it anew") from None


def check_figures(path: Path, script: str) -> None:
    """Refuse to write figures over anything but earlier ones of the same script.

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
    """Take a folder, which need not exist, for a script that begins anew: earlier results of the same are lost.

    Args:
        folder: of the run.
        script: as for :func:`check_figures`.
        own: files that come with results of this script, and are lost with them.

    Raises:
        ConfigError: it holds a training, or another script's results; or nothing can be written.
    """
    results = folder / RESULTS
    check_figures(results, script)
    for name in (CHECKPOINT, *POLICIES):
        if (folder / name).exists() and not (name in own and results.exists()):
            raise ConfigError(
                f"{folder / name} is of a training; write elsewhere with --out, or delete it to lose what was learned"
            )
    if folder.is_dir():
        hold(folder)
