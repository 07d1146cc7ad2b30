"""Configurations: frozen, validated pydantic models, YAML override files and one-line errors.

A configuration is an :class:`EnvConfig` (or a task's subclass of it, one level deep) with one section for each part of
the simulation. Every field has a default, so a YAML file or a keyword of ``gym.make`` only says what differs::

    config = load_config(ReachConfig, "overrides.yaml", {"control.tone": 0.3, "fidelity": "tiny"})
    print(dump_yaml(config))

Keys are nested (``control: {tone: 0.3}``) or dotted (``control.tone``); where only one section has a setting of that
name, the bare name is enough (``tone``), which lets ``gym.make(ID, fidelity="coarse")`` work. The section ``control``
has one of two sets of settings, by its ``mode``; ``control="pd"`` is short for ``control={"mode": "pd"}``.
"""

from piavatar_envs.config.errors import ConfigError, UnexpectedKeyword
from piavatar_envs.config.load import dump_yaml, load_config, load_keywords, parse_assignments, read_yaml, replace
from piavatar_envs.config.schema import (
    FROZEN,
    AvatarConfig,
    AvatarSourceConfig,
    BodyColor,
    ClothConfig,
    ColliderConfig,
    ControlConfig,
    EnvConfig,
    FrozenDict,
    GarmentConfig,
    NamedCamera,
    PairFriction,
    PhysicsConfig,
    PixelsConfig,
    PlacedCamera,
    PoseControlConfig,
    PropConfig,
    RandomizeConfig,
    RegionConfig,
    RenderConfig,
    SceneConfig,
    ShapeConfig,
    TorqueControlConfig,
)

__all__ = [
    "FROZEN",
    "AvatarConfig",
    "AvatarSourceConfig",
    "BodyColor",
    "ClothConfig",
    "ColliderConfig",
    "ConfigError",
    "ControlConfig",
    "EnvConfig",
    "FrozenDict",
    "GarmentConfig",
    "NamedCamera",
    "PairFriction",
    "PhysicsConfig",
    "PixelsConfig",
    "PlacedCamera",
    "PoseControlConfig",
    "PropConfig",
    "RandomizeConfig",
    "RegionConfig",
    "RenderConfig",
    "SceneConfig",
    "ShapeConfig",
    "TorqueControlConfig",
    "UnexpectedKeyword",
    "dump_yaml",
    "load_config",
    "load_keywords",
    "parse_assignments",
    "read_yaml",
    "replace",
]
