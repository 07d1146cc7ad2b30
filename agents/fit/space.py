"""Parameters of a study as settings of an environment: names, bounds of the schema, and values set in a configuration.

A name is dotted and counts entries of lists from 0: ``physics.young_modulus``, ``scene.props.0.velocity.1``. A setting
that is a range, from which episodes draw, is set to a range of one value: ``randomize.mass_factor``, ``ball_mass``.

A batch holds some settings for each of its environments (:attr:`Space.shared`), so trials that differ in these alone
are played at once; any other setting needs a build of its own for each of its values.
"""

from __future__ import annotations

import difflib
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, get_args, get_origin

import numpy as np
from pydantic import BaseModel

from agents.fit.config import FitConfig, ParameterConfig
from piavatar_envs.config import ConfigError, EnvConfig, RandomizeConfig, load_config
from piavatar_envs.envs.batch_env import BatchEnv
from piavatar_envs.sim.props import LEAST_DENSITY, MOST_DENSITY
from piavatar_envs.tasks import load_task

#: Names of the factors that a batch holds for each environment.
FACTORS = tuple(f"randomize.{name}" for name in RandomizeConfig.model_fields)


@dataclass(frozen=True)
class Axis:
    """One parameter of a study.

    Attributes:
        name: dotted name of the setting.
        low, high: bounds.
        log: whether its scale is logarithmic.
        whole: whether it is a whole number.
        ranged: whether the setting is a range, which becomes ``(value, value)``.
    """

    name: str
    low: float
    high: float
    log: bool
    whole: bool
    ranged: bool

    def share(self, value: float | np.ndarray) -> np.ndarray:
        """Map values to [0, 1] on the scale of the parameter."""
        value = np.asarray(value, np.float64)
        if self.log:
            return np.log(value / self.low) / math.log(self.high / self.low)
        return (value - self.low) / (self.high - self.low)

    def value(self, share: float) -> float | int:
        """Map a share in [0, 1] to a value."""
        if self.log:
            value = self.low * (self.high / self.low) ** share
        else:
            value = self.low + share * (self.high - self.low)
        value = min(max(float(value), self.low), self.high)
        return int(round(value)) if self.whole else value


def _limits(annotation: Any, metadata: Sequence[Any] = ()) -> dict[str, float]:
    """Return the limits that a setting's annotation states, by ``ge``, ``gt``, ``le`` and ``lt``."""
    found: dict[str, float] = {}
    if get_origin(annotation) is Annotated:
        annotation, *inner = get_args(annotation)
        metadata = (*inner, *metadata)
    for entry in metadata:
        for part in (entry, *getattr(entry, "metadata", ())):
            for name in ("ge", "gt", "le", "lt"):
                if isinstance(limit := getattr(part, name, None), (int, float)):
                    found[name] = limit
    for argument in get_args(annotation):
        found = {**_limits(argument), **found}
    return found


def _kinds(annotation: Any) -> set[type]:
    """Return the plain types that an annotation has, also within unions and tuples."""
    arguments = get_args(annotation)
    if not arguments:
        return {annotation} if isinstance(annotation, type) else {Any}
    if get_origin(annotation) is Annotated:
        arguments = arguments[:1]
    return set().union(*(_kinds(argument) for argument in arguments if argument is not ...))


def _find(config: BaseModel, name: str) -> tuple[Any, dict[str, float], bool]:
    """Return annotation and limits of a setting, and whether it is a range.

    Raises:
        ConfigError: there is no such setting.
    """
    value: Any = config
    annotation, metadata = Any, ()
    parts = name.split(".")
    for depth, part in enumerate(parts):
        known: Sequence[str] = ()
        if isinstance(value, BaseModel):
            known = tuple(type(value).model_fields)
            if part in known:
                field = type(value).model_fields[part]
                annotation, metadata, value = field.annotation, field.metadata, getattr(value, part)
                continue
        elif isinstance(value, (tuple, list)):
            known = tuple(map(str, range(len(value))))
            if part in known:
                arguments = [entry for entry in get_args(_plain(annotation)) if entry is not ...]
                annotation = arguments[min(int(part), len(arguments) - 1)] if arguments else Any
                metadata, value = (), value[int(part)]
                continue
        elif isinstance(value, Mapping) and depth == len(parts) - 1:
            arguments = get_args(_plain(annotation))
            annotation, metadata, value = arguments[1] if arguments else Any, (), value.get(part)
            continue
        above = ".".join(parts[:depth])
        near = difflib.get_close_matches(part, known, 1)
        hint = f"did you mean {'.'.join([*parts[:depth], near[0]])}?" if near else f"there are {', '.join(known)}"
        raise ConfigError(
            f"parameters.{name} is not a setting of {type(config).__name__}"
            + (f"; {hint}" if known else f": {above} has no parts; set it under env to what the trials begin from")
        )
    if isinstance(value, BaseModel):
        raise ConfigError(f"parameters.{name} is a section; name one of its numbers: {', '.join(value.model_dump())}")
    kinds = _kinds(annotation)
    ranged = isinstance(value, tuple) and len(value) == 2
    if not kinds & {int, float, Any} or (isinstance(value, (tuple, list)) and not ranged) or isinstance(value, bool):
        raise ConfigError(f"parameters.{name} is not a number; a study varies numbers only")
    return annotation, _limits(annotation, metadata), ranged


def _plain(annotation: Any) -> Any:
    """Return an annotation without ``Annotated`` and without None."""
    if get_origin(annotation) is Annotated:
        return _plain(get_args(annotation)[0])
    arguments = [entry for entry in get_args(annotation) if entry is not type(None)]
    return arguments[0] if type(None) in get_args(annotation) and arguments else annotation


def _axis(config: EnvConfig, name: str, given: ParameterConfig) -> Axis:
    """Resolve a parameter of a study by the schema.

    Raises:
        ConfigError: no such setting, no bounds, or bounds without a range.
    """
    annotation, limits, ranged = _find(config, name)
    low = given.low if given.low is not None else limits.get("ge", limits.get("gt"))
    high = given.high if given.high is not None else limits.get("le", limits.get("lt"))
    for side, bound in (("low", low), ("high", high)):
        if bound is None:
            raise ConfigError(f"parameters.{name}.{side} is missing, and the schema sets no such limit")
    if not low < high or (given.scale == "log" and low <= 0.0):
        positive = "> 0 and " if given.scale == "log" else ""
        raise ConfigError(f"parameters.{name}: low={low:g} must be {positive}below high={high:g}")
    whole = int in (kinds := _kinds(annotation)) and not kinds & {float, Any}
    if whole and (low != int(low) or high != int(high)):
        raise ConfigError(f"parameters.{name}: low={low:g} and high={high:g} must be whole numbers")
    return Axis(name, float(low), float(high), given.scale == "log", whole, ranged)


def _assign(settings: dict[str, Any], name: str, value: Any) -> None:
    """Set a dotted name in the JSON form of a configuration."""
    *path, last = name.split(".")
    for part in path:
        settings = settings[int(part)] if isinstance(settings, list) else settings[part]
    if isinstance(settings, list):
        settings[int(last)] = value
    else:
        settings[last] = value


class Space:
    """The parameters of a study.

    Attributes:
        axes: the parameters, in the order of the configuration.
        task_class: of the environment.
        base: settings of the environment that all trials share.
        shared: axes that a batch holds for each of its environments.
    """

    def __init__(self, config: FitConfig) -> None:
        """Resolve the parameters and check that the environment takes both ends of every range.

        Raises:
            ConfigError: a name that is not a numeric setting, or a bound that the environment refuses.
        """
        self.task_class = load_task(config.env_id)
        self.base = load_config(self.task_class.Config, config.env)
        self.axes = tuple(_axis(self.base, name, given) for name, given in config.parameters.items())
        self.shared = tuple(axis for axis in self.axes if self._varies_in_a_batch(axis))
        for axis in self.axes:
            for side in (axis.value(0.0), axis.value(1.0)):
                try:
                    self._with({axis.name: side}, self.base)
                except ConfigError as error:
                    raise ConfigError(f"parameters.{axis.name}: {error}") from None

    def _varies_in_a_batch(self, axis: Axis) -> bool:
        """Return whether a batch can hold the setting for each of its environments.

        Factors of ``randomize`` are, and the mass of a prop of the scene whose Young's modulus follows from it.
        """
        section, _, setting = axis.name.rpartition(".")
        if section.startswith("scene.props.") and setting == "mass":
            return self.base.scene.props[int(section.rpartition(".")[2])].young_modulus is None
        return axis.name in FACTORS

    def _with(self, values: Mapping[str, Any], config: EnvConfig) -> EnvConfig:
        """Return a validated copy of ``config`` with settings changed."""
        settings = config.model_dump(mode="json")
        ranged = {axis.name for axis in self.axes if axis.ranged}
        for name, value in values.items():
            one = name in ranged and not isinstance(value, (list, tuple))
            _assign(settings, name, [value, value] if one else value)
        return load_config(type(config), settings)

    def settings(self, values: Mapping[str, float]) -> EnvConfig:
        """Return the settings of a trial, from which an environment of its own is made."""
        return self._with(values, self.base)

    def build_settings(self, values: Mapping[str, float]) -> EnvConfig:
        """Return the settings of a build for a trial, and for all others that differ in :attr:`shared` alone.

        Factors get their whole range, for which the time step is chosen, and masses the middle of theirs.
        """
        own = {axis.name: values[axis.name] for axis in self.axes if axis not in self.shared}
        for axis in self.shared:
            own[axis.name] = [axis.low, axis.high] if axis.name in FACTORS else axis.value(0.5)
        return self._with(own, self.base)

    def build_key(self, values: Mapping[str, float]) -> str:
        """Return a key that trials have in common which one batch can hold."""
        return json.dumps([values[axis.name] for axis in self.axes if axis not in self.shared])

    def place(self, batch: BatchEnv, values: Sequence[Mapping[str, float]]) -> None:
        """Set the parameters in :attr:`shared` of every environment of a batch, from its next reset on.

        Args:
            batch: built with :meth:`build_settings`.
            values: of each environment.

        Raises:
            ConfigError: a prop would be too light or too heavy for its size.
        """
        for axis in self.shared:
            own = np.array([row[axis.name] for row in values])
            if axis.name in FACTORS:
                batch.simulation.randomization.fix(axis.name.partition(".")[2], own)
                continue
            props = batch.simulation.props
            index = props.index(self.base.scene.props[int(axis.name.split(".")[2])].name)
            density = props.density.numpy().copy()
            density[:, index] = own / props.volume[index]
            if not ((density >= LEAST_DENSITY) & (density <= MOST_DENSITY)).all():
                raise ConfigError(
                    f"{axis.name}={own.tolist()} kg in {props.volume[index]:.3g} m^3 is not a possible density"
                )
            props.density.assign(density)

    def shares(self, values: Sequence[Mapping[str, float]]) -> np.ndarray:
        """Map trials to points of the unit cube, shape ``(trials, parameters)``."""
        rows = [[float(axis.share(row[axis.name])) for axis in self.axes] for row in values]
        return np.array(rows, np.float64).reshape(len(rows), len(self.axes))

    def values(self, shares: Sequence[float]) -> dict[str, float]:
        """Map a point of the unit cube to values by name."""
        return {axis.name: axis.value(float(share)) for axis, share in zip(self.axes, shares, strict=True)}
