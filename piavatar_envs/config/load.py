"""Reading, merging and printing configurations, for any pydantic model.

Overrides are expanded to nested mappings, merged in order, and validated once and strictly, so that a file, a keyword
and a command line are refused alike, in one line.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import IO, Any, TypeVar

import numpy as np
import yaml
from pydantic import BaseModel, ValidationError
from pydantic.fields import FieldInfo

from piavatar_envs.config.errors import (
    ConfigError,
    UnexpectedKeyword,
    entry_of,
    error_line,
    models_of,
    section_of,
    setting_keys,
    shown,
    variants_of,
)
from piavatar_envs.core.reading import UNREADABLE

Config = TypeVar("Config", bound=BaseModel)

_NAMES = "the name of a setting is a string"
#: Greatest number of values in a document, each alias counted as what it stands for.
_MOST_VALUES = 100_000
#: Tag of the key ``<<``, which merges another mapping.
_MERGE = "tag:yaml.org,2002:merge"


class _Loader(yaml.SafeLoader):
    """SafeLoader that refuses a key given twice and reads numbers as YAML 1.2 does.

    In YAML 1.1, ``017`` is 15, ``1:30`` is 90 and ``1e5`` is a string.
    """

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict:
        """Construct a mapping whose keys are given once, but for those of merged mappings."""
        keys = [self.construct_object(key, deep=True) for key, _ in node.value if key.tag != _MERGE]
        twice = next((key for i, key in enumerate(keys) if key in keys[:i]), None)
        if twice is not None:
            raise yaml.constructor.ConstructorError(None, None, f"the key {twice!r} is given twice", node.start_mark)
        return super().construct_mapping(node, deep)


#: Tags of numbers, their forms in YAML 1.2 and the characters with which they may begin.
_NUMBERS = {
    "tag:yaml.org,2002:int": (r"[-+]?[0-9][0-9_]*|0x[0-9a-fA-F]+", "-+0123456789"),
    "tag:yaml.org,2002:float": (
        r"[-+]?(\.[0-9]+|[0-9][0-9_]*(\.[0-9_]*)?)([eE][-+]?[0-9]+)?|[-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN)",
        "-+.0123456789",
    ),
}


def _construct_integer(loader: yaml.SafeLoader, node: yaml.ScalarNode) -> int:
    text = loader.construct_scalar(node).replace("_", "")
    return int(text, 16 if text.startswith("0x") else 10)


_Loader.yaml_implicit_resolvers = {
    first: [(tag, form) for tag, form in found if tag not in _NUMBERS]
    for first, found in yaml.SafeLoader.yaml_implicit_resolvers.items()
}
for _tag, (_form, _first) in _NUMBERS.items():
    _Loader.add_implicit_resolver(_tag, re.compile(rf"^(?:{_form})$"), list(_first))
_Loader.add_constructor("tag:yaml.org,2002:int", _construct_integer)


def load_config(
    cls: type[Config],
    source: Mapping[str, Any] | str | Path | Config | None = None,
    overrides: Mapping[str, Any] | None = None,
) -> Config:
    """Build a configuration: defaults, then ``source``, then ``overrides``.

    Args:
        cls: the model, e.g. a task's configuration.
        source: nothing, a mapping, the path of a YAML file, or a configuration to start from.
        overrides: settings that override ``source``; nested, dotted, or bare where the name is unique.

    Raises:
        ConfigError: the settings are no mapping, or have an unknown key, a wrong type or a value out of range; one line
            for all errors.
    """
    path = source if isinstance(source, (str, Path)) else None
    base = _expand(cls, _read_settings(cls, Path(path)) if path is not None else _settings("config", source))
    above = _expand(cls, _settings("overrides", overrides))
    chosen = _merge(base, above)
    base, above = _with_preset(cls, base, chosen), _with_preset(cls, above, chosen)
    merged = _merge(_without_replaced_variants(cls, base, above), above)
    merged = _merge(_without_replaced_variants(cls, _own_defaults(cls, merged), merged), merged)
    try:
        # as JSON, files, keywords and command lines are validated alike: a list may be a tuple, a string is no number
        return cls.model_validate_json(json.dumps(plain(merged)))
    except ValidationError as error:
        given = set(_flat_keys(above))
        raise ConfigError(*(error_line(cls, item, path, given) for item in error.errors(include_url=False))) from None


def load_keywords(
    cls: type[Config], source: Mapping[str, Any] | str | Path | Config | None, keywords: Mapping[str, Any]
) -> Config:
    """Build a configuration from the ``config`` and the other keywords of a call; see :func:`load_config`.

    Raises:
        ConfigError: as :func:`load_config`.
        UnexpectedKeyword: a keyword is not a setting; its message has Python's words for that.
    """
    try:
        return load_config(cls, source, keywords)
    except ConfigError as error:
        unknown = [key for key in keywords if _qualified(cls, key).partition(".")[0] not in cls.model_fields]
        if not unknown:
            raise
        raise UnexpectedKeyword(f"got an unexpected keyword argument {unknown[0]!r}", *error.args) from None


def replace(config: Config, overrides: Mapping[str, Any] | None = None, /, **settings: Any) -> Config:
    """Return a validated copy with settings changed: ``replace(config, {"control.tone": 0}, fidelity="tiny")``.

    Raises:
        ConfigError: as :func:`load_config`.
    """
    both = _merge(_expand(type(config), overrides or {}), _expand(type(config), settings))
    return load_config(type(config), config, both)


def dump_yaml(config: BaseModel) -> str:
    """Write a resolved configuration as YAML, from which :func:`load_config` returns an equal one."""
    return yaml.safe_dump(config.model_dump(mode="json"), sort_keys=False, default_flow_style=False, allow_unicode=True)


def parse_assignments(assignments: Iterable[str]) -> dict[str, Any]:
    """Parse overrides of a command line, ``["control.tone=0.3", "fidelity=tiny"]``, whose values are YAML.

    Raises:
        ConfigError: an assignment has no ``=``, its value is not YAML, or a key comes twice.
    """
    overrides: dict[str, Any] = {}
    for assignment in assignments:
        key, equals, text = assignment.partition("=")
        if not equals or not key.strip():
            raise ConfigError(f"{assignment!r} is not an override; write KEY=VALUE, e.g. control.tone=0.3")
        if key.strip() in overrides:
            raise ConfigError(f"{key.strip()} is given twice, last as {text!r}; give it once")
        try:
            overrides[key.strip()] = _parse(text)
        except (yaml.YAMLError, *UNREADABLE) as error:
            raise ConfigError(f"{key.strip()}={text!r} is not a YAML value: {_one_line(error)}") from None
    return overrides


def read_yaml(path: Path) -> Mapping[str, Any]:
    """Read a YAML file of settings.

    Raises:
        ConfigError: it cannot be read, is not YAML, or has no mapping.
    """
    try:
        with path.open(encoding="utf-8") as stream:
            content = _parse(stream)
    except OSError as error:
        raise ConfigError(f"cannot read the configuration {path}: {error.strerror}") from None
    except (yaml.YAMLError, *UNREADABLE) as error:
        raise ConfigError(f"{path} is not YAML: {_one_line(error)}") from None
    if content is not None and not isinstance(content, dict):
        raise ConfigError(f"{path} holds a {type(content).__name__}, not settings; write lines of KEY: VALUE")
    return content or {}


def _parse(source: str | IO[str]) -> Any:
    """Construct the value of a YAML document, whose aliases are expanded within limits.

    Raises:
        yaml.YAMLError: it is not YAML, or expands to more than :data:`_MOST_VALUES`.
    """
    loader = _Loader(source)
    try:
        node = loader.get_single_node()
        if node is None:
            return None
        _count(node, {})
        return loader.construct_document(node)
    finally:
        loader.dispose()


def _count(node: yaml.Node, counted: dict[yaml.Node, int | None]) -> int:
    """Count the values below a node, those of an alias (``*name``) once more wherever it stands.

    Args:
        node: of the document.
        counted: the counts of nodes so far; None for those that hold this one.

    Raises:
        yaml.YAMLError: there are too many, or a node holds itself.
    """
    if node in counted:
        total = counted[node]
        if total is None:
            raise yaml.constructor.ConstructorError(
                None, None, "a value holds itself; write it out instead of by an alias", node.start_mark
            )
        return total
    counted[node], total = None, 1
    if isinstance(node, yaml.MappingNode):
        total += sum(_count(part, counted) for pair in node.value for part in pair)
    elif isinstance(node, yaml.SequenceNode):
        total += sum(_count(part, counted) for part in node.value)
    if total > _MOST_VALUES:
        message = f"more than {_MOST_VALUES} values once aliases are expanded; write fewer"
        raise yaml.constructor.ConstructorError(None, None, message, node.start_mark)
    counted[node] = total
    return total


def _read_settings(cls: type[BaseModel], path: Path) -> Mapping[str, Any]:
    """Read a YAML file of settings, but refuse that of a training run where those of an environment are expected.

    Raises:
        ConfigError: as :func:`read_yaml`, or the file is that of a training.
    """
    content = read_yaml(path)
    if "env_id" in content and "env_id" not in cls.model_fields:
        raise ConfigError(
            f"{path} is the file of a training run; settings of its environment are those under its key env"
        )
    return content


def _settings(what: str, given: Any) -> Mapping[str, Any] | BaseModel:
    """Return the settings that are passed to a call, an empty mapping for None.

    Raises:
        ConfigError: they are neither a mapping nor a configuration.
    """
    if given is None:
        return {}
    if not isinstance(given, (Mapping, BaseModel)):
        raise ConfigError(
            f"{what}={shown(given)} is of type {type(given).__name__}; settings are a mapping of names to values, the "
            "path of a YAML file, or a configuration"
        )
    return given


def _expand(
    cls: type[BaseModel] | tuple[type[BaseModel], ...], settings: Mapping[str, Any] | BaseModel, prefix: str = ""
) -> dict[str, Any]:
    """Turn dotted and bare keys into nested mappings.

    Args:
        cls: the model that is to be built; several where it is one of a union.
        settings: by nested, dotted or bare name.
        prefix: dotted name of the section that they are in, with a dot at its end.

    Raises:
        ConfigError: a name is not a string or has an empty part, or a setting is given twice.
    """
    if isinstance(settings, BaseModel):
        return settings.model_dump(mode="json")
    models = cls if isinstance(cls, tuple) else (cls,)
    nested: dict[str, Any] = {}
    for key, value in settings.items():
        if not isinstance(key, str):
            raise ConfigError(f"{prefix}{key!r} is of type {type(key).__name__}; {_NAMES}")
        if "" in key.split("."):
            raise ConfigError(
                f"{prefix}{key!r} is not the name of a setting; write names without empty parts, as control.tone"
            )
        head, _, rest = (key if prefix else _qualified(models[0], key)).partition(".")
        field = next((model.model_fields[head] for model in models if head in model.model_fields), None)
        value = _expand_value(field, {rest: value} if rest else value, f"{prefix}{head}.")
        twice = set(_flat_keys({head: value})) & set(_flat_keys(nested))
        if twice:
            raise ConfigError(f"{prefix}{min(twice)} is given twice, last as {shown(value)}; give it once")
        nested = _merge(nested, {head: value})
    return nested


def _expand_value(field: FieldInfo | None, value: Any, prefix: str) -> Any:
    """Expand the value of a section, of a union of sections, or of a list of them; return any other as it is."""
    models = models_of(field) if field else ()
    if models and value is None:
        return {}  # a section whose lines are all commented out
    if field and variants_of(field) and not isinstance(value, (Mapping, BaseModel)):
        return {field.discriminator: value}  # control="pd" is short for control.mode="pd"
    if isinstance(value, (Mapping, BaseModel)):
        return _expand(models, value, prefix) if models else dict(value)
    entry = entry_of(field.annotation) if field else None
    if entry and isinstance(value, (list, tuple)):
        return [
            _expand(entry, item, f"{prefix}{index}.") if isinstance(item, (Mapping, BaseModel)) else item
            for index, item in enumerate(value)
        ]
    return value


def _qualified(cls: type[BaseModel], key: str) -> str:
    """Return the dotted name of a bare key, if exactly one section has a setting of that name, or the model says which.

    Raises:
        ConfigError: several sections have one.
    """
    if "." in key or key in cls.model_fields:
        return key
    if chosen := getattr(cls, "bare_names", {}).get(key):
        return chosen
    found = [name for name in setting_keys(cls) if name.rpartition(".")[2] == key]
    if len(found) > 1:
        raise ConfigError(f"{key} is ambiguous in {cls.__name__}; say which: {' or '.join(found)}")
    return found[0] if found else key


def _merge(base: Mapping[str, Any], top: Mapping[str, Any]) -> dict[str, Any]:
    """Merge ``top`` into ``base``, mapping by mapping."""
    merged = dict(base)
    for key, value in top.items():
        both = isinstance(value, Mapping) and isinstance(merged.get(key), Mapping)
        merged[key] = _merge(merged[key], value) if both else value
    return merged


def _with_preset(cls: type[BaseModel], layer: dict[str, Any], chosen: Mapping[str, Any]) -> dict[str, Any]:
    """Add the settings of the preset that a layer names, if it does; the layer's other settings win over them.

    Args:
        cls: the model, which may have ``presets``.
        layer: expanded settings.
        chosen: all expanded settings, which say what variant of a union it is.
    """
    name = layer.get("preset")
    preset = getattr(cls, "presets", {}).get(name) if isinstance(name, str) else None
    if preset is None:
        return layer
    known: dict[str, Any] = {}
    for section, settings in preset.items():
        field, given = cls.model_fields[section], chosen.get(section) or {}
        model = _variant(field, given) if variants_of(field) else section_of(field.annotation)
        known[section] = {key: value for key, value in settings.items() if model and key in model.model_fields}
    return _merge(known, layer)


def _without_replaced_variants(
    cls: type[BaseModel], base: Mapping[str, Any], top: Mapping[str, Any]
) -> Mapping[str, Any]:
    """Drop from ``base`` the settings of a union's variant that ``top`` replaces by another one, in sections too."""
    kept = dict(base)
    for name, field in cls.model_fields.items():
        if not isinstance(base.get(name), Mapping) or not isinstance(top.get(name), Mapping):
            continue
        if section := section_of(field.annotation):
            kept[name] = _without_replaced_variants(section, base[name], top[name])
        if not variants_of(field):
            continue
        before = _variant(field, base[name])
        after = _variant(field, {field.discriminator: base[name].get(field.discriminator, ...)} | top[name])
        if before and before is not after:
            kept[name] = {key: value for key, value in base[name].items() if key not in before.model_fields}
    return kept


def _variant(field: FieldInfo, settings: Mapping[str, Any]) -> type[BaseModel] | None:
    """Return the model that ``settings`` choose from a union, by default that of the field's default; None for none."""
    tag = settings.get(str(field.discriminator), ...)
    if tag is ...:
        return type(field.get_default(call_default_factory=True))
    return variants_of(field).get(tag) if isinstance(tag, str) else None


def _own_defaults(cls: type[BaseModel], settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return the defaults by ``cls`` of the sections that ``settings`` mention: a task's may not be the section's own.

    Of a union, those of another variant than the default's are its own; only the tag must then be given.
    """
    defaults: dict[str, Any] = {}
    for name, field in cls.model_fields.items():
        if not models_of(field) or not isinstance(settings.get(name), Mapping) or field.is_required():
            continue
        default = field.get_default(call_default_factory=True)
        if not variants_of(field) or _variant(field, settings[name]) is type(default):
            defaults[name] = default.model_dump(mode="json")
    return defaults


def _flat_keys(nested: Mapping[str, Any], prefix: str = "") -> list[str]:
    """Return the dotted names of all values."""
    keys: list[str] = []
    for key, value in nested.items():
        keys += _flat_keys(value, f"{prefix}{key}.") if isinstance(value, Mapping) else [f"{prefix}{key}"]
    return keys


def plain(value: Any, key: str = "") -> Any:
    """Return the JSON form of a value of a Python caller or of YAML, such as a NumPy array, a path or a model.

    Raises:
        ConfigError: it has none, or a name is not a string.
    """
    if isinstance(value, BaseModel):
        return value.model_dump(mode="json")
    if isinstance(value, Mapping):
        for name in value:
            if not isinstance(name, str):
                raise ConfigError(f"{key}.{name!r} is of type {type(name).__name__}; {_NAMES}")
        return {name: plain(item, f"{key}.{name}" if key else name) for name, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(item, f"{key}.{index}") for index, item in enumerate(value)]
    if isinstance(value, (np.generic, np.ndarray)):
        return plain(value.tolist(), key)
    if isinstance(value, Path):
        return str(value)
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    raise ConfigError(
        f"{key}={shown(value)} is of type {type(value).__name__}; a setting is a number, a string, a list or a mapping"
    )


def _one_line(error: Exception) -> str:
    """Return a message without line breaks, or the name of an error without one."""
    return " ".join(str(error).split()) or type(error).__name__
