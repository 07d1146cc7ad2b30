"""Sections of a configuration, from the continuum to pictures, and :class:`EnvConfig`, which has them all.

Ranges of values come first, then the sections in the order of :class:`EnvConfig`. Descriptions of fields are written
for users: they appear on the pages of the environments, with the unit in brackets at their end.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, ClassVar, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, model_validator

from piavatar_envs.avatar.body.flesh_stiffness import FREE_SHARE
from piavatar_envs.avatar.body.skeleton import JOINT_NAMES, joint_index
from piavatar_envs.avatar.body.sources import check_settings, check_source
from piavatar_envs.cloth.fabric import MOST_CLOTH_SUBSTEPS, Fabric, check_fabric, fabric_of
from piavatar_envs.cloth.garments import check_kind
from piavatar_envs.cloth.garments import check_settings as check_garment
from piavatar_envs.config.load import ConfigError, load_config
from piavatar_envs.mpm.materials import check_material
from piavatar_envs.mpm.model import CFL_STABLE

#: Configuration of every model; strict, because a number in quotes is a mistake, and without infinity and NaN.
FROZEN = ConfigDict(
    frozen=True, extra="forbid", strict=True, allow_inf_nan=False, validate_default=True, protected_namespaces=()
)


class FrozenDict(dict):
    """A read-only, hashable ``dict`` for values of frozen configurations."""

    def _refuse(self, *_args: Any, **_kwargs: Any) -> None:
        """Refuse every change."""
        raise TypeError("the configuration is frozen; make a changed copy with replace(config, {...})")

    __setitem__ = __delitem__ = __ior__ = update = pop = popitem = setdefault = clear = _refuse  # type: ignore[assignment]

    def __hash__(self) -> int:  # type: ignore[override]
        return hash(frozenset(self.items()))

    def __reduce__(self) -> tuple:
        # the protocol of dict fills an empty copy item by item, which a frozen one refuses
        return FrozenDict, (dict(self),)


def _check_joint(name: str) -> str:
    """Refuse the name of no joint.

    Raises:
        ValueError: it is such.
    """
    try:
        joint_index(name)
    except KeyError as error:
        raise ValueError(error.args[0]) from None
    return name


def _check_quaternion(rotation: tuple[float, ...]) -> tuple[float, ...]:
    """Refuse a quaternion that is too near to zero to be normalised.

    Raises:
        ValueError: it is.
    """
    if math.hypot(*rotation) < 1.0e-3:
        raise ValueError(f"{list(rotation)} must be a quaternion wxyz, not zero")
    return rotation


def _check_order(bounds: tuple[float, float]) -> tuple[float, float]:
    """Refuse bounds of which the first is the greater one.

    Raises:
        ValueError: they are such.
    """
    if not bounds[0] <= bounds[1]:
        raise ValueError("must be in order; give the lower bound first")
    return bounds


def _check_flesh_rate(rates: tuple[float, float]) -> tuple[float, float]:
    """Refuse rates that decrease from skin to bone or are not positive; two zeros switch the pull off.

    Raises:
        ValueError: the rates are such.
    """
    skin, bone = rates
    if not (0.0 < skin <= bone or skin == bone == 0.0):
        raise ValueError(f"the skin's rate {skin:g} must be positive and at most the bone's {bone:g}, as in (30, 1000)")
    return rates


MOST_SUBSTEPS = 10_000
#: Greatest Young's modulus [Pa] and range of densities [kg/m^3] of soft matter: hard plastic, thin smoke, osmium.
MOST_MODULUS = 1.0e9
#: Greatest viscosity [Pa s] and damping ratio of soft matter.
MOST_VISCOSITY, MOST_DAMPING = 1.0e6, 10.0
LEAST_DENSITY, MOST_DENSITY = 0.1, 25_000.0
#: Greatest distance from the origin along each axis [m].
FARTHEST = 1000.0
#: Colour of the inside of a garment over that of its outside.
_INSIDE = 0.75
#: The range of a factor that changes nothing.
UNCHANGED = (1.0, 1.0)

#: Name of a material of this package or of :func:`piavatar_envs.register_material`.
MaterialName = Annotated[str, AfterValidator(check_material)]
JointName = Annotated[str, AfterValidator(_check_joint)]
#: Coordinate of an avatar or a prop, which leaves room for matter around it [m].
Place = Annotated[float, Field(ge=-100.0, le=100.0)]
Coordinate = Annotated[float, Field(ge=-FARTHEST, le=FARTHEST)]
Vector = tuple[Coordinate, Coordinate, Coordinate]
#: Camera that sees a standing person three-quarters from the front: its place and what it looks at [m].
STANDING_VIEW = (1.75, -3.75, 1.62), (0.0, -0.04, 0.86)
Component = Annotated[float, Field(ge=-1000.0, le=1000.0)]
Quaternion = Annotated[tuple[Component, Component, Component, Component], AfterValidator(_check_quaternion)]
Length = Annotated[float, Field(gt=0.0, le=100.0)]
Speed = Annotated[float, Field(ge=-100.0, le=100.0)]
TopSpeed = Annotated[float, Field(ge=0.0, le=1.0e6)]
Spin = Annotated[float, Field(ge=-1000.0, le=1000.0)]
ShapeValue = Annotated[float, Field(ge=-1.0, le=1.0)]
Share = Annotated[float, Field(ge=0.0, le=1.0)]
Factor = Annotated[float, Field(ge=1.0e-3, le=1.0e3)]
FactorRange = Annotated[tuple[Factor, Factor], AfterValidator(_check_order)]
Rate = Annotated[float, Field(le=1.0e6)]
RateRange = Annotated[tuple[Rate, Rate], AfterValidator(_check_flesh_rate)]


class PhysicsConfig(BaseModel):
    """The continuum: resolution, material, coupling and time step."""

    model_config = FROZEN

    fidelity: Literal["tiny", "coarse", "medium", "fine"] = Field(
        "coarse",
        description="resolution of the body: tiny (some 400 particles, for tests), coarse (grid spacing height/32, "
        "2,500-3,000 particles), medium (height/64), fine (grid spacing about 1 cm)",
    )
    control_dt: float = Field(1.0 / 30.0, ge=1.0e-4, le=0.2, description="time between two actions [s]")
    num_substeps: int | None = Field(
        None, ge=1, le=MOST_SUBSTEPS, description="substeps per control step; null chooses them from the CFL limit"
    )
    reference_substeps: int | None = Field(
        None,
        ge=1,
        le=MOST_SUBSTEPS,
        description="substeps per control step whose damping of short waves further ones keep, which costs a second "
        "transfer; null takes those of elastic flesh; from `num_substeps` on every substep damps them",
    )
    cfl: float = Field(
        0.5,
        gt=0.0,
        le=CFL_STABLE,
        description="largest c dt / dx a substep may have, c the P-wave speed; beyond 0.84 it is not stable [-]",
    )
    material: MaterialName = Field(
        "neo_hookean",
        description="elastic energy of the flesh: neo_hookean, fixed_corotated, or a name given to register_material",
    )
    young_modulus: float = Field(1.0e5, ge=1.0, le=MOST_MODULUS, description="Young's modulus of the flesh [Pa]")
    soft_young_modulus: float | None = Field(
        None,
        ge=1.0,
        le=MOST_MODULUS,
        description="Young's modulus of the softest flesh of trunk and thighs; null as the rest [Pa]",
    )
    poisson_ratio: float = Field(0.3, ge=0.0, lt=0.5, description="Poisson's ratio of the flesh [-]")
    density: float = Field(1000.0, ge=LEAST_DENSITY, le=MOST_DENSITY, description="density of the flesh [kg/m^3]")
    viscosity: float = Field(
        0.0, ge=0.0, le=MOST_VISCOSITY, description="shear viscosity of the flesh, beside that of damping_ratio [Pa s]"
    )
    damping_ratio: float = Field(
        0.0,
        ge=0.0,
        le=MOST_DAMPING,
        description="damping of the flesh over critical damping, for vibrations at 25 Hz; in proportion to frequency "
        "at others [-]",
    )
    decoupling: Literal["split", "paper", "none", "no_stress"] = Field(
        "split",
        description="how commanded motion is kept out of the strain: split (two velocities, the default), paper (its "
        "deformation-gradient decoupling), none (velocity injected, strain and all), no_stress (no elasticity); paper "
        "and none have one velocity, in which no root can be held: they need root=free",
    )
    gravity: float = Field(9.81, ge=0.0, le=100.0, description="gravitational acceleration, along -z [m/s^2]")
    friction: float = Field(0.8, ge=0.0, le=10.0, description="Coulomb coefficient of the ground; walls are smooth [-]")


class PoseControlConfig(BaseModel):
    """Pose control: actions move a commanded pose, which the body follows; a bounded wrench may hold the root."""

    model_config = FROZEN

    mode: Literal["pose"] = Field("pose", description="pose: actions are increments of a pose that moves the body")
    command: Literal["increment", "target", "reference"] = Field(
        "increment",
        description="increment (the tracked pose moves by the command's change), target (the tracked pose moves to "
        "the commanded one) or reference (open loop); target and reference only for undisturbed reproduction",
    )
    tone: float = Field(
        1.0,
        ge=0.0,
        le=1.0,
        description="how firmly joints return to the commanded pose after contact: 0 limp, 1 tensed [-]",
    )
    resistance: Literal["flesh", "joints"] = Field(
        "flesh",
        description="what resists contact: flesh (pulls on its particles, an acceleration that light limbs hardly "
        "resist by) or joints (springs of the table of muscles times tone, as under pd)",
    )
    alpha: float = Field(0.3, ge=0.0, le=1.0, description="shape preservation, as a share of a control step [-]")
    shape_preservation: Literal["physical", "kinematic"] = Field(
        "physical",
        description="physical (a momentum-keeping pull of the flesh) or kinematic (the paper's term in the velocity)",
    )
    soft_tissue: float = Field(
        0.0, ge=0.0, le=1.0, description="share of a change of commanded motion that the softest flesh misses [-]"
    )
    joint_speed_limit: float = Field(
        4.0, gt=0.0, le=50.0, description="fastest rotation an action of 1 commands about a joint's axis [rad/s]"
    )
    root: Literal["wrench", "weight", "free"] = Field(
        "wrench",
        description="wrench (a bounded force and torque hold the commanded root, and every particle of the body "
        "against gravity), weight (they hold the bones, on which the flesh hangs by its weight) or free (nothing does)",
    )
    free_motion: bool | None = Field(
        None,
        description="take the rigid part out of commanded motion, so that it carries no unreacted momentum; null where "
        "nothing holds the root",
    )
    max_root_force: float = Field(2.0, ge=0.0, le=1000.0, description="largest root force, in body weights [m g]")
    max_root_torque: float = Field(
        0.7, ge=0.0, le=1000.0, description="largest root torque, in metres of body weight [m * m g]"
    )
    bound_motion: bool = Field(
        False,
        description="whether the root's limits also bound the momentum of commanded motion, which then comes as fast "
        "as they allow; otherwise it comes at once, at any force",
    )
    release_tilt: float = Field(
        math.radians(45.0), gt=0.0, le=math.pi, description="tilt error at which the root wrench is released [rad]"
    )
    release_distance: float = Field(
        0.5,
        gt=0.0,
        le=FARTHEST,
        description="horizontal error at which the root wrench is released, until the next reset [m]",
    )
    release_height: float = Field(
        0.4, gt=0.0, le=FARTHEST, description="height error at which the root wrench is released [m]"
    )

    @property
    def moves_freely(self) -> bool:
        """Whether commanded motion has its rigid part taken out: ``free_motion``, or its default where it is null."""
        return self.root == "free" if self.free_motion is None else self.free_motion


class TorqueControlConfig(BaseModel):
    """Torque control: joints move under torques of springs towards joint targets (pd), or of the actions (torque)."""

    model_config = FROZEN

    mode: Literal["pd", "torque"] = Field(
        "pd", description="pd: joint targets of springs with limited torques; torque: torques of the joints"
    )
    root_assist: float = Field(
        0.0, ge=0.0, le=1.0, description="external support of the pelvis: 0 none, 1 springs that nearly hold it [-]"
    )
    joint_stiffness: float = Field(
        1.0, ge=0.0, le=1.0e6, description="factor on the stiffness of the joints' springs [-]"
    )
    joint_damping: float = Field(1.0, ge=0.0, le=1.0e6, description="factor on the damping of the joints' springs [-]")
    strength: float = Field(1.0, ge=0.0, le=1.0e6, description="factor on the greatest torques of the joints [-]")
    flesh_rate: RateRange = Field(
        (30.0, 1000.0), description="rates of the pulls that hold flesh to bones, at the skin and at the bone [1/s]"
    )
    flesh_resistance: float = Field(
        FREE_SHARE,
        ge=0.0,
        le=10.0,
        description="resistance of flesh to bent joints, over that of flesh held exactly at its skinned places; 0.25 "
        "is that of flesh which gives way to its stress, 0 none [-]",
    )
    firm_bones: bool = Field(
        True,
        description="return particles of bones, which slip from them under load, to their places after every control "
        "step, unless these lie beyond a surface: tracked bones stay together",
    )
    bone_contact: bool = Field(
        True,
        description="stop bones a millimetre before the floor and colliders; otherwise only flesh stops, and bones "
        "sink through it into them",
    )

    @property
    def joint_speed_limit(self) -> float:
        """Zero: neither a target nor a torque commands a speed [rad/s]."""
        return 0.0

    @property
    def soft_tissue(self) -> float:
        """Zero: no commanded motion, so no flesh that misses its changes [-]."""
        return 0.0


#: Either kind of control, by its ``mode``; settings of the other kind are refused.
ControlConfig = Annotated[PoseControlConfig | TorqueControlConfig, Field(discriminator="mode")]


#: Value of a setting of an avatar source; a mapping has the settings of another source.
PlainValue = bool | int | float | str | tuple[bool | int | float | str, ...] | None
SourceValue = PlainValue | dict[str, PlainValue]


class AvatarSourceConfig(BaseModel):
    """The source of the body and its own settings; see :mod:`piavatar_envs.avatar.body.sources` and docs/avatars.md."""

    model_config = FROZEN | {"extra": "allow"}
    __pydantic_extra__: dict[str, SourceValue]

    source: Annotated[str, AfterValidator(check_source)] = Field(
        "embedded",
        description="embedded (the body of this package), another source of docs/avatars.md, or one of your own, by "
        "its name; further settings below avatar are those of the source",
    )
    path: str | None = Field(None, description="file or folder of the body, for sources that read one")

    @property
    def settings(self) -> dict[str, Any]:
        """The source's own settings."""
        given = {"path": self.path, **(self.__pydantic_extra__ or {})}
        return {name: value for name, value in given.items() if value is not None}

    def of_avatar(self, own: Mapping[str, Any]) -> AvatarSourceConfig:
        """Return the source of an avatar with settings of its own; those that name a source replace all of these."""
        return load_config(AvatarSourceConfig, None if "source" in own else self, own)


class GarmentConfig(BaseModel):
    """A loose garment and its kind's own settings; see :mod:`piavatar_envs.cloth.garments` and docs/garments.md."""

    model_config = FROZEN | {"extra": "allow"}
    __pydantic_extra__: dict[str, PlainValue]

    kind: Annotated[str, AfterValidator(check_kind)] = Field(
        ...,
        description="skirt, dress, shirt, trousers, scarf, cape, a mesh of your own, or another kind of "
        "docs/garments.md, by its name; further settings are those of the kind",
    )
    fabric: Annotated[str, AfterValidator(check_fabric)] = Field(
        "cotton", description="cotton, denim, silk, another fabric of docs/garments.md, or one of your own, by its name"
    )
    color: tuple[Share, Share, Share] | None = Field(None, description="sRGB, each in [0, 1]; null as the fabric [-]")
    areal_density: float | None = Field(None, ge=0.01, le=5.0, description="mass per area; null as the fabric [kg/m^2]")
    stretch: float | None = Field(
        None, ge=1.0, le=1.0e5, description="membrane stiffness E h; null as the fabric [N/m]"
    )
    bending: float | None = Field(None, ge=0.0, le=1.0, description="bending stiffness; null as the fabric [N m]")
    friction: float | None = Field(
        None, ge=0.0, le=10.0, description="Coulomb coefficient on skin; null as the fabric [-]"
    )

    @property
    def settings(self) -> dict[str, Any]:
        """The kind's own settings."""
        return {name: value for name, value in (self.__pydantic_extra__ or {}).items() if value is not None}

    @property
    def cloth(self) -> Fabric:
        """The fabric with this garment's own values."""
        names = ("areal_density", "stretch", "bending", "friction")
        own = {name: getattr(self, name) for name in names if getattr(self, name) is not None}
        if self.color is not None:
            own |= {"front": self.color, "back": tuple(_INSIDE * part for part in self.color)}
        return dataclasses.replace(fabric_of(self.fabric), **own)

    @model_validator(mode="after")
    def _check_settings(self) -> GarmentConfig:
        """Refuse settings that the kind does not have."""
        try:
            check_garment(self.kind, self.settings)
        except ValueError as error:
            raise ConfigError(str(error)) from None
        return self


class ClothConfig(BaseModel):
    """The solver of garments; without effect where there are none."""

    model_config = FROZEN

    solver: Literal["xpbd", "mpm"] = Field(
        "xpbd",
        description="xpbd: extended position-based dynamics with small steps; mpm: a thin shell on the grid of the "
        "bodies, for fine grids and comparisons",
    )
    substeps: int = Field(
        20, ge=1, le=MOST_CLOTH_SUBSTEPS, description="substeps of cloth in a control step, of which 20 suit 1/30 s"
    )
    sweeps: int = Field(4, ge=1, le=100, description="sweeps over the edges in a substep; with fewer, cloth may buzz")
    self_collision: bool = Field(False, description="keep garments apart from themselves and each other")
    wind: tuple[Speed, Speed, Speed] = Field((0.0, 0.0, 0.0), description="velocity of the air [m/s]")

    @model_validator(mode="after")
    def _refuse_what_has_no_effect(self) -> ClothConfig:
        """Refuse settings of the other solver."""
        for name in ("substeps", "sweeps", "self_collision") if self.solver == "mpm" else ():
            value = getattr(self, name)
            if value != type(self).model_fields[name].default:
                shown = str(value).lower() if isinstance(value, bool) else value
                raise ConfigError(f"cloth.{name}={shown} has no effect with cloth.solver='mpm'; leave it out")
        return self


class ShapeConfig(BaseModel):
    """The body's shape: fixed parameters, or a random shape at each reset."""

    model_config = FROZEN

    randomize: bool = Field(False, description="draw a random shape at each reset")
    pool: int | None = Field(
        None,
        ge=1,
        le=4096,
        description="number of bodies that are shaped beforehand, from which a reset draws on the device; null shapes "
        "a new body at each reset, on the host, in 0.1 s each [-]",
    )
    parameters: Annotated[dict[str, ShapeValue], AfterValidator(FrozenDict)] = Field(
        default_factory=dict,
        description="shape parameters by name, each in [-1, 1], 0 the mean; not randomized",
    )
    scale: float = Field(
        1.0, ge=0.0, le=1.0, description="width of the random shapes: 0 the mean shape, 1 the full range [-]"
    )


class RandomizeConfig(BaseModel):
    """Factors that every episode draws, uniform in their logarithm; see :mod:`piavatar_envs.sim.randomize`."""

    model_config = FROZEN

    mass_factor: FactorRange = Field(
        UNCHANGED, description="range of the factor on an avatar's density, and so on its mass and inertia [-]"
    )
    stiffness_factor: FactorRange = Field(
        UNCHANGED, description="range of the factor on Young's modulus of an avatar's flesh [-]"
    )
    ground_friction_factor: FactorRange = Field(
        UNCHANGED, description="range of the factor on all friction with the ground, walls and colliders [-]"
    )
    body_friction_factor: FactorRange = Field(
        UNCHANGED, description="range of the factor on all friction between avatars and props [-]"
    )
    cloth_mass_factor: FactorRange = Field(UNCHANGED, description="range of the factor on the mass of garments [-]")
    cloth_stiffness_factor: FactorRange = Field(
        UNCHANGED, description="range of the factor on stretch and bending stiffness of garments [-]"
    )
    cloth_friction_factor: FactorRange = Field(
        UNCHANGED, description="range of the factor on all friction of garments [-]"
    )


#: Settings of ``physics`` in which avatars may differ.
OF_FLESH = (
    "material",
    "young_modulus",
    "soft_young_modulus",
    "poisson_ratio",
    "density",
    "viscosity",
    "damping_ratio",
)


def _of_flesh(settings: Mapping[str, Any]) -> Mapping[str, Any]:
    """Refuse settings of the continuum in which avatars cannot differ.

    Raises:
        ConfigError: there is one.
    """
    shared = [name for name in settings if name not in OF_FLESH]
    if shared:
        raise ConfigError(f"{shared[0]} cannot differ between avatars; only {', '.join(OF_FLESH)}")
    return settings


class AvatarControl(BaseModel):
    """The section ``control`` by itself, as which an avatar's own settings are validated."""

    model_config = FROZEN

    control: ControlConfig


def _check_control(mode: str, settings: Mapping[str, Any], place: str = "") -> None:
    """Refuse settings of an avatar that ``mode`` does not have, or that are out of range.

    Args:
        mode: the mode of control.
        settings: values by name.
        place: dotted name of the avatar in messages, with a dot at its end.

    Raises:
        ConfigError: there is one.
    """
    try:
        load_config(AvatarControl, {"control": {"mode": mode, **settings}})
    except ConfigError as error:
        raise ConfigError(*(f"{place}{part}" for part in error.args)) from None


def _of_control(settings: Mapping[str, Any]) -> FrozenDict:
    """Refuse ``mode``, in which avatars cannot differ, and settings that no mode has, or that are out of range.

    Raises:
        ConfigError: there is one.
    """
    if "mode" in settings:
        raise ConfigError(f"mode={settings['mode']!r} cannot differ between avatars; set control.mode")
    pose = {name: value for name, value in settings.items() if name not in TorqueControlConfig.model_fields}
    torque = {name: value for name, value in settings.items() if name not in pose}
    try:
        _check_control("pose", pose)
        _check_control("pd", torque)
    except ConfigError as error:
        raise ConfigError(*(part.removeprefix("control.") for part in error.args)) from None
    return FrozenDict(settings)


def _settings_of(section: type[BaseModel]) -> AfterValidator:
    """Return a validator that refuses settings which ``section`` would refuse."""

    def check(settings: Mapping[str, Any]) -> FrozenDict:
        """Validate the settings as a section."""
        load_config(section, settings)
        return FrozenDict(settings)

    return AfterValidator(check)


class RegionConfig(BaseModel):
    """Flesh of another material, such as hair or a boot: of some joints, of a group of the file, or of both."""

    model_config = FROZEN

    joints: tuple[JointName, ...] = Field((), description="names of the joints whose flesh it is; empty for all")
    group: str | None = Field(
        None,
        min_length=1,
        description="mesh, material or painted group of the body's file, below which the flesh lies, see "
        "docs/avatars.md; null for all of the body",
    )
    depth: float | None = Field(
        None, gt=0.0, le=FARTHEST, description="greatest distance of the flesh from the skin; null for any [m]"
    )
    beyond: float = Field(
        0.0, ge=0.0, le=FARTHEST, description="least distance of the flesh from the nearest bone particle [m]"
    )
    material: MaterialName | None = Field(None, description="elastic energy; null as the rest")
    young_modulus: float | None = Field(
        None, ge=1.0, le=MOST_MODULUS, description="Young's modulus; null as the rest [Pa]"
    )
    poisson_ratio: float | None = Field(None, ge=0.0, lt=0.5, description="Poisson's ratio; null as the rest [-]")
    density: float | None = Field(
        None, ge=LEAST_DENSITY, le=MOST_DENSITY, description="density; null as the rest [kg/m^3]"
    )
    viscosity: float | None = Field(
        None, ge=0.0, le=MOST_VISCOSITY, description="shear viscosity; null as the rest [Pa s]"
    )
    damping_ratio: float | None = Field(
        None, ge=0.0, le=MOST_DAMPING, description="damping ratio at 25 Hz; null as the rest [-]"
    )
    soft_tissue: float | None = Field(
        None,
        ge=0.0,
        le=1.0,
        description="share of a change of commanded motion that its flesh misses, under pose control; null as the rest "
        "[-]",
    )
    alpha: float | None = Field(
        None, ge=0.0, le=1.0, description="shape preservation under pose control; null as the rest [-]"
    )
    flesh_rate: RateRange | None = Field(
        None,
        description="rates of the pulls to the bones under pd and torque, at the skin and at the bone; null as the "
        "rest [1/s]",
    )

    @model_validator(mode="after")
    def _check_place(self) -> RegionConfig:
        """Refuse a region of no particular place."""
        if not self.joints and self.group is None:
            raise ConfigError("neither joints nor a group are given; name joints, or a group of the file")
        return self


class AvatarConfig(BaseModel):
    """One avatar: its initial place, and settings that differ from the environment's."""

    model_config = FROZEN

    position: tuple[Place, Place] = Field((0.0, 0.0), description="initial position, x and y [m]")
    yaw: float = Field(0.0, ge=-10.0, le=10.0, description="initial turn about the vertical; at 0 it faces -y [rad]")
    physics: Annotated[dict[str, Any], AfterValidator(_of_flesh), _settings_of(PhysicsConfig)] = Field(
        default_factory=dict,
        description="material, young_modulus, soft_young_modulus, poisson_ratio, density, viscosity or damping_ratio "
        "of its flesh",
    )
    control: Annotated[dict[str, Any], AfterValidator(_of_control)] = Field(
        default_factory=dict, description="settings of its control, such as tone; all avatars have the same mode"
    )
    avatar: Annotated[dict[str, Any], _settings_of(AvatarSourceConfig)] = Field(
        default_factory=dict, description="settings of the source of its body"
    )
    shape: Annotated[dict[str, Any], _settings_of(ShapeConfig)] = Field(
        default_factory=dict, description="settings of its shape"
    )
    regions: tuple[RegionConfig, ...] = Field((), description="flesh of other materials; later ones win")
    garments: tuple[GarmentConfig, ...] | None = Field(
        None, description="its garments, from the innermost; null for those of the environment"
    )


class PropConfig(BaseModel):
    """A soft prop: matter like the flesh, which can fly, roll, deform and slide."""

    model_config = FROZEN

    name: str = Field(..., min_length=1, description="its name in observations and settings")
    shape: Literal["sphere", "box", "capsule", "mesh"] = Field("sphere", description="its shape")
    size: tuple[Length, ...] = Field(
        (0.11,),
        description="sphere: radius; box: half extents; capsule: radius, half length; mesh: length of the file's unit, "
        "1 if not given [m]",
    )
    file: str | None = Field(None, description="watertight mesh, for shape mesh")
    mass: float | None = Field(None, ge=1.0e-6, le=1.0e4, description="mass; null for that of the density [kg]")
    density: float = Field(
        1000.0, ge=LEAST_DENSITY, le=MOST_DENSITY, description="density, if no mass is given [kg/m^3]"
    )
    material: MaterialName = Field("neo_hookean", description="elastic energy")
    young_modulus: float | None = Field(
        None,
        ge=1.0,
        le=MOST_MODULUS,
        description="Young's modulus; null for waves as fast as the flesh's, which needs no more substeps [Pa]",
    )
    poisson_ratio: float = Field(0.3, ge=0.0, lt=0.5, description="Poisson's ratio [-]")
    viscosity: float = Field(
        0.0, ge=0.0, le=MOST_VISCOSITY, description="shear viscosity, beside that of damping_ratio [Pa s]"
    )
    damping_ratio: float = Field(
        0.0,
        ge=0.0,
        le=MOST_DAMPING,
        description="damping over critical damping, for vibrations at 25 Hz; in proportion to frequency at others [-]",
    )
    position: Vector = Field((0.0, -1.0, 1.0), description="initial position of its centre of mass [m]")
    rotation: Quaternion = Field((1.0, 0.0, 0.0, 0.0), description="initial rotation, quaternion wxyz")
    velocity: tuple[Speed, Speed, Speed] = Field((0.0, 0.0, 0.0), description="initial velocity [m/s]")
    spin: tuple[Spin, Spin, Spin] = Field((0.0, 0.0, 0.0), description="initial angular velocity [rad/s]")
    top_speed: TopSpeed = Field(
        0.0,
        description="greatest speed that any part of it is given later, as in a throw, for which substeps are short "
        "enough [m/s]",
    )
    friction: float = Field(0.5, ge=0.0, le=10.0, description="Coulomb coefficient on the ground and colliders [-]")

    @model_validator(mode="after")
    def _leave_a_mesh_its_size(self) -> PropConfig:
        """Give a mesh the scale 1, where the default would be the radius of a ball."""
        if self.shape == "mesh" and "size" not in self.model_fields_set:
            object.__setattr__(self, "size", (1.0,))  # the model is frozen
        return self


class ColliderConfig(BaseModel):
    """An analytic solid, at rest or in prescribed motion."""

    model_config = FROZEN

    name: str = Field(..., min_length=1, description="its name in settings")
    kind: Literal["plane", "box", "sphere", "capsule"] = Field("box", description="its shape")
    size: tuple[Length, ...] = Field(
        (), description="box: half extents; sphere: radius; capsule: radius, half length [m]"
    )
    position: Vector = Field((0.0, 0.0, 0.0), description="position of its origin [m]")
    rotation: Quaternion = Field((1.0, 0.0, 0.0, 0.0), description="quaternion wxyz; a plane faces its local +z")
    velocity: tuple[Speed, Speed, Speed] = Field((0.0, 0.0, 0.0), description="velocity of its origin [m/s]")
    spin: tuple[Spin, Spin, Spin] = Field((0.0, 0.0, 0.0), description="angular velocity [rad/s]")
    top_speed: TopSpeed = Field(0.0, description="greatest speed that any part of it is given later [m/s]")
    friction: float = Field(0.5, ge=0.0, le=10.0, description="Coulomb coefficient [-]")


class PairFriction(BaseModel):
    """Friction between two of the avatars (by agent name), props, colliders and ``ground``."""

    model_config = FROZEN

    a: str = Field(..., description="name of the one")
    b: str = Field(..., description="name of the other")
    friction: float = Field(..., ge=0.0, le=10.0, description="Coulomb coefficient [-]")


class SceneConfig(BaseModel):
    """Avatars, props and colliders, to which a task adds its own."""

    model_config = FROZEN

    avatars: tuple[AvatarConfig, ...] = Field((), description="one per agent; empty for those of the task")
    props: tuple[PropConfig, ...] = Field((), description="soft props in addition to the task's")
    colliders: tuple[ColliderConfig, ...] = Field((), description="analytic solids in addition to ground and task's")
    ground: bool = Field(True, description="a floor at z = 0")
    walls: bool = Field(
        True,
        description="smooth walls around the domain, if there are props or several avatars, to keep them in it",
    )
    self_contact: bool = Field(
        False, description="separate velocity fields for torso, arms and legs, so that they touch each other"
    )
    body_friction: float = Field(0.5, ge=0.0, le=10.0, description="Coulomb coefficient between bodies [-]")
    pair_friction: tuple[PairFriction, ...] = Field((), description="coefficients of pairs that differ")
    contact_normals: Literal["shared", "own"] = Field(
        "shared", description="shared (one normal a pair: keeps momentum) or own (the paper's rule, which does not)"
    )
    contact_gate: float = Field(
        0.15, ge=0.0, le=3.0, description="gap between two bodies' surfaces below which they touch [grid spacings]"
    )


#: Colours of bodies in pictures; see :mod:`piavatar_envs.render.quantities`.
BodyColor = Literal["skin", "strain", "distortion", "impulse"]


#: Least width and height of a picture: of an observed one, and of a frame, which may hold text [pixel].
LEAST_PICTURE, LEAST_FRAME = 8, 16


class RenderConfig(BaseModel):
    """Pictures of the scene; used only with a ``render_mode``."""

    model_config = FROZEN

    width: int = Field(480, ge=LEAST_FRAME, le=7680, description="width of a frame [pixel]")
    height: int = Field(480, ge=LEAST_FRAME, le=4320, description="height of a frame [pixel]")
    color: BodyColor = Field(
        "skin",
        description="colour of the bodies of avatars: their own (skin); the largest change of a principal stretch "
        "(strain); |F - R|, with the rotation R of the deformation gradient F (distortion); or the impulse of other "
        "bodies on the body part in the last control step (impulse)",
    )
    overlays: bool = Field(True, description="draw what is not matter: the task's markers, and the scale of colours")
    mosaic: int | None = Field(
        None,
        ge=1,
        le=1024,
        description="number of environments, the first ones, that render() of a vector shows side by side in one "
        "picture; null for a picture of each",
    )
    camera_position: tuple[Coordinate, Coordinate, Coordinate] | None = Field(
        None, description="position of the camera, from the ground below what it follows; null as the task has it [m]"
    )
    camera_target: tuple[Coordinate, Coordinate, Coordinate] | None = Field(
        None, description="the point that it looks at, from the same origin; null as the task has it [m]"
    )
    camera_follows: bool | None = Field(
        None, description="follow the avatars, or stay at the origin; null as the task has it"
    )


class NamedCamera(BaseModel):
    """A camera of the task, or one fixed to a bone of the agent that observes."""

    model_config = FROZEN

    kind: Literal["task", "head", "left_hand", "right_hand"] = Field(
        "task",
        description="task: the camera of render(), above what it follows; head, left_hand, right_hand: fixed to that "
        "bone of the agent that observes",
    )


class PlacedCamera(BaseModel):
    """A camera at a place of your own."""

    model_config = FROZEN

    kind: Literal["placed"] = Field("placed", description="placed: where position and target say")
    position: Vector = Field(
        STANDING_VIEW[0], description="the eye, from the ground below what it follows, or from the origin [m]"
    )
    target: Vector = Field(STANDING_VIEW[1], description="the point that it looks at, from the same origin [m]")
    follows: bool = Field(True, description="follow the avatars over the ground, or stay at the origin")

    @model_validator(mode="after")
    def _check_direction(self) -> PlacedCamera:
        """Refuse a camera that looks at its own place."""
        if math.dist(self.position, self.target) < 1.0e-3:
            raise ConfigError(f"position={list(self.position)} is where it looks; move it or target")
        return self


class PixelsConfig(BaseModel):
    """Pictures as observations; used only with ``obs_mode="pixels"`` and ``"pixels+state"``."""

    model_config = FROZEN

    width: int = Field(64, ge=LEAST_PICTURE, le=1024, description="width of an observed picture [pixel]")
    height: int = Field(64, ge=LEAST_PICTURE, le=1024, description="height of an observed picture [pixel]")
    camera: NamedCamera | PlacedCamera = Field(
        default_factory=NamedCamera, discriminator="kind", description="what is seen"
    )
    field_of_view: float | None = Field(
        None, ge=1.0, le=120.0, description="vertical angle; null for 90 of cameras on a body, and 29 of others [deg]"
    )
    depth: bool = Field(False, description="observe the distance along the view axis of every pixel, too")
    segmentation: bool = Field(
        False, description="observe what every pixel shows, too: 0 ground and sky, then the number of the subject"
    )
    farthest: float = Field(
        20.0, gt=0.0, le=FARTHEST, description="depth of the sky and of everything beyond, which is cut off there [m]"
    )


#: Settings of each preset; those that the mode of control does not have are left out.
PRESETS: dict[str, dict[str, dict[str, float]]] = {
    "firm": {"physics": {"young_modulus": 1.0e5}, "control": {"tone": 1.0, "joint_stiffness": 1.0}},
    "soft": {"physics": {"young_modulus": 2.0e4}, "control": {"tone": 0.1, "joint_stiffness": 0.3}},
    "limp": {"physics": {"young_modulus": 2.0e4}, "control": {"tone": 0.0, "joint_stiffness": 0.0}},
}


class EnvConfig(BaseModel):
    """Settings of every environment; a task adds its own in a subclass.

    Class attributes:
        presets: settings of each value of ``preset``, by section.
        bare_names: what bare names mean that several sections have, or that name a section within one.
    """

    model_config = FROZEN
    presets: ClassVar[Mapping[str, Mapping[str, Mapping[str, Any]]]] = PRESETS
    bare_names: ClassVar[Mapping[str, str]] = {
        "width": "render.width",
        "height": "render.height",
        "camera": "pixels.camera",
    }

    preset: Literal["firm", "soft", "limp"] | None = Field(
        None,
        description="settings of body and joints in one word, which given settings override: firm (young_modulus 1e5, "
        "tone or joint_stiffness 1), soft (2e4, tone 0.1 or joint_stiffness 0.3), limp (2e4 and 0); null sets nothing",
    )
    physics: PhysicsConfig = Field(default_factory=PhysicsConfig, description="the continuum")
    control: ControlConfig = Field(default_factory=PoseControlConfig, description="how actions move the body")
    avatar: AvatarSourceConfig = Field(default_factory=AvatarSourceConfig, description="the source of the body")
    shape: ShapeConfig = Field(default_factory=ShapeConfig, description="the body's shape")
    garments: tuple[GarmentConfig, ...] = Field((), description="what every avatar wears, from the innermost")
    cloth: ClothConfig = Field(default_factory=ClothConfig, description="the solver of garments")
    randomize: RandomizeConfig = Field(default_factory=RandomizeConfig, description="factors that every episode draws")
    scene: SceneConfig = Field(default_factory=SceneConfig, description="avatars, props, colliders and their contact")
    render: RenderConfig = Field(default_factory=RenderConfig, description="pictures")
    pixels: PixelsConfig = Field(default_factory=PixelsConfig, description="pictures as observations")
    episode_seconds: float = Field(5.0, gt=0.0, le=3600.0, description="simulated time until truncation [s]")
    joints: tuple[str, ...] | None = Field(
        None, description="joints that act; the others keep their reference pose; null for all 21"
    )
    observe_parameters: bool = Field(
        False,
        description="observe the parameters that the episode has drawn (randomize, random shapes, the task), the "
        "current root_assist under pd and torque, and the episode's clock",
    )
    obs_mode: Literal["flat", "dict", "pixels", "pixels+state"] = Field(
        "flat",
        description="observations as one float32 vector (flat), by name (dict), as pictures (pixels), or as pictures "
        "beside the vector (pixels+state)",
    )

    @property
    def observes_pixels(self) -> bool:
        """Whether observations are pictures, or have some."""
        return self.obs_mode in ("pixels", "pixels+state")

    @model_validator(mode="after")
    def _check_pixels(self) -> EnvConfig:
        """Refuse settings of observed pictures where none are observed."""
        usual = type(self).model_fields["pixels"].get_default(call_default_factory=True)
        if self.observes_pixels or self.pixels == usual:
            return self
        changed = [f"pixels.{name}" for name, value in self.pixels if value != getattr(usual, name)]
        verb, those = ("has", "it") if len(changed) == 1 else ("have", "them")
        raise ConfigError(
            f"{', '.join(changed)} {verb} no effect under obs_mode={self.obs_mode!r}; use 'pixels' or 'pixels+state', "
            f"or leave {those} out"
        )

    @model_validator(mode="after")
    def _check_avatars(self) -> EnvConfig:
        """Refuse an avatar's settings of another mode than the environment's; regions may have those of both."""
        for index, avatar in enumerate(self.scene.avatars):
            _check_control(self.control.mode, avatar.control, f"scene.avatars.{index}.")
            if self.control.mode != "pose" and any(region.soft_tissue is not None for region in avatar.regions):
                raise ConfigError(
                    f"scene.avatars.{index}.regions: soft_tissue belongs to control.mode='pose', and has no effect "
                    f"under {self.control.mode!r}; leave it out"
                )
            for number, region in enumerate(avatar.regions):
                name, other = ("flesh_rate", "alpha") if self.control.mode == "pose" else ("alpha", "flesh_rate")
                if getattr(region, name) is not None and getattr(region, other) is None:
                    raise ConfigError(
                        f"scene.avatars.{index}.regions.{number}.{name}={getattr(region, name)} has no effect under "
                        f"control.mode={self.control.mode!r}; give {other}, with it or alone"
                    )
        return self

    @model_validator(mode="after")
    def _check_sources(self) -> EnvConfig:
        """Refuse settings that the source of a body does not have."""
        places = {"avatar": self.avatar}
        for index, avatar in enumerate(self.scene.avatars):
            places[f"scene.avatars.{index}.avatar"] = self.avatar.of_avatar(avatar.avatar)
        for key, chosen in places.items():
            try:
                check_settings(chosen.source, chosen.settings)
            except ValueError as error:
                raise ConfigError(f"{key}: {error}") from None
        return self


def select_joints(names: Sequence[str] | None) -> tuple[str, ...]:
    """Return the acting joints in skeleton order; all but the root if ``names`` is None.

    Raises:
        ConfigError: ``names`` has an unknown joint, a joint twice, or the root.
    """
    if names is None:
        return JOINT_NAMES[1:]
    unknown = [name for name in names if name not in JOINT_NAMES[1:]]
    if unknown or len(set(names)) != len(names) or not names:
        raise ConfigError(
            f"joints={list(names)}: {unknown[0]!r} is not a joint; use some of {', '.join(JOINT_NAMES[1:])}"
            if unknown
            else f"joints={list(names)} must name each joint once and at least one"
        )
    return tuple(name for name in JOINT_NAMES if name in names)
