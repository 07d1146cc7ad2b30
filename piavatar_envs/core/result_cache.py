"""Results that take long to compute, kept in files beside Warp's compiled kernels.

A file is named by a digest of all that its content depends on: the arguments, and the code that computes it. Nothing is
ever stale, therefore, and a file that cannot be read is computed anew. Without a place to write to, results are
computed in every process. When the folder grows too large, files that were not used for longest go.
"""

from __future__ import annotations

import dataclasses
import hashlib
import os
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import warp as wp

from piavatar_envs.core.kernel_cache import init_warp
from piavatar_envs.core.reading import UNREADABLE

#: Name of the folder, in that of the compiled kernels.
FOLDER = "piavatar_envs"
#: Results that were computed in less are not kept [s].
LEAST_SECONDS = 1.0
#: Size of the folder beyond which old files are deleted [bytes].
MOST_BYTES = 4 << 30
#: Time after which a line says what is being computed [s].
PATIENCE = 2.0

Arrays = Mapping[str, np.ndarray]


def digest_of(values: Any, code: Iterable[ModuleType]) -> str:
    """Return a digest of values and of the source of modules.

    Args:
        values: NumPy arrays, numbers, texts, None, and lists, tuples and dataclasses of such.
        code: modules whose functions compute the result.

    Raises:
        TypeError: a value is of another type.
    """
    digest = hashlib.blake2b(digest_size=16)
    for module in code:
        digest.update(_source(module.__file__))
    for part in _parts(values):
        digest.update(part)
    return digest.hexdigest()


def _parts(value: Any) -> Iterator[bytes | np.ndarray]:
    """Yield what distinguishes a value from others.

    Raises:
        TypeError: its type is not supported.
    """
    if isinstance(value, np.ndarray):
        yield f"{value.dtype.str}{value.shape}".encode()
        yield np.ascontiguousarray(value)
    elif dataclasses.is_dataclass(value):
        yield type(value).__name__.encode()
        for field in dataclasses.fields(value):
            yield from _parts(getattr(value, field.name))
    elif isinstance(value, (list, tuple)):
        yield f"{len(value)} values".encode()
        for item in value:
            yield from _parts(item)
    elif value is None or isinstance(value, (bool, int, float, str, np.generic)):
        yield f"{type(value).__name__} {value!r}".encode()
    else:
        raise TypeError(f"no digest of a {type(value).__name__}; pass arrays, numbers, texts or dataclasses of such")


def kept(name: str, digest: str, compute: Callable[[], Arrays], doing: str) -> dict[str, np.ndarray]:
    """Return arrays from their file, or compute and keep them.

    Args:
        name: of the kind of result, for people who look into the folder.
        digest: of all that the result depends on; see :func:`digest_of`.
        compute: returns the arrays, none of objects.
        doing: the line that is printed if it takes long, as ``"closing the skin of knight.glb"``.
    """
    init_warp()
    path = Path(wp.config.kernel_cache_dir) / FOLDER / f"{name}_{digest}.npz"
    with suppress(*UNREADABLE), np.load(path, allow_pickle=False) as file:
        found = {key: file[key] for key in file.files}
        with suppress(OSError):
            path.touch()  # a folder that can only be read is fine
        return found
    began = time.perf_counter()
    with _announced(f"piavatar-envs: {doing}; the first time takes a while"):
        arrays = dict(compute())
    if time.perf_counter() - began >= LEAST_SECONDS:
        _write(path, arrays)
    return arrays


@cache
def _source(file: str) -> bytes:
    return Path(file).read_bytes()


def _write(path: Path, arrays: Arrays) -> None:
    """Write a file that is whole at any time, or none where that is not possible."""
    with suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, part = tempfile.mkstemp(dir=path.parent, suffix=".part")
        try:
            with os.fdopen(handle, "wb") as stream:
                np.savez(stream, **arrays)
            os.replace(part, path)
        except OSError:
            os.unlink(part)
        _prune(path)


def _prune(newest: Path) -> None:
    """Delete files other than ``newest``, the longest unused first, until the folder is within :data:`MOST_BYTES`.

    Raises:
        OSError: another process has deleted one meanwhile, or the folder cannot be read.
    """
    files = sorted((file.stat().st_mtime, file) for file in newest.parent.glob("*.npz") if file != newest)
    size = newest.stat().st_size + sum(file.stat().st_size for _, file in files)
    for _, file in files:
        if size <= MOST_BYTES:
            return
        size -= file.stat().st_size
        file.unlink()


@contextmanager
def _announced(line: str) -> Iterator[None]:
    """Print a line to standard error if the block takes longer than :data:`PATIENCE`."""
    timer = threading.Timer(PATIENCE, print, [line], {"file": sys.stderr, "flush": True})
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()
