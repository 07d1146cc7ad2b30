"""Reading, merging and printing configurations: the machinery below :mod:`piavatar_envs.envs.config`.

It knows pydantic models and YAML, and no single setting. Overrides are expanded to nested mappings, merged in order,
and validated once, strictly, so that a file, a keyword and a command line are refused alike, in one readable line.
"""

from __future__ import annotations

import difflib
import json
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import yaml
from pydantic import BaseModel, ValidationError

Config = TypeVar("Config", bound=BaseModel)


class ConfigError(ValueError):
    """A configuration that cannot be used; the message is one line that names the key, the value and the limit."""


#: Of a key ``<<``, which stands for those of another mapping.
_MERGE = "tag:yaml.org,2002:merge"


class _Loader(yaml.SafeLoader):
    """SafeLoader that refuses a key given twice and reads ``1e5`` as a number (YAML 1.1 makes it a string)."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict:
        keys = [self.construct_object(key, deep=True) for key, _ in node.value if key.tag != _MERGE]
        twice = next((key for i, key in enumerate(keys) if key in keys[:i]), None)
        if twice is not None:
            raise yaml.constructor.ConstructorError(None, None, f"the key {twice!r} is given twice", node.start_mark)
        return super().construct_mapping(node, deep)


_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float", re.compile(r"^[-+]?(\d[\d_]*\.?\d*|\.\d+)[eE][-+]?\d+$"), list("-+.0123456789")
)


def load_config(
    cls: type[Config],
    source: Mapping[str, Any] | str | Path | Config | None = None,
    overrides: Mapping[str, Any] | None = None,
) -> Config:
    """Build a configuration: defaults, then ``source``, then ``overrides``.

    Args:
        cls: the model, e.g. a task's configuration.
        source: nothing, a mapping, the path of a YAML file, or a configuration to start from.
        overrides: settings that win over ``source``; nested, dotted, or bare where the name is unique.

    Raises:
        ConfigError: unknown key, wrong type or value out of range; one line for all that is wrong.
    """
    path = source if isinstance(source, (str, Path)) else None
    base = _read_yaml(Path(path)) if path is not None else source
    merged = _merge(_expand(cls, base or {}), _expand(cls, overrides or {}))
    merged = _merge(_own_defaults(cls, merged), merged)
    try:
        # JSON is what YAML, keywords and command lines have in common: a list may be a tuple, a string is no number.
        return cls.model_validate_json(json.dumps(merged, default=_plain))
    except ValidationError as error:
        given = set(_flat_keys(_expand(cls, overrides or {})))
        lines = [_error_line(cls, item, path, given) for item in error.errors(include_url=False)]
        raise ConfigError("; ".join(lines)) from None


def replace(config: Config, overrides: Mapping[str, Any] | None = None, /, **settings: Any) -> Config:
    """A validated copy of ``config`` with settings changed: ``replace(config, {"drive.tone": 0}, fidelity="tiny")``.

    Raises:
        ConfigError: as :func:`load_config`.
    """
    both = _merge(_expand(type(config), overrides or {}), _expand(type(config), settings))
    return load_config(type(config), config, both)


def dump_yaml(config: BaseModel) -> str:
    """The whole resolved configuration as YAML; :func:`load_config` reads it back to an equal one."""
    return yaml.safe_dump(config.model_dump(mode="json"), sort_keys=False, default_flow_style=False, allow_unicode=True)


def parse_assignments(assignments: Iterable[str]) -> dict[str, Any]:
    """Overrides from a command line: ``["drive.tone=0.3", "fidelity=tiny"]``, the values read as YAML.

    Raises:
        ConfigError: an assignment has no ``=``, its value is not YAML, or a key comes twice.
    """
    overrides: dict[str, Any] = {}
    for assignment in assignments:
        key, equals, text = assignment.partition("=")
        if not equals or not key.strip():
            raise ConfigError(f"{assignment!r} is not an override; write KEY=VALUE, e.g. drive.tone=0.3")
        if key.strip() in overrides:
            raise ConfigError(f"{key.strip()} is given twice, last as {text!r}; give it once")
        try:
            overrides[key.strip()] = yaml.load(text, _Loader)
        except yaml.YAMLError as error:
            raise ConfigError(f"{key.strip()}={text!r} is not a YAML value: {_one_line(error)}") from None
    return overrides


def setting_keys(cls: type[BaseModel]) -> tuple[str, ...]:
    """The dotted names of all settings of ``cls``, in order, e.g. ``("physics.fidelity", ..., "obs_mode")``."""
    keys: list[str] = []
    for name, field in cls.model_fields.items():
        section = _section(field.annotation)
        keys += [f"{name}.{key}" for key in setting_keys(section)] if section else [name]
    return tuple(keys)


def _read_yaml(path: Path) -> Mapping[str, Any]:
    try:
        with path.open(encoding="utf-8") as stream:
            content = yaml.load(stream, _Loader)
    except OSError as error:
        raise ConfigError(f"cannot read the configuration {path}: {error.strerror}") from None
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path} is not YAML: {_one_line(error)}") from None
    if content is not None and not isinstance(content, dict):
        raise ConfigError(f"{path} holds a {type(content).__name__}, not settings; write lines of KEY: VALUE")
    return content or {}


def _section(annotation: Any) -> type[BaseModel] | None:
    """The model that a field nests, or None for a plain value."""
    return annotation if isinstance(annotation, type) and issubclass(annotation, BaseModel) else None


def _expand(cls: type[BaseModel], settings: Mapping[str, Any] | BaseModel, prefix: str = "") -> dict[str, Any]:
    """Dotted and bare keys to nested mappings; refuses a setting that is given twice."""
    if isinstance(settings, BaseModel):
        return settings.model_dump(mode="json")
    nested: dict[str, Any] = {}
    for key, value in settings.items():
        if not isinstance(key, str):
            raise ConfigError(f"{prefix}{key!r} is of type {type(key).__name__}; the name of a setting is a string")
        head, _, rest = (key if prefix else _qualified(cls, key)).partition(".")
        section = _section(cls.model_fields[head].annotation) if head in cls.model_fields else None
        if rest:
            value = {rest: value}
        if section and value is None:
            value = {}  # a section whose lines are all commented out
        elif section and head in section.model_fields and not isinstance(value, (Mapping, BaseModel)):
            value = {head: value}  # drive="target" means drive.drive
        if section and isinstance(value, (Mapping, BaseModel)):
            value = _expand(section, value, f"{prefix}{head}.")
        elif isinstance(value, (Mapping, BaseModel)):
            value = dict(value)
        twice = set(_flat_keys({head: value})) & set(_flat_keys(nested))
        if twice:
            raise ConfigError(f"{prefix}{min(twice)} is given twice, last as {value!r}; give it once")
        nested = _merge(nested, {head: value})
    return nested


def _qualified(cls: type[BaseModel], key: str) -> str:
    """The dotted name of a bare key, if exactly one section has a setting of that name."""
    if "." in key or key in cls.model_fields:
        return key
    found = [name for name in setting_keys(cls) if name.rpartition(".")[2] == key]
    if len(found) > 1:
        raise ConfigError(f"{key} is ambiguous in {cls.__name__}; say which: {' or '.join(found)}")
    return found[0] if found else key


def _merge(base: Mapping[str, Any], top: Mapping[str, Any]) -> dict[str, Any]:
    """``base`` with ``top`` laid over it, mapping by mapping."""
    merged = dict(base)
    for key, value in top.items():
        both = isinstance(value, Mapping) and isinstance(merged.get(key), Mapping)
        merged[key] = _merge(merged[key], value) if both else value
    return merged


def _own_defaults(cls: type[BaseModel], settings: Mapping[str, Any]) -> dict[str, Any]:
    """Defaults by ``cls`` of the sections of which ``settings`` has some: a task's may not be the section's own."""
    sections = {name: field for name, field in cls.model_fields.items() if _section(field.annotation)}
    return {
        name: field.get_default(call_default_factory=True).model_dump(mode="json")
        for name, field in sections.items()
        if isinstance(settings.get(name), Mapping) and not field.is_required()
    }


def _flat_keys(nested: Mapping[str, Any], prefix: str = "") -> list[str]:
    keys: list[str] = []
    for key, value in nested.items():
        keys += _flat_keys(value, f"{prefix}{key}.") if isinstance(value, Mapping) else [f"{prefix}{key}"]
    return keys


def _plain(value: Any) -> Any:
    """JSON form of what Python callers pass: NumPy numbers and arrays, paths, and models in a list."""
    if isinstance(value, BaseModel):
        return value.model_dump(mode="json")
    if isinstance(value, (np.generic, np.ndarray)):
        return value.tolist()
    if isinstance(value, Path):
        return str(value)
    raise ConfigError(
        f"{value!r} is of type {type(value).__name__}; a setting is a number, a string, a list or a mapping"
    )


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())


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
    "greater_than": ("gt", "> {}"),
    "greater_than_equal": ("ge", ">= {}"),
    "less_than": ("lt", "< {}"),
    "less_than_equal": ("le", "<= {}"),
    "multiple_of": ("multiple_of", "a multiple of {}"),
}


def _error_line(cls: type[BaseModel], error: Mapping[str, Any], path: str | Path | None, given: set[str]) -> str:
    """One validation error as ``[file: ]key=value must be LIMIT [unit]``."""
    key, kind, context = ".".join(str(part) for part in error["loc"]), error["type"], error.get("ctx", {})
    if kind == "extra_forbidden":
        line = _unknown_key(cls, key)
    elif kind == "missing":
        line = f"{key} is missing, and has no default"
    else:
        if kind in _LIMITS:
            name, words = _LIMITS[kind]
            rule = f"must be {words.format(f'{context[name]:g}')}{_unit(cls, key)}"
        elif kind == "literal_error":
            rule = f"must be one of {context['expected']}"
        elif kind in _KINDS:
            rule = f"must be {_KINDS[kind]}{_unit(cls, key)}"
        else:
            rule = f"is refused: {context.get('error', error['msg'])}"
        line = f"{key or cls.__name__}={error['input']!r} {rule}"
    return f"{path}: {line}" if path is not None and key not in given else line


def _unit(cls: type[BaseModel], key: str) -> str:
    """The unit that ends the description of setting ``key``, with a space before it, or nothing."""
    model: type[BaseModel] | None = cls
    field = None
    for part in key.split("."):
        if model is None or part not in model.model_fields:
            break
        field = model.model_fields[part]
        model = _section(field.annotation)
    found = re.search(r" (\[[^\]\d-][^\]]*\])", (field.description or "") if field else "")
    return f" {found[1]}" if found else ""


def _unknown_key(cls: type[BaseModel], key: str) -> str:
    names = setting_keys(cls)
    section, _, leaf = key.rpartition(".")
    leaves = {name.rpartition(".")[2]: name for name in reversed(names)}
    close = difflib.get_close_matches(leaf, leaves, n=1, cutoff=0.6)
    sections = [name for name in cls.model_fields if name not in names]
    near = leaves[close[0]] if close else next(iter(difflib.get_close_matches(leaf, sections, n=1)), None)
    if near:
        return f"{key} is no setting of {cls.__name__}; did you mean {near}?"
    siblings = [name for name in names if name.startswith(f"{section}.")] if section else list(cls.model_fields)
    return f"{key} is no setting of {cls.__name__}; there are {', '.join(siblings or names)}"
