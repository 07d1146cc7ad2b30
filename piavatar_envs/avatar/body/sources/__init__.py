"""Avatar sources, one file each.

A source is a function that returns an :class:`~piavatar_envs.avatar.body.asset.AvatarAsset`; its keyword arguments are
its settings, such as the ``path`` of a file. Every module of this package is one, under its own name, by its function
``build``; :func:`register_source` adds others. The settings ``avatar.source`` and ``avatar.path`` choose one.
"""

from __future__ import annotations

import importlib
import inspect
import pkgutil
from collections.abc import Callable
from functools import lru_cache

from piavatar_envs.avatar.body.asset import AvatarAsset

#: Builds a body from the source's own settings.
Builder = Callable[..., AvatarAsset]

_registered: dict[str, Builder] = {}


def list_sources() -> tuple[str, ...]:
    """Return the names of all sources."""
    return tuple(sorted({*(module.name for module in pkgutil.iter_modules(__path__)), *_registered}))


def register_source(name: str, builder: Builder) -> None:
    """Make bodies of your own available as ``avatar={"source": name}``, in this process.

    Args:
        name: the name of the source. Registering it again replaces it.
        builder: called with the settings that are given, such as ``path``; returns the body.

    Raises:
        TypeError: the builder is not callable.
        ValueError: a source of this package has the name.
    """
    if not callable(builder):
        raise TypeError(f"builder of {name!r} is a {type(builder).__name__}; pass a function")
    if name in {module.name for module in pkgutil.iter_modules(__path__)}:
        raise ValueError(f"source {name!r} is one of this package; use another name")
    _registered[name] = builder


def check_source(name: str) -> str:
    """Return ``name``.

    Raises:
        ValueError: no source has it.
    """
    if name not in list_sources():
        raise ValueError(f"unknown avatar source {name!r}; use one of {', '.join(list_sources())}")
    return name


def load_asset(source: str = "embedded", path: str | None = None) -> AvatarAsset:
    """Return the body of a source, built once a process for equal settings.

    Args:
        source: name of the source.
        path: a file, for sources that read one.

    Raises:
        ValueError: no source has the name, or it takes no path, or needs one.
        TypeError: the source returns something else than an asset.
    """
    check_source(source)
    builder = _registered.get(source) or importlib.import_module(f"{__name__}.{source}").build
    settings = {} if path is None else {"path": path}
    try:
        inspect.signature(builder).bind(**settings)
    except TypeError as error:
        raise ValueError(f"avatar source {source!r} with path={path!r}: {error}") from None
    return _build(builder, path)


@lru_cache(maxsize=16)
def _build(builder: Builder, path: str | None) -> AvatarAsset:
    asset = builder() if path is None else builder(path=path)
    if not isinstance(asset, AvatarAsset):
        raise TypeError(f"{builder} returns a {type(asset).__name__}; return an AvatarAsset")
    return asset
