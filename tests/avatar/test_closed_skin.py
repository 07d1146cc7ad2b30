"""Closed skins: volumes of solids that are known, what is body and what is worn, and what is refused."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest

from piavatar_envs.avatar.body.asset import mesh_volume
from piavatar_envs.avatar.body.closed_skin import CELL, close_skin, read_soup

RADIUS = 0.15


def sphere(centre=(0.0, 0.0, 0.0), radius: float = RADIUS, rings: int = 40, first: float = 0.0):
    """Return a sphere from the polar angle ``first`` on; a hole at the top unless that is 0."""
    polar = np.linspace(first, np.pi, rings + 1)
    angle = np.linspace(0.0, 2.0 * np.pi, 2 * rings, endpoint=False)
    ring, turn = np.meshgrid(np.arange(rings), np.arange(2 * rings), indexing="ij")
    a, b = ring * 2 * rings + turn, ring * 2 * rings + (turn + 1) % (2 * rings)
    c, d = a + 2 * rings, b + 2 * rings
    faces = np.concatenate([np.stack(t, -1).reshape(-1, 3) for t in ((a, c, d), (a, d, b))])
    sine, cosine = np.sin(polar)[:, None], np.cos(polar)[:, None]
    points = np.stack([sine * np.cos(angle), sine * np.sin(angle), np.broadcast_to(cosine, (rings + 1, 2 * rings))], -1)
    return radius * points.reshape(-1, 3) + np.asarray(centre), faces


def joined(*meshes):
    """Return several meshes as one soup."""
    offsets = np.cumsum([0, *(len(vertices) for vertices, _ in meshes[:-1])])
    faces = [faces + offset for (_, faces), offset in zip(meshes, offsets, strict=True)]
    return np.concatenate([vertices for vertices, _ in meshes]), np.concatenate(faces)


def closed(vertices, faces, **settings):
    return close_skin(read_soup(vertices, faces, **settings), vertices)


def assert_watertight(skin):
    start, end = skin.faces.T.ravel(), np.roll(skin.faces, -1, axis=1).T.ravel()
    edges = start.astype(np.int64) * len(skin.vertices) + end
    assert len(np.unique(edges)) == len(edges)
    assert np.array_equal(np.sort(edges), np.sort(end.astype(np.int64) * len(skin.vertices) + start))
    assert mesh_volume(skin.vertices, skin.faces) > 0.0


def ball(radius: float = RADIUS) -> float:
    return 4.0 / 3.0 * np.pi * radius**3


def test_the_union_of_two_balls_has_its_volume():
    distance = 0.2
    lens = np.pi * (4.0 * RADIUS + distance) * (2.0 * RADIUS - distance) ** 2 / 12.0
    skin = closed(*joined(sphere(), sphere((distance, 0.0, 0.0))))
    assert_watertight(skin)
    assert mesh_volume(skin.vertices, skin.faces) == pytest.approx(2.0 * ball() - lens, rel=0.01)
    assert skin.vertices[:, 0].max() == pytest.approx(distance + RADIUS, abs=0.2 * CELL)


def test_the_same_soup_gives_the_same_skin():
    soup = joined(sphere(), sphere((0.2, 0.0, 0.0)))
    first, second = closed(*soup), closed(*soup)
    assert np.array_equal(first.vertices, second.vertices) and np.array_equal(first.faces, second.faces)
    assert (first.anchors != second.anchors).nnz == 0


def test_one_closed_shell_stays_as_it_is_once_its_seams_are_welded():
    vertices, faces = sphere()
    skin = closed(vertices, faces)
    assert_watertight(skin)
    assert mesh_volume(skin.vertices, skin.faces) == pytest.approx(mesh_volume(vertices, faces), rel=1e-6)
    # vertices of the seam at the poles are one
    assert len(skin.vertices) == len(np.unique(np.round(vertices / 1e-5), axis=0))
    np.testing.assert_allclose(skin.anchors @ vertices, skin.vertices, atol=1e-6)


@pytest.mark.parametrize("second", [None, (0.2, 0.0, 0.0)])
def test_an_inside_out_shell_is_turned(second):
    (vertices, faces), shells = sphere(second or (0.0, 0.0, 0.0)), [sphere()] if second else []
    soup = joined(*shells, (vertices, faces[:, ::-1]))
    read, skin = read_soup(*soup), closed(*soup)
    assert_watertight(skin)
    right = closed(*joined(*shells, (vertices, faces)))
    assert mesh_volume(skin.vertices, skin.faces) == pytest.approx(mesh_volume(right.vertices, right.faces), rel=1e-6)
    degenerate = np.isin(np.arange(len(soup[1])), np.concatenate([shell.rows for shell in read.shells]), invert=True)
    assert read.flipped[len(soup[1]) - len(faces) :][~degenerate[-len(faces) :]].all()


def test_triangles_that_run_against_their_neighbours_are_turned():
    vertices, faces = sphere()
    mixed = faces.copy()
    mixed[::7] = mixed[::7, ::-1]
    skin = closed(vertices, mixed)
    assert_watertight(skin)
    assert mesh_volume(skin.vertices, skin.faces) == pytest.approx(mesh_volume(vertices, faces), rel=1e-6)


@pytest.mark.parametrize(("angle", "body"), [(0.35, True), (0.5, False)])
def test_a_shell_with_a_hole_is_body_if_its_cap_is_small(angle, body):
    # The cap is pi sin^2 of 2 pi (1 + cos): 3.0 and 6.1 per cent of the area.
    soup = read_soup(*sphere(first=angle))
    assert soup.shells[0].cap_share == pytest.approx(np.sin(angle) ** 2 / (2.0 * (1.0 + np.cos(angle))), rel=0.01)
    assert soup.shells[0].body is body
    if not body:
        with pytest.raises(ValueError, match="encloses a volume"):
            close_skin(soup, sphere(first=angle)[0])


def test_a_hole_is_closed_by_its_flat_cap():
    angle = 0.35
    vertices, faces = sphere(first=angle)
    height = RADIUS * (1.0 - np.cos(angle))
    missing = np.pi * height**2 * (3.0 * RADIUS - height) / 3.0
    skin = closed(vertices, faces)
    assert_watertight(skin)
    assert mesh_volume(skin.vertices, skin.faces) == pytest.approx(ball() - missing, rel=0.01)
    assert skin.vertices[:, 2].max() == pytest.approx(RADIUS * np.cos(angle), abs=0.3 * CELL)


def test_an_open_skirt_and_held_things_do_not_change_the_volume():
    body = joined(sphere(), sphere((0.2, 0.0, 0.0)))
    alone = closed(*body)
    skirt, club = sphere(radius=0.25, first=2.0), sphere((0.0, 0.3, 0.0), 0.1)
    vertices, faces = joined(body, skirt, club)
    held = np.arange(len(faces)) >= len(faces) - len(club[1])
    soup = read_soup(vertices, faces, held)
    assert len(soup.body) == 2 and len(soup.worn) == 2
    dressed = close_skin(soup, vertices)
    assert mesh_volume(dressed.vertices, dressed.faces) == pytest.approx(mesh_volume(alone.vertices, alone.faces))


@pytest.mark.parametrize(("thickness", "body"), [(0.002, False), (0.02, True)])
def test_closed_cloth_that_the_grid_cannot_resolve_is_worn(thickness, body):
    plate, faces = sphere()
    plate = plate * [1.0, 1.0, thickness / (2.0 * RADIUS)]
    soup = read_soup(*joined(sphere((0.0, 0.0, 0.5)), (plate, faces)))
    assert [shell.body for shell in soup.shells] == [True, body]


def test_cavities_are_filled_and_pieces_apart_are_left_out():
    vertices, faces = joined(sphere(), sphere((0.2, 0.0, 0.0)), sphere((0.6, 0.0, 0.0), 0.08))
    skin = closed(vertices, faces)
    assert skin.vertices[:, 0].max() < 0.4
    # six overlapping balls about a hollow
    shell = [0.2 * np.array(direction) for direction in (*np.eye(3), *-np.eye(3))]
    skin = closed(*joined(*(sphere(centre, 0.16) for centre in shell)))
    assert_watertight(skin)
    assert np.linalg.norm(skin.vertices, axis=1).min() > 0.15


def test_values_of_the_surface_carry_over_to_the_skin():
    vertices, faces = joined(sphere(), sphere((0.2, 0.0, 0.0)))
    skin = closed(vertices, faces)
    np.testing.assert_allclose(skin.anchors.sum(axis=1), 1.0, atol=1e-6)
    assert np.abs(skin.anchors @ vertices - skin.vertices).max() < 0.3 * CELL


def test_bad_surfaces_are_refused():
    vertices, faces = sphere()
    with pytest.raises(ValueError, match="no triangles"):
        read_soup(vertices, faces[:0])
    with pytest.raises(ValueError, match="vertex 3 is not finite"):
        read_soup(np.where(np.arange(len(vertices))[:, None] == 3, np.nan, vertices), faces)
    huge, faces = joined(sphere(), sphere((0.2, 0.0, 0.0)))
    with pytest.raises(ValueError, match="too large for a grid"):
        close_skin(read_soup(huge, faces), 100.0 * huge)


def test_hundreds_of_thousands_of_triangles_take_bounded_memory():
    soup = joined(sphere(rings=180), sphere((0.2, 0.0, 0.0), rings=180))
    assert len(soup[1]) > 250_000
    tracemalloc.start()
    skin = closed(*soup)
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert_watertight(skin)
    assert len(skin.faces) < 20_000 and most < 0.4e9
