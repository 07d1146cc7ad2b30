"""Throws at a click: the parabola passes the target, and starts inside the domain."""

from __future__ import annotations

import numpy as np
import pytest

from piavatar_envs.live.throwing import CLEARANCE, DISTANCE, aim, throw

BOX = np.array([-1.6, -1.6, -0.3]), np.array([1.6, 1.6, 2.6])
RADIUS = 0.11


@pytest.mark.parametrize("speed", [1.0, 6.0])
@pytest.mark.parametrize("eye", [(0.0, -4.0, 1.2), (3.0, 3.0, 2.0), (0.3, 0.0, 9.0)])
def test_a_throw_reaches_its_target(eye, speed):
    target = np.array([0.1, -0.15, 1.2])
    start, velocity = throw(np.array(eye), target, speed, 9.81, RADIUS, BOX)
    way = np.linalg.norm(target - start)
    time = way / speed
    np.testing.assert_allclose(start + velocity * time - [0.0, 0.0, 0.5 * 9.81 * time**2], target, atol=1e-12)
    assert way <= DISTANCE + 1e-9
    assert (start >= BOX[0] + RADIUS + CLEARANCE - 1e-9).all() and (start <= BOX[1] - RADIUS - CLEARANCE + 1e-9).all()
    assert start[2] >= RADIUS


def test_a_ray_hits_the_nearest_body_or_passes_it():
    points = np.array([[0.0, 0.0, 1.0], [0.0, 2.0, 1.0], [0.0, -9.0, 1.0]])
    eye = np.array([0.05, -3.0, 1.0])
    np.testing.assert_allclose(aim(eye, np.array([0.0, 2.0, 0.0]), points), (0.05, 0.0, 1.0))
    np.testing.assert_allclose(aim(eye + [1.0, 0.0, 0.0], np.array([0.0, 1.0, 0.0]), points)[0], 1.05)
