"""Optional dependencies: the error of a missing one, and the command that installs it where this package is from."""

from __future__ import annotations

import importlib.metadata
import json
from pathlib import Path

#: Modules by extra; an extra is present if all of its modules are.
EXTRAS = {
    "render": ("imageio", "imageio_ffmpeg", "PIL"),
    "train": ("stable_baselines3", "torch", "matplotlib", "tensorboard"),
    "fit": ("optuna", "stable_baselines3", "torch", "matplotlib"),
    "vlm": ("transformers",),
    "datasets": ("minari", "h5py", "stable_baselines3", "torch", "torchrl"),
    "motions": ("pybullet_data",),
    "props": ("trimesh",),
    "multi": ("pettingzoo",),
    "skrl": ("skrl", "stable_baselines3", "torch", "matplotlib", "pettingzoo"),
    "rsl": ("rsl_rl", "tensordict", "stable_baselines3", "torch", "matplotlib"),
    "live": ("viser",),
    "splats": ("gsply",),
    "usd": ("pxr",),
    "bench": ("mujoco",),
    "dev": ("pytest", "xdist", "build"),
}
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
        vcs = origin["vcs_info"]
        revision = f"@{vcs['requested_revision']}" if "requested_revision" in vcs else ""
        return f'pip install "piavatar-envs[{extra}] @ {vcs["vcs"]}+{origin["url"]}{revision}"'
    if (_ROOT / "pyproject.toml").is_file():
        return f'pip install -e "{_ROOT}[{extra}]"'
    source = f" @ {origin['url']}" if "url" in origin else ""
    return f'pip install "piavatar-envs[{extra}]{source}"'


def extra_of(module: str) -> str:
    """Return the first extra that installs a module."""
    return next((extra for extra, modules in EXTRAS.items() if module in modules), "train")


class MissingExtra(ImportError):
    """A package of an extra is not installed; one line with the command that installs it."""


def missing(what: str, package: str, extra: str) -> MissingExtra:
    """Return the error of ``what`` needing ``package``, which is not installed, with the command that installs it."""
    return MissingExtra(f"{what} needs {package}, which is not installed; install it with: {install_command(extra)}")
