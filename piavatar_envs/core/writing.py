"""Files that scripts write: refused before there is content for them, and nothing is created for the check."""

from __future__ import annotations

import tempfile
from pathlib import Path


def check_writable(path: Path) -> None:
    """Refuse a file that could not be written, before there is content for it; leaves everything as it is.

    Raises:
        ValueError: it is a folder, or nothing can be written there.
    """
    try:
        if path.is_dir():
            raise ValueError(f"{path} is a folder; name a file in it")
        if path.exists():
            path.open("ab").close()
        nearest = next(folder for folder in path.absolute().parents if folder.exists())
        tempfile.TemporaryFile(dir=nearest).close()  # finds more than a check of permissions does
    except OSError as error:
        raise ValueError(f"{path} cannot be written ({error.strerror}); write elsewhere") from None
