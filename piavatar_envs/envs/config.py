"""Configurations: frozen, validated pydantic models, YAML override files and one-line errors.

A configuration is an :class:`EnvConfig` (or a task's subclass of it, one level deep) with one section for each room of
the simulation. Every field has a default, so a YAML file or a keyword of ``gym.make`` only says what differs::

    config = load_config(ReachConfig, "overrides.yaml", {"drive.tone": 0.3, "fidelity": "tiny"})
    print(dump_yaml(config))

Keys are nested (``drive: {tone: 0.3}``) or dotted (``drive.tone``); where only one section has a setting of that name,
the bare name will do (``tone``), which is what lets ``gym.make(ID, fidelity="coarse")`` work.
"""

from __future__ import annotations

from typing import Literal

from pydantic import BaseModel, Field

from piavatar_envs.envs.config_io import ConfigError, dump_yaml, load_config, parse_assignments, replace
from piavatar_envs.envs.scene import AvatarConfig, ColliderConfig, PairFriction, PropConfig, RegionConfig, SceneConfig
from piavatar_envs.envs.sections import (
    FROZEN,
    DriveConfig,
    FrozenDict,
    PhysicsConfig,
    RandomizeConfig,
    RenderConfig,
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


class EnvConfig(BaseModel):
    """What every environment has. A task adds its own settings in one subclass."""

    model_config = FROZEN

    physics: PhysicsConfig = Field(default_factory=PhysicsConfig, description="the continuum")
    drive: DriveConfig = Field(default_factory=DriveConfig, description="how poses move the body")
    shape: ShapeConfig = Field(default_factory=ShapeConfig, description="the body's shape")
    randomize: RandomizeConfig = Field(
        default_factory=RandomizeConfig, description="what every episode draws anew, besides the task and the shape"
    )
    scene: SceneConfig = Field(default_factory=SceneConfig, description="what is in the world, and how it touches")
    render: RenderConfig = Field(default_factory=RenderConfig, description="pictures")
    episode_seconds: float = Field(5.0, gt=0.0, le=3600.0, description="simulated time until truncation [s]")
    joints: tuple[str, ...] | None = Field(
        None, description="joints that act, the others do what they would do anyway; null for all 21"
    )
    observe_parameters: bool = Field(
        False,
        description="observe what the episode has drawn (randomize, random shapes, the task), under pd and torque "
        "root_assist as it is now, and the episode's clock",
    )
    obs_mode: Literal["flat", "dict"] = Field(
        "flat", description="observations as one float32 vector (flat) or by name (dict)"
    )
