"""Configurations: frozen, validated pydantic models, YAML override files and one-line errors.

A configuration is an :class:`EnvConfig` (or a task's subclass of it, one level deep) with one section for each part of
the simulation. Every field has a default, so a YAML file or a keyword of ``gym.make`` only says what differs::

    config = load_config(ReachConfig, "overrides.yaml", {"drive.tone": 0.3, "fidelity": "tiny"})
    print(dump_yaml(config))

Keys are nested (``drive: {tone: 0.3}``) or dotted (``drive.tone``); where only one section has a setting of that name,
the bare name is enough (``tone``), which lets ``gym.make(ID, fidelity="coarse")`` work.
"""

from piavatar_envs.config.errors import ConfigError
from piavatar_envs.config.load import dump_yaml, load_config, parse_assignments, replace
from piavatar_envs.config.schema import (
    FROZEN,
    AvatarConfig,
    ColliderConfig,
    DriveConfig,
    EnvConfig,
    FrozenDict,
    PairFriction,
    PhysicsConfig,
    PropConfig,
    RandomizeConfig,
    RegionConfig,
    RenderConfig,
    SceneConfig,
    ShapeConfig,
)

__all__ = [
    "FROZEN",
    "AvatarConfig",
    "ColliderConfig",
    "ConfigError",
    "DriveConfig",
    "EnvConfig",
    "FrozenDict",
    "PairFriction",
    "PhysicsConfig",
    "PropConfig",
    "RandomizeConfig",
    "RegionConfig",
    "RenderConfig",
    "SceneConfig",
    "ShapeConfig",
    "dump_yaml",
    "load_config",
    "parse_assignments",
    "replace",
]
