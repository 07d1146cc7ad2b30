"""Avatar sources, one file each.

A source is a function that returns an :class:`~piavatar_envs.avatar.body.asset.AvatarAsset`; its keyword arguments are
its settings, such as the ``path`` of a file. Every module of this package is one, under its own name, by its function
``build``; :func:`register_source` adds others. Of the settings below ``avatar``, ``source`` is its name, and the others
are its arguments. A module may list in ``SUFFIXES`` the endings of the files that it reads.
"""

from __future__ import annotations

import importlib
import inspect
import os
import pkgutil
from collections.abc import Callable, Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any, get_type_hints

import numpy as np
from pydantic import TypeAdapter, ValidationError

from piavatar_envs.avatar.body.asset import AvatarAsset
from piavatar_envs.avatar.body.splat_files import SUFFIXES as SPLAT_SUFFIXES
from piavatar_envs.avatar.body.splat_files import holds_splats
from piavatar_envs.avatar.gltf import check_format
from piavatar_envs.core.reading import files_behind, naming, reading

#: Builds a body from the source's own settings.
Builder = Callable[..., AvatarAsset]

_registered: dict[str, Builder] = {}


def _own_modules() -> set[str]:
    return {module.name for module in pkgutil.iter_modules(__path__)}


def list_sources() -> tuple[str, ...]:
    """Return the names of all sources."""
    return tuple(sorted({*_own_modules(), *_registered}))


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
    if name in _own_modules():
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


def source_of(path: str | Path) -> str:
    """Return the name of the source that reads files of such a name; for splats also by the beginning of the file.

    Raises:
        ValueError: none does.
    """
    suffix = Path(path).suffix.lower()
    known: dict[str, str] = {}
    for name in sorted(_own_modules()):
        for own in getattr(importlib.import_module(f"{__name__}.{name}"), "SUFFIXES", ()):
            known.setdefault(own, name)
    if suffix in SPLAT_SUFFIXES and holds_splats(path):
        return "gaussian"
    if suffix not in known:
        with reading(path, "a character"):
            check_format(Path(path))
        raise ValueError(f"no avatar source reads {path}; use a file of {', '.join(sorted(known))}")
    return known[suffix]


def check_settings(source: str, settings: Mapping[str, Any]) -> None:
    """Refuse settings that a source does not have, values of another type, and too few of them.

    Raises:
        ValueError: no source has the name, it lacks one of the settings or takes another type, or needs one that is not
            given.
    """
    parameters = inspect.signature(_builder(source)).parameters.values()
    kinds = {parameter.kind for parameter in parameters}
    own = [p.name for p in parameters if p.kind in (p.POSITIONAL_OR_KEYWORD, p.KEYWORD_ONLY)]
    unknown = [name for name in settings if name not in own]
    if unknown and inspect.Parameter.VAR_KEYWORD not in kinds:
        there = f"it has {', '.join(own)}" if own else "it has no settings"
        raise ValueError(f"avatar source {source!r} has no setting {unknown[0]}={settings[unknown[0]]!r}; {there}")
    for p in parameters:
        if p.name in own and p.default is inspect.Parameter.empty and p.name not in settings:
            raise ValueError(f"avatar source {source!r} needs the setting {p.name}")
    # a source of one's own checks its settings itself
    hints = get_type_hints(_builder(source)) if source in _own_modules() else {}
    for name in sorted(settings.keys() & hints.keys()):
        try:
            TypeAdapter(hints[name]).validate_python(settings[name], strict=True)
        except ValidationError as error:
            wanted = error.errors()[0]["msg"].replace("Input should be", "it must be")
            wanted = wanted.replace("an instance of Sequence", "a list")
            raise ValueError(f"avatar source {source!r} has {name}={settings[name]!r}: {wanted}") from None
        if isinstance(settings[name], Mapping):  # of another source
            others = dict(settings[name])
            check_settings(others.pop("source", "embedded"), others)


def load_asset(source: str = "embedded", path: str | Path | None = None, **settings: Any) -> AvatarAsset:
    """Return the body of a source, built once per process for equal settings and unchanged files.

    Args:
        source: name of the source.
        path: a file, for sources that read one.
        settings: other arguments of the source; those that are None are left out.

    Raises:
        ValueError: no source has the name, or it lacks one of the settings, or needs one.
        TypeError: the source returns something else than an asset.
    """
    given = {"path": path, **settings}
    given = {name: _plain(value) for name, value in given.items() if value is not None}
    check_settings(source, given)
    versions = tuple(_version(value) for value in given.values())
    with naming(given.get("path")):
        return _build(_builder(source), tuple(sorted(given.items())), versions)


def _builder(source: str) -> Builder:
    check_source(source)
    return _registered.get(source) or importlib.import_module(f"{__name__}.{source}").build


class _Settings(dict):
    """Settings within a setting, which can be hashed; never changed."""

    def __hash__(self) -> int:  # type: ignore[override]
        return hash(tuple(sorted(self.items(), key=lambda item: item[0])))


def _plain(value: Any) -> Any:
    """Return a setting as a value that can be compared and hashed."""
    if isinstance(value, Mapping):
        return _Settings({str(name): _plain(item) for name, item in value.items()})
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, str) or not hasattr(value, "__iter__"):
        return value
    return tuple(_plain(item) for item in value)


def _version(value: Any) -> tuple[tuple[str, int, int], ...] | None:
    """Return time of change and size of the files that a setting names, so that changed ones are read anew."""
    if isinstance(value, Mapping):
        return tuple(file for item in value.values() for file in _version(item) or ())
    if not isinstance(value, str) or not os.path.exists(value):
        return None
    files = [(str(file), os.stat(file)) for file in files_behind(Path(value))]
    return tuple((name, status.st_mtime_ns, status.st_size) for name, status in files)


@lru_cache(maxsize=16)
def _build(builder: Builder, settings: tuple[tuple[str, Any], ...], _versions: tuple) -> AvatarAsset:
    asset = builder(**dict(settings))
    if not isinstance(asset, AvatarAsset):
        raise TypeError(f"{builder} returns a {type(asset).__name__}; return an AvatarAsset")
    return asset
