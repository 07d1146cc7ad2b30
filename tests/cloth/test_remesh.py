"""Remeshing: even, closed where the surface is, with its borders."""

from __future__ import annotations

import numpy as np
import pytest

from piavatar_envs.avatar.body.asset import mesh_volume
from piavatar_envs.cloth.remesh import boundary_loops, remesh


def sheet(columns: int, rows: int, size: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices and triangles of a rectangle with ``columns x rows`` cells of a width."""
    x, y = np.meshgrid(np.arange(columns + 1), np.arange(rows + 1), indexing="ij")
    vertices = size * np.stack([x, y, 0 * x], axis=-1).reshape(-1, 3)
    a = (x * (rows + 1) + y)[:-1, :-1].ravel()
    b, c, d = a + rows + 1, a + rows + 2, a + 1
    return vertices, np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])


def ball(count: int = 3000) -> tuple[np.ndarray, np.ndarray]:
    """Return points evenly spread on the unit sphere, and their convex hull."""
    from scipy.spatial import ConvexHull

    k = np.arange(count) + 0.5
    z, turn = 1.0 - 2.0 * k / count, np.pi * (1.0 + 5**0.5) * k
    points = np.stack([np.sqrt(1 - z * z) * np.cos(turn), np.sqrt(1 - z * z) * np.sin(turn), z], axis=1)
    faces = ConvexHull(points).simplices
    a, b, c = points[faces].transpose(1, 0, 2)
    inward = (np.cross(b - a, c - a) * a).sum(axis=1) < 0.0
    faces[inward] = faces[inward][:, ::-1]
    return points, faces


def test_a_closed_surface_stays_closed_and_keeps_its_volume():
    points, faces = ball()
    found = remesh(points, faces, 300)
    assert len(found.keep) == 300 and len(found.faces) == 2 * 300 - 4  # Euler
    assert not boundary_loops(found.faces)
    kept = points[found.keep]
    assert mesh_volume(kept, found.faces) == pytest.approx(4 / 3 * np.pi, rel=0.04)
    edges = kept[found.faces] - kept[np.roll(found.faces, 1, axis=1)]
    length = np.linalg.norm(edges, axis=2)
    assert length.max() < 3.0 * length.min()


def test_cells_are_wider_where_a_surface_may_be_coarse():
    points, faces = ball()
    found = remesh(points, faces, 300, coarse=points[:, 2] > 0.0)
    above = (points[found.keep][:, 2] > 0.0).mean()
    assert 0.5 / 9 < above < 2.0 / 9


def test_borders_are_sampled_by_arc_length_and_stay_open():
    points, faces = sheet(40, 40, 0.025)
    loops = boundary_loops(faces)
    assert len(loops) == 1 and len(loops[0]) == 160
    found = remesh(points, faces, 120, first=loops, spacing=0.1)
    (border,) = boundary_loops(found.faces)
    assert set(border) == set(range(40))  # 4 m in steps of 0.1 m, and first in the order
    kept = points[found.keep]
    across = np.cross(
        kept[found.faces[:, 1]] - kept[found.faces[:, 0]], kept[found.faces[:, 2]] - kept[found.faces[:, 0]]
    )
    assert (across[:, 2] > -1e-12).all() and 0.5 * across[:, 2].sum() == pytest.approx(1.0, rel=0.01)


def test_every_piece_of_a_surface_is_kept():
    points, faces = ball(1000)
    apart = np.concatenate([points, points + [5.0, 0.0, 0.0]])
    found = remesh(apart, np.concatenate([faces, faces + len(points)]), 200)
    assert not boundary_loops(found.faces) and len(found.faces) == 2 * 200 - 8


@pytest.mark.parametrize("count", [3, 1001])
def test_an_impossible_count_is_refused(count):
    points, faces = ball(1000)
    with pytest.raises(ValueError, match=f"count={count}"):
        remesh(points, faces, count)


def test_loops_that_meet_at_a_vertex_are_separated():
    # two holes of a sheet that share a corner
    _, faces = sheet(6, 6)
    a = lambda x, y: x * 7 + y  # noqa: E731
    gone = {frozenset((a(x, y), a(x + 1, y), a(x + 1, y + 1))) for x, y in ((2, 2), (3, 3))}
    gone |= {frozenset((a(x, y), a(x + 1, y + 1), a(x, y + 1))) for x, y in ((2, 2), (3, 3))}
    left = np.array([t for t in faces.tolist() if frozenset(t) not in gone])
    loops = boundary_loops(left)
    assert sorted(map(len, loops)) == [4, 4, 24]
    assert loops[0].tolist()[0] == 0
