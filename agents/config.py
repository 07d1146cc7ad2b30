"""Configurations of training runs: what they share in all libraries, seeds of episodes, and what a policy is for."""

from __future__ import annotations

import sys
from collections.abc import Callable, Collection, Mapping
from pathlib import Path
from typing import Annotated, Any, TypeVar

from pydantic import BaseModel, Field

from piavatar_envs.config import FROZEN, ConfigError, EnvConfig, FrozenDict, load_config
from piavatar_envs.envs.task import Task
from piavatar_envs.multi import Game, load_game

Resolved = TypeVar("Resolved", bound=BaseModel)

#: Of the hidden layers of a network.
Widths = tuple[Annotated[int, Field(ge=1)], ...]
#: Hyper-parameters that several algorithms have, each with its own default.
Discount = Annotated[float, Field(gt=0.0, le=1.0, description="discount of a step's reward, gamma [-]")]
GaeLambda = Annotated[float, Field(ge=0.0, le=1.0, description="bias against variance of the advantage [-]")]
ClipRange = Annotated[float, Field(gt=0.0, description="largest change of an action's probability ratio [-]")]
ValueWeight = Annotated[float, Field(ge=0.0, description="weight of the critic's squared error [-]")]
EntropyWeight = Annotated[float, Field(ge=0.0, description="weight of the entropy bonus [-]")]
LogStd = Annotated[float, Field(ge=-10.0, le=2.0, description="logarithm of the first actions' standard deviation [-]")]
#: Training episodes begin here; those of evaluations, which no agent was trained on, end before it.
FIRST_TRAINED = 2**30
#: Environments that one training run can have: so many seeds are its own.
MOST_ENVS = 2**16
#: Seeds that training runs can have: the episodes' seeds stay below 2^31.
MOST_RUNS = 1000


def first_training_seed(run: int) -> int:
    """Return the seed of environment 0's episodes in the training of seed ``run``."""
    return FIRST_TRAINED + MOST_ENVS * run


class EvaluationSettings(BaseModel):
    """Settings of an evaluation: every agent plays the same episodes, on which none was trained."""

    model_config = FROZEN

    # half of what lies before the training episodes each: their sum cannot reach those
    episodes: int = Field(20, ge=2, le=FIRST_TRAINED // 2, description="episodes an agent plays")
    first_seed: int = Field(
        1_000_000,
        ge=0,
        lt=FIRST_TRAINED // 2,
        description="seed of the first episode; each episode has its own, counted upwards",
    )


def multi_game(env_id: str) -> Game:
    """Return a game of several agents by its name.

    Raises:
        ValueError: there is no such game.
    """
    try:
        return load_game(env_id)
    except ImportError as error:
        raise ValueError(f"{env_id} is not importable: {error}") from error


def check_imports(env_id: Any, path: Path, imports: Collection[str]) -> None:
    """Refuse a run whose id imports a module that was not asked for, because importing it runs its code.

    Args:
        env_id: what the run's file says.
        path: of that file.
        imports: modules that may be imported.

    Raises:
        ConfigError: it names another module, which is not imported yet.
    """
    module = str(env_id).rpartition(":")[0]
    if module and module not in imports and module not in sys.modules:
        raise ConfigError(
            f"{path}: env_id={env_id!r} imports the module {module!r}, which runs its code; if you trust it, add "
            f"--imports {module}"
        )


def load_resolved(
    cls: type[Resolved],
    env_class: Callable[[Resolved], type[EnvConfig]],
    source: Mapping[str, Any] | str | Path | None = None,
    overrides: Mapping[str, Any] | None = None,
) -> Resolved:
    """Load a configuration with a section ``env`` and fill in the environment's defaults.

    Args:
        cls: of the configuration; its attribute ``obs_modes`` names what its networks take, if more than vectors.
        env_class: the environment's configuration class; a ValueError where there is no such environment.
        source: a YAML file or a mapping.
        overrides: settings that override it, as from a command line; ``env.NAME`` for those of the environment.

    Raises:
        ConfigError: a setting that is unknown, of the wrong type or out of range, also of the environment.
    """
    overrides = dict(overrides or {})
    for_env = {key[len("env.") :]: overrides.pop(key) for key in list(overrides) if key.startswith("env.")}
    config = load_config(cls, source, overrides)
    try:
        env = load_config(env_class(config), config.env, for_env)
    except ValueError as error:
        raise ConfigError(f"env: {error}" if isinstance(error, ConfigError) else f"env_id: {error}") from None
    modes = getattr(cls, "obs_modes", ("flat",))
    if env.obs_mode not in modes:
        known = " or ".join(map(repr, modes))
        raise ConfigError(f"env: obs_mode={env.obs_mode!r} must be {known} to train; choose terms with observe")
    return config.model_copy(update={"env": FrozenDict(env.model_dump(mode="json"))})


def interface(task: Task, observe: Collection[str] | None = None) -> dict[str, Any]:
    """Describe what a policy is made for: the meaning of its actions and of its observations.

    Args:
        task: of the environment.
        observe: terms of the observation that the policy sees; None for all of it.
    """
    config = task.config
    control = config.control.mode
    actions = task.action_spec().under(control)
    seen = [term for term in task.terms() if observe is None or term.name in observe]
    return {
        "control.mode": control,
        "its actions": actions if control == "pose" else actions.joints,  # under torques nothing has a speed of its own
        "observe_parameters": config.observe_parameters,
        "its observations": (seen, task.observed_props() if observe is None else ()),
    }


def changed(task: Task, other: Task, observe: Collection[str] | None = None) -> list[str]:
    """Return the entries of :func:`interface` that differ in another environment, by name."""
    then = interface(other, observe)
    return [name for name, now in interface(task, observe).items() if now != then[name]]
