"""Command lines of scripts that take settings: ``python -m agents.SCRIPT [KEY=VALUE ...] [--OPTION VALUE ...]``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TypeVar

import tyro

Options = TypeVar("Options")


def read_options(cls: type[Options], script: str, args: Sequence[str] | None = None) -> Options:
    """What a command line says; settings may stand before, between and after the options.

    Args:
        cls: a dataclass for tyro, whose field ``settings`` holds the settings.
        script: its name, without ``agents.``.
        args: command line, by default the process's own.
    """
    program = f"python -m agents.{script}"
    options, unread = tyro.cli(cls, prog=program, args=args, return_unknown_args=True)
    if any(word.startswith("-") for word in unread):
        return tyro.cli(cls, prog=program, args=args)  # says which options there are not, and exits
    # tyro takes settings that stand together, and hands back those beyond an option
    return replace(options, settings=(*options.settings, *unread))
