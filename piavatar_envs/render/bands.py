"""A body coloured by its strain, as a few meshes of one colour each: what a viewer without vertex colours can show."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from piavatar_envs.render.coloring import color_by
from piavatar_envs.render.scene import Body, Color

NUM_BANDS = 16


@dataclass(frozen=True, eq=False)
class Band:
    """The triangles of a body between two strains.

    Attributes:
        number: of the band, counted from the least strain.
        vertices: theirs alone [m], shape ``(V, 3)``.
        faces: the triangles, shape ``(T, 3)``.
        color: sRGB in [0, 1], of the middle of the band.
    """

    number: int
    vertices: np.ndarray
    faces: np.ndarray
    color: Color


def bands_of(body: Body) -> list[Band]:
    """Split the body into bands of equal width in its scalars; bands without triangles are left out.

    A triangle belongs where the mean of its corners does; beyond the range, and NaN, to the last band.
    """
    middles = (np.arange(NUM_BANDS) + 0.5) / NUM_BANDS
    colors = color_by(middles, 1.0)
    share = np.nan_to_num(np.asarray(body.scalars)[body.faces].mean(axis=1) / body.scalar_max, nan=1.0, posinf=1.0)
    band = np.clip(share * NUM_BANDS, 0.0, NUM_BANDS - 1.0).astype(np.int64)
    found = []
    for number in np.unique(band):
        own = body.faces[band == number]
        used, corners = np.unique(own, return_inverse=True)
        faces = corners.reshape(-1, 3).astype(np.int32)
        found.append(Band(int(number), np.asarray(body.vertices)[used], faces, tuple(colors[number])))
    return found
