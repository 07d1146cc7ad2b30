"""Fabrics: weight, stretch, bending and friction of cloth, from published measurements.

A fabric is isotropic and linear here, at the small strains of cloth that is worn. Sources of the table:

- H. Wang, R. Ramamoorthi, J. O'Brien, "Data-driven elastic models for cloth: modeling and measurement", ACM Trans.
  Graph. 30(4), 71 (2011), ten fabrics, with areal density, stiffness at small strain and bending of the flat cloth:
  twill (their trousers, 65 % cotton), denim (11 oz), jersey (their interlock T-shirt), ponte (their jacket), fleece
  (their blanket).
- Z. Penava, D. Simic Penava, Z. Knezic, "Determination of the elastic constants of plain woven fabrics by a tensile
  test in various directions", Fibres Text. East. Eur. 22(2) (2014), pp. 57-63: areal density of plain cotton and, at
  its first modulus times thickness, stretch.
- S. Kawabata, "The standardization and analysis of hand evaluation", 2nd ed., Textile Machinery Society of Japan
  (1980), means of men's winter suitings on the KES-F: 26.4 mg/cm^2, 0.136 gf cm^2/cm, 6 % at 500 gf/cm: wool.
- F. T. Peirce, "The 'handle' of cloth as a measurable quantity", J. Text. Inst. 21 (1930), T377-T416: the bending
  length c = (D / (sigma g))^(1/3) of cloth with bending stiffness D and areal density sigma. Cotton (2 cm), silk (crepe
  de Chine, 1.5 cm) and linen (2.5 cm) bend by *estimates* of it; weight and stretch of the latter two are usual ones.
- M. Temel, A. A. Johnson, A. B. Lloyd, "Evaluating the repeatability of friction coefficient measurements and tactile
  perceptions in skin-textile interactions across body regions", Tribol. Lett. 70(1) (2022): cotton slides on skin at
  0.25 (forearm) to 0.8 (chest). Coefficients of the table are *estimates* within that range.

Woven cloth is stiffer than the solver resolves with its usual steps: 1 to 10 kN/m, of which a garment stretches by less
than 0.1 % under its weight. The stretch of the table is at most :data:`MOST_STRETCH`; that of a garment under its
weight is then a few thousandths. Bending is never changed.
"""

from __future__ import annotations

from dataclasses import dataclass

Color = tuple[float, float, float]

#: Stretch stiffness beyond which 20 substeps with 4 sweeps gain nothing [N/m].
MOST_STRETCH = 500.0
#: Substeps of cloth that may be set for a control step, at most; stiff bending needs many.
MOST_CLOTH_SUBSTEPS = 1000


@dataclass(frozen=True)
class Fabric:
    """Weight, stiffness, friction and colours of cloth.

    Attributes:
        areal_density: mass per area [kg/m^2].
        stretch: membrane stiffness E h [N/m].
        bending: bending stiffness D, the moment per width and curvature [N m].
        friction: Coulomb coefficient on skin, props and other cloth's wearers [-].
        drag: half the density of air times the drag coefficient of motion along the normal [kg/m^3].
        skin_drag: the same of motion along the cloth [kg/m^3].
        front: sRGB of its outside, in [0, 1].
        back: sRGB of its inside, in [0, 1].
    """

    areal_density: float
    stretch: float
    bending: float
    friction: float = 0.4
    drag: float = 0.6
    skin_drag: float = 0.02
    front: Color = (0.62, 0.16, 0.20)
    back: Color = (0.50, 0.14, 0.17)

    def __post_init__(self) -> None:
        for name in ("areal_density", "stretch"):
            if not getattr(self, name) > 0.0:
                raise ValueError(f"{name}={getattr(self, name)} of a fabric must be positive")
        for name in ("bending", "friction", "drag", "skin_drag"):
            if not getattr(self, name) >= 0.0:
                raise ValueError(f"{name}={getattr(self, name)} of a fabric must not be negative")


def _woven(areal_density: float, stretch: float, bending: float, friction: float, front: Color, back: Color) -> Fabric:
    """Return a fabric with its measured stretch [N/m] as far as the solver resolves it."""
    return Fabric(areal_density, min(stretch, MOST_STRETCH), bending, friction, front=front, back=back)


#: Fabrics by name; stretches are the measured ones, which :data:`MOST_STRETCH` bounds.
FABRICS: dict[str, Fabric] = {
    "cotton": _woven(0.150, 260.0, 1.2e-5, 0.4, (0.66, 0.17, 0.20), (0.50, 0.12, 0.15)),
    "twill": _woven(0.220, 4070.0, 1.25e-4, 0.4, (0.72, 0.63, 0.48), (0.60, 0.52, 0.39)),
    "denim": _woven(0.324, 2030.0, 6.4e-5, 0.4, (0.17, 0.25, 0.42), (0.46, 0.54, 0.65)),
    "silk": _woven(0.070, 1000.0, 2.3e-6, 0.3, (0.36, 0.21, 0.47), (0.43, 0.29, 0.54)),
    "linen": _woven(0.190, 2000.0, 2.9e-5, 0.4, (0.82, 0.77, 0.66), (0.72, 0.67, 0.56)),
    "wool": _woven(0.264, 8200.0, 1.33e-5, 0.4, (0.25, 0.27, 0.31), (0.20, 0.21, 0.25)),
    "jersey": _woven(0.187, 70.0, 2.3e-5, 0.4, (0.20, 0.46, 0.47), (0.16, 0.37, 0.38)),
    "ponte": _woven(0.284, 90.0, 3.6e-5, 0.4, (0.16, 0.16, 0.19), (0.13, 0.13, 0.15)),
    "fleece": _woven(0.228, 490.0, 1.17e-4, 0.5, (0.80, 0.49, 0.22), (0.70, 0.43, 0.20)),
}

_registered: dict[str, Fabric] = {}


def list_fabrics() -> tuple[str, ...]:
    """Return the names of all fabrics."""
    return tuple(sorted({*FABRICS, *_registered}))


def register_fabric(name: str, fabric: Fabric) -> None:
    """Make a fabric of your own available by its name, in this process.

    Args:
        name: of the fabric; registering it again replaces it.
        fabric: its properties.

    Raises:
        TypeError: ``fabric`` is no :class:`Fabric`.
        ValueError: a fabric of this package has the name.
    """
    if not isinstance(fabric, Fabric):
        raise TypeError(f"fabric {name!r} is a {type(fabric).__name__}; pass a Fabric")
    if name in FABRICS:
        raise ValueError(f"fabric {name!r} is one of this package; use another name")
    _registered[name] = fabric


def fabric_of(name: str) -> Fabric:
    """Return the fabric of a name.

    Raises:
        ValueError: no fabric has it.
    """
    if name in FABRICS:
        return FABRICS[name]
    if name not in _registered:
        raise ValueError(f"unknown fabric {name!r}; use one of {', '.join(list_fabrics())}")
    return _registered[name]


def check_fabric(name: str) -> str:
    """Return ``name``.

    Raises:
        ValueError: no fabric has it.
    """
    fabric_of(name)
    return name
