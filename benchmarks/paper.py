"""Figures that PIAvatar (Han et al., arXiv 2606.21162) publishes for its own method, to stand next to ours.

Only what is needed to compare; where the paper gives a table's range and not the entry, the range is here. Distances
in metres, angles in degrees.
"""

from __future__ import annotations

from typing import Any

#: Table 1, SMPL-X with decoupling: mean distance [m] ("MSE" in the paper) after so many substeps.
TABLE_1_MEAN_DISTANCE: dict[int, float] = {100: 0.013, 200: 0.022, 300: 0.031, 400: 0.039}
#: Table 1: share of points within 1 cm at the first and the last of them.
TABLE_1_ACCURACY: dict[int, float] = {100: 0.91, 400: 0.58}
#: Table 1 without decoupling: mean distance [m], not tied to one of the columns here.
TABLE_1_UNDECOUPLED = 0.25
#: Table 2: smallest and largest error of the root's rotation and of the joints' rotations relative to their parents.
TABLE_2_ROOT_ROTATION = (0.03, 0.12)
TABLE_2_RELATIVE_ROTATION = (0.10, 0.32)


def table_1(decoupling: str, substeps: int) -> dict[str, Any]:
    """What the paper has for a row of Table 1; None where it has nothing."""
    if decoupling == "none":
        return {"mean_distance_m": TABLE_1_UNDECOUPLED, "acc_at_1cm": None}
    return {
        "mean_distance_m": TABLE_1_MEAN_DISTANCE.get(substeps),
        "acc_at_1cm": TABLE_1_ACCURACY.get(substeps),
    }


def table_2() -> dict[str, Any]:
    """The paper's ranges for Table 2."""
    return {
        "root_rotation_deg": list(TABLE_2_ROOT_ROTATION),
        "relative_rotation_deg": list(TABLE_2_RELATIVE_ROTATION),
    }
