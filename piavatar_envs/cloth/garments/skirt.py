"""A flared skirt: a sector of an annulus on a waistband."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from pydantic import Field

from piavatar_envs.cloth.cut import Cut
from piavatar_envs.cloth.pattern import Belt, Sector
from piavatar_envs.cloth.proxy import LEFT_FOOT, LEFT_LEG, RIGHT_FOOT, RIGHT_LEG, TRUNK
from piavatar_envs.cloth.wearer import Wearer

#: Distance of a waistband from the hull of the body [m].
EASE = 0.006
#: Length of a skirt without one, over the way from the waistband to the knees.
_TO_KNEES = 0.92


def cut(
    wearer: Wearer,
    length: Annotated[float, Field(ge=0.05, le=1.5, description="from the waistband to the hem [m]")] | None = None,
    flare: Annotated[
        float, Field(ge=0.2, le=1.0, description="angle of the pattern over a full turn: 0.25 a quarter circle [-]")
    ] = 0.5,
    rise: Annotated[
        float, Field(ge=0.0, le=1.5, description="height of the waistband, from pelvis (0) to lowest spine joint (1)")
    ] = 1.0,
    edge: Annotated[float, Field(ge=0.01, le=0.1, description="length of the mesh's edges, about [m]")] = 0.03,
) -> Cut:
    """Return a skirt.

    Args:
        wearer: the body.
        length: of the cloth; by default to a little above the knees.
        flare: from a quarter of a circle to a full one.
        rise: height of the waistband.
        edge: of the mesh.

    Raises:
        ValueError: the skirt is longer than from its waistband to the ground.
    """
    belt = waist_belt(wearer, rise)
    if length is None:
        length = _TO_KNEES * to_knees(wearer, belt.height)
    if length > belt.height:
        raise ValueError(f"length={length:.3g} of the garment 'skirt' must be at most {belt.height:.3g} [m]")
    panel = Sector.around(belt.length, length, flare, edge)
    start = to_knees(wearer, belt.height)

    def fit(other: Wearer) -> np.ndarray:
        own = waist_belt(other, rise)
        return panel.hung(own, to_knees(other, own.height) / start)

    sees = np.full(len(panel.polar), TRUNK | LEFT_LEG | RIGHT_LEG | LEFT_FOOT | RIGHT_FOOT, np.int32)
    return Cut(panel.hung(belt), panel.faces, sees, panel.rows[0], panel.lengths, fit)


def waist_belt(wearer: Wearer, rise: float) -> Belt:
    """Return the curve of a waistband at a height from the pelvis (0) to the lowest joint of the spine (1)."""
    pelvis, spine = wearer.at("pelvis")[2], wearer.at("spine1")[2]
    return Belt(wearer.section(float(pelvis + rise * (spine - pelvis))), EASE)


def to_knees(wearer: Wearer, height: float) -> float:
    """Return how far a height is above the knees [m]."""
    return float(height - 0.5 * (wearer.at("left_knee")[2] + wearer.at("right_knee")[2]))
