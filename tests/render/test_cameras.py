"""Cameras of batches: where they stand, what they look at, and that no body covers its own view."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from piavatar_envs.avatar.body.skeleton import joint_index
from piavatar_envs.core.launch_graph import LaunchGraph
from piavatar_envs.render.cameras import BODY_CAMERAS, BatchCamera
from piavatar_envs.render.scene import Camera
from piavatar_envs.render.stage import Stage
from tests.render.batches import act, seen

SIZE = 64


def taken(batch, camera, **settings) -> tuple[np.ndarray, np.ndarray]:
    """Return views and centers of all environments now."""
    camera = BatchCamera(batch.simulation, camera, 2 * SIZE, SIZE, Stage(batch.simulation).envs, **settings)
    graph = LaunchGraph(batch.device)
    camera.record(graph)
    graph.run()
    return camera.views.numpy(), camera.centers.numpy()


@pytest.fixture
def moving(make_batch):
    batch = make_batch("PIAvatar/Reach-v0", 3)
    batch.reset(seeds=[1, 2, 3])
    act(batch, 8)
    return batch


@pytest.mark.parametrize("follows", [True, False])
def test_the_task_camera_stands_about_what_it_follows(moving, follows):
    camera = Camera((1.0, -3.0, 1.5), (0.2, 0.1, 0.8), 40.0)
    views, centers = taken(moving, camera, follows=follows)
    roots = moving.simulation.avatar.tracked.position.numpy()[:, 0, :2]
    np.testing.assert_allclose(centers, roots if follows else 0.0 * roots, atol=1e-7)
    for view, center in zip(views, centers, strict=True):
        offset = np.array([*center, 0.0])
        np.testing.assert_allclose(view["eye"], offset + camera.position, atol=1e-6)
        way = np.array(camera.target) - camera.position
        np.testing.assert_allclose(view["forward"], way / np.linalg.norm(way), atol=1e-6)
        assert view["right"][2] == pytest.approx(0.0, abs=1e-7) and view["up"][2] > 0.0
        assert view["focal"] == pytest.approx(0.5 * SIZE / np.tan(np.radians(20.0)))
        assert (view["width"], view["height"]) == (2 * SIZE, SIZE)


@pytest.mark.parametrize("name", list(BODY_CAMERAS))
def test_a_camera_on_a_body_turns_with_its_bone_and_does_not_see_it(moving, name):
    views, centers = taken(moving, name)
    tracked, bone = moving.simulation.avatar.tracked, joint_index(BODY_CAMERAS[name])
    look = moving.simulation.flesh[0].asset.drawn
    weight = np.where(look.skin_joints == bone, look.skin_weights, 0.0).sum(axis=1)
    vertices = seen(moving)[:, : len(look.vertices)]
    np.testing.assert_array_equal(centers, tracked.position.numpy()[:, 0, :2])
    offsets = []
    for env, view in enumerate(views):
        turn = Rotation.from_quat(tracked.rotation.numpy()[env, bone])
        offsets.append(turn.inv().apply(view["eye"] - tracked.position.numpy()[env, bone]))
        forward, right, up = (np.array(view[axis]) for axis in ("forward", "right", "up"))
        np.testing.assert_allclose(np.cross(right, forward), up, atol=1e-6)
        way = turn.inv().apply(forward)
        if name == "head":  # where the face looks
            assert way[1] < -0.9 and abs(way[0]) < 1e-6
            assert turn.inv().apply(up)[2] > 0.9
        own = vertices[env][weight > 0.5] - view["eye"]
        depth = own @ forward
        wide, high = (np.abs(own @ axis) * view["focal"] / np.maximum(depth, 1e-9) for axis in (right, up))
        assert not ((depth > 0.0) & (wide < SIZE) & (high < 0.5 * SIZE)).any()
        assert np.linalg.norm(own, axis=1).min() < 0.15
    np.testing.assert_allclose(offsets, offsets[:1] * 3, atol=1e-5)


@pytest.mark.parametrize(("chosen", "angle"), [({}, 90.0), ({"field_of_view": 50.0}, 50.0)])
def test_the_angle_of_a_camera_on_a_body(moving, chosen, angle):
    views, _ = taken(moving, "head", **chosen)
    np.testing.assert_allclose(views["focal"], 0.5 * SIZE / np.tan(np.radians(0.5 * angle)), rtol=1e-6)


def test_an_unknown_camera_is_refused(moving):
    with pytest.raises(ValueError, match="use one of head, left_hand, right_hand"):
        taken(moving, "foot")
