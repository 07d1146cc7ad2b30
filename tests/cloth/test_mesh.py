"""Meshes of cloth: colors, areas, bending."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import sparse

from benchmarks.garments.sheets import lattice, mesh_of
from piavatar_envs.cloth.mesh import ClothMesh, joined


def bending(mesh: ClothMesh) -> np.ndarray:
    """Return Q as a dense matrix."""
    data = mesh.bending_value, mesh.bending_column, mesh.bending_start
    return sparse.csr_array(data, shape=(mesh.num_vertices,) * 2).toarray()


def check_colors(mesh: ClothMesh) -> None:
    for a, b in zip(mesh.color_start[:-1], mesh.color_start[1:], strict=True):
        touched = mesh.edges[a:b].ravel()
        assert b > a and len(np.unique(touched)) == len(touched)


def test_edges_of_a_color_share_no_vertex_and_areas_are_those_of_the_pattern():
    points, faces = lattice(0.3, 0.5, 0.03)
    mesh = mesh_of(points, faces)
    check_colors(mesh)
    assert mesh.num_colors <= 10 and mesh.color_start[-1] == mesh.num_edges == mesh.num_vertices + len(faces) - 1
    assert mesh.area.sum() == pytest.approx(0.15) and mesh.edge_area.sum() == pytest.approx(3 * 0.15)
    assert np.allclose(mesh.strain(1.02 * points), 0.02)


def test_bending_costs_nothing_for_linear_functions_and_half_d_times_curvature_squared_on_a_cylinder():
    points, faces = lattice(0.4, 0.4, 0.02)
    mesh = mesh_of(points, faces)
    q = bending(mesh)
    assert np.allclose(q, q.T) and np.abs(q @ np.c_[np.ones(len(points)), points]).max() < 1e-9 * np.abs(q).max()
    curvature = 2.0
    for way in (points[:, 0], points[:, 1]):  # of a shallow cylinder
        height = 0.5 * curvature * way**2
        # less of it is curved than the sheet: a hinge at the border has no second triangle
        assert height @ q @ height == pytest.approx(curvature**2 * 0.4**2, rel=0.12)


def test_joined_meshes_keep_every_edge_and_bend_apart():
    a, b = (mesh_of(*lattice(width, 0.2, 0.03)) for width in (0.2, 0.3))
    mesh = joined([a, b])
    check_colors(mesh)
    assert mesh.num_colors == max(a.num_colors, b.num_colors) and mesh.num_edges == a.num_edges + b.num_edges
    first = mesh.edges[:, 0] < a.num_vertices
    for part, own, at in ((first, a, 0), (~first, b, a.num_vertices)):
        assert np.array_equal(mesh.edges[part] - at, own.edges) and np.array_equal(mesh.length[part], own.length)
    q, n = bending(mesh), a.num_vertices
    assert np.array_equal(q[:n, :n], bending(a)) and np.array_equal(q[n:, n:], bending(b)) and not q[:n, n:].any()


@pytest.mark.parametrize(
    ("faces", "message"),
    [
        ([[0, 1, 3]], "vertex 2"),
        ([[0, 1, 2], [1, 0, 3], [0, 1, 4]], "3 triangles"),
        ([[0, 1, 2], [2, 1, 5], [1, 3, 4]], "no area"),
        (np.zeros((0, 3)), "no triangles"),
    ],
)
def test_a_mesh_that_is_no_cloth_is_refused(faces, message):
    points = np.array([[0, 0], [1, 0], [0, 1], [2, 0], [3, 0], [1, 1]], float)
    with pytest.raises(ValueError, match=message):
        mesh_of(points, np.array(faces))
