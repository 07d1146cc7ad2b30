"""Cloth that keeps apart from itself and from other garments."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.garments.sheets import LINEN, Run, flat_sheet, garment
from piavatar_envs.mpm.colliders import Collider, make_boundaries

SOFT = replace(LINEN, bending=2e-6, drag=0.6, skin_drag=0.02, friction=0.3)


def below(run: Run, points: np.ndarray) -> np.ndarray:
    """Return for the vertices of the second sheet the height of the first one beneath, NaN where it is not."""
    from scipy.interpolate import LinearNDInterpolator

    lower, upper = np.split(run.get(), [len(points)])
    return upper[:, 2] - LinearNDInterpolator(lower[:, :2], lower[:, 2])(upper[:, :2])


def two_sheets(**settings) -> tuple[Run, np.ndarray]:
    """Return a sheet on the floor and one above it that is turned and falls on it."""
    points, faces = flat_sheet(0.2, 0.2, 0.03)
    c, s = np.cos(0.4), np.sin(0.4)
    turned = points @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    lower, upper = points + [0.0, 0.0, 0.004], turned + [0.013, 0.007, 0.03]
    floor = make_boundaries([Collider.plane((0, 0, 1), 0.0)], 1, 1, settings.get("device", "cpu"))
    return Run(garment(lower, faces, SOFT), garment(upper, faces, SOFT), boundaries=floor, **settings), points


def test_a_sheet_lies_on_another_only_with_self_collision():
    run, points = two_sheets(self_collision=True)
    gap = below(run.steps(45), points)
    gap = gap[np.isfinite(gap)]
    assert len(gap) > 40 and gap.min() > 0.0 and np.median(gap) == pytest.approx(0.004, abs=1e-3)
    assert run.speed() < 0.02
    run, points = two_sheets()
    assert np.nanmedian(below(run.steps(45), points)) < 0.002


def test_sheets_that_meet_in_flight_keep_their_momentum_and_their_order():
    points, faces = flat_sheet(0.2, 0.2, 0.03)
    heavy = replace(LINEN, areal_density=0.5, friction=0.3)
    sheets = garment(points, faces, LINEN), garment(points + [0.02, 0.01, 0.03], faces, heavy)
    run = Run(*sheets, gravity=(0.0, 0.0, 0.0), self_collision=True)
    v = np.repeat([[0.0, 0.0, 0.5], [0.3, 0.0, -0.5]], len(points), axis=0)
    run.put(v=v)
    before = run.momentum()[0]
    size = run.mass @ np.linalg.norm(v, axis=1)
    energy = run.mass @ (v**2).sum(axis=1)
    inner = np.abs(points).max(axis=1) < 0.065  # borders may curl around each other
    for _ in range(6):
        run.steps(1)
        assert np.nanmin(below(run, points)[inner]) > 0.003
    assert np.abs(run.momentum()[0] - before).max() < 1e-6 * size
    speeds = [x[:, 2].mean() for x in np.split(run.get("v"), [len(points)])]
    assert abs(speeds[1] - speeds[0]) < 0.35  # they go on together, or part at the bounded speed
    assert run.mass @ (run.get("v") ** 2).sum(axis=1) < energy


def test_a_strip_folds_onto_itself_and_does_not_pass():
    points, faces = flat_sheet(0.4, 0.1, 0.025)
    mesh_points = points + [0.0, 0.0, 0.004]
    over = points[:, 0] > 0.0  # the right half is folded back over the left one, 2 cm above it
    start = mesh_points.copy()
    arc = np.clip(points[:, 0], 0.0, 0.0314)  # a half circle of 1 cm radius
    rest = np.maximum(points[:, 0] - 0.0314, 0.0)
    start[over, 0] = (0.01 * np.sin(arc / 0.01) - rest)[over]
    start[over, 2] = (0.004 + 0.01 * (1.0 - np.cos(arc / 0.01)))[over]
    floor = make_boundaries([Collider.plane((0, 0, 1), 0.0)], 1, 1, "cpu")
    heights = {}
    for on in (True, False):
        sheet = garment(mesh_points, faces, SOFT, start=start)
        run = Run(sheet, boundaries=floor, self_collision=on).steps(60)
        heights[on] = run.get()[points[:, 0] > 0.08, 2]
    assert np.median(heights[True]) > 0.0065 and np.median(heights[False]) < 0.0055


def test_results_do_not_depend_on_the_order_of_threads(device):
    """Check two environments of one batch, which the emulated GPU begins in opposite orders, and another run."""
    run, _ = two_sheets(num_envs=2, device=device, self_collision=True)
    again, _ = two_sheets(num_envs=1, device=device, self_collision=True)
    run.steps(5)
    again.steps(5)
    assert run.get("x", 0).tobytes() == run.get("x", 1).tobytes() == again.get("x").tobytes()
    assert np.abs(run.get("v", 0)[:, 2]).max() > 0.1
