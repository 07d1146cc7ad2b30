"""Errors of settings as one line: key, value, limit with unit, and the setting that may have been meant.

Its functions work on any pydantic model; :func:`setting_keys` and its neighbours read the structure of one.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_args, get_origin

from pydantic import BaseModel
from pydantic.fields import FieldInfo

#: Greatest length of a value in a message [characters].
MOST_SHOWN = 120
#: Arguments of Gymnasium that are no settings, and the call that takes them.
_ELSEWHERE = {
    "num_envs": "use gym.make_vec(..., num_envs=...)",
    "autoreset_mode": "use gym.make_vec(..., autoreset_mode=...)",
    "seed": "use reset(seed=...)",
    "options": "use reset(options=...)",
}


class ConfigError(ValueError):
    """A configuration that cannot be used; its arguments are the errors, one line each with key, value and limit."""

    def __str__(self) -> str:
        """Join the errors to one line."""
        return "; ".join(str(part) for part in self.args)


class UnexpectedKeyword(ConfigError, TypeError):
    """A keyword of a call that is not a setting; libraries that try their own keywords look for Python's TypeError."""

    def __init__(self, *errors: object) -> None:
        # gym.make appends all arguments of the call to the message of a TypeError
        super().__init__(*(str(error).partition(" was raised from the environment creator")[0] for error in errors))


def setting_keys(cls: type[BaseModel]) -> tuple[str, ...]:
    """Return the dotted names of all settings of ``cls``, in order, e.g. ``("physics.fidelity", ..., "obs_mode")``."""
    keys: dict[str, None] = {}
    for name, field in cls.model_fields.items():
        models = models_of(field)
        below = [f"{name}.{key}" for model in models for key in setting_keys(model)]
        keys.update(dict.fromkeys(below if models else [name]))
    return tuple(keys)


def section_of(annotation: Any) -> type[BaseModel] | None:
    """Return the model that a field nests, or None for a plain value."""
    # in Python 3.10, a generic such as tuple[int, int] is a type, too
    plain = get_origin(annotation) is None and isinstance(annotation, type)
    return annotation if plain and issubclass(annotation, BaseModel) else None


def variants_of(field: FieldInfo) -> dict[str, type[BaseModel]]:
    """Return the models of a discriminated union by the values of its tag; empty for any other field."""
    if not isinstance(field.discriminator, str):
        return {}
    models = get_args(field.annotation)
    return {tag: model for model in models for tag in get_args(model.model_fields[field.discriminator].annotation)}


def models_of(field: FieldInfo) -> tuple[type[BaseModel], ...]:
    """Return the models that a field may hold: one of a section, several of a union, none of a plain value."""
    section = section_of(field.annotation)
    return (section,) if section else tuple(dict.fromkeys(variants_of(field).values()))


def entry_of(annotation: Any) -> type[BaseModel] | None:
    """Return the model of a list's entries, or None for any other field."""
    return section_of(get_args(annotation)[0]) if get_origin(annotation) is tuple else None


def shown(value: Any) -> str:
    """Return a value as messages show it, on one line and at most :data:`MOST_SHOWN` characters long."""
    text = " ".join(repr(value).split())
    return text if len(text) <= MOST_SHOWN else f"{text[:MOST_SHOWN]}..."


_KINDS = {
    "float_type": "a number",
    "int_type": "a whole number",
    "bool_type": "true or false",
    "string_type": "a string",
    "dict_type": "a mapping of names to values",
    "model_type": "a section, with its settings below it",
    "tuple_type": "a list",
    "list_type": "a list",
    "finite_number": "a finite number",
}
_LIMITS = {
    "greater_than": ("gt", "> {:g}"),
    "greater_than_equal": ("ge", ">= {:g}"),
    "less_than": ("lt", "< {:g}"),
    "less_than_equal": ("le", "<= {:g}"),
    "multiple_of": ("multiple_of", "a multiple of {:g}"),
    "too_long": ("max_length", "a list of at most {}"),
    "too_short": ("min_length", "a list of at least {}"),
    "string_too_short": ("min_length", "a string of at least {} character"),
}


@dataclass(frozen=True)
class _Place:
    """The place of an error in a configuration.

    Attributes:
        key: its dotted name, without the tags of unions.
        entry: the part of ``key`` up to the innermost entry of a list, with a dot at its end.
        model: the innermost model on the way to it.
        rest: the part of the way that begins in ``model``.
        union: the field whose union ``model`` is one of, and its dotted name; None for other models.
    """

    key: str
    entry: str
    model: type[BaseModel]
    rest: tuple[str | int, ...]
    union: tuple[str, FieldInfo] | None = None

    @property
    def field(self) -> FieldInfo | None:
        """The setting itself, or None where the model has none of that name."""
        return self.model.model_fields.get(str(self.rest[0])) if self.rest else None


def _locate(cls: type[BaseModel], loc: Sequence[str | int]) -> _Place:
    """Follow ``loc`` from ``cls`` through sections, unions of them and lists of them."""
    model, depth, entry, union = cls, 0, 0, None
    parts: list[str] = []
    while depth < len(loc) and (name := str(loc[depth])) in model.model_fields:
        field, below = model.model_fields[name], loc[depth + 1] if depth + 1 < len(loc) else None
        variants, item = variants_of(field), entry_of(field.annotation)
        if item and isinstance(below, int):
            parts += [name, str(below)]
            model, depth, entry, union = item, depth + 2, len(parts), None
        elif variants and below in variants:
            parts.append(name)
            model, depth, union = variants[below], depth + 2, (".".join(parts), field)
        elif section := section_of(field.annotation):
            parts.append(name)
            model, depth, union = section, depth + 1, None
        else:
            break
    rest = tuple(loc[depth:])
    key = ".".join([*parts, *map(str, rest)])
    return _Place(key, "".join(f"{part}." for part in parts[:entry]), model, rest, union)


def error_line(cls: type[BaseModel], error: Mapping[str, Any], path: str | Path | None, given: set[str]) -> str:
    """Write one validation error as ``[file: ]key=value must be LIMIT [unit]``.

    Args:
        cls: the model that was to be built.
        error: an entry of pydantic's list of errors.
        path: the file that the settings are from, if they are from one.
        given: dotted keys that are not from there.
    """
    place, kind, context = _locate(cls, error["loc"]), error["type"], error.get("ctx", {})
    key, cause, value = place.key, context.get("error"), error["input"]
    if isinstance(cause, ConfigError):  # of a part that was validated by itself
        line = "; ".join(f"{key}.{part}" if key else part for part in cause.args)
        key = line.partition("=")[0]
    elif kind == "extra_forbidden":
        line = _unknown_key(cls, place, value)
    elif kind == "missing":
        line = f"{key} is missing, and has no default"
    else:
        if kind in _LIMITS:
            name, words = _LIMITS[kind]
            rule = f"must be {words.format(context[name])}{_unit(place)}"
        elif kind == "literal_error":
            rule = f"must be one of {context['expected']}"
        elif kind == "union_tag_invalid":
            tag = context["discriminator"].strip("'")
            key, value, rule = f"{key}.{tag}", value[tag], f"must be one of {context['expected_tags']}"
        elif kind in _KINDS:
            rule = f"must be {_KINDS[kind]}{_unit(place)}"
        else:
            rule = f"is refused: {cause or error['msg']}"
        line = f"{key or cls.__name__}={shown(value)} {rule}"
    from_file = path is not None and not any(key == one or key.startswith(f"{one}.") for one in given)
    return f"{path}: {line}" if from_file else line


def _unit(place: _Place) -> str:
    """Return the unit that ends the description of the setting, with a space before it, or nothing."""
    found = re.search(r" (\[[^\]\d-][^\]]*\])", (place.field.description or "") if place.field else "")
    return f" {found[1]}" if found else ""


def _unknown_key(cls: type[BaseModel], place: _Place, value: Any) -> str:
    """Say that there is no such setting, and name a close one; in an entry of a list, one of the entry's own."""
    if line := _other_variant(place, value):
        return line
    held = place.model if place.entry else cls  # of all sections: the setting may be in another one
    key, names = place.key.removeprefix(place.entry), setting_keys(held)
    section, _, leaf = key.rpartition(".")
    if key in _ELSEWHERE and not place.entry:
        return f"{key} is not a setting of {held.__name__}; {_ELSEWHERE[key]}"
    leaves = {name.rpartition(".")[2]: name for name in reversed(names)}
    close = difflib.get_close_matches(leaf, leaves, n=1, cutoff=0.6)
    sections = [name for name in held.model_fields if name not in names and name != section]
    near = leaves[close[0]] if close else next(iter(difflib.get_close_matches(leaf, sections, n=1)), None)
    if near:
        return f"{place.key} is not a setting of {held.__name__}; did you mean {place.entry}{near}?"
    siblings = [name for name in names if name.startswith(f"{section}.")] if section else list(held.model_fields)
    return f"{place.key} is not a setting of {held.__name__}; there are {', '.join(siblings or names)}"


def _other_variant(place: _Place, value: Any) -> str | None:
    """Say which variants of a union have the setting; None if none has it."""
    if place.union is None:
        return None
    name, field = place.union
    variants = variants_of(field)
    tags = [tag for tag, model in variants.items() if place.rest[0] in model.model_fields]
    own = [tag for tag, model in variants.items() if model is place.model]
    if not tags:
        return None
    tag, those = f"{name}.{field.discriminator}", " or ".join(map(repr, tags))
    return (
        f"{place.key}={shown(value)} belongs to {tag}={those}, and has no effect under {' or '.join(map(repr, own))}; "
        f"leave it out, or set {tag}={tags[0]!r}"
    )
