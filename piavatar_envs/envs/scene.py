"""What is in a world besides the ground: avatars, soft props and analytic colliders, and how they touch."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BaseModel, Field

from piavatar_envs.avatar.skeleton import joint_index
from piavatar_envs.envs.config_io import ConfigError, load_config
from piavatar_envs.envs.sections import (
    FARTHEST,
    FROZEN,
    LEAST_DENSITY,
    MOST_DENSITY,
    MOST_MODULUS,
    Coordinate,
    DriveConfig,
    FrozenDict,
    PhysicsConfig,
    Place,
    ShapeConfig,
)

#: Settings of the section ``physics`` that an avatar may have of its own.
OF_FLESH = ("material", "young_modulus", "soft_young_modulus", "poisson_ratio", "density")


def _not_zero(rotation: tuple[float, ...]) -> tuple[float, ...]:
    """``rotation``, if it is one.

    Raises:
        ValueError: it is too near to zero to say about which axis it turns.
    """
    if math.hypot(*rotation) < 1.0e-3:
        raise ValueError(f"{list(rotation)} must be a quaternion wxyz, not zero")
    return rotation


def _of_flesh(settings: Mapping[str, Any]) -> Mapping[str, Any]:
    """``settings``, if avatars may differ in them.

    Raises:
        ConfigError: one belongs to the whole world.
    """
    strange = [name for name in settings if name not in OF_FLESH]
    if strange:
        raise ConfigError(f"{strange[0]} cannot differ between avatars; only {', '.join(OF_FLESH)}")
    return settings


def _of_drive(settings: Mapping[str, Any]) -> Mapping[str, Any]:
    """Likewise."""
    if "control" in settings:
        raise ConfigError("control cannot differ between avatars; set it for the environment")
    return settings


def _settings_of(section: type[BaseModel]) -> AfterValidator:
    """Refuses what ``section`` would refuse, long before it is laid over the environment's own."""

    def check(settings: Mapping[str, Any]) -> FrozenDict:
        load_config(section, settings)
        return FrozenDict(settings)

    return AfterValidator(check)


def _joint(name: str) -> str:
    """``name``, if a joint has it.

    Raises:
        ValueError: none has.
    """
    try:
        joint_index(name)
    except KeyError as error:
        raise ValueError(error.args[0]) from None
    return name


Vector = tuple[Coordinate, Coordinate, Coordinate]
Part = Annotated[float, Field(ge=-1000.0, le=1000.0)]
Quaternion = Annotated[tuple[Part, Part, Part, Part], AfterValidator(_not_zero)]
Length = Annotated[float, Field(gt=0.0, le=100.0)]
Speed = Annotated[float, Field(ge=-100.0, le=100.0)]
TopSpeed = Annotated[float, Field(ge=0.0, le=1.0e6)]
Spin = Annotated[float, Field(ge=-1000.0, le=1000.0)]
MaterialName = Literal["neo_hookean", "fixed_corotated"]


class RegionConfig(BaseModel):
    """Flesh of some bones that is of another material: hair, a garment, a stiff boot."""

    model_config = FROZEN

    joints: tuple[Annotated[str, AfterValidator(_joint)], ...] = Field(
        ..., min_length=1, description="joints whose flesh it is, by name"
    )
    beyond: float = Field(
        0.0, ge=0.0, le=FARTHEST, description="only flesh farther than this from the nearest bone particle [m]"
    )
    material: MaterialName | None = Field(None, description="elastic energy; null as the rest")
    young_modulus: float | None = Field(
        None, ge=1.0, le=MOST_MODULUS, description="Young's modulus; null as the rest [Pa]"
    )
    poisson_ratio: float | None = Field(None, ge=0.0, lt=0.5, description="Poisson's ratio; null as the rest [-]")
    density: float | None = Field(
        None, ge=LEAST_DENSITY, le=MOST_DENSITY, description="density; null as the rest [kg/m^3]"
    )


class AvatarConfig(BaseModel):
    """One avatar: where it starts, and what differs from the environment's own settings."""

    model_config = FROZEN

    position: tuple[Place, Place] = Field((0.0, 0.0), description="where it stands, x and y [m]")
    yaw: float = Field(0.0, ge=-10.0, le=10.0, description="turn about the vertical; at 0 it faces -y [rad]")
    physics: Annotated[dict[str, Any], AfterValidator(_of_flesh), _settings_of(PhysicsConfig)] = Field(
        default_factory=dict,
        description="material, young_modulus, soft_young_modulus, poisson_ratio or density of its flesh",
    )
    drive: Annotated[dict[str, Any], AfterValidator(_of_drive), _settings_of(DriveConfig)] = Field(
        default_factory=dict, description="settings of its drive, such as tone"
    )
    shape: Annotated[dict[str, Any], _settings_of(ShapeConfig)] = Field(
        default_factory=dict, description="settings of its shape"
    )
    regions: tuple[RegionConfig, ...] = Field((), description="flesh of other materials; later ones win")


class PropConfig(BaseModel):
    """A soft thing of its own: it is matter like the flesh, and flies, rolls, dents and rubs."""

    model_config = FROZEN

    name: str = Field(..., min_length=1, description="by which it is observed and referred to")
    shape: Literal["sphere", "box", "capsule", "mesh"] = Field("sphere", description="its solid")
    size: tuple[Length, ...] = Field(
        (0.11,), description="sphere: radius; box: half extents; capsule: radius, half length; mesh: scale [m]"
    )
    file: str | None = Field(None, description="watertight mesh, for shape mesh")
    mass: float | None = Field(None, ge=1.0e-6, le=1.0e4, description="mass; null to take the density [kg]")
    density: float = Field(
        1000.0, ge=LEAST_DENSITY, le=MOST_DENSITY, description="density, where no mass is given [kg/m^3]"
    )
    material: MaterialName = Field("neo_hookean", description="elastic energy")
    young_modulus: float | None = Field(
        None,
        ge=1.0,
        le=MOST_MODULUS,
        description="Young's modulus; null for waves as fast as the flesh's, at no more substeps [Pa]",
    )
    poisson_ratio: float = Field(0.3, ge=0.0, lt=0.5, description="Poisson's ratio [-]")
    position: Vector = Field((0.0, -1.0, 1.0), description="of its centre of mass at the start [m]")
    rotation: Quaternion = Field((1.0, 0.0, 0.0, 0.0), description="at the start, quaternion wxyz")
    velocity: tuple[Speed, Speed, Speed] = Field((0.0, 0.0, 0.0), description="at the start [m/s]")
    spin: tuple[Spin, Spin, Spin] = Field((0.0, 0.0, 0.0), description="angular velocity at the start [rad/s]")
    top_speed: TopSpeed = Field(
        0.0,
        description="greatest speed that a task, or you, will give any part of it later, as in a throw; substeps are "
        "short enough for it [m/s]",
    )
    friction: float = Field(0.5, ge=0.0, le=10.0, description="Coulomb coefficient on the ground and colliders [-]")


class ColliderConfig(BaseModel):
    """An analytic solid, at rest or moving as told; nothing moves it."""

    model_config = FROZEN

    name: str = Field(..., min_length=1, description="by which it is referred to")
    kind: Literal["plane", "box", "sphere", "capsule"] = Field("box", description="its solid")
    size: tuple[Length, ...] = Field(
        (), description="box: half extents; sphere: radius; capsule: radius, half length [m]"
    )
    position: Vector = Field((0.0, 0.0, 0.0), description="of its origin [m]")
    rotation: Quaternion = Field((1.0, 0.0, 0.0, 0.0), description="quaternion wxyz; a plane faces its local +z")
    velocity: tuple[Speed, Speed, Speed] = Field((0.0, 0.0, 0.0), description="of its origin [m/s]")
    spin: tuple[Spin, Spin, Spin] = Field((0.0, 0.0, 0.0), description="angular velocity [rad/s]")
    top_speed: TopSpeed = Field(
        0.0, description="greatest speed that a task, or you, will give any part of it later [m/s]"
    )
    friction: float = Field(0.5, ge=0.0, le=10.0, description="Coulomb coefficient [-]")


class PairFriction(BaseModel):
    """Friction of two things by name: avatars (agent names), props, colliders, or ``ground``."""

    model_config = FROZEN

    a: str = Field(..., description="one")
    b: str = Field(..., description="the other")
    friction: float = Field(..., ge=0.0, le=10.0, description="Coulomb coefficient [-]")


class SceneConfig(BaseModel):
    """Avatars, props and colliders. A task adds its own to those given here."""

    model_config = FROZEN

    avatars: tuple[AvatarConfig, ...] = Field((), description="one an agent; where empty, the task places them")
    props: tuple[PropConfig, ...] = Field((), description="soft props besides the task's")
    colliders: tuple[ColliderConfig, ...] = Field((), description="analytic solids besides the ground and the task's")
    ground: bool = Field(True, description="a floor at z = 0")
    walls: bool = Field(
        True,
        description="where there are props or several avatars: smooth walls around the domain, to keep them in it",
    )
    self_contact: bool = Field(
        False, description="torso, arms and legs as velocity fields of their own, so that they touch each other"
    )
    body_friction: float = Field(0.5, ge=0.0, le=10.0, description="Coulomb coefficient between bodies [-]")
    pair_friction: tuple[PairFriction, ...] = Field((), description="coefficients that differ")
    contact_normals: Literal["shared", "own"] = Field(
        "shared", description="shared (one normal a pair: keeps momentum) or own (the paper's rule, which does not)"
    )
    contact_gate: float = Field(
        0.15, ge=0.0, le=3.0, description="gap between two bodies' surfaces below which they touch [grid spacings]"
    )
