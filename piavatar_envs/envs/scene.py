"""What is in a world besides the ground: avatars, soft props and analytic colliders, and how they touch."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BaseModel, Field

from piavatar_envs.envs.sections import FROZEN, FrozenDict

Vector = tuple[float, float, float]


def _not_zero(rotation: tuple[float, ...]) -> tuple[float, ...]:
    if not any(rotation):
        raise ValueError(f"{list(rotation)} must be a quaternion wxyz, not zero")
    return rotation


Quaternion = Annotated[tuple[float, float, float, float], AfterValidator(_not_zero)]
Settings = Annotated[dict[str, Any], AfterValidator(FrozenDict)]
MaterialName = Literal["neo_hookean", "fixed_corotated"]


class RegionConfig(BaseModel):
    """Flesh of some bones that is of another material: hair, a garment, a stiff boot."""

    model_config = FROZEN

    joints: tuple[str, ...] = Field(..., min_length=1, description="joints whose flesh it is, by name")
    beyond: float = Field(0.0, ge=0.0, description="only flesh farther than this from the nearest bone particle [m]")
    material: MaterialName | None = Field(None, description="elastic energy; null as the rest")
    young_modulus: float | None = Field(None, gt=0.0, description="Young's modulus; null as the rest [Pa]")
    poisson_ratio: float | None = Field(None, ge=0.0, lt=0.5, description="Poisson's ratio; null as the rest [-]")
    density: float | None = Field(None, gt=0.0, description="density; null as the rest [kg/m^3]")


class AvatarConfig(BaseModel):
    """One avatar: where it starts, and what differs from the environment's own settings."""

    model_config = FROZEN

    position: tuple[float, float] = Field((0.0, 0.0), description="where it stands, x and y [m]")
    yaw: float = Field(0.0, description="turn about the vertical; at 0 it faces -y [rad]")
    physics: Settings = Field(
        default_factory=dict,
        description="material, young_modulus, soft_young_modulus, poisson_ratio or density of its flesh",
    )
    drive: Settings = Field(default_factory=dict, description="settings of its drive, such as tone")
    shape: Settings = Field(default_factory=dict, description="settings of its shape")
    regions: tuple[RegionConfig, ...] = Field((), description="flesh of other materials; later ones win")


class PropConfig(BaseModel):
    """A soft thing of its own: it is matter like the flesh, and flies, rolls, dents and rubs."""

    model_config = FROZEN

    name: str = Field(..., min_length=1, description="by which it is observed and referred to")
    shape: Literal["sphere", "box", "capsule", "mesh"] = Field("sphere", description="its solid")
    size: tuple[float, ...] = Field(
        (0.11,), description="sphere: radius; box: half extents; capsule: radius, half length; mesh: scale [m]"
    )
    file: str | None = Field(None, description="watertight mesh, for shape mesh")
    mass: float | None = Field(None, gt=0.0, description="mass; null to take the density [kg]")
    density: float = Field(1000.0, gt=0.0, description="density, where no mass is given [kg/m^3]")
    material: MaterialName = Field("neo_hookean", description="elastic energy")
    young_modulus: float | None = Field(
        None,
        gt=0.0,
        description="Young's modulus; null for waves as fast as the flesh's, at no more substeps [Pa]",
    )
    poisson_ratio: float = Field(0.3, ge=0.0, lt=0.5, description="Poisson's ratio [-]")
    position: Vector = Field((0.0, -1.0, 1.0), description="of its centre of mass at the start [m]")
    rotation: Quaternion = Field((1.0, 0.0, 0.0, 0.0), description="at the start, quaternion wxyz")
    velocity: Vector = Field((0.0, 0.0, 0.0), description="at the start [m/s]")
    spin: Vector = Field((0.0, 0.0, 0.0), description="angular velocity at the start [rad/s]")
    friction: float = Field(0.5, ge=0.0, le=10.0, description="Coulomb coefficient on the ground and colliders [-]")


class ColliderConfig(BaseModel):
    """An analytic solid, at rest or moving as told; nothing moves it."""

    model_config = FROZEN

    name: str = Field(..., min_length=1, description="by which it is referred to")
    kind: Literal["plane", "box", "sphere", "capsule"] = Field("box", description="its solid")
    size: tuple[float, ...] = Field(
        (), description="box: half extents; sphere: radius; capsule: radius, half length [m]"
    )
    position: Vector = Field((0.0, 0.0, 0.0), description="of its origin [m]")
    rotation: Quaternion = Field((1.0, 0.0, 0.0, 0.0), description="quaternion wxyz; a plane faces its local +z")
    velocity: Vector = Field((0.0, 0.0, 0.0), description="of its origin [m/s]")
    spin: Vector = Field((0.0, 0.0, 0.0), description="angular velocity [rad/s]")
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
