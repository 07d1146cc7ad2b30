"""Metrics of tracked poses, and their spread over seeds."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from benchmarks import runner


def distance_metrics(distances: Sequence[np.ndarray]) -> dict[str, float]:
    """Mean, root mean square and accuracy of distances [m], every particle of every body alike."""
    if not distances:
        return {"mean_distance_m": math.nan, "rmse_m": math.nan, "acc_at_1cm": math.nan}
    d = np.concatenate(distances)
    return {
        "mean_distance_m": float(d.mean()),
        "rmse_m": float(np.sqrt((d**2).mean())),
        "acc_at_1cm": float((d < 0.01).mean()),
    }


def pose_metrics(errors: Sequence[dict[str, np.ndarray]]) -> dict[str, float]:
    """Mean Kabsch errors in degrees and metres."""

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
    """Of every metric its mean over seeds, the standard deviation and half of the 95 % interval of the mean.

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
        row[f"{name}_ci95"] = runner.mean_and_interval(values).half_width if len(values) > 1 else None
    return row
