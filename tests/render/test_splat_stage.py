"""Avatars of splats in environments: pictures, batches, games and exported frames."""

from __future__ import annotations

import numpy as np
import pytest

from piavatar_envs.avatar.body.asset import AvatarAsset
from piavatar_envs.avatar.body.sampling import ClosedSurface
from piavatar_envs.avatar.body.sources import load_asset, register_source
from piavatar_envs.avatar.body.splat_files import read_splats
from piavatar_envs.avatar.skin import skin_bytes
from piavatar_envs.core.launch_graph import LaunchGraph
from piavatar_envs.export import Recording
from piavatar_envs.render.painter import Painter
from piavatar_envs.render.stage import Stage, bytes_of_stage
from piavatar_envs.render.views import Shot, view_rows
from scripts.synthetic_splats import drawn_as, on_body
from tests.render.batches import act

COUNT = 700
SPLATS = {"avatar.source": "splats_of_tests"}


def _build() -> AvatarAsset:
    """Return the embedded body, drawn as splats."""
    plain = load_asset(appearance="skin")
    return drawn_as(plain, on_body(plain, COUNT))


@pytest.fixture(autouse=True)
def source():
    register_source("splats_of_tests", _build)


def moved(stage: Stage) -> list[np.ndarray]:
    """Return centres, covariances and rotations of all pictures."""
    graph = LaunchGraph(stage.device)
    stage.record(graph)
    graph.run()
    return [array.numpy().copy() for array in (stage.splats.means, stage.splats.covariances, stage.splats.turns)]


@pytest.mark.parametrize("world", ["PIAvatar/Reach-v0", "PIAvatar/KickBall-v0"])
def test_a_row_of_a_batch_is_the_environment_alone(world, make_batch, equal):
    batch, alone = make_batch(world, 3, **SPLATS), make_batch(world, **SPLATS)
    batch.reset(seeds=[7, 8, 9])
    alone.reset(seeds=[8])
    act(batch, 2)
    act(alone, 2, rows=slice(1, 2))
    every = moved(Stage(batch.simulation))
    for single, all_rows in zip(moved(Stage(alone.simulation)), every, strict=True):
        assert np.isfinite(all_rows).all() and equal(single[0], all_rows[1])
    assert np.abs(every[0][0] - every[0][1]).max() > 1e-3


def test_pictures_of_a_simulation_share_what_binds_splats(make_batch):
    batch = make_batch("PIAvatar/Reach-v0", **SPLATS)
    first, second = (Stage(batch.simulation).splats.bound[0] for _ in range(2))
    assert first is second and first.upload(batch.device) is second.upload(batch.device)


def test_splats_stay_on_the_skin(make_batch):
    batch = make_batch("PIAvatar/Reach-v0", **SPLATS)
    batch.reset(seeds=[0])
    act(batch, 2)
    stage = Stage(batch.simulation)
    means = moved(stage)[0][0]
    part = stage.parts[0]
    away = ClosedSurface(stage.vertices.numpy()[0, part.vertices], part.faces).distance(means)
    assert np.abs(away).mean() < 0.002 and np.abs(away).max() < 0.02


def test_pictures_show_splats_and_the_shadow_of_the_body(make_batch):
    batch = make_batch("PIAvatar/Reach-v0", **SPLATS)
    batch.reset(seeds=[0])
    stage, size = Stage(batch.simulation), (96, 96)
    labels = []
    for layers in ([], stage.layers(*size)):
        painter = Painter(stage.surfaces, 1, *size, stage.device, segmentation=True, vertices=stage.vertices)
        shot = Shot(np.array([1.0, -3.4, 1.4]), np.array([0.0, 0.0, 0.9]), 34.0, np.zeros(2))
        painter.views.assign(view_rows([shot], *size))
        painter.layers += layers
        graph = LaunchGraph(stage.device)
        stage.record(graph)
        painter.record(graph)
        graph.run()
        labels.append(painter.labels.numpy()[0])
    assert not labels[0].any()  # the mesh is not seen
    assert set(np.unique(labels[1])) == {0, 1} and (labels[1] == 1).sum() > 500


def test_agents_of_a_game_have_splats_of_their_own(device, tmp_path):
    sumo_v0 = pytest.importorskip("piavatar_envs.multi.sumo_v0", exc_type=ImportError)
    env = sumo_v0.parallel_env(fidelity="tiny", device=device, **SPLATS)
    env.reset(seed=0)
    stage = Stage(env.batch.simulation)
    means = moved(stage)[0][0]
    assert stage.splats.slices == {0: slice(0, COUNT), 1: slice(COUNT, 2 * COUNT)}
    assert np.linalg.norm(means[:COUNT].mean(axis=0) - means[COUNT:].mean(axis=0)) > 0.3
    (layer,) = stage.layers(16, 16)
    assert layer.subjects.numpy().tolist() == COUNT * [1] + COUNT * [2]
    recording = Recording(env, tmp_path / "film", "ply")
    recording.add()
    folders = {folder.name: folder for folder in recording.finish()}
    for index, own in stage.splats.slices.items():
        read = read_splats(folders[f"splats_{index}"] / "0000.ply")
        np.testing.assert_allclose(read.means, means[own], atol=1e-5)
        c = stage.splats.covariances.numpy()[0, own][:, [0, 3, 5]]
        found = np.diagonal(read.covariances(), axis1=1, axis2=2)
        np.testing.assert_allclose(found, c, atol=1e-3 * c.max())


def test_splats_are_observed_as_pixels(make_batch, equal):
    settings = {"obs_mode": "pixels", "segmentation": True, "pixels": {"width": 24, "height": 24}, **SPLATS}
    batch, alone = make_batch("PIAvatar/Reach-v0", 3, **settings), make_batch("PIAvatar/Reach-v0", **settings)
    batch.reset(seeds=[7, 8, 9])
    alone.reset(seeds=[8])
    act(batch, 2)
    act(alone, 2, rows=slice(1, 2))
    shown = {name: own[0].numpy().copy() for name, own in batch.pixels.arrays.items()}
    assert all(equal(own[0].numpy()[0], shown[name][1]) for name, own in alone.pixels.arrays.items())
    assert (shown["segmentation"] == 1).sum() > 60, "the avatar is seen"
    batch.reset(np.array([True, False, False]))
    now = {name: own[0].numpy() for name, own in batch.pixels.arrays.items()}
    assert all(equal(own[1:], shown[name][1:]) for name, own in now.items())
    assert not equal(now["pixels"][0], shown["pixels"][0])
    assert [painter.drawn.numpy().tolist() for painter in batch.pixels.painters] == [[True, False, False]]


@pytest.mark.parametrize("settings", [{}, SPLATS])
def test_the_memory_of_a_picture_is_counted(make_batch, settings):
    batch = make_batch("PIAvatar/KickBall-v0", **settings)
    markers = batch.task.marker_specs()
    stage = Stage(batch.simulation, markers)
    arrays = [stage.vertices]
    if stage.splats is not None:
        arrays += [stage.splats.means, stage.splats.covariances, stage.splats.turns]
    held, counted = sum(array.capacity for array in arrays), bytes_of_stage(batch.simulation, markers)
    skins = (1 + bool(settings)) * skin_bytes(batch.simulation.flesh[0].points.rest.shape[1])
    assert counted == held + skins
