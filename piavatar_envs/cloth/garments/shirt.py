"""A shirt, from a sleeveless one to one with long sleeves, which hangs on the shoulders."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from pydantic import Field
from scipy import sparse

from piavatar_envs.cloth.cut import Cut
from piavatar_envs.cloth.panels import along_limb, below_neck, laid, lay_out, limb_field
from piavatar_envs.cloth.proxy import LEFT_ARM, RIGHT_ARM, TRUNK
from piavatar_envs.cloth.wearer import Wearer

#: Distance at which a shirt lies on the skin, and its ease at the chest [m].
THICKNESS, _EASE = 0.006, 0.010
_SMOOTHING = 32


def cut(
    wearer: Wearer,
    sleeve: Annotated[
        float,
        Field(ge=0.0, le=1.95, description="end of the sleeves: 0 at the shoulder, 1 at the elbow, 2 at the wrist [-]"),
    ] = 0.6,
    hem: Annotated[
        float, Field(ge=-1.0, le=1.5, description="end of the trunk: 0 at the pelvis, 1 at the lowest spine joint [-]")
    ] = -0.45,
    loose: Annotated[float, Field(ge=0.0, le=0.1, description="distance from the skin at hem and sleeves [m]")] = 0.03,
    edge: Annotated[float, Field(ge=0.01, le=0.1, description="length of the mesh's edges, about [m]")] = 0.03,
) -> Cut:
    """Return a shirt.

    Args:
        wearer: the body.
        sleeve: end of the sleeves.
        hem: end of the trunk.
        loose: ease at the ends.
        edge: of the mesh.
    """
    along = along_limb(wearer, "shoulder", "elbow", "wrist")
    pelvis, spine, chest = (wearer.at(joint)[2] for joint in ("pelvis", "spine1", "spine3"))
    bottom = pelvis + hem * (spine - pelvis)
    field = np.minimum(below_neck(wearer, 0.12, 0.45), limb_field(wearer, along, sleeve, "shoulder", "elbow"))
    field = np.minimum(field, np.where(wearer.arms, 1.0, wearer.vertices[:, 2] - bottom))
    reach = np.clip(np.where(np.isfinite(along), along, 0.0), 0.0, 1.0)
    # the share of the ease, by material: it stays that of each vertex on other shapes
    down = np.clip((chest - wearer.vertices[:, 2]) / (chest - bottom), 0.0, 1.0)
    share = np.where(wearer.arms, reach, down**1.5)

    def ease(_: Wearer, blend: sparse.csr_array, __: np.ndarray, normals: np.ndarray) -> np.ndarray:
        return normals * (_EASE + loose * (blend @ share))[:, None]

    panel = lay_out(wearer, field, ease, THICKNESS, edge, _SMOOTHING)
    parts = [panel.anchors @ wearer.turned_by(joint) for joint in ("left_shoulder", "right_shoulder")]
    # a sleeve touches its arm and the body of the shirt the trunk: both would be pinched between them in the armpit
    sees = np.where(parts[0] > 0.5, LEFT_ARM, np.where(parts[1] > 0.5, RIGHT_ARM, TRUNK)).astype(np.int32)

    def fit(other: Wearer) -> np.ndarray:
        return laid(other, panel, ease, THICKNESS, _SMOOTHING)

    return Cut(fit(wearer), panel.faces, sees, fit=fit, thickness=THICKNESS)
