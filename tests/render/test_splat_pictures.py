"""Pictures of avatars of splats: of one environment and of many, and silhouettes beside those of the mesh."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy.ndimage import binary_dilation

from piavatar_envs.api.pictures import SceneReader
from piavatar_envs.avatar.body.asset import AvatarAsset
from piavatar_envs.avatar.body.sources import load_asset, register_source
from piavatar_envs.core.launch_graph import LaunchGraph
from piavatar_envs.render.cameras import BatchCamera
from piavatar_envs.render.coloring import color_by
from piavatar_envs.render.painter import Painter
from piavatar_envs.render.quantities import QUANTITIES
from piavatar_envs.render.renderer import Renderer
from piavatar_envs.render.scene import Camera
from piavatar_envs.render.stage import Stage
from piavatar_envs.render.surfaces import MeshPart, Surfaces
from piavatar_envs.render.views import Shot
from scripts.synthetic_splats import drawn_as, on_body
from tests.render.batches import act

SPLATS = {"avatar.source": "body_of_splats"}


def with_splats(count: int) -> AvatarAsset:
    """Return the embedded body with splats on its skin."""
    plain = load_asset(appearance="skin")
    return drawn_as(plain, on_body(plain, count))


register_source("body_of_splats", lambda count=20_000: with_splats(count))


class Pictures:
    """Pictures of some environments of a batch, with labels."""

    def __init__(self, batch, envs, size: int = 64, meshes: bool = False) -> None:
        stage = Stage(batch.simulation, batch.task.marker_specs(), envs)
        shown = [MeshPart(part.num_vertices, part.faces, subject=part.subject) for part in stage.parts]
        surfaces = Surfaces.build(shown, batch.device) if meshes else stage.surfaces
        self.painter = Painter(
            surfaces, len(envs), size, size, batch.device, depth=True, segmentation=True, vertices=stage.vertices
        )
        if not meshes:
            self.painter.layers += stage.layers(size, size)
        out = self.painter.views, self.painter.centers
        camera = BatchCamera(batch.simulation, Camera(), size, size, stage.envs, out=out)
        self._graph = LaunchGraph(batch.device)
        batch.task.record_markers(batch, self._graph, stage.markers)
        stage.record(self._graph)
        camera.record(self._graph)
        self.painter.record(self._graph)

    def take(self) -> tuple[np.ndarray, ...]:
        """Return pictures, depths and labels."""
        self._graph.run()
        return tuple(array.numpy().copy() for array in (self.painter.picture, self.painter.depth, self.painter.labels))


def test_rows_of_a_batch_equal_pictures_alone(make_batch, equal):
    batch = make_batch("PIAvatar/KickBall-v0", 3, **SPLATS)
    batch.reset(seeds=[7, 8, 9])
    act(batch, 3)
    every = Pictures(batch, [0, 1, 2]).take()
    for env in range(3):
        for a, b in zip(every, Pictures(batch, [env]).take(), strict=True):
            assert equal(a[env], b[0])
    picture, depth, labels = every
    assert {1, 2} <= set(np.unique(labels))  # the avatar, and the ball
    red, green, _ = picture[labels == 1].astype(int).T
    assert (red > green + 60).mean() > 0.1  # stripes of the shirt
    assert 2.0 < np.median(depth[labels == 1]) < 6.0


def test_a_bent_arm_has_no_holes(make_batch):
    batch = make_batch("PIAvatar/Reach-v0", **SPLATS)
    batch.reset(seeds=[3])
    act(batch, 12, rows=slice(0, 1))
    drawn, covered = (Pictures(batch, [0], 320, meshes).take()[2][0] == 1 for meshes in (True, False))
    assert (drawn & covered).sum() >= 0.98 * drawn.sum()
    assert binary_dilation(drawn, iterations=3)[covered].all()  # splats reach a pixel or two beyond


def test_render_draws_splats(make_env):
    env = make_env("PIAvatar/Reach-v0", render_mode="rgb_array", **SPLATS, **{"render.width": 64, "render.height": 64})
    env.reset(seed=3)
    red, green, _ = env.render().astype(int).reshape(-1, 3).T
    assert (red > green + 60).sum() > 60


@pytest.mark.parametrize("color", ["strain", "distortion"])
def test_a_uniform_strain_gives_all_splats_the_colour_of_the_map(make_batch, color):
    """And so does the picture, in the midst of the body, where nothing but splats is seen."""
    batch = make_batch("PIAvatar/Reach-v0", **SPLATS)
    batch.reset(seeds=[3])
    F, scale = batch.simulation.state.F, QUANTITIES[color]
    # both quantities of one stretch are its departure from one; 0.6 of the scale is in the midst of a colour
    F.assign(np.broadcast_to(np.diag([1.0, 1.0 + 0.6 * scale.maximum, 1.0]).reshape(9, 1), F.shape).astype(np.float32))
    body = SceneReader(batch).scene(0, color).bodies[0]
    expected = color_by([0.6], 1.0)
    np.testing.assert_array_equal(body.splats.colors, np.tile(expected, (len(body.splats.cloud), 1)))
    np.testing.assert_array_equal(body.splats.sh.shape[1:], (1, 3))
    np.testing.assert_allclose(body.splats.as_cloud().colors(np.array([0.6, 0.0, 0.8])), body.splats.colors, atol=1e-6)
    with Renderer(96, 96) as renderer:
        plain = renderer.render([dataclasses.replace(body, scalars=None)], follow=body.vertices.mean(axis=0))
    trunk = np.abs(plain[42:48, 46:50].astype(int) - np.rint(255.0 * expected))
    assert trunk.max() <= 2


def test_splats_show_where_a_body_was_struck(make_batch, equal):
    """A renderer that has drawn the same splats before draws them with the present colours, and with their own."""
    ball = {"name": "ball", "size": [0.12], "mass": 4, "position": [0, -0.6, 1.05], "velocity": [0, 6, 0]}
    batch = make_batch("PIAvatar/Reach-v0", **SPLATS, **{"scene.props": [ball]})
    batch.reset(seeds=[3])
    reader, camera = SceneReader(batch), Camera((0.0, -4.0, 1.0), (0.0, 0.0, 1.0))

    def draw(*colors: str) -> list[np.ndarray]:
        """Draw the body without the ball."""
        with Renderer(120, 120, camera, scale=False) as renderer:
            return [renderer.render([reader.scene(0, color).bodies[0]]) for color in colors]

    with Renderer(120, 120, camera, scale=False) as renderer:
        still = renderer.render([reader.scene(0, "strain").bodies[0]])
        for _ in range(3):
            batch.step()
        body = reader.scene(0, "strain").bodies[0]
        struck, own = renderer.render([body]), renderer.render([reader.scene(0).bodies[0]])
    for again, picture in zip(draw("strain", "skin"), (struck, own), strict=True):
        assert equal(again, picture)
    rest = color_by([0.0], 1.0)
    most = np.square(body.splats.colors - rest).sum(axis=1).argmax()
    place = body.splats.means[most]
    assert np.linalg.norm(place - batch.simulation.props.state.position.numpy()[0, 0]) < 0.16
    shot = Shot(np.array(camera.position), np.array(camera.target), camera.field_of_view, np.zeros(2))
    x, y = shot.project(place[None], 120, 120)[0].astype(int)
    np.testing.assert_allclose(still[y, x] / 255.0, rest[0], atol=0.01)
    np.testing.assert_allclose(struck[y, x] / 255.0, body.splats.colors[most], atol=0.06)
    assert np.abs(struck[y, x].astype(int) - still[y, x]).max() > 40


def test_observed_pictures_show_splats(make_batch, equal):
    settings = {**SPLATS, "obs_mode": "pixels", "pixels.segmentation": True}
    batch, alone = (make_batch("PIAvatar/Reach-v0", count, **settings) for count in (3, 1))
    batch.reset(seeds=[7, 8, 9])
    alone.reset(seeds=[8])
    act(batch, 2)
    act(alone, 2, rows=slice(1, 2))
    seen, one = ({name: rows[0].numpy() for name, rows in each.pixels.arrays.items()} for each in (batch, alone))
    for name, rows in seen.items():
        assert equal(rows[1], one[name][0])
    red, green, _ = seen["pixels"][seen["segmentation"][..., 0] == 1].astype(int).T
    assert (red > green + 60).mean() > 0.1
