"""Cameras of tasks: everything is in the picture, as large as it can be."""

import math

import numpy as np
import pytest

from piavatar_envs.envs.framing import FIELD_OF_VIEW, MARGIN, frame
from tests.tasks.measured import assert_all_is_seen


def test_a_new_episode_is_all_in_the_picture(make_env, env_id):
    env = make_env(env_id)
    assert_all_is_seen(env)


@pytest.mark.parametrize(
    ("direction", "aspect"), [((1.0, -2.0, 0.5), 1.0), ((-3.0, 0.2, 1.0), 0.5), ((0.0, 1.0, 0.0), 2.0)]
)
def test_the_nearest_camera_that_shows_all_spheres(direction, aspect):
    rng = np.random.default_rng(0)
    spheres = np.concatenate([rng.normal(size=(8, 3)), rng.uniform(0.05, 0.5, (8, 1))], axis=1)
    eye, target = frame(spheres.tolist(), direction, aspect)
    way = np.array(eye) - target
    np.testing.assert_allclose(way / np.linalg.norm(way), direction / np.linalg.norm(direction), atol=2e-3)
    axes = np.linalg.qr(np.stack([way, [0.0, 0.0, 1.0], rng.normal(size=3)], axis=1))[0].T  # view, up and aside
    # distance of every sphere from each side of the pyramid
    slopes = {
        1: math.tan(math.radians(0.5 * FIELD_OF_VIEW)),
        2: math.tan(math.radians(0.5 * FIELD_OF_VIEW)) * min(aspect, 1.0),
    }
    depth = -(spheres[:, :3] - eye) @ (axes[0] * np.sign(axes[0] @ way))
    free = [
        (1.0 - 2.0 * MARGIN) * slope * depth
        - np.abs((spheres[:, :3] - eye) @ axes[axis])
        - spheres[:, 3] * math.hypot(1.0, (1.0 - 2.0 * MARGIN) * slope)
        for axis, slope in slopes.items()
    ]
    assert np.min(free) > -5e-3
    assert np.min(free) < 5e-3  # it touches a side: no camera along this line is nearer


def test_settings_place_the_camera(make_env):
    env = make_env("PIAvatar/KickBall-v0", camera_position=(4.0, 1.0, 1.5))
    task = env.batch.task
    other = make_env("PIAvatar/KickBall-v0").batch.task
    assert task.place_camera(1.0) == ((4.0, 1.0, 1.5), other.place_camera(1.0)[1])


@pytest.mark.parametrize("direction", [(0.0, 0.0, 1.0), (0.0, 0.0, 0.0)])
def test_a_view_without_a_side_is_refused(direction):
    with pytest.raises(ValueError, match="direction"):
        frame([(0.0, 0.0, 0.0, 1.0)], direction)
