"""Warp's start, quiet, and its cache of kernels: an unusable folder is named, damaged objects are compiled anew."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any

import warp as wp

from piavatar_envs.core.capture_lock import CAPTURE

_NO_DRIVER = b"Could not find or load the NVIDIA CUDA driver"


class KernelCacheError(OSError):
    """The folder of compiled kernels cannot be used; one line with the folder and the remedy."""


@cache
def init_warp() -> None:
    """Initialise Warp, which creates the folder of its cache; initialising it again does nothing.

    Of Warp's default messages only warnings remain, and not that there is no CUDA driver.

    Raises:
        KernelCacheError: the folder cannot be created.
    """
    for name in ("WARP_CACHE_PATH", "XDG_CACHE_HOME"):
        if os.environ.get(name) == "":  # which is not set, and to Warp the working directory
            del os.environ[name]
    if wp.config.log_level == wp.LOG_INFO:  # its default: a banner, and a line a module in every process
        wp.config.log_level = wp.LOG_WARNING
    try:
        with CAPTURE.exclusive(), _without_driver_warning():
            wp.init()
    except OSError as error:
        raise unusable(error) from error


@contextmanager
def _without_driver_warning() -> Iterator[None]:
    """Hold back Warp's warning of a missing CUDA driver, which it writes in every process of a machine without GPU."""
    try:
        held = tempfile.TemporaryFile()  # noqa: SIM115 - its errors are not those of the block
        before = os.dup(2)  # native code writes there, whatever sys.stderr is
    except OSError:  # no folder for temporary files can be written, or there is no standard error
        yield
        return
    with held:
        os.dup2(held.fileno(), 2)
        try:
            yield
        finally:
            os.dup2(before, 2)
            os.close(before)
            held.seek(0)
            for line in held.read().splitlines(keepends=True):
                if _NO_DRIVER not in line:
                    os.write(2, line)


def unusable(error: OSError) -> KernelCacheError:
    """Return the error of a cache that cannot be written or read."""
    folder = wp.config.kernel_cache_dir or os.environ.get("WARP_CACHE_PATH") or error.filename
    return KernelCacheError(
        f"Warp cannot keep compiled kernels in {folder} ({error.strerror or error}); name a folder that can be written "
        "and has space in the environment variable WARP_CACHE_PATH"
    )


def load_module(module: Any, device: wp.Device, block_dim: int) -> None:
    """Load the kernels of a Warp module, compiled where the cache lacks them; a damaged entry is compiled anew.

    Raises:
        KernelCacheError: the cache cannot be written.
        Exception: a kernel does not compile, as Warp reports it.
    """
    try:
        try:
            wp.load_module(module, device, block_dim=block_dim, max_workers=0)
        except Exception as error:
            entry = Path(wp.config.kernel_cache_dir) / module.get_module_identifier(1 if device.is_cpu else block_dim)
            damaged = isinstance(error, (ValueError, FileNotFoundError)) or "Failed to load" in str(error)
            if not (damaged and entry.is_dir()):
                raise
            shutil.rmtree(entry, ignore_errors=True)
            module.unload()
            wp.load_module(module, device, block_dim=block_dim, max_workers=0)
    except OSError as error:
        raise unusable(error) from error
