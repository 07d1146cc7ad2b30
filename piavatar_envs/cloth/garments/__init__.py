"""Kinds of garments, one file each.

A kind is a function ``cut(wearer, **settings)`` that returns a :class:`~piavatar_envs.cloth.cut.Cut` for a
:class:`~piavatar_envs.cloth.wearer.Wearer`; its other arguments are its settings, whose annotations hold their limits.
Every module of this package is a kind, under its own name; :func:`register_garment` adds others.
"""

from __future__ import annotations

import importlib
import inspect
import pkgutil
from collections.abc import Callable, Mapping
from typing import Annotated, Any, get_args, get_origin, get_type_hints

from pydantic import TypeAdapter, ValidationError
from pydantic.fields import FieldInfo

from piavatar_envs.cloth.cut import Cut
from piavatar_envs.cloth.wearer import Wearer

#: Cuts a garment for a wearer from the kind's own settings.
Cutter = Callable[..., Cut]

_registered: dict[str, Cutter] = {}


def _own_modules() -> set[str]:
    return {module.name for module in pkgutil.iter_modules(__path__)}


def list_garments() -> tuple[str, ...]:
    """Return the names of all kinds."""
    return tuple(sorted({*_own_modules(), *_registered}))


def register_garment(kind: str, cut: Cutter) -> None:
    """Make garments of your own available as ``{"kind": kind}``, in this process.

    Args:
        kind: its name; registering it again replaces it.
        cut: called with a wearer and the settings that are given; returns a :class:`~piavatar_envs.cloth.cut.Cut`.

    Raises:
        TypeError: ``cut`` is not callable.
        ValueError: a kind of this package has the name.
    """
    if not callable(cut):
        raise TypeError(f"the cut of {kind!r} is a {type(cut).__name__}; pass a function")
    if kind in _own_modules():
        raise ValueError(f"garment {kind!r} is one of this package; use another name")
    _registered[kind] = cut


def check_kind(kind: str) -> str:
    """Return ``kind``.

    Raises:
        ValueError: no garment is of that kind.
    """
    if kind not in list_garments():
        raise ValueError(f"unknown garment {kind!r}; use one of {', '.join(list_garments())}")
    return kind


def settings_of(kind: str) -> dict[str, inspect.Parameter]:
    """Return the settings of a kind by name."""
    parameters = list(inspect.signature(cutter(kind)).parameters.values())[1:]
    return {p.name: p for p in parameters if p.kind in (p.POSITIONAL_OR_KEYWORD, p.KEYWORD_ONLY)}


def check_settings(kind: str, settings: Mapping[str, Any]) -> None:
    """Refuse settings that a kind does not have, values of another type or out of range, and too few of them.

    Raises:
        ValueError: there is one; the message begins with the setting.
    """
    own = settings_of(kind)
    kinds = {parameter.kind for parameter in inspect.signature(cutter(kind)).parameters.values()}
    unknown = [name for name in settings if name not in own]
    if unknown and inspect.Parameter.VAR_KEYWORD not in kinds:
        there = f"it has {', '.join(own)}" if own else "it has no settings"
        raise ValueError(f"{unknown[0]}={settings[unknown[0]]!r} is not a setting of the garment {kind!r}; {there}")
    for name, parameter in own.items():
        if parameter.default is inspect.Parameter.empty and name not in settings:
            raise ValueError(f"{name} is missing: the garment {kind!r} needs it")
    hints = get_type_hints(cutter(kind), include_extras=True)
    for name in settings.keys() & own.keys() & hints.keys():
        try:
            TypeAdapter(hints[name]).validate_python(settings[name], strict=True)
        except ValidationError as error:
            wanted = error.errors()[0]["msg"].replace("Input should be", "must be")
            raise ValueError(
                f"{name}={settings[name]!r} of the garment {kind!r} {wanted}{_unit(hints[name])}"
            ) from None


def cut_garment(kind: str, wearer: Wearer, settings: Mapping[str, Any]) -> Cut:
    """Return a garment cut for a wearer.

    Raises:
        ValueError: no garment is of that kind, its settings are refused, or the body is none that it fits.
        TypeError: the kind returns something else than a cut.
    """
    check_settings(kind, settings)
    cut = cutter(kind)(wearer, **settings)
    if not isinstance(cut, Cut):
        raise TypeError(f"the garment {kind!r} returns a {type(cut).__name__}; return a Cut")
    return cut


def cutter(kind: str) -> Cutter:
    """Return the function that cuts garments of a kind.

    Raises:
        ValueError: no garment is of that kind.
    """
    check_kind(kind)
    return _registered.get(kind) or importlib.import_module(f"{__name__}.{kind}").cut


def describe(kind: str, setting: str) -> str:
    """Return the description of a setting with its unit, empty without one."""
    hint = get_type_hints(cutter(kind), include_extras=True).get(setting)
    return next((item.description or "" for item in _notes(hint)), "")


def _notes(hint: Any) -> list[FieldInfo]:
    """Return the limits and descriptions of an annotation, also within a union."""
    if get_origin(hint) is Annotated:
        return [item for item in get_args(hint)[1:] if isinstance(item, FieldInfo)]
    return [note for part in get_args(hint) for note in _notes(part)]


def _unit(hint: Any) -> str:
    """Return the unit that ends a description, with a space before it, or nothing."""
    text = next((item.description or "" for item in _notes(hint)), "")
    start = text.rfind(" [")
    return text[start:] if text.endswith("]") and start >= 0 else ""
