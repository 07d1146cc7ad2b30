"""Scorers: each module of this folder holds one, found by the module's name, with its settings as ``Config``.

A scorer reads episodes of :mod:`agents.fit.rollout` and returns a number for each. One of your own is another module
here, or a class passed to :func:`register_scorer`.
"""

from __future__ import annotations

import importlib
import pkgutil
from typing import ClassVar, Literal, Protocol

from pydantic import BaseModel

_REGISTERED: dict[str, type[Scorer]] = {}


class Unscored(Exception):
    """An episode that has no score, as a rebound without a contact; the message says why."""


class Scorer(Protocol):
    """A judge of episodes.

    One whose score is a distance may also have ``residuals(episode)``, the differences as a vector: the best is then
    found by a model of these.

    Attributes:
        Config: its settings.
        direction: whether the best score is the greatest or the least, unless the study says otherwise.
        unit: of the score.
        readings: names of what it reads, of :mod:`piavatar_envs.api.readings`, or ``"time"``.
        pictures: number of frames of an episode that it sees; 0 for none.
    """

    Config: ClassVar[type[BaseModel]]
    direction: Literal["maximize", "minimize"]
    unit: str
    readings: tuple[str, ...]
    pictures: int

    def __init__(self, config: BaseModel) -> None:
        """Read what the settings name.

        Raises:
            ConfigError: a file of the settings cannot be read.
            MissingExtra: a library is not installed.
        """

    def connect(self, world) -> None:
        """Check the settings against a :class:`~agents.fit.rollout.World` before anything is played.

        Raises:
            ConfigError: they do not fit the world.
        """

    def score(self, episode) -> float:
        """Return the score of an :class:`~agents.fit.rollout.Episode`.

        Raises:
            Unscored: it has none.
        """


def register_scorer(name: str, scorer: type[Scorer]) -> None:
    """Register a scorer of your own by a name that ``scorer`` and ``scorers`` of a study then know."""
    _REGISTERED[name] = scorer


def scorer_names() -> tuple[str, ...]:
    """Return the names of all scorers."""
    return (*sorted(module.name for module in pkgutil.iter_modules(__path__)), *_REGISTERED)


def scorer_class(name: str) -> type[Scorer]:
    """Return the class of a scorer.

    Raises:
        ValueError: there is none of that name.
    """
    if name in _REGISTERED:
        return _REGISTERED[name]
    if name not in scorer_names():
        raise ValueError(f"there is no scorer {name!r}; use one of {', '.join(scorer_names())}")
    return importlib.import_module(f"{__name__}.{name}").SCORER
