"""Subdivision: smooth where the mesh is, splines at its borders, and the limits that theory gives."""

from __future__ import annotations

import numpy as np
import pytest

from piavatar_envs.cloth.subdivision import levels_for, subdivided


def sheet(rows: int, columns: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the points of a flat sheet of right triangles of side one, and its triangles."""
    y, x = np.mgrid[:rows, :columns]
    index = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = index[:-1, :-1].ravel(), index[:-1, 1:].ravel(), index[1:, :-1].ravel(), index[1:, 1:].ravel()
    points = np.stack([x, y, 0 * x], axis=-1).reshape(-1, 3).astype(float)
    return points, np.concatenate([np.stack([a, b, d], 1), np.stack([a, d, c], 1)])


def octahedron() -> tuple[np.ndarray, np.ndarray]:
    """Return the regular octahedron around the origin, outward."""
    points = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], float)
    faces = [[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4], [2, 0, 5], [1, 2, 5], [3, 1, 5], [0, 3, 5]]
    return points, np.array(faces)


@pytest.mark.parametrize("levels", [0, 1, 2])
def test_rows_sum_to_one_and_triangles_keep_their_side(levels):
    points, faces = octahedron()
    fine = subdivided(faces, len(points), levels)
    assert len(fine.faces) == 8 * 4**levels and fine.faces.max() == fine.matrix.shape[0] - 1
    np.testing.assert_allclose(fine.matrix.sum(axis=1), 1.0, atol=1e-12)
    assert (fine.matrix.data > 0.0).all()
    corners = (fine.matrix @ points)[fine.faces]
    outward = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert (np.einsum("td,td->t", outward, corners.mean(axis=1)) > 0.0).all()


def test_a_flat_sheet_keeps_its_straight_borders():
    points, faces = sheet(5, 7)
    fine = subdivided(faces, len(points), 2)
    places = fine.matrix @ points
    assert np.abs(places[:, 2]).max() < 1e-12
    np.testing.assert_allclose(places.min(axis=0), points.min(axis=0), atol=1e-12)
    np.testing.assert_allclose(places.max(axis=0), points.max(axis=0), atol=1e-12)
    corners = places[fine.faces]
    area = 0.5 * np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])[:, 2]
    assert (area > 0.0).all() and area.sum() == pytest.approx(24.0, rel=0.01)  # corners of two triangles are rounded


def test_a_vertex_goes_to_its_limit():
    """To ``(1 - n c) v + c sum`` of its ring, ``c = 1 / (n + 3 / (8 beta))`` (Hoppe et al. 1994, with Loop's beta)."""
    points, faces = octahedron()
    point = (subdivided(faces, len(points), 6).matrix @ points)[4]
    beta = (0.625 - (0.375 + 0.25 * np.cos(np.pi / 2.0)) ** 2) / 4.0
    share = 1.0 / (4.0 + 3.0 / (8.0 * beta))
    np.testing.assert_allclose(point, [0.0, 0.0, 1.0 - 4.0 * share], atol=1e-3)


def test_a_border_is_a_cubic_spline_of_itself():
    """It passes through ``(a + 4 b + c) / 6``, whatever is beside it."""
    points, faces = sheet(3, 6)
    rng = np.random.default_rng(0)
    points[:, 2] = rng.normal(size=len(points))
    border, others = points.copy(), rng.normal(size=points.shape)
    fine = subdivided(faces, len(points), 6).matrix
    others[:6] = border[:6]
    for shape in (border, others):
        np.testing.assert_allclose((fine @ shape)[2], (shape[1] + 4.0 * shape[2] + shape[3]) / 6.0, atol=1e-3)


def test_coarse_meshes_are_divided_until_their_edges_are_short():
    points, faces = sheet(4, 4)
    assert [levels_for(faces, scale * points, 0.016) for scale in (0.01, 0.02, 0.04, 0.4)] == [0, 1, 2, 2]
