"""A dress: a bodice to the waist, where a belt holds it, and a flared skirt below."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from pydantic import Field

from piavatar_envs.cloth.bodice import cut_bodice
from piavatar_envs.cloth.cut import Cut
from piavatar_envs.cloth.garments.skirt import to_knees, waist_belt
from piavatar_envs.cloth.pattern import Sector
from piavatar_envs.cloth.proxy import LEFT_FOOT, LEFT_LEG, RIGHT_FOOT, RIGHT_LEG, TRUNK
from piavatar_envs.cloth.remesh import boundary_loops
from piavatar_envs.cloth.wearer import Wearer

#: Distance at which a dress lies on the skin, and its ease at the waist [m].
THICKNESS, _LOOSE = 0.005, 0.004
#: Length of a dress without one from the waist down, over the way from there to the knees.
_TO_KNEES = 1.0
#: Passes that make the steps between the vertices of the waist even.
_EVENING = 20


def cut(
    wearer: Wearer,
    length: Annotated[float, Field(ge=0.05, le=1.5, description="from the waist to the hem [m]")] | None = None,
    flare: Annotated[
        float, Field(ge=0.2, le=1.0, description="angle of the skirt's pattern over a full turn: 0.5 a half circle [-]")
    ] = 0.5,
    sleeve: Annotated[
        float,
        Field(ge=0.0, le=1.95, description="end of the sleeves: 0 at the shoulder, 1 at the elbow, 2 at the wrist [-]"),
    ] = 0.0,
    neckline: Annotated[
        float, Field(ge=0.0, le=0.5, description="depth of the neckline: 0 at the neck, 1 at the chest's joint [-]")
    ] = 0.3,
    rise: Annotated[
        float, Field(ge=0.3, le=1.5, description="height of the waist, from pelvis (0) to lowest spine joint (1)")
    ] = 1.1,
    edge: Annotated[float, Field(ge=0.01, le=0.1, description="length of the mesh's edges, about [m]")] = 0.03,
) -> Cut:
    """Return a dress.

    Args:
        wearer: the body.
        length: of the skirt; by default to the knees.
        flare: from a quarter of a circle to a full one.
        sleeve: end of the sleeves.
        neckline: its depth.
        rise: height of the belt.
        edge: of the mesh.

    Raises:
        ValueError: the dress is longer than from its waist to the ground.
    """
    belt = waist_belt(wearer, rise)
    start = to_knees(wearer, belt.height)
    length = _TO_KNEES * start if length is None else length
    if length > belt.height:
        raise ValueError(f"length={length:.3g} of the garment 'dress' must be at most {belt.height:.3g} [m]")
    bodice = cut_bodice(wearer, belt.height, sleeve, neckline, _LOOSE, THICKNESS, edge)
    above, upper = bodice.on(wearer), bodice.panel.faces
    waist = min(boundary_loops(upper), key=lambda loop: above[loop, 2].mean())
    angle = belt.angle(above[waist])
    waist, angle = waist[np.argsort(angle)], np.sort(angle)
    for _ in range(_EVENING):  # even steps around the belt
        before, after = np.roll(angle, 1), np.roll(angle, -1)
        before[0] -= 2.0 * np.pi
        after[-1] += 2.0 * np.pi
        angle = 0.5 * angle + 0.25 * (before + after)
    panel = Sector.around(belt.length, length, flare, edge, angle)
    number = np.concatenate([waist, len(above) + np.arange(len(panel.polar) - len(waist))])
    place = np.full(len(above) + len(panel.polar) - len(waist), -1)  # in the panel
    place[number] = np.arange(len(panel.polar))

    def fit(other: Wearer) -> np.ndarray:
        own = waist_belt(other, rise)
        positions = np.concatenate([bodice.on(other), np.zeros((len(place) - len(above), 3))])
        positions[number] = panel.hung(own, to_knees(other, own.height) / start)
        return positions

    positions = fit(wearer)

    def lengths(pairs: np.ndarray) -> np.ndarray:
        straight = np.linalg.norm(positions[pairs[:, 0]] - positions[pairs[:, 1]], axis=1)
        flat = (place[pairs] >= 0).all(axis=1)
        straight[flat] = panel.lengths(place[pairs[flat]])
        return straight

    legs = np.full(len(place) - len(above), TRUNK | LEFT_LEG | RIGHT_LEG | LEFT_FOOT | RIGHT_FOOT, np.int32)
    sees = np.concatenate([bodice.sees, legs])
    faces = np.concatenate([upper, number[panel.faces]]).astype(np.int32)
    return Cut(positions, faces, sees, waist.astype(np.int32), lengths, fit, THICKNESS)
