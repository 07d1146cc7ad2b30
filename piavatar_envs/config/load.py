"""Reading, merging and printing configurations: the machinery below :mod:`piavatar_envs.config`.

It knows pydantic models and YAML, and no single setting. Overrides are expanded to nested mappings, merged in order,
and validated once, strictly, so that a file, a keyword and a command line are refused alike, in one readable line.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import yaml
from pydantic import BaseModel, ValidationError

from piavatar_envs.config.errors import (
    ConfigError,
    entry_of,
    error_line,
    section_of,
    setting_keys,
    shown,
)

Config = TypeVar("Config", bound=BaseModel)

_NAMES = "the name of a setting is a string"
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
        ConfigError: what is given is no settings; unknown key, wrong type or value out of range; one line for all that
            is wrong.
    """
    path = source if isinstance(source, (str, Path)) else None
    base = _expand(cls, _read_settings(cls, Path(path)) if path is not None else _settings("config", source))
    above = _expand(cls, _settings("overrides", overrides))
    merged = _merge(base, above)
    merged = _merge(_own_defaults(cls, merged), merged)
    try:
        # JSON is what YAML, keywords and command lines have in common: a list may be a tuple, a string is no number.
        return cls.model_validate_json(json.dumps(_plain(merged)))
    except ValidationError as error:
        given = set(_flat_keys(above))
        raise ConfigError(*(error_line(cls, item, path, given) for item in error.errors(include_url=False))) from None


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
    try:
        json.dumps(content, default=str, skipkeys=True)
    except ValueError:  # an alias (*name) within its own anchor (&name)
        raise ConfigError(f"{path} has a value that holds itself; write it out instead of by an alias") from None
    return content or {}


def _read_settings(cls: type[BaseModel], path: Path) -> Mapping[str, Any]:
    """What a YAML file holds; that of a training is refused where settings of an environment are asked for."""
    content = _read_yaml(path)
    if "env_id" in content and "env_id" not in cls.model_fields:
        raise ConfigError(f"{path} is the file of a training; settings of its environment are those under its key env")
    return content


def _settings(what: str, given: Any) -> Mapping[str, Any] | BaseModel:
    """Settings as they are given to a call, nothing for None.

    Raises:
        ConfigError: they are something else, which would be taken for nothing where it is false.
    """
    if given is None:
        return {}
    if not isinstance(given, (Mapping, BaseModel)):
        raise ConfigError(
            f"{what}={shown(given)} is of type {type(given).__name__}; settings are a mapping of names to values, the "
            "path of a YAML file, or a configuration"
        )
    return given


def _expand(cls: type[BaseModel], settings: Mapping[str, Any] | BaseModel, prefix: str = "") -> dict[str, Any]:
    """Dotted and bare keys to nested mappings; refuses a setting that is given twice."""
    if isinstance(settings, BaseModel):
        return settings.model_dump(mode="json")
    nested: dict[str, Any] = {}
    for key, value in settings.items():
        if not isinstance(key, str):
            raise ConfigError(f"{prefix}{key!r} is of type {type(key).__name__}; {_NAMES}")
        if "" in key.split("."):
            raise ConfigError(f"{prefix}{key!r} is no name of a setting; names are as drive.tone, without empty parts")
        head, _, rest = (key if prefix else _qualified(cls, key)).partition(".")
        annotation = cls.model_fields[head].annotation if head in cls.model_fields else None
        section, entry = section_of(annotation), entry_of(annotation)
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
        elif entry and isinstance(value, (list, tuple)):
            value = [
                _expand(entry, item, f"{prefix}{head}.{index}.") if isinstance(item, (Mapping, BaseModel)) else item
                for index, item in enumerate(value)
            ]
        twice = set(_flat_keys({head: value})) & set(_flat_keys(nested))
        if twice:
            raise ConfigError(f"{prefix}{min(twice)} is given twice, last as {shown(value)}; give it once")
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
    sections = {name: field for name, field in cls.model_fields.items() if section_of(field.annotation)}
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


def _plain(value: Any, key: str = "") -> Any:
    """JSON form of what Python callers and YAML pass: also NumPy numbers and arrays, paths, and models in a list.

    Raises:
        ConfigError: there is none, or a name is no string.
    """
    if isinstance(value, BaseModel):
        return value.model_dump(mode="json")
    if isinstance(value, Mapping):
        for name in value:
            if not isinstance(name, str):
                raise ConfigError(f"{key}.{name!r} is of type {type(name).__name__}; {_NAMES}")
        return {name: _plain(item, f"{key}.{name}" if key else name) for name, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(item, f"{key}.{index}") for index, item in enumerate(value)]
    if isinstance(value, (np.generic, np.ndarray)):
        return _plain(value.tolist(), key)
    if isinstance(value, Path):
        return str(value)
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    raise ConfigError(
        f"{key}={shown(value)} is of type {type(value).__name__}; a setting is a number, a string, a list or a mapping"
    )


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())
