"""A surface that the wearer's own file has as clothes, such as the skirt of a GLB, no longer drawn with the bones."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import Annotated

import numpy as np
from pydantic import Field
from scipy.spatial import cKDTree

from piavatar_envs.avatar.body.asset import WornSurface
from piavatar_envs.avatar.body.sampling import ClosedSurface
from piavatar_envs.cloth.cut import Cut
from piavatar_envs.cloth.sheet import Edge, Holding, sheet_of, welded_pieces
from piavatar_envs.cloth.wearer import Wearer


def cut(
    wearer: Wearer,
    surface: Annotated[
        str | None, Field(description="name of the surface or its material in the file; null for the only one")
    ] = None,
    held: Holding = "top",
    edge: Edge = 0.03,
) -> Cut:
    """Return a garment of a surface that is worn, in the colours and with the textures of the file.

    Args:
        wearer: the body, in its rest pose.
        surface: its name, as ``python -m piavatar_envs inspect FILE`` lists it.
        held: whether the wearer holds its highest border.
        edge: of the mesh.

    Raises:
        ValueError: the wearer's file has no such surface, or it is not a single sheet.
    """
    name, own = _surface(wearer, surface)
    points = _placed(wearer, own.vertices.astype(np.float64))
    cloth = sheet_of(wearer, name, *welded_pieces(points, own.faces), held, edge)
    # the same vertices in the mean shape, as the avatar's look has them
    rows = cKDTree(points).query(cloth.source)[1]
    colors = None if own.colors is None else own.colors[rows]
    return replace(cloth, colors=colors, source=own.vertices[rows].astype(np.float64), replaces=name)


def _placed(wearer: Wearer, points: np.ndarray) -> np.ndarray:
    """Return points of the mean shape, moved with the nearest skin to where the wearer stands, shape ``(W, 3)`` [m]."""
    mean = wearer.asset.vertices.astype(np.float64)
    _, face, weights = ClosedSurface(mean, wearer.faces).query(points)
    return points + np.einsum("nc,ncd->nd", weights, (wearer.vertices - mean)[wearer.faces[face]])


def _surface(wearer: Wearer, surface: str | None) -> tuple[str, WornSurface]:
    """Return a surface and its name.

    Raises:
        ValueError: there is none, or several and no name.
    """
    worn, body = wearer.asset.worn, wearer.asset.name
    if not worn:
        raise ValueError(f"{body} wears nothing of its own that is not body; use a kind that is cut, such as 'skirt'")
    if surface is None:
        distinct = {own.drawn.tobytes(): name for name, own in worn.items()}
        if len(distinct) > 1:
            raise ValueError(f"{body} wears several surfaces; set surface to one of {_list(worn)}")
        surface = next(iter(worn))
    if surface not in worn:
        raise ValueError(f"{body} wears no surface {surface!r}; it has {_list(worn)}")
    return surface, worn[surface]


def _list(names: Iterable[str]) -> str:
    return ", ".join(repr(name) for name in names)
