"""A cape: a sector of an annulus that hangs from the shoulders down the back."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from pydantic import Field

from piavatar_envs.cloth.cut import Cut
from piavatar_envs.cloth.pattern import Belt, Sector
from piavatar_envs.cloth.proxy import LEFT_ARM, LEFT_FOOT, LEFT_LEG, RIGHT_ARM, RIGHT_FOOT, RIGHT_LEG, TRUNK
from piavatar_envs.cloth.wearer import Wearer

#: Distance of the upper edge from the hull of the shoulders [m].
_EASE = 0.008
#: Height of the upper edge, from the joints of the shoulders (0) to that of the neck (1).
_HEIGHT = 0.45
#: Length of a cape without one, over the way from its upper edge to the ankles.
_TO_ANKLES = 0.8
#: Angle by which the upper edge goes on from the side of the shoulders to the front.
_FRONT = -0.35


def cut(
    wearer: Wearer,
    length: Annotated[float, Field(ge=0.1, le=1.6, description="from the shoulders to the hem [m]")] | None = None,
    flare: Annotated[
        float, Field(ge=0.2, le=1.0, description="angle of the pattern over that on the wearer: 1 a full circle [-]")
    ] = 0.35,
    edge: Annotated[float, Field(ge=0.01, le=0.1, description="length of the mesh's edges, about [m]")] = 0.035,
) -> Cut:
    """Return a cape.

    Args:
        wearer: the body.
        length: of the cloth; by default to the calves.
        flare: width of the hem.
        edge: of the mesh.

    Raises:
        ValueError: the cape is longer than from the shoulders to the ground.
    """
    belt = _belt(wearer)
    start = _to_ankles(wearer, belt)
    length = _TO_ANKLES * start if length is None else length
    if length > belt.height:
        raise ValueError(f"length={length:.3g} of the garment 'cape' must be at most {belt.height:.3g} [m]")
    panel = Sector.around(belt.length, length, flare, edge, span=(-_FRONT, np.pi + _FRONT))

    def fit(other: Wearer) -> np.ndarray:
        own = _belt(other)
        return panel.hung(own, _to_ankles(other, own) / start)

    sees = np.full(
        len(panel.polar), TRUNK | LEFT_ARM | RIGHT_ARM | LEFT_LEG | RIGHT_LEG | LEFT_FOOT | RIGHT_FOOT, np.int32
    )
    return Cut(fit(wearer), panel.faces, sees, panel.rows[0], panel.lengths, fit)


def _belt(wearer: Wearer) -> Belt:
    """Return the curve around the trunk below the neck."""
    shoulders = 0.5 * (wearer.at("left_shoulder")[2] + wearer.at("right_shoulder")[2])
    return Belt(wearer.section(float(shoulders + _HEIGHT * (wearer.at("neck")[2] - shoulders))), _EASE)


def _to_ankles(wearer: Wearer, belt: Belt) -> float:
    """Return the height of the upper edge above the ankles [m]."""
    return float(belt.height - 0.5 * (wearer.at("left_ankle")[2] + wearer.at("right_ankle")[2]))
