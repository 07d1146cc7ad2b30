"""Optional dependencies: the error of a missing one, and the command that installs it where this package is from."""

from __future__ import annotations

import importlib.metadata
import json
from pathlib import Path

#: The folder that holds the package: the root of a checkout, or a folder of installed packages.
_ROOT = Path(__file__).resolve().parents[2]


def install_command(extra: str) -> str:
    """Return the command that adds ``extra`` to this installation: from its checkout, its address or an index."""
    try:
        text = importlib.metadata.distribution("piavatar-envs").read_text("direct_url.json")
    except importlib.metadata.PackageNotFoundError:
        text = None
    origin = json.loads(text or "{}")
    if "vcs_info" in origin:
        return f'pip install "piavatar-envs[{extra}] @ {origin["vcs_info"]["vcs"]}+{origin["url"]}"'
    if (_ROOT / "pyproject.toml").is_file():
        return f'pip install -e "{_ROOT}[{extra}]"'
    source = f" @ {origin['url']}" if "url" in origin else ""
    return f'pip install "piavatar-envs[{extra}]{source}"'


def missing(what: str, package: str, extra: str) -> ImportError:
    """Return the error of ``what`` needing ``package``, which is not installed, with the command that installs it."""
    return ImportError(f"{what} needs {package}, which is not installed; install it with: {install_command(extra)}")
