"""Command lines of scripts that take settings: ``python -m agents.SCRIPT [KEY=VALUE ...] [--OPTION VALUE ...]``."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

import tyro
import yaml
from pydantic import BaseModel
from tyro.constructors import ConstructorRegistry, StructConstructorSpec, StructFieldSpec, StructTypeInfo

from piavatar_envs.cli import print_any_text
from piavatar_envs.config import ConfigError, load_config

Options = TypeVar("Options")

#: Modules by the folder of a configuration, and settings that distinguish its configuration from others.
_FOLDERS = {
    "fit": "agents.fit",
    "rl_zoo3": "rl_zoo3.train",
    "rllib": "agents.rllib.train",
    "rsl_rl": "agents.rsl_rl.train",
    "sb3": "agents.sb3.train",
    "skrl": "agents.skrl.train",
}
_SETTINGS = {
    "agents.fit": {"parameters", "scorer"},
    "agents.rllib.train": {"iterations", "ppo", "env_runners"},
    "agents.rsl_rl.train": {"iterations", "ppo"},
    "agents.sb3.train": {"total_steps"},
    "agents.skrl.train": {"mappo"},
    "rl_zoo3.train": {"PIAvatar/Reach-v0"},
}

_registry = ConstructorRegistry()


@_registry.struct_rule
def _models(info: StructTypeInfo) -> StructConstructorSpec | None:
    """Parse pydantic models and report their errors in one line."""
    if not (isinstance(info.type, type) and issubclass(info.type, BaseModel)):
        return None
    default = info.default if isinstance(info.default, info.type) else info.type()

    def instantiate(**settings: Any) -> BaseModel:
        try:
            return load_config(info.type, settings)
        except ConfigError as error:
            sys.exit(f"error: {error}")

    instantiate.__doc__ = info.type.__doc__
    fields = [
        StructFieldSpec(name, field.annotation, getattr(default, name), field.description)
        for name, field in info.type.model_fields.items()
    ]
    return StructConstructorSpec(instantiate, tuple(fields))


def read_options(cls: type[Options], script: str, args: Sequence[str] | None = None) -> Options:
    """Parse a command line; settings may stand before, between and after the options.

    Args:
        cls: a dataclass for tyro, whose field ``settings`` holds the settings.
        script: its name, without ``agents.``.
        args: command line, by default the process's own.
    """
    print_any_text()
    program = f"python -m agents.{script}"
    with _registry:
        options, unread = tyro.cli(cls, prog=program, args=args, return_unknown_args=True)
        if any(word.startswith("-") for word in unread):
            return tyro.cli(cls, prog=program, args=args)  # names the unknown options and exits
    # tyro parses adjacent settings and returns those that follow an option
    return replace(options, settings=(*options.settings, *unread))


@contextmanager
def one_line_errors(*kinds: type[Exception]) -> Iterator[None]:
    """End the script with a one-line message for errors of some kinds, instead of a traceback."""
    try:
        yield
    except kinds as error:
        sys.exit(f"error: {error}")


def script_hint(path: Path, script: str) -> str:
    """Return a hint at the script that a refused configuration is for, or an empty string.

    Args:
        path: of the file.
        script: that has refused it, without ``agents.``.
    """
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, yaml.YAMLError):
        return ""  # the error itself names the cause
    names = {str(key).partition(".")[0] for key in content} if isinstance(content, dict) else set()
    known = {other: telling for other, telling in _SETTINGS.items() if telling <= names}
    others = [other for other in known if not any(known[other] < more for more in known.values())]
    asked = f"agents.{script}"
    other = _FOLDERS.get(path.resolve().parent.name, others[0] if len(others) == 1 else asked)
    return "" if other == asked else f" (this is a file for python -m {other})"
