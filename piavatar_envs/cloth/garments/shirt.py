"""A shirt, from a sleeveless one to one with long sleeves, which hangs on the shoulders."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from piavatar_envs.cloth.bodice import cut_bodice
from piavatar_envs.cloth.cut import Cut
from piavatar_envs.cloth.wearer import Wearer

#: Distance at which a shirt lies on the skin [m].
THICKNESS = 0.006


def cut(
    wearer: Wearer,
    sleeve: Annotated[
        float,
        Field(ge=0.0, le=1.95, description="end of the sleeves: 0 at the shoulder, 1 at the elbow, 2 at the wrist [-]"),
    ] = 0.6,
    hem: Annotated[
        float, Field(ge=-1.0, le=1.5, description="end of the trunk: 0 at the pelvis, 1 at the lowest spine joint [-]")
    ] = -0.45,
    neckline: Annotated[
        float, Field(ge=0.0, le=0.5, description="depth of the neckline: 0 at the neck, 1 at the chest's joint [-]")
    ] = 0.12,
    loose: Annotated[float, Field(ge=0.0, le=0.1, description="distance from the skin at hem and sleeves [m]")] = 0.03,
    edge: Annotated[float, Field(ge=0.01, le=0.1, description="length of the mesh's edges, about [m]")] = 0.03,
) -> Cut:
    """Return a shirt.

    Args:
        wearer: the body.
        sleeve: end of the sleeves.
        hem: end of the trunk.
        neckline: its depth.
        loose: ease at the ends.
        edge: of the mesh.
    """
    pelvis, spine = wearer.at("pelvis")[2], wearer.at("spine1")[2]
    bodice = cut_bodice(wearer, pelvis + hem * (spine - pelvis), sleeve, neckline, loose, THICKNESS, edge)
    return Cut(bodice.on(wearer), bodice.panel.faces, bodice.sees, fit=bodice.on, thickness=THICKNESS)
