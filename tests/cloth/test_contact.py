"""Contact of cloth: books of momentum, curved and moving obstacles, several pieces, and cloth that is squeezed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.garments.sheets import (
    LINEN,
    Run,
    booked,
    flat_sheet,
    garment,
    hanging_sheet,
    move,
    plane,
    sphere,
    surfaces,
)
from piavatar_envs.cloth.obstacles import QUANTUM
from piavatar_envs.mpm.colliders import Collider, make_boundaries

G = 9.81
NOWHERE = (0.0, 0.0, 0.0)
#: Edges hardly pull, so that they take no angular momentum.
LOOSE = replace(LINEN, stretch=1e-6, bending=0.0)


def colliders(*each: Collider):
    return make_boundaries(each, 1, 1, "cpu")


@pytest.mark.parametrize("fabric", [LINEN, LOOSE], ids=["tight", "loose"])
def test_the_books_hold_what_cloth_loses_to_a_skin_that_moves(fabric):
    """Throw a sheet at a ball that moves and turns, without gravity: momentum, and of loose cloth angular momentum."""
    points, faces = flat_sheet(0.3, 0.3, 0.03, z=0.12)
    ball, triangles = sphere(0.1)
    o = surfaces((ball, triangles))
    run = Run(garment(points, faces, fabric, wearer=0), obstacles=o, gravity=NOWHERE).put(v=[0.5, 0.2, -2.0])
    changes, books = [], []
    for n in range(12):
        c, s = np.cos(0.1 * (n + 1)), np.sin(0.1 * (n + 1))
        move(
            o,
            ball @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]]) + [0.01 * (n + 1), 0.0, 0.01 * (n + 1) ** 2],
        )
        before = run.momentum()
        changes.append(np.subtract(before, run.steps(1).momentum()))
        books.append(booked(o))
    changes, books = np.array(changes), np.array(books)  # (steps, 2, 3)
    size = np.linalg.norm(books, axis=2).max(axis=0)
    assert np.count_nonzero(np.linalg.norm(books[:, 0], axis=1) > 1e-3 * size[0]) >= 4
    error = np.abs(changes - books).max(axis=(0, 2)) / size
    assert error[0] < 1e-6
    assert fabric is LINEN or error[1] < 1e-5


@pytest.mark.parametrize("last", [False, True])
def test_the_books_hold_what_a_held_sheet_weighs_and_how_it_swings(last):
    """Check vertices that come first in their edges, and ones that come last."""
    points, faces, top = hanging_sheet(0.2, 0.3, 0.03)
    if last:
        points, faces, top = points[::-1].copy(), len(points) - 1 - faces, len(points) - 1 - top
    run = Run(garment(points, faces, replace(LINEN, bending=2e-5), held=top)).put(v=[0.0, 0.4, 0.0])
    weight = run.mass.sum() * np.array([0.0, 0.0, -G]) / 30
    for _ in range(10):
        before = run.momentum()[0]
        lost = before + weight - run.steps(1).momentum()[0]
        assert np.abs(lost - booked(run.obstacles)[0]).max() < 1e-6 * np.linalg.norm(weight) * 10
    run = Run(garment(points, faces, LINEN, held=top)).steps(150)
    booked(run.obstacles)
    found = booked(run.steps(1).obstacles)
    assert found[0] == pytest.approx(weight, abs=1e-4 * np.linalg.norm(weight))
    turning = np.cross(run.get(), run.mass[:, None] * np.array([0.0, 0.0, -G]) / 30).sum(axis=0)
    assert found[1] == pytest.approx(turning, abs=1e-3 * np.linalg.norm(turning))


def test_cloth_lies_on_the_curved_surface_not_on_its_triangles():
    """Check the distance from a ball, whose triangles are up to 5 mm inside of it; loose cloth has no folds."""
    points, faces = flat_sheet(0.1, 0.1, 0.01, z=0.1 + 0.004)
    ball, triangles = sphere(0.1, rings=4)
    inside = 0.1 - np.linalg.norm(ball[triangles].mean(axis=1), axis=1).min()
    sticky = garment(points, faces, replace(LOOSE, drag=0.6, friction=1.0), wearer=0)
    run = Run(sticky, obstacles=surfaces((ball, triangles))).steps(30)
    above = np.linalg.norm(points[:, :2], axis=1) < 0.05
    error = np.abs(np.linalg.norm(run.get()[above], axis=1) - 0.104)
    assert inside > 5e-3 and error.max() < 0.4 * inside  # three quarters of the curvature


def test_a_sheet_sees_parts_of_its_wearer_and_all_other_pieces():
    points, faces = flat_sheet(0.2, 0.2, 0.04, z=0.03)
    ball, triangles = sphere(0.05)
    apart = (ball + [2.0, 0.0, 0.0], triangles)
    for own, other, sees, stays, on in (
        (plane(0.3), apart, -1, True, 0),
        (plane(0.3), apart, 2, False, None),
        (apart, plane(0.3), 1, True, 1),
    ):
        o = surfaces(own, other)
        run = Run(garment(points, faces, wearer=0, sees=sees), obstacles=o).steps(20)
        impulse = np.abs(o.impulse.numpy()[0, :, :3]).sum(axis=1) * QUANTUM
        first = o.piece_start.numpy()
        loads = [impulse[first[p] : first[p + 1]].sum() for p in range(2)]
        assert (run.get()[:, 2].min() > 0.0039) == stays
        assert [load > 0.0 for load in loads] == [on == 0, on == 1]


def test_two_sheets_of_two_wearers_keep_to_their_own_fabric_and_thickness():
    points, faces = flat_sheet(0.2, 0.2, 0.05, z=0.01)
    o = surfaces(plane(0.3), (plane(0.3)[0] + [1.0, 0.0, 0.0], plane(0.3)[1]))
    slope = np.radians(20.0)
    sheets = [
        garment(points + [shift, 0.0, 0.0], faces, replace(LINEN, friction=friction), wearer=wearer, thickness=thick)
        for wearer, (shift, friction, thick) in enumerate([(0.0, 0.1, 0.004), (1.0, 0.6, 0.008)])
    ]
    run = Run(*sheets, obstacles=o, gravity=(G * np.sin(slope), 0.0, -G * np.cos(slope))).steps(8)
    own = np.split(run.get(), [len(points)])
    slid = [(x - sheet.draped)[:, 0].mean() for x, sheet in zip(own, sheets, strict=True)]
    assert [x[:, 2].mean() for x in own] == pytest.approx([0.004, 0.008], abs=1e-5)
    assert slid[0] > 0.05 and abs(slid[1]) < 0.005


def test_cloth_between_a_body_and_the_floor_rests_and_pushes_nothing():
    points, faces = flat_sheet(0.2, 0.2, 0.04, z=0.004)
    below, triangles = plane(0.3)
    o = surfaces((below + [0.0, 0.0, 0.003], triangles[:, ::-1]))  # it faces down, nearer than twice the thickness
    run = Run(garment(points, faces, wearer=0), obstacles=o, boundaries=colliders(Collider.plane((0, 0, 1), 0.0)))
    J, _ = booked(run.steps(10).obstacles)
    assert run.speed() < 1e-3 and np.abs(J).max() == 0.0


def test_a_belt_carries_cloth_along_by_friction():
    points, faces = flat_sheet(0.2, 0.2, 0.05, z=0.004)
    belt = Collider("box", (5.0, 1.0, 0.5), (0.0, 0.0, -0.5), velocity=(0.6, 0.0, 0.0))
    run = Run(garment(points, faces, replace(LINEN, friction=0.3)), boundaries=colliders(belt)).steps(3)
    assert run.get("v")[:, 0].mean() == pytest.approx(0.3 * G * 0.1, rel=0.01)
    assert run.steps(9).get("v")[:, 0] == pytest.approx(0.6, abs=1e-3)


def test_cloth_that_begins_inside_leaves_at_a_bounded_speed():
    points, faces = flat_sheet(0.1, 0.1, 0.05, z=-0.02)
    run = Run(garment(points, faces, wearer=0), obstacles=surfaces(plane(0.3)), gravity=NOWHERE).steps(1)
    assert run.get()[:, 2].min() > 0.0 and np.abs(run.get("v")).max() <= 0.3 + 1e-6
