"""Quantities that colour bodies: known gradients and impulses have the numbers of theory, on particles and skin."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from piavatar_envs.api.pictures import SceneReader
from piavatar_envs.avatar.body.skeleton import BODY_PARTS
from piavatar_envs.core.arrays import components_of
from piavatar_envs.render import distortion
from piavatar_envs.render.quantities import QUANTITIES, of_particles

SHEAR = 0.4


@pytest.fixture
def batch(make_batch):
    found = make_batch("PIAvatar/KickBall-v0", 2)
    found.reset(seeds=[0, 1])
    return found


def test_distortion_of_known_gradients():
    """Compare with |F - R| for stretches, and for a shear g, whose rotation has the tangent -g / 2."""
    assert distortion(np.diag([1.3, 0.6, 1.0])[None]) == pytest.approx([0.5])
    gradient = np.eye(3)
    gradient[0, 1] = SHEAR
    rotation = Rotation.from_rotvec([0.0, 0.0, -np.arctan(SHEAR / 2.0)]).as_matrix()
    expected = np.linalg.norm(gradient - rotation)
    turned = Rotation.random(rng=np.random.default_rng(0)).as_matrix() @ gradient
    assert distortion(np.stack([gradient, turned])) == pytest.approx([expected] * 2)
    assert np.isinf(distortion(np.full((1, 3, 3), np.nan))).all()


@pytest.mark.parametrize("name", ["strain", "distortion"])
def test_a_uniform_gradient_has_one_colour_on_bodies_and_props(batch, name):
    state = batch.simulation.state
    before = state.F.numpy().copy()
    sheared = np.eye(3, dtype=np.float32)
    sheared[0, 1] = SHEAR
    state.F.assign(components_of(np.broadcast_to(sheared, (*before.shape[:1], before.shape[-1], 3, 3))))
    try:
        scene = SceneReader(batch).scene(1, name)
    finally:
        state.F.assign(before)
    stretch = np.sqrt(1.0 + SHEAR**2 / 4.0) + SHEAR / 2.0  # and its inverse
    expected = {"strain": stretch - 1.0, "distortion": np.hypot(stretch - 1.0, 1.0 - 1.0 / stretch)}[name]
    for body in scene.bodies:
        np.testing.assert_allclose(body.scalars, expected, rtol=1e-5)
        assert (body.scalar_max, body.scalar_label) == (QUANTITIES[name].maximum, QUANTITIES[name].label)


def test_an_impulse_colours_the_part_that_feels_it(batch):
    simulation = batch.simulation
    sensors, before = simulation.sensors.part_impulse, simulation.sensors.part_impulse.numpy().copy()
    felt = np.zeros_like(before)
    arm = list(BODY_PARTS).index("left_arm")
    felt[1, arm, 1] = (3.0, 0.0, 4.0)
    sensors.assign(felt)
    try:
        body = simulation.avatars[0].body
        values = of_particles(simulation, 1, slice(body.first, body.first + body.count), "impulse")
        scene, other = (SceneReader(batch).scene(env, "impulse") for env in (1, 0))
    finally:
        sensors.assign(before)
    np.testing.assert_allclose(values, np.where(simulation.flesh[0].part == arm, 5.0, 0.0))
    skin, ball = scene.bodies
    left = skin.vertices[:, 0] > skin.vertices[:, 0].max() - 0.1
    assert skin.scalars[left].min() > 4.9 and skin.scalars[skin.vertices[:, 0] < 0.0].max() < 0.1
    assert ball.scalars is None and other.bodies[0].scalars.max() == 0.0


def test_pictures_without_overlays_have_matter_only(make_env):
    markers = []
    for overlays in (True, False):
        env = make_env("PIAvatar/KickBall-v0", overlays=overlays)
        env.reset(seed=0)
        markers.append(len(SceneReader(env.batch).scene(0).markers))
    assert markers == [1, 0]
