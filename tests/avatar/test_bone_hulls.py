"""Hulls of bones: their deepest points in solids, against a search of the whole hull."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp
from scipy.optimize import minimize, nnls
from scipy.spatial.transform import Rotation

from piavatar_envs.avatar.bone_hulls import NEAR, NOWHERE, find_deepest_points
from piavatar_envs.mpm.colliders import Collider, make_boundaries
from piavatar_envs.sim.prop_geometry import primitive_distance

SOLIDS = {"sphere": (0.03,), "box": (0.15, 0.005, 0.02), "capsule": (0.02, 0.3)}
POINTS = 12


def least_distance(distance, points):
    """Return the least distance of a hull of points from a solid [m], by descent from every point and the middle."""

    def of_weights(w):
        return float(distance((w / w.sum()) @ points[None])[0]) if w.sum() > 0.0 else 1.0

    starts = [*np.eye(POINTS), np.full(POINTS, 1.0 / POINTS)]
    return min(
        minimize(of_weights, start, bounds=[(0.0, 1.0)] * POINTS, method="L-BFGS-B", options={"ftol": 1e-12}).fun
        for start in starts
    )


@pytest.mark.parametrize("kind", SOLIDS)
def test_no_point_of_a_hull_is_deeper(device, kind):
    # Solids beside hulls, with edges and poles that pass between their points; and hulls that are far away.
    rng, count = np.random.default_rng(0), 16
    solid = Collider(kind, SOLIDS[kind], (0.02, -0.01, 0.03), tuple(Rotation.random(random_state=1).as_quat()))
    turn, position = Rotation.from_quat(np.roll(solid.rotation, -1)), np.array(solid.position)
    local = primitive_distance(kind, (*solid.size, 0.0, 0.0)[:3])

    def distance(x):
        return local(turn.inv().apply(np.atleast_2d(x) - position))

    hulls = rng.normal(size=(count, POINTS, 3)) * [0.02, 0.02, 0.1]
    hulls = np.array([Rotation.random(random_state=rng).apply(hull) for hull in hulls])
    away = rng.normal(size=(count, 3))
    hulls += position + (rng.uniform(0.03, 0.09, (count, 1)) * away / np.linalg.norm(away, axis=1)[:, None])[:, None]
    hulls[-1] += 5.0 * away[-1] / np.linalg.norm(away[-1])
    start = wp.array(POINTS * np.arange(count + 1, dtype=np.int32), dtype=int, device=device)
    place = wp.array(hulls.reshape(1, -1, 3).astype(np.float32), dtype=wp.vec3, device=device)
    deepest = wp.zeros((1, count), dtype=wp.vec3, device=device)
    inputs = [make_boundaries([solid], 1, 1, device), start, place, wp.zeros(1, dtype=int, device=device)]
    weight = wp.zeros((1, POINTS * count), dtype=float, device=device)
    wp.launch(find_deepest_points, deepest.shape, inputs, [weight, deepest], device=device)
    between = 0
    for hull, found in zip(hulls[:-1], deepest.numpy()[0].astype(float), strict=False):
        own = distance(found)[0]
        if own > 0.0:  # within a solid the nearest face has kinks
            assert own < least_distance(distance, hull) + 5e-4
        residual = nnls(np.vstack([hull.T, np.ones(POINTS)]), np.r_[found, 1.0])[1]
        assert residual < 1e-5  # it is of the hull
        between += own < distance(hull).min() - 5e-3
    assert between > count // 4
    assert deepest.numpy()[0, -1, 0] == pytest.approx(float(NOWHERE)) and distance(hulls[-1]).min() > float(NEAR)
