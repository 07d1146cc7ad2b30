"""What refusals of settings say: where, which value, which limit and unit, and which setting may have been meant.

It knows pydantic models and their errors, and no single setting.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, get_args, get_origin

from pydantic import BaseModel

#: Most characters of a value in a message.
MOST_SHOWN = 120
#: What users of Gymnasium may give with settings, and where it belongs.
_ELSEWHERE = {
    "num_envs": "gym.make_vec(..., num_envs=...) makes several environments",
    "autoreset_mode": "gym.make_vec(..., autoreset_mode=...) takes it, of several environments",
    "seed": "reset(seed=...) takes it",
    "options": "reset(options=...) takes them",
}


class ConfigError(ValueError):
    """A configuration that cannot be used; the message is one line that names the key, the value and the limit.

    Its arguments are the message, in parts if there are several things wrong.
    """

    def __str__(self) -> str:
        return "; ".join(str(part) for part in self.args)


def setting_keys(cls: type[BaseModel]) -> tuple[str, ...]:
    """The dotted names of all settings of ``cls``, in order, e.g. ``("physics.fidelity", ..., "obs_mode")``."""
    keys: list[str] = []
    for name, field in cls.model_fields.items():
        section = section_of(field.annotation)
        keys += [f"{name}.{key}" for key in setting_keys(section)] if section else [name]
    return tuple(keys)


def section_of(annotation: Any) -> type[BaseModel] | None:
    """The model that a field nests, or None for a plain value."""
    return annotation if isinstance(annotation, type) and issubclass(annotation, BaseModel) else None


def entry_of(annotation: Any) -> type[BaseModel] | None:
    """The model of a list's entries, or None for what is no list of models."""
    return section_of(get_args(annotation)[0]) if get_origin(annotation) is tuple else None


def shown(value: Any) -> str:
    """A value as messages show it: on one line, and no longer than they can be read."""
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


def error_line(cls: type[BaseModel], error: Mapping[str, Any], path: str | Path | None, given: set[str]) -> str:
    """One validation error as ``[file: ]key=value must be LIMIT [unit]``.

    Args:
        cls: the model that was to be.
        error: what pydantic says is wrong.
        path: the file that the settings are from, if they are from one.
        given: dotted keys that are not from there.
    """
    loc, kind, context = error["loc"], error["type"], error.get("ctx", {})
    key, cause = ".".join(str(part) for part in loc), context.get("error")
    if isinstance(cause, ConfigError):  # of settings that were looked at by themselves
        line = "; ".join(f"{key}.{part}" for part in cause.args)
    elif kind == "extra_forbidden":
        line = _unknown_key(cls, loc)
    elif kind == "missing":
        line = f"{key} is missing, and has no default"
    else:
        if kind in _LIMITS:
            name, words = _LIMITS[kind]
            rule = f"must be {words.format(context[name])}{_unit(cls, loc)}"
        elif kind == "literal_error":
            rule = f"must be one of {context['expected']}"
        elif kind in _KINDS:
            rule = f"must be {_KINDS[kind]}{_unit(cls, loc)}"
        else:
            rule = f"is refused: {cause or error['msg']}"
        line = f"{key or cls.__name__}={shown(error['input'])} {rule}"
    from_file = path is not None and not any(key == one or key.startswith(f"{one}.") for one in given)
    return f"{path}: {line}" if from_file else line


def _holder(cls: type[BaseModel], loc: Sequence[str | int]) -> tuple[type[BaseModel], int]:
    """The innermost model on the way to ``loc``, through sections and lists of them, and how long the way to it is."""
    held, depth = cls, 0
    while depth < len(loc) and loc[depth] in held.model_fields:
        annotation = held.model_fields[loc[depth]].annotation
        entry = entry_of(annotation) if len(loc) > depth + 1 and isinstance(loc[depth + 1], int) else None
        inner = entry or section_of(annotation)
        if inner is None:
            break
        held, depth = inner, depth + (2 if entry else 1)
    return held, depth


def _unit(cls: type[BaseModel], loc: Sequence[str | int]) -> str:
    """The unit that ends the description of the setting at ``loc``, with a space before it, or nothing."""
    held, depth = _holder(cls, loc)
    field = held.model_fields.get(loc[depth]) if depth < len(loc) else None
    found = re.search(r" (\[[^\]\d-][^\]]*\])", (field.description or "") if field else "")
    return f" {found[1]}" if found else ""


def _unknown_key(cls: type[BaseModel], loc: Sequence[str | int]) -> str:
    """That there is no setting at ``loc``, and which one may have been meant; in an entry of a list, one of its own."""
    held, depth = _holder(cls, loc)
    if not any(isinstance(part, int) for part in loc):
        held, depth = cls, 0  # of all sections: what is asked for may be in another one
    entry = "".join(f"{part}." for part in loc[:depth])
    key = ".".join(str(part) for part in loc[depth:])
    names = setting_keys(held)
    section, _, leaf = key.rpartition(".")
    if loc[0] in _ELSEWHERE and len(loc) == 1:
        return f"{key} is no setting of {held.__name__}; {_ELSEWHERE[key]}"
    leaves = {name.rpartition(".")[2]: name for name in reversed(names)}
    close = difflib.get_close_matches(leaf, leaves, n=1, cutoff=0.6)
    sections = [name for name in held.model_fields if name not in names and name != section]
    near = leaves[close[0]] if close else next(iter(difflib.get_close_matches(leaf, sections, n=1)), None)
    if near:
        return f"{entry}{key} is no setting of {held.__name__}; did you mean {entry}{near}?"
    siblings = [name for name in names if name.startswith(f"{section}.")] if section else list(held.model_fields)
    return f"{entry}{key} is no setting of {held.__name__}; there are {', '.join(siblings or names)}"
