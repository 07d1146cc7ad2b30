"""Markers: meshes of the right size, place and orientation."""

from __future__ import annotations

import numpy as np
import pytest

from piavatar_envs.render import Arrow, Box, Ring, Sphere


def enclosed_volume(marker) -> float:
    """Signed volume of a marker's mesh [m^3]; positive if it is closed and its triangles face outward."""
    vertices, faces = marker.mesh()
    vertices = vertices.astype(np.float64) - vertices.mean(axis=0)
    a, b, c = (vertices[faces[:, corner]] for corner in range(3))
    return float(np.einsum("ti,ti->", a, np.cross(b, c)) / 6.0)


def test_markers_enclose_their_volume():
    assert enclosed_volume(Sphere((1.0, 2.0, 3.0), 0.5)) == pytest.approx(4.0 / 3.0 * np.pi * 0.5**3, rel=0.03)
    assert enclosed_volume(Box((1.0, -2.0, 0.5), (0.1, 0.2, 0.3))) == pytest.approx(8 * 0.1 * 0.2 * 0.3, rel=1e-5)
    radius, length, head = 0.02, 0.5, 0.1
    solid = np.pi * radius**2 * (length - head) + np.pi * (2.4 * radius) ** 2 * head / 3.0
    assert enclosed_volume(Arrow((1, 1, 1), (0.3, 0.4, 0.0), radius=radius)) == pytest.approx(solid, rel=0.03)


@pytest.mark.parametrize("normal", [(0.6, -0.8, 0.0), (0.0, 0.0, 1.0)])
def test_a_ring_lies_in_its_plane_about_its_centre(normal):
    center, normal = np.array([0.3, -2.0, 0.8]), np.array(normal)
    ring = Ring(center, normal, 0.5, wire=0.03)
    offset = ring.mesh()[0] - center
    along = offset @ normal
    away = np.linalg.norm(offset - along[:, None] * normal, axis=1)
    assert np.hypot(away - 0.5, along) == pytest.approx(0.03, abs=1e-6)
    assert enclosed_volume(ring) == pytest.approx(2.0 * np.pi**2 * 0.5 * 0.03**2, rel=0.06)


def test_a_ring_is_cut_at_the_ground():
    standing = Ring((0.0, -1.0, 0.25), (0.0, -1.0, 0.0), 0.4).mesh()[0]
    assert standing[:, 2].min() == pytest.approx(0.0, abs=0.02) and standing[:, 2].max() == pytest.approx(0.67)
    # where the circle cuts the ground
    assert np.abs(standing[standing[:, 2] < 0.03, 0]).min() == pytest.approx(np.sqrt(0.4**2 - 0.25**2), abs=0.03)
    assert Ring((0.0, -1.0, 0.25), (0.0, -1.0, 0.0), 0.4, lowest=-1.0).mesh()[0][:, 2].min() == pytest.approx(-0.17)


def test_an_arrow_points_along_its_vector():
    vertices, _ = Arrow((1.0, 0.0, 2.0), (0.0, -0.6, 0.8)).mesh()
    along = (vertices - [1.0, 0.0, 2.0]) @ [0.0, -0.6, 0.8]
    assert along.min() == pytest.approx(0.0, abs=1e-6) and along.max() == pytest.approx(1.0)
    assert np.isfinite(Arrow((0, 0, 0), (0, 0, 0)).mesh()[0]).all()


def test_a_box_turns():
    quarter = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    vertices, _ = Box((0, 0, 0), (0.3, 0.1, 0.2), rotation=quarter).mesh()
    np.testing.assert_allclose(vertices.max(axis=0), [0.1, 0.3, 0.2], atol=1e-6)
