"""The upper part of shirts and dresses: from the neck to a hem, with or without sleeves."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import sparse

from piavatar_envs.cloth.panels import Ease, Panel, along_limb, below_neck, laid, lay_out, limb_field
from piavatar_envs.cloth.proxy import LEFT_ARM, LEFT_LEG, RIGHT_ARM, RIGHT_LEG, TRUNK
from piavatar_envs.cloth.wearer import Wearer

#: Ease at the chest [m], and passes of smoothing.
_EASE, _SMOOTHING = 0.010, 32
#: Share of that ease at the neckline, and the way from it over which it grows [m].
_AT_COLLAR, _SET_IN = 0.3, 0.06
#: Place of armholes along the upper arm, where there are no sleeves.
_ARMHOLE = 0.04


@dataclass(frozen=True, eq=False)
class Bodice:
    """A panel around trunk and shoulders.

    Attributes:
        panel: its mesh.
        sees: parts of the wearer that its vertices touch, shape ``(N,)`` int32.
        ease: way outwards of the cloth.
        gap: least distance from the skin [m].
    """

    panel: Panel
    sees: np.ndarray
    ease: Ease
    gap: float

    def on(self, wearer: Wearer) -> np.ndarray:
        """Return its vertices on a wearer [m], shape ``(N, 3)``."""
        return laid(wearer, self.panel, self.ease, self.gap, _SMOOTHING)


def cut_bodice(
    wearer: Wearer, bottom: float, sleeve: float, neckline: float, loose: float, gap: float, edge: float
) -> Bodice:
    """Return a bodice.

    Args:
        wearer: the body.
        bottom: height of its hem [m].
        sleeve: end of the sleeves: 0 at the shoulder, 1 at the elbow, 2 at the wrist.
        neckline: depth of the neckline, over the way from the neck's joint to that of the chest.
        loose: ease at hem and sleeves [m].
        gap: least distance from the skin [m].
        edge: length of edges, about [m].
    """
    along = along_limb(wearer, "shoulder", "elbow", "wrist")
    height, chest = wearer.vertices[:, 2], wearer.at("spine3")[2]
    end = max(sleeve, _ARMHOLE)
    collar = below_neck(wearer, neckline)
    field = np.minimum(collar, limb_field(wearer, along, end, "shoulder", "elbow"))
    field = np.minimum(field, np.where(wearer.arms, 1.0, height - bottom))
    reach = np.clip(np.where(np.isfinite(along), along, 0.0) / max(end, 0.3), 0.0, 1.0)
    # the ease belongs to the material: it stays that of each vertex on other shapes
    down = np.clip((chest - height) / max(chest - bottom, 1.0e-3), 0.0, 1.0)
    share = np.where(wearer.arms, 0.7 * reach, down**1.5)

    near = _EASE * (_AT_COLLAR + (1.0 - _AT_COLLAR) * np.clip(collar / _SET_IN, 0.0, 1.0))

    def ease(_: Wearer, blend: sparse.csr_array, __: np.ndarray, normals: np.ndarray) -> np.ndarray:
        return normals * (blend @ (near + loose * share))[:, None]

    panel = lay_out(wearer, field, ease, gap, edge, _SMOOTHING)
    left, right = (panel.anchors @ wearer.turned_by(joint) for joint in ("left_shoulder", "right_shoulder"))
    # a sleeve touches its arm and the rest trunk and legs: both would be pinched between them in the armpit
    rest = TRUNK | LEFT_LEG | RIGHT_LEG
    sees = np.where(left > 0.5, LEFT_ARM, np.where(right > 0.5, RIGHT_ARM, rest)).astype(np.int32)
    return Bodice(panel, sees, ease, gap)
