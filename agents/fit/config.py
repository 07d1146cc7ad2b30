"""Configuration of a study, resolved with the settings of its environment and of its scorers."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BaseModel, Field, model_validator

from agents.config import FIRST_TRAINED, load_resolved
from agents.fit.scorers import scorer_class
from piavatar_envs.config import FROZEN, ConfigError, EnvConfig, FrozenDict, load_config, read_yaml
from piavatar_envs.tasks import load_task

#: Trials, repeats and environments that a study can have.
MOST_TRIALS, MOST_REPEATS, MOST_BATCH = 10_000, 1000, 4096


class ParameterConfig(BaseModel):
    """One parameter of a study: a numeric setting of the environment, and its bounds."""

    model_config = FROZEN

    low: float | None = Field(None, description="lower bound, in the unit of the setting; null for the schema's")
    high: float | None = Field(None, description="upper bound, in the unit of the setting; null for the schema's")
    scale: Literal["log", "linear"] = Field("linear", description="scale on which values are drawn and modelled")


class Keyframe(BaseModel):
    """Actions that are held from a time on."""

    model_config = FROZEN

    time: float = Field(0.0, ge=0.0, description="time since the reset [s]")
    actions: Annotated[dict[str, float], AfterValidator(FrozenDict)] = Field(
        default_factory=dict, description="components of the action by name, as left_elbow.x; all others are 0"
    )


class ActorConfig(BaseModel):
    """The actor of all trials."""

    model_config = FROZEN

    kind: Literal["zero", "random", "keyframes", "run"] = Field(
        "zero",
        description="zero (keeps the commanded pose), random (drawn from the episode's seed), keyframes (a script) or "
        "run (the policy that a training run has left)",
    )
    keyframes: tuple[Keyframe, ...] = Field((), description="of the script, in the order of their times")
    run: Path | None = Field(None, strict=False, description="folder of the training")

    @model_validator(mode="after")
    def _check_kind(self) -> ActorConfig:
        """Refuse settings that the kind of actor needs and lacks, or has no use for."""
        if bool(self.keyframes) != (self.kind == "keyframes") or (self.run is not None) != (self.kind == "run"):
            raise ConfigError(
                f"kind={self.kind!r} with {len(self.keyframes)} keyframes and run={self.run}; give keyframes with kind "
                "'keyframes', a run with kind 'run', and neither with others"
            )
        times = [frame.time for frame in self.keyframes]
        if times != sorted(times):
            raise ConfigError(f"keyframes at {times} s must be in the order of their times")
        return self


class FitConfig(BaseModel):
    """Settings of a study."""

    model_config = FROZEN

    env_id: str = Field("PIAvatar/Reach-v0", description="registered id, or MODULE:ID for one of your own")
    env: dict[str, Any] = Field(default_factory=dict, description="settings of the environment that all trials share")
    question: str = Field("", description="the question in words, for reports and for the page of a survey")
    parameters: dict[str, ParameterConfig] = Field(
        default_factory=dict, description="parameters by the dotted name of their setting, as scene.props.0.mass"
    )
    actor: ActorConfig = Field(default_factory=ActorConfig, description="the actor of all trials")
    scorer: str = Field("measured", description="the scorer that judges: measured, recorded or vlm, or one of your own")
    scorers: dict[str, Any] = Field(default_factory=dict, description="settings of scorers, by their names")
    direction: Literal["maximize", "minimize"] | None = Field(
        None, description="whether the best score is the greatest or the least; null as the scorer has it"
    )
    sampler: Literal["gp", "tpe", "random"] = Field(
        "gp", description="Optuna's sampler: gp (Gaussian process), tpe (tree-structured Parzen estimator) or random"
    )
    seed: int = Field(0, ge=0, lt=2**31, description="seed of the sampler")
    trials: int = Field(40, ge=2, le=MOST_TRIALS, description="trials in all")
    startup: int = Field(10, ge=1, le=MOST_TRIALS, description="first trials, from a Sobol sequence instead of a model")
    batch: int = Field(1, ge=1, le=MOST_BATCH, description="trials that are proposed and played at once")
    repeats: int = Field(1, ge=1, le=MOST_REPEATS, description="episodes of a trial, each with a seed of its own")
    first_seed: int = Field(
        0, ge=0, lt=FIRST_TRAINED, description="seed of the first episode of every trial; repeats count upwards"
    )

    @property
    def scorer_settings(self) -> Mapping[str, Any]:
        """Settings of the chosen scorer."""
        return self.scorers.get(self.scorer, {})

    @property
    def best_is(self) -> str:
        """``"maximize"`` or ``"minimize"``."""
        return self.direction or scorer_class(self.scorer).direction


def load_fit(source: Mapping[str, Any] | str | Path, overrides: Mapping[str, Any] | None = None) -> FitConfig:
    """Load the configuration of a study, with the defaults of its environment and of its scorers filled in.

    Args:
        source: a YAML file or a mapping.
        overrides: settings that override it, as from a command line; ``env.NAME`` for those of the environment,
            ``scorers.KIND.NAME`` for those of a scorer, ``parameters.NAME.low`` for a bound.

    Raises:
        ConfigError: a setting that is unknown, of the wrong type or out of range, also of environment and scorers.
    """
    settings = dict(read_yaml(Path(source)) if isinstance(source, (str, Path)) else source)
    overrides = dict(overrides or {})
    for key in [key for key in overrides if key.startswith(("scorers.", "parameters."))]:
        section, _, name = key.partition(".")
        owner, _, setting = name.partition(".") if section == "scorers" else name.rpartition(".")
        known = settings.get(section) or {}
        if not (owner and isinstance(known, Mapping) and (section == "scorers" or owner in known)):
            raise ConfigError(f"{key} is not a setting; there are {', '.join(known) or 'no'} {section}")
        settings[section] = {**known, owner: {**(known.get(owner) or {}), setting: overrides.pop(key)}}
    config = load_resolved(FitConfig, _env_class, settings, overrides)
    scorers = {}
    for name, own in {config.scorer: {}, **config.scorers}.items():
        try:
            scorers[name] = load_config(scorer_class(name).Config, own).model_dump(mode="json")
        except ValueError as error:
            raise ConfigError(f"scorers.{name}: {error}") from None
    if not config.parameters:
        raise ConfigError("parameters is empty; name the settings that the study varies, as scene.props.0.mass")
    return config.model_copy(update={"scorers": FrozenDict(scorers)})


def _env_class(config: FitConfig) -> type[EnvConfig]:
    """Return the configuration class of the environment."""
    return load_task(config.env_id).Config
