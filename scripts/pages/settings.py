"""Settings of a configuration as rows: name, default, unit, allowed values, meaning."""

from __future__ import annotations

import re
import types
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from pydantic import BaseModel
from pydantic.fields import FieldInfo
from pydantic_core import PydanticUndefined

from piavatar_envs.config import EnvConfig
from piavatar_envs.config.errors import models_of, variants_of
from scripts.pages.markdown import code, listed

_SINGULAR = {float: "number", int: "integer", str: "text", bool: "truth value"}


@dataclass(frozen=True)
class Setting:
    """A row of a table.

    Attributes:
        key: dotted name; of an entry of a list, the bare one.
        default: of the task, as Markdown.
        unit: ``"-"`` for a pure number, empty where there can be none.
        allowed: range, choices or type, as Markdown.
        description: one line, without the unit.
        own: whether the setting, or its default, is the task's own.
    """

    key: str
    default: str
    unit: str
    allowed: str
    description: str
    own: bool


@dataclass(frozen=True)
class Section:
    """Settings of one level: the top (without a name), a section, or each entry of a list."""

    name: str
    description: str
    settings: tuple[Setting, ...]


def sections_of(config: EnvConfig) -> list[Section]:
    """Return every setting of a configuration with its value as the default, by section, the top first."""
    return list(_sections("", "", type(config), config, EnvConfig()))


def _sections(
    name: str, description: str, model: type[BaseModel], values: BaseModel | None, usual: BaseModel | None
) -> Iterator[Section]:
    """Return the section of ``model`` and all below; without ``values``, with the model's defaults."""
    rows, below = [], []
    for key, field in model.model_fields.items():
        path, nested = f"{name}.{key}" if name else key, _model(field.annotation)
        value = getattr(values, key) if values is not None else _default(field)
        other, variants = getattr(usual, key, None), variants_of(field)
        if variants:
            yield from _union(path, field, value, other)
            continue
        if nested:
            inner = value if isinstance(value, BaseModel) else None
            below.append((path, field.description or "", nested, inner, other))
            continue
        own = values is not None and (usual is None or key not in type(usual).model_fields or other != value)
        # no keyword can name an entry of a list
        rows.append(_setting(key if name.endswith("[]") else path, field, value, own))
        item = _item_model(field.annotation)
        if item:
            below.append((f"{path}[]", f"each entry of {path}", item, None, None))
    if rows:
        yield Section(name, description, tuple(rows))
    for deeper in below:
        yield from _sections(*deeper)


def _union(path: str, field: FieldInfo, value: BaseModel, usual: BaseModel | None) -> Iterator[Section]:
    """Return the sections of a discriminated union: its tag, and the other settings of each model."""
    tag, variants = field.discriminator, variants_of(field)
    meaning = "; ".join(model.model_fields[tag].description or "" for model in models_of(field))
    default = getattr(value, tag)
    choices = listed(f'"{one}"' for one in variants)
    own = default != getattr(usual, tag, None)
    row = Setting(f"{path}.{tag}", shown(default), "", choices, meaning, own)
    yield Section(path, field.description or "", (row,))
    for model in models_of(field):
        chosen, common = (one if type(one) is model else model() for one in (value, usual))
        rows = [
            _setting(f"{path}.{key}", inner, getattr(chosen, key), getattr(chosen, key) != getattr(common, key))
            for key, inner in model.model_fields.items()
            if key != tag
        ]
        modes = " or ".join(f'{tag}="{name}"' for name, one in variants.items() if one is model)
        yield Section(path, f"with {modes}", tuple(rows))


def _setting(key: str, field: FieldInfo, value: Any, own: bool) -> Setting:
    text = field.description or ""
    unit = re.search(r" \[([^\]]+)\]$", text)
    plain = text[: unit.start()] if unit else text
    return Setting(key, shown(value), unit[1] if unit else "", allowed(field), plain, own)


def _default(field: FieldInfo) -> Any:
    return field.get_default(call_default_factory=True)


def _model(annotation: Any) -> type[BaseModel] | None:
    return annotation if isinstance(annotation, type) and issubclass(annotation, BaseModel) else None


def _item_model(annotation: Any) -> type[BaseModel] | None:
    """Return the model of a list's or tuple's entries."""
    if get_origin(annotation) in (tuple, list):
        return _model(get_args(annotation)[0])
    return None


def shown(value: Any) -> str:
    """Return a default as code, or "required" if there is none."""
    return "required" if value is PydanticUndefined else code(literal(value))


def literal(value: Any) -> str:
    """Return a value as users write it, without quotes around the names of a mapping."""
    if isinstance(value, BaseModel):
        # only the settings that set an entry apart
        return literal(value.model_dump(exclude_defaults=True))
    if isinstance(value, float):
        return f"{value:g}"
    if isinstance(value, str):
        return f'"{value}"'
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{key}: {literal(item)}" for key, item in value.items()) + "}"
    if isinstance(value, (tuple, list)):
        return "[" + ", ".join(map(literal, value)) + "]"
    return repr(value)


def allowed(field: FieldInfo) -> str:
    """Return the range, choices or type of a field."""
    return _allowed(field.annotation, field.metadata)


def _allowed(annotation: Any, metadata: Any = ()) -> str:
    origin, inner = get_origin(annotation), get_args(annotation)
    if origin is Annotated:
        return _allowed(inner[0], inner[1:])
    if origin in (Union, types.UnionType):
        some = [_allowed(kind, metadata) for kind in inner if kind is not type(None)]
        return " or ".join(some + [code(None)] * (type(None) in inner))
    if origin is Literal:
        return listed(f'"{choice}"' for choice in inner)
    if origin in (tuple, list):
        if origin is tuple and Ellipsis not in inner:
            same = len(set(inner)) == 1
            return f"{len(inner)} {_several(inner[0])}" if same else "; ".join(map(_allowed, inner))
        return f"list of {_several(inner[0])}"
    if origin is dict:
        return "mapping" if inner[1] is Any else f"mapping to {_several(inner[1])}"
    if annotation is bool:
        return listed((True, False))
    limits = _limits(metadata)
    word = _SINGULAR.get(annotation) or getattr(annotation, "__name__", str(annotation))
    return limits if limits and annotation is float else f"{word} {limits}".strip()


def _several(annotation: Any) -> str:
    """Name the entries of a list, in the plural."""
    if _model(annotation):
        return "entries, see below"
    if get_origin(annotation) is Annotated:
        kind, *metadata = get_args(annotation)
        return f"{_several(kind)} {_limits(_flat(metadata))}".strip()
    if annotation in (float, int):
        return f"{_SINGULAR[annotation]}s"
    return "texts" if annotation is str else _allowed(annotation)


def _flat(metadata: Any) -> list[Any]:
    """Return the limits of an ``Annotated``: plain ones, and those inside a pydantic ``Field``."""
    return [limit for item in metadata for limit in (item.metadata if isinstance(item, FieldInfo) else [item])]


def _limits(metadata: Any) -> str:
    """Return an interval or a one-sided bound: ``[0, 1]``, ``(0, 0.2]``, ``> 0``, ``<= 5``."""
    found = {
        name: value
        for limit in metadata
        for name in ("gt", "ge", "lt", "le")
        if (value := getattr(limit, name, None)) is not None
    }
    low = next((name for name in ("gt", "ge") if name in found), None)
    high = next((name for name in ("lt", "le") if name in found), None)
    if low and high:
        return f"{'(' if low == 'gt' else '['}{found[low]:g}, {found[high]:g}{')' if high == 'lt' else ']'}"
    signs = {"gt": ">", "ge": "≥", "lt": "<", "le": "≤"}
    return next((f"{signs[name]} {found[name]:g}" for name in (low, high) if name), "")
