"""Saved states: the settings that they hold, and the checks that a state passes before anything changes.

A state maps names to arrays whose first dimension is the environment. The settings on which the future depends are
part of it, as JSON in bytes, one row for each environment: a state can be split, joined and stored like other arrays.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel

from piavatar_envs.config.errors import shown
from piavatar_envs.core.reading import UNREADABLE, files_behind

#: Name of the settings in a state.
SETTINGS = "env.settings"
#: Settings without effect on the future, and the setting that a state holds as a number of its own.
_SHOWN, _BEGUN_WITH = ("render", "pixels", "obs_mode"), "root_assist"
#: Arrays that may hold numbers that are not finite: the next step finds them and ends the episode with a failure.
_FOUND_BY_STEPS = ("particles.x", "particles.u", "particles.C", "particles.F", "cloth.x", "cloth.v")
#: How the names of external forces begin; a state has them only after the first force.
FORCES = "forces."
#: How the names of shares of root assistance end.
_ASSIST = ".assist"


def has_forces(state: Mapping[str, Any]) -> bool:
    """Return whether a state has arrays of external forces: it was saved after the first one."""
    return any(name.startswith(FORCES) for name in state)


def add_forces(state: Mapping[str, Any], present: Mapping[str, np.ndarray]) -> dict[str, Any]:
    """Return a state with the arrays of external forces that ``present`` has, zeroed: no force acts."""
    rows = len(next(iter(state.values()), ()))
    missing = {name: np.zeros_like(value[:rows]) for name, value in present.items() if name.startswith(FORCES)}
    return {**state, **missing}


def check_state(state: Any, num_envs: int) -> None:
    """Refuse a state that does not fit ``num_envs`` environments, or that holds numbers out of range.

    Raises:
        ValueError: no mapping, an array of another number of environments, or a number that is not finite. Exempt are
            numbers that the next step finds, and environments that have failed, except for arrays that resets keep.
    """
    if not isinstance(state, Mapping):
        raise ValueError(f"the state is a {type(state).__name__} without any arrays; use what get_state() returned")
    arrays = {name: np.asarray(value) for name, value in state.items()}
    for name, value in arrays.items():
        if value.shape[:1] != (num_envs,):
            expected = (num_envs, *value.shape[1:])
            raise ValueError(f"state[{name!r}] has shape {value.shape}, expected {expected} for num_envs={num_envs}")
    failed = np.zeros(num_envs, bool)
    failure = arrays.get("particles.failure")
    if failure is not None and failure.dtype.kind == "i":
        failed = failure.reshape(num_envs, -1).any(1)
    for name, value in arrays.items():
        if value.dtype.kind == "f" and name not in _FOUND_BY_STEPS:
            kept = _kept_by_resets(name)
            _check_finite(name, value, failed & (not kept))
            if kept:
                _check_range(name, value, 1.0 if name.endswith(_ASSIST) else np.inf)


def _kept_by_resets(name: str) -> bool:
    """Return whether resets keep an array or parts of it: materials of bodies, and the root assistance."""
    return name.startswith(("matter.", "contact.")) or name.endswith(_ASSIST)


def _check_range(name: str, value: np.ndarray, most: float) -> None:
    """Refuse numbers that are negative or above ``most``."""
    bad = (value < 0.0) | (value > most)
    if bad.any():
        first = tuple(np.argwhere(bad)[0].tolist())
        limit = f" and <= {most:g}" if np.isfinite(most) else ""
        raise ValueError(
            f"state[{name!r}]{list(first)}={value[first]} must be >= 0{limit}; use what get_state() returned"
        )


def _check_finite(name: str, value: np.ndarray, failed: np.ndarray) -> None:
    """Refuse numbers that are not finite where the environment has not failed."""
    bad = ~np.isfinite(value)
    if bad.any():
        bad[failed] = False
    if bad.any():
        first = tuple(np.argwhere(bad)[0].tolist())
        raise ValueError(f"state[{name!r}]{list(first)} is {value[first]}, not finite; use what get_state() returned")


def file_digests(config: BaseModel) -> dict[str, str]:
    """Return a digest of every file that a setting names by its path (a clip, a mesh), by the setting's dotted name.

    A file may be followed by ``#`` and the name of a part. Of a folder, the names and contents of all its files count,
    of a ``.gltf`` those of the files that it names.
    """

    def files(value: Any, name: str) -> Iterator[tuple[str, Path]]:
        if isinstance(value, (Mapping, list)):
            for key, item in value.items() if isinstance(value, Mapping) else enumerate(value):
                yield from files(item, f"{name}.{key}" if name else str(key))
        elif isinstance(value, str) and (Path(value).suffix or _may_be_folder(name, value)):
            paths = (Path(text) for text in (value, value.rpartition("#")[0]) if text)
            folder = _may_be_folder(name, value)
            yield from ((name, path) for path in paths if path.is_file() or (folder and path.is_dir()))

    return {name: _digest(path) for name, path in files(config.model_dump(mode="json"), "")}


def _may_be_folder(name: str, value: str) -> bool:
    """Return whether a setting may name a folder: by a slash, or where an avatar source takes it as a path anyway."""
    *sections, last = name.split(".")
    return "/" in value or ("avatar" in sections and last != "source")


def _digest(path: Path) -> str:
    """Return a digest of a file, or of all files of a folder or of a ``.gltf``."""
    files = files_behind(path)
    if files == [path]:
        return _digest_of_file(path)
    folder, digest = path if path.is_dir() else path.parent, hashlib.sha256()
    for file in files:
        digest.update(f"{file.relative_to(folder).as_posix()}\0{_digest_of_file(file)}\n".encode())
    return digest.hexdigest()[:16]


def _digest_of_file(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()[:16]


def settings_rows(config: BaseModel, num_envs: int, files: Mapping[str, str]) -> np.ndarray:
    """Encode the settings on which the future depends, and the digests of their files.

    Args:
        config: the settings.
        num_envs: number of environments.
        files: of :func:`file_digests`, when the environment was built.

    Returns:
        JSON in UTF-8, ``(num_envs, length)`` uint8.
    """
    kept = {name: value for name, value in config.model_dump(mode="json").items() if name not in _SHOWN}
    if files:
        kept["files"] = dict(files)
    text = json.dumps(_without_beginnings(kept), sort_keys=True, separators=(",", ":"))
    return np.tile(np.frombuffer(text.encode(), np.uint8), (num_envs, 1))


def check_settings(state: Mapping[str, Any], config: BaseModel, files: Mapping[str, str]) -> None:
    """Refuse a state that was saved under settings that would change its future.

    Args:
        state: of any number of environments; one without settings passes here and is refused as incomplete.
        config: settings of the environment that is to continue from it.
        files: digests of its files.

    Raises:
        ValueError: a setting or the content of a file differs, or the settings cannot be read.
    """
    if SETTINGS not in state:
        return
    saved, own = np.asarray(state[SETTINGS]), settings_rows(config, 1, files)
    if saved.dtype != np.uint8 or saved.ndim != 2:
        raise ValueError(_unreadable(f"has shape {saved.shape} and type {saved.dtype}"))
    unlike = (saved != own).any(1) if saved.shape[1] == own.shape[1] else np.ones(len(saved), bool)
    for row in np.unique(saved[unlike], axis=0):
        _compare(row, own[0])


def check_arrays(state: Mapping[str, Any], present: Mapping[str, np.ndarray]) -> None:
    """Refuse a state whose arrays are not those of an environment; its settings are compared elsewhere.

    Args:
        state: the state.
        present: that of the environment as it is.

    Raises:
        ValueError: arrays are missing, unknown, or of another shape or type.
    """
    if set(state) != set(present):
        missing, unknown = sorted(set(present) - set(state)), sorted(set(state) - set(present))
        raise ValueError(f"the state is of another environment: missing {missing}, unknown {unknown}")
    for name, have in present.items():
        value = np.asarray(state[name])
        if name != SETTINGS and (value.shape != have.shape or value.dtype != have.dtype):
            expected = f"expected {have.shape} and {have.dtype}"
            raise ValueError(f"state[{name!r}] has shape {value.shape} and type {value.dtype}, {expected}")


def _compare(saved: np.ndarray, own: np.ndarray) -> None:
    """Refuse the encoded settings of one environment where they differ from ``own``."""
    try:
        then = json.loads(saved.tobytes())
    except UNREADABLE:
        raise ValueError(_unreadable("is not a text of settings")) from None
    unlike = _first_unlike(then, json.loads(own.tobytes()))
    if unlike:
        name, was, now = unlike
        raise ValueError(
            f"the state was saved with {name}={shown(was)}, this environment has {shown(now)}; make one with the "
            f"state's settings, or, to go on under others, put state[{SETTINGS!r}] of this one's get_state() into it"
        )


def _unreadable(what: str) -> str:
    return f"state[{SETTINGS!r}] {what}; use what get_state() returned"


def _without_beginnings(value: Any) -> Any:
    """Drop from nested settings those that only initialise a new environment."""
    if isinstance(value, Mapping):
        return {name: _without_beginnings(item) for name, item in value.items() if name != _BEGUN_WITH}
    return [_without_beginnings(item) for item in value] if isinstance(value, list) else value


def _first_unlike(was: Any, now: Any, name: str = "") -> tuple[str, Any, Any] | None:
    """Return the first difference between nested settings: dotted name and both values, or None."""
    if isinstance(was, Mapping) and isinstance(now, Mapping):
        pairs = [(key, was.get(key), now.get(key)) for key in sorted({*was, *now})]
    elif _are_entries(was) and _are_entries(now) and len(was) == len(now):
        pairs = [(index, *pair) for index, pair in enumerate(zip(was, now, strict=True))]
    else:
        return None if was == now else (name, was, now)
    found = (_first_unlike(old, new, f"{name}.{key}" if name else str(key)) for key, old, new in pairs)
    return next(filter(None, found), None)


def _are_entries(value: Any) -> bool:
    """Return whether a value is a list of sections, not of numbers or names."""
    return isinstance(value, list) and all(isinstance(item, Mapping) for item in value)
