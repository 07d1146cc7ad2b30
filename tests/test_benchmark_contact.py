"""The contact benchmark measures what it says, at a resolution where that takes seconds."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.physics import collisions, contact


@pytest.fixture(scope="module")
def rows(device):
    if device != "cpu":
        pytest.skip("a smoke run; the benchmark itself runs on a GPU with --device")
    return list(contact.cases(contact.Options(quick=True, only_contact=True)))


def test_rows_are_complete(rows):
    names = {row["case"] for row in rows}
    assert {"ball on body", "body on body", "ball at 20 m/s", "gap of a hit", "gap at rest"} <= names
    assert {"block on analytic incline, mu 0.2", "block on soft incline, mu 0.2"} <= names
    assert {row["normals"] for row in rows} == {"shared", "own"} and {row["resolution"] for row in rows} == {"tiny"}
    assert all(np.isfinite(value) for row in rows for value in row.values() if isinstance(value, float))


def test_shared_normals_keep_momentum(rows):
    kept = [row for row in rows if row["normals"] == "shared" and "linear_momentum_rel" in row]
    assert kept and all(row["linear_momentum_rel"] < 1e-5 and row["angular_momentum_rel"] < 1e-5 for row in kept)
    assert all(row["energy_ratio_max"] <= 1.01 for row in kept)


def test_a_collision_knows_its_things():
    things = [collisions.block((0.0, 0.0, 0.0), "tiny"), collisions.ball((0.0, 0.0, 0.6), "tiny", mass=2.0)]
    world = collisions.collide(things, "tiny")
    assert [len(world.positions(thing)) for thing in (0, 1)] == [len(thing.x) for thing in things]
    assert world.totals(1).mass == pytest.approx(2.0, rel=1e-5)
    assert world.nearest() > 0.3 and not world.touched() and not world.failed
