"""The settings in a state: those that decide what comes of it, so that no environment of others takes it for its own.

They are text (JSON) in bytes, a row an environment as all of a state: it can be cut, joined, kept in any file of arrays
and made a tensor like the rest.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import numpy as np
from pydantic import BaseModel

from piavatar_envs.config.errors import shown

#: Their name in a state.
SETTINGS = "env.settings"
#: What changes nothing that happens; and what holds until somebody says otherwise, so that the state has it as it is.
_SHOWN, _BEGUN_WITH = ("render", "obs_mode"), "root_assist"


def settings_rows(config: BaseModel, num_envs: int) -> np.ndarray:
    """What decides the future in ``config``, for each environment: JSON in UTF-8, ``(num_envs, length)`` uint8."""
    kept = {name: value for name, value in config.model_dump(mode="json").items() if name not in _SHOWN}
    text = json.dumps(_without_beginnings(kept), sort_keys=True, separators=(",", ":"))
    return np.tile(np.frombuffer(text.encode(), np.uint8), (num_envs, 1))


def check_settings(state: Mapping[str, Any], config: BaseModel) -> None:
    """Refuse a state that was saved under settings by which its future would be another one.

    Args:
        state: of any number of environments; whether it holds settings is for others to see.
        config: settings of the environment that shall go on from it.

    Raises:
        ValueError: a setting differs, or there are none to be read.
    """
    if SETTINGS not in state:
        return
    saved, own = np.asarray(state[SETTINGS]), settings_rows(config, 1)
    if saved.dtype != np.uint8 or saved.ndim != 2:
        raise ValueError(_unreadable(f"has shape {saved.shape} and type {saved.dtype}"))
    unlike = (saved != own).any(1) if saved.shape[1] == own.shape[1] else np.ones(len(saved), bool)
    for row in np.unique(saved[unlike], axis=0):
        _compare(row, own[0])


def _compare(saved: np.ndarray, own: np.ndarray) -> None:
    """Refuse one environment's settings where they are not those of ``own``, both as they are in a state."""
    try:
        then = json.loads(saved.tobytes())
    except ValueError:  # also of bytes that are no text
        raise ValueError(_unreadable("is no text of settings")) from None
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
    """Nested settings, without those that are only what a new environment begins with."""
    if isinstance(value, Mapping):
        return {name: _without_beginnings(item) for name, item in value.items() if name != _BEGUN_WITH}
    return [_without_beginnings(item) for item in value] if isinstance(value, list) else value


def _first_unlike(was: Any, now: Any, name: str = "") -> tuple[str, Any, Any] | None:
    """The first of what is not alike in nested settings: its dotted name and both values, None where there is none."""
    if isinstance(was, Mapping) and isinstance(now, Mapping):
        pairs = [(key, was.get(key), now.get(key)) for key in sorted({*was, *now})]
    elif _are_entries(was) and _are_entries(now) and len(was) == len(now):
        pairs = [(index, *pair) for index, pair in enumerate(zip(was, now, strict=True))]
    else:
        return None if was == now else (name, was, now)
    found = (_first_unlike(old, new, f"{name}.{key}" if name else str(key)) for key, old, new in pairs)
    return next(filter(None, found), None)


def _are_entries(value: Any) -> bool:
    """Whether it is a list of sections, not of numbers or names."""
    return isinstance(value, list) and all(isinstance(item, Mapping) for item in value)
