"""Files of users: one list of the errors that a damaged or foreign file may raise, and one error instead of them."""

from __future__ import annotations

import json
import lzma
import pickle
import re
import struct
import tokenize
import urllib.parse
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from itertools import islice
from pathlib import Path

import numpy as np

#: Errors of parsers (NumPy, zipfile, json, yaml, torch) on content that is damaged, foreign or too deeply nested.
UNREADABLE: tuple[type[Exception], ...] = (
    ArithmeticError, AttributeError, EOFError, LookupError, MemoryError, NameError, OSError, RuntimeError, SyntaxError,
    TypeError, ValueError, lzma.LZMAError, pickle.UnpicklingError, struct.error, tokenize.TokenError,
    zipfile.BadZipFile, zlib.error,
)  # fmt: skip

#: Name of a file in a ``.gltf``; the document is not parsed, for it may be anything.
_URI = re.compile(rb'"uri"\s*:\s*("(?!data:)(?:[^"\\]|\\.){1,1000}")')
#: Greatest number of entries of a folder, or of names in a file, that count as its content.
_MOST_ENTRIES = 10_000


def files_behind(path: Path) -> list[Path]:
    """Return the files that a path stands for: itself, of a ``.gltf`` those that it names, of a folder all below it."""
    if path.is_dir():
        return sorted(file for file in islice(path.rglob("*"), _MOST_ENTRIES) if file.is_file())
    found = [path]
    if path.suffix.lower() == ".gltf":
        with suppress(*UNREADABLE):  # its reader says what is wrong
            names = [json.loads(match[1]) for match in islice(_URI.finditer(path.read_bytes()), _MOST_ENTRIES)]
            beside = [Path(urllib.parse.unquote(name)) for name in dict.fromkeys(names)]
            below = [path.parent / file for file in beside if not file.is_absolute()]
            found += [file for file in below if file.is_file()]
    return found


def check_file(path: Path) -> None:
    """Refuse a path at which there is no file.

    Raises:
        FileNotFoundError: there is nothing.
        ValueError: there is a folder.
    """
    if path.is_dir():
        raise ValueError(f"{path} is a folder; give the path of a file in it")
    if not path.is_file():
        raise FileNotFoundError(f"no file {path}")


def numbers(file: np.lib.npyio.NpzFile, key: str) -> np.ndarray:
    """Return an array of numbers from an archive.

    NumPy returns the bytes of what is not an array.

    Raises:
        KeyError: there is no such array.
        ValueError: it does not hold real numbers.
    """
    array = file[key]
    if not isinstance(array, np.ndarray) or array.dtype.kind not in "bfiu":
        kind = array.dtype if isinstance(array, np.ndarray) else "bytes, none of an array"
        raise ValueError(f"{key} holds {kind}; save an array of real numbers")
    return array


def first_line(error: Exception) -> str:
    """Return the first line of an error's message after the error's name, which alone says what a KeyError is."""
    lines = str(error).strip().splitlines()
    named = isinstance(error, ValueError) and type(error).__module__ == "builtins"
    return ": ".join([*([] if named and lines else [type(error).__name__]), *lines[:1]])


@contextmanager
def reading(path: str | Path, what: str, kind: type[ValueError] = ValueError) -> Iterator[None]:
    """Raise one error, of one line, for every error of :data:`UNREADABLE` while a file is read.

    Args:
        path: of the file.
        what: it should have been, with an article, as ``"an AMASS motion"``.
        kind: type of the error.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: of ``kind``, it cannot be read.
    """
    try:
        yield
    except FileNotFoundError as error:
        if error.errno is None:
            raise
        raise FileNotFoundError(f"no file {error.filename or path}") from error
    except UNREADABLE as error:
        raise kind(f"{path} is not {what}: {first_line(error)}") from error


@contextmanager
def naming(path: str | Path | None) -> Iterator[None]:
    """Name a file in every refusal of it; of nothing for None.

    Raises:
        ValueError: it was refused.
    """
    try:
        yield
    except ValueError as error:
        if path is None or type(error) is not ValueError or Path(path).name in str(error):
            raise
        raise ValueError(f"{path}: {error}") from error
