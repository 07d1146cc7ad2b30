"""Trousers, from shorts to long ones, on a waistband."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from pydantic import Field
from scipy import sparse

from piavatar_envs.cloth.cut import Cut
from piavatar_envs.cloth.panels import along_limb, laid, lay_out, limb_field
from piavatar_envs.cloth.proxy import LEFT_FOOT, LEFT_LEG, RIGHT_FOOT, RIGHT_LEG, TRUNK
from piavatar_envs.cloth.remesh import boundary_loops
from piavatar_envs.cloth.wearer import Wearer

#: Distance at which trousers lie on the skin, and their ease at waist and hips [m].
THICKNESS, _EASE = 0.006, 0.008
_SMOOTHING = 24
#: Place along the leg at which its width is measured, and from where a leg is as wide as that.
_MEASURED, _STRAIGHT = 0.35, 0.6
#: Least distance from the middle that the inside of a leg keeps [m].
_APART = 0.004


def cut(
    wearer: Wearer,
    length: Annotated[
        float, Field(ge=0.2, le=1.95, description="end of the legs: 0 at the hip, 1 at the knee, 2 at the ankle [-]")
    ] = 1.88,
    width: Annotated[
        float, Field(ge=0.0, le=2.0, description="least width of the legs over that of the wearer's thighs [-]")
    ] = 0.8,
    rise: Annotated[
        float, Field(ge=0.2, le=1.2, description="height of the waistband, from pelvis (0) to lowest spine joint (1)")
    ] = 0.75,
    edge: Annotated[float, Field(ge=0.01, le=0.1, description="length of the mesh's edges, about [m]")] = 0.03,
) -> Cut:
    """Return trousers.

    Args:
        wearer: the body.
        length: end of the legs.
        width: of straight legs.
        rise: height of the waistband.
        edge: of the mesh.
    """
    along = along_limb(wearer, "hip", "knee", "ankle")
    pelvis, spine = wearer.at("pelvis")[2], wearer.at("spine1")[2]
    top = pelvis + rise * (spine - pelvis)
    field = np.minimum(top - wearer.vertices[:, 2], limb_field(wearer, along, length, "hip", "knee"))
    field = np.where(wearer.arms, -1.0, field)
    straight = np.clip((np.where(np.isfinite(along), along, 0.0) - _MEASURED) / (_STRAIGHT - _MEASURED), 0.0, 1.0)
    near = np.abs(along - _MEASURED) < 0.1

    def ease(other: Wearer, blend: sparse.csr_array, points: np.ndarray, normals: np.ndarray) -> np.ndarray:
        way = normals * (_EASE + 0.006 * (blend @ straight))[:, None]
        for side, sign in (("left", 1.0), ("right", -1.0)):
            own = other.turned_by(f"{side}_hip") > 0.5
            radius = _radial(other, side, other.vertices[own & near])
            wide = width * np.linalg.norm(radius, axis=1).mean()
            share = blend @ (own * straight)
            outward = _radial(other, side, points)
            size = np.maximum(np.linalg.norm(outward, axis=1, keepdims=True), 1.0e-6)
            way += share[:, None] * np.maximum(wide / size - 1.0, 0.0) * outward
            inside = blend @ own.astype(np.float64) > 0.5
            limit = np.minimum(sign * points[:, 0], _APART)
            way[:, 0] = np.where(
                inside, sign * np.maximum(sign * (points + way)[:, 0], limit) - points[:, 0], way[:, 0]
            )
        return way

    panel = lay_out(wearer, field, ease, THICKNESS, edge, _SMOOTHING)
    parts = [panel.anchors @ wearer.turned_by(joint) for joint in ("left_hip", "right_hip")]
    left, right = LEFT_LEG | LEFT_FOOT, RIGHT_LEG | RIGHT_FOOT
    sees = np.where(parts[0] > 0.5, left, np.where(parts[1] > 0.5, right, TRUNK)).astype(np.int32)

    def fit(other: Wearer) -> np.ndarray:
        return laid(other, panel, ease, THICKNESS, _SMOOTHING)

    positions = fit(wearer)
    waist = max(boundary_loops(panel.faces), key=lambda loop: positions[loop, 2].mean())
    return Cut(positions, panel.faces, sees, waist, fit=fit, thickness=THICKNESS)


def _radial(wearer: Wearer, side: str, points: np.ndarray) -> np.ndarray:
    """Return vectors to points from the axis of a leg through hip, knee and ankle, shape ``(N, 3)``."""
    hip, knee, ankle = (wearer.at(f"{side}_{joint}") for joint in ("hip", "knee", "ankle"))
    found = np.full((len(points), 3), np.inf)
    for start, end in ((hip, knee), (knee, ankle)):
        way = end - start
        share = np.clip((points - start) @ way / (way @ way), 0.0, 1.0)
        vector = points - start - share[:, None] * way
        nearer = np.linalg.norm(vector, axis=1) < np.linalg.norm(found, axis=1)
        found[nearer] = vector[nearer]
    return found
