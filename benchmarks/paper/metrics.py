"""Metrics of tracked poses, and their spread over seeds.

Figures that PIAvatar (Han et al., arXiv 2606.21162) publishes for its own method, to stand next to ours.

Only what is needed to compare; where the paper gives a table's range and not the entry, the range is here. Distances
in metres, angles in degrees.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from agents.intervals import mean_and_interval


def distance_metrics(distances: Sequence[np.ndarray]) -> dict[str, float]:
    """Return mean, root mean square and accuracy of distances [m] over all particles of all bodies."""
    if not distances:
        return {"mean_distance_m": math.nan, "rmse_m": math.nan, "acc_at_1cm": math.nan}
    d = np.concatenate(distances)
    return {
        "mean_distance_m": float(d.mean()),
        "rmse_m": float(np.sqrt((d**2).mean())),
        "acc_at_1cm": float((d < 0.01).mean()),
    }


def pose_metrics(errors: Sequence[dict[str, np.ndarray]]) -> dict[str, float]:
    """Return mean Kabsch errors in degrees and metres."""

    def mean(name: str) -> float:
        values = np.concatenate([error[name].ravel() for error in errors])
        return float(values.mean()) if len(values) else math.nan

    return {
        "root_rotation_deg": math.degrees(mean("root_rotation")),
        "root_translation_m": mean("root_translation"),
        "relative_rotation_deg": math.degrees(mean("relative_rotation")),
        "relative_translation_m": mean("relative_translation"),
    }


def spread(samples: Sequence[dict[str, float]]) -> dict[str, float | None]:
    """Return of every metric its mean over seeds, the standard deviation and half of the mean's 95 % interval.

    A value that does not exist (every body of a seed has failed) is left out; None where nothing is left.
    """
    row: dict[str, float | None] = {}
    for name in samples[0] if samples else ():
        if name == "failed":
            continue
        values = np.array([sample[name] for sample in samples], float)
        values = values[np.isfinite(values)]
        row[name] = float(values.mean()) if len(values) else None
        row[f"{name}_std"] = float(values.std(ddof=1)) if len(values) > 1 else None
        row[f"{name}_ci95"] = mean_and_interval(values).half_width if len(values) > 1 else None
    return row


#: Table 1, SMPL-X with decoupling: mean distance [m] ("MSE" in the paper) after so many substeps.
TABLE_1_MEAN_DISTANCE: dict[int, float] = {100: 0.013, 200: 0.022, 300: 0.031, 400: 0.039}
#: Table 1: share of points within 1 cm at the first and the last of them.
TABLE_1_ACCURACY: dict[int, float] = {100: 0.91, 400: 0.58}
#: Table 1 without decoupling: mean distance [m] after so many substeps.
TABLE_1_UNDECOUPLED: dict[int, float] = {100: 0.089, 200: 0.138, 300: 0.206, 400: 0.248}
#: Table 2: smallest and largest error of the root's rotation and of the joints' rotations relative to their parents.
TABLE_2_ROOT_ROTATION = (0.03, 0.12)
TABLE_2_RELATIVE_ROTATION = (0.10, 0.32)


def table_1(decoupling: str, substeps: int) -> dict[str, Any]:
    """Return the paper's row of Table 1; None where it has no figure."""
    if decoupling == "none":
        return {"mean_distance_m": TABLE_1_UNDECOUPLED.get(substeps), "acc_at_1cm": None}
    return {
        "mean_distance_m": TABLE_1_MEAN_DISTANCE.get(substeps),
        "acc_at_1cm": TABLE_1_ACCURACY.get(substeps),
    }


def table_2() -> dict[str, Any]:
    """Return the paper's ranges for Table 2."""
    return {
        "root_rotation_deg": list(TABLE_2_ROOT_ROTATION),
        "relative_rotation_deg": list(TABLE_2_RELATIVE_ROTATION),
    }
