"""A garment from a file, in place around the body or moved there; the drape brings it out of the skin and to rest."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from piavatar_envs.avatar.body.sources.mesh import Y_UP, load_surface
from piavatar_envs.cloth.cut import Cut
from piavatar_envs.cloth.sheet import Edge, Holding, sheet_of, welded_pieces
from piavatar_envs.cloth.wearer import Wearer

#: Distance from the body of the nearest vertex, and of any [m].
_FARTHEST, _WIDEST = 0.1, 2.0


def cut(
    wearer: Wearer,
    path: str,
    scale: Annotated[float, Field(gt=0.0, le=1000.0, description="length of the file's unit [m]")] = 1.0,
    offset: Annotated[
        tuple[float, float, float], Field(description="shift after the scaling; the body stands on 0 and faces -y [m]")
    ] = (0.0, 0.0, 0.0),
    up: Annotated[
        Literal["y", "z"] | None, Field(description="axis that points up; null for y of glTF, z else")
    ] = None,
    held: Holding = "top",
    edge: Edge = 0.03,
) -> Cut:
    """Return a garment of a file.

    Args:
        wearer: the body, in its rest pose.
        path: an OBJ, GLB, glTF, PLY, STL or OFF file; a surface with borders, such as a dress, not a closed body.
        scale: of its unit.
        offset: of its origin.
        up: its axis.
        held: whether the wearer holds its highest border.
        edge: of the mesh.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it has no surface, none with a border to hold, or is far from the body.
    """
    file = Path(path)
    loaded = load_surface(file)
    upright = loaded.vertices
    if (up or ("y" if file.suffix.lower() in (".glb", ".gltf") else "z")) == "y":
        upright = upright @ Y_UP.T
    points, faces = welded_pieces(upright * scale + np.array(offset), loaded.faces)
    _check_place(file.name, wearer, points)
    return sheet_of(wearer, file.name, points, faces, held, edge)


def _check_place(name: str, wearer: Wearer, points: np.ndarray) -> None:
    """Refuse a surface that is not around the body.

    Raises:
        ValueError: it is such.
    """
    apart = wearer.surface.distance(points)
    if np.abs(apart).min() > _FARTHEST or (apart < -_FARTHEST).mean() > 0.5 or apart.max() > _WIDEST:
        spans = [[_shown(each.min(axis=0)), _shown(each.max(axis=0))] for each in (points, wearer.vertices)]
        raise ValueError(
            f"{name} is not around the body: it reaches from {spans[0][0]} to {spans[0][1]} m, the body from "
            f"{spans[1][0]} to {spans[1][1]}; give scale, offset or up"
        )


def _shown(point: np.ndarray) -> list[float]:
    return [round(float(value), 2) for value in point]
