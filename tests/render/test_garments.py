"""Drawn garments: closed and two-sided, smooth, where their cloth is; bodies beneath them do not show."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import sparse
from scipy.spatial import cKDTree

from piavatar_envs.api.pictures import MouseForce, SceneReader, grip_at
from piavatar_envs.avatar.body.outfit import KITS
from piavatar_envs.avatar.body.skeleton import JOINT_NAMES
from piavatar_envs.avatar.gltf import read_gltf
from piavatar_envs.core.launch_graph import LaunchGraph
from piavatar_envs.core.srgb import linear_to_srgb
from piavatar_envs.export import Recording
from piavatar_envs.render.film_files import film_writer
from piavatar_envs.render.garments import GarmentMesh, both_sides, garment_names
from piavatar_envs.render.live import Drag
from piavatar_envs.render.painter import Painter
from piavatar_envs.render.stage import MARKERS, Stage, bytes_of_stage
from piavatar_envs.render.views import Shot, view_rows
from piavatar_envs.render.wearing import sinking
from tests.render.batches import seen
from tests.render.cloth import COLORS, tube, worn_by
from tests.render.test_film_files import played

REACH = "PIAvatar/Reach-v0"


@pytest.fixture
def put_on(monkeypatch):
    """Give garments to a simulation for a test."""

    def put(simulation, *garments, **more):
        monkeypatch.setattr(simulation, "garments", worn_by(simulation, *garments, **more), raising=False)

    return put


def test_a_sheet_becomes_a_closed_surface():
    mesh = GarmentMesh.of(tube(0.5, 0.9, 0.2))
    sides = np.concatenate([np.roll(mesh.faces, -k, axis=1)[:, :2] for k in range(3)])
    edges, counts = np.unique(sides, axis=0, return_counts=True)
    assert (counts == 1).all() and {tuple(edge) for edge in edges} == {tuple(edge[::-1]) for edge in edges}
    half = mesh.num_vertices // 2
    assert (mesh.colors[:half] == [204, 26, 26]).all() and (mesh.colors[half:] == [26, 26, 204]).all()
    assert both_sides(np.zeros((0, 3), int), 0).shape == (0, 3)


def test_drawn_points_lie_on_both_sides_of_the_cloth(make_batch, put_on):
    batch, garments = make_batch(REACH, 2), (tube(0.5, 0.9, 0.2), tube(0.2, 0.3, 0.1, kind="cuff", rows=4))
    batch.reset(seeds=[0, 1])
    put_on(batch.simulation, *garments, shift=(0.3, 0.0, 0.1))
    stage = Stage(batch.simulation, batch.task.marker_specs())
    assert stage.subjects == ("ground", "agent_0", MARKERS, "agent_0.skirt", "agent_0.cuff")
    parts = stage.parts[-2:]
    assert [(part.name, part.kind, part.subject) for part in parts] == [
        ("agent_0.skirt", "garment", 3), ("agent_0.cuff", "garment", 4),
    ]  # fmt: skip
    labels = stage.surfaces.subject.numpy()
    assert [(labels == part.subject).sum() for part in parts] == [len(part.faces) for part in parts]
    for vertices in seen(batch, stage):
        assert np.isfinite(vertices).all()
        for part, garment, radius in zip(parts, garments, (0.2, 0.1), strict=True):
            outer, inner = vertices[part.vertices].reshape(2, -1, 3) - [0.3, 0.0, 0.1]
            assert np.linalg.norm(outer - inner, axis=1) == pytest.approx(0.002, rel=1e-3)
            # a spline lies within its polygon, less than the sagitta of an edge
            away = np.linalg.norm(0.5 * (outer + inner)[:, :2], axis=1)
            assert away.max() < radius + 1e-6 and away.min() > radius * np.cos(np.pi / 32) - 1e-3
            assert (np.linalg.norm(outer[:, :2], axis=1) > np.linalg.norm(inner[:, :2], axis=1)).all()
            heights = garment.draped[:, 2].min(), garment.draped[:, 2].max()
            assert (outer[:, 2].min(), outer[:, 2].max()) == pytest.approx(heights, abs=1e-3)


def test_memory_counts_garments(make_batch, put_on):
    batch = make_batch(REACH)
    before, garment = bytes_of_stage(batch.simulation), tube(0.5, 0.9, 0.2)
    put_on(batch.simulation, garment)
    drawn = GarmentMesh.of(garment).num_vertices
    assert bytes_of_stage(batch.simulation) - before == 12 * (drawn + garment.mesh.num_vertices)
    assert Stage(batch.simulation).parts[-1].num_vertices == drawn


def test_an_environment_that_has_failed_shows_no_garment(make_batch, put_on):
    batch = make_batch(REACH, 2)
    batch.reset(seeds=[0, 1])
    put_on(batch.simulation, tube(0.5, 0.9, 0.2))
    x = batch.simulation.garments.cloth.state.x
    broken = x.numpy()
    broken[1] = np.nan
    x.assign(broken)
    stage = Stage(batch.simulation, batch.task.marker_specs())
    finite = np.isfinite(seen(batch, stage)[:, stage.parts[-1].vertices]).all(axis=(1, 2))
    assert finite.tolist() == [True, False]


def test_pictures_show_the_side_that_faces_the_camera(make_batch, put_on):
    batch = make_batch(REACH)
    batch.reset(seeds=[0])
    put_on(batch.simulation, tube(0.3, 0.95, 0.35))
    stage, graph = Stage(batch.simulation), LaunchGraph(batch.device)
    painter = Painter(stage.surfaces, 1, 96, 96, stage.device, segmentation=True, vertices=stage.vertices)
    stage.record(graph)
    painter.record(graph)
    shares = []
    for eye, target in (((0.0, -2.5, 0.7), (0.0, 0.0, 0.7)), ((0.02, -0.1, 2.6), (0.0, 0.0, 0.0))):
        shot = Shot(np.array(eye), np.array(target), 34.0, np.zeros(2))
        painter.views.assign(view_rows([shot], 96, 96))
        graph.run()
        cloth = painter.picture.numpy()[0][painter.labels.numpy()[0] == stage.parts[-1].subject].astype(int)
        shares.append((cloth[:, 0] > cloth[:, 2]).mean())
    assert shares[0] > 0.97 and shares[1] < 0.2


def test_skin_sinks_beneath_cloth_and_nowhere_else():
    skirt = tube(0.5, 0.9, 0.2)
    height, normal = np.array([0.3, 0.45, 0.52, 0.6, 0.7, 0.85, 0.905, 0.95]), np.array([1.0, 0.0, 0.0])

    def depths(radius: float, way: float = 1.0) -> np.ndarray:
        points = np.stack([np.full(8, radius), np.zeros(8), height], axis=1)
        return sinking(skirt, points, np.tile(way * normal, (8, 1)))

    on, loose, outside, other_way = depths(0.195), depths(0.12), depths(0.22), depths(0.195, -1.0)
    through = depths(0.21)  # as an outfit in a fold
    assert through[3:5] == pytest.approx(0.014) and through[0] == 0.0
    assert on[:2] == pytest.approx(0.0) and 0.0 < on[2] < on[3] == pytest.approx(on[4]) == pytest.approx(0.014)
    assert 0.0 < on[6] < 0.008 and on[7] == 0.0  # above the waistband
    assert loose[4] == pytest.approx(0.010, rel=1e-3) and 0.0 < loose[2] < 0.003
    assert outside[:5] == pytest.approx(0.0) and other_way[:5] == pytest.approx(0.0)


def test_a_garment_sinks_beneath_another_one(make_batch, put_on):
    batch = make_batch(REACH)
    shirt = tube(0.7, 1.3, 0.205, kind="shirt", rows=14)
    put_on(batch.simulation, tube(0.1, 0.95, 0.2, kind="trousers", rows=20), shirt)
    stage = Stage(batch.simulation, batch.task.marker_specs())
    trousers = seen(batch, stage)[0, stage.parts[-2].vertices]
    away, height = np.linalg.norm(trousers[:, :2], axis=1), trousers[:, 2]
    assert away[height > 0.72].max() < 0.195 and away[height < 0.66].min() > 0.195
    assert np.linalg.norm(seen(batch, stage)[0, stage.parts[-1].vertices][:, :2], axis=1).min() > 0.2


def test_a_body_in_a_shirt_does_not_wear_the_painted_one(make_batch, put_on):
    simulation = make_batch(REACH).simulation

    def shirted() -> int:
        return (Stage(simulation).parts[0].colors == KITS[0].shirt).all(axis=1).sum()

    bare, look = shirted(), simulation.flesh[0].asset.drawn.vertices.copy()
    put_on(simulation, tube(0.5, 0.95, 0.2))
    assert shirted() == bare > 1000
    dress = tube(0.6, 1.5, 0.22, rows=20, kind="dress")
    put_on(simulation, dress)
    assert shirted() == 0
    behind = (dress.draped[dress.mesh.faces][..., 1] > 0.0).all(axis=1)
    put_on(simulation, replace(dress, kind="cape", mesh=replace(dress.mesh, faces=dress.mesh.faces[behind])))
    assert shirted() == bare
    assert (simulation.flesh[0].asset.drawn.vertices == look).all()  # the body itself is the same


def test_scenes_have_garments_after_all_other_bodies(make_batch, put_on):
    batch = make_batch("PIAvatar/KickBall-v0", 2)
    batch.reset(seeds=[0, 1])
    put_on(batch.simulation, tube(0.5, 0.9, 0.2), tube(0.0, 0.1, 0.2, wearer=-1, kind="sheet", rows=3))
    scene = SceneReader(batch).scene(1)
    skirt, sheet = scene.bodies[2:]
    assert skirt.colors is not None and (skirt.vertices[:, 2].max(), sheet.vertices[:, 2].max()) == pytest.approx(
        (0.9, 0.1), abs=2e-3
    )
    for body, name in ((1, "ball"), (2, JOINT_NAMES[bone_at(batch, skirt.vertices[0])])):
        assert grip_at(batch, 1, Drag(body, scene.bodies[body].vertices[0], np.zeros(3))).name == name
    assert grip_at(batch, 1, Drag(3, sheet.vertices[0], np.zeros(3))) is None
    mouse = MouseForce(batch, 1, lambda *_arguments, **_more: pytest.fail("a sheet that is worn by none is not pulled"))
    mouse.apply(Drag(3, sheet.vertices[0], np.zeros(3)))
    assert mouse.arrow() is None


def bone_at(batch, place: np.ndarray) -> int:
    """Return the joint that moves the particle nearest to a place most."""
    body = batch.simulation.avatars[0].body
    x = batch.simulation.state.x.numpy()[1, body.first : body.first + body.count]
    nearest = np.linalg.norm(x - place, axis=1).argmin()
    return int(batch.simulation.flesh[0].sampled.skin_joints[nearest, 0])


@pytest.fixture(scope="module")
def film(make_batch):
    """Return the scenes of a body in a skirt that rises, and the places of the skirt's two sides in each."""
    batch, skirt = make_batch(REACH, 2), tube(0.5, 0.9, 0.2)
    batch.reset(seeds=[0, 1])
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(batch.simulation, "garments", worn_by(batch.simulation, skirt), raising=False)
        reader, x, scenes = SceneReader(batch), batch.simulation.garments.cloth.state.x, []
        for _ in range(3):
            scenes.append(reader.scene(0))
            x.assign(x.numpy() + np.float32([0.0, 0.0, 0.1]))
    return scenes, [scene.bodies[1].vertices.copy() for scene in scenes]


@pytest.mark.parametrize("kind", ["glb", "ply", "usd"])
def test_films_have_garments(film, kind, tmp_path):
    """Check that a file has both sides of a skirt in their colours, where it was in every frame."""
    if kind == "usd":
        pytest.importorskip("pxr.Usd", reason="needs the extra usd")
    scenes, places = film
    assert np.ptp([place[0, 2] for place in places]) == pytest.approx(0.2, abs=1e-3)
    writer = film_writer(tmp_path, kind, 25.0)
    for scene in scenes:
        writer.add(scene)
    paths, (faces, colors) = writer.finish(), (scenes[0].bodies[1].faces, scenes[0].bodies[1].colors)
    if kind == "glb":
        gltf = read_gltf(paths[0])
        positions, _ = played(gltf, gltf.names.index("body_1"))
        own = gltf.json["meshes"][gltf.names.index("body_1")]["primitives"][0]
        triangles = gltf.accessor(own["indices"]).reshape(-1, 3)
        painted = 255.0 * linear_to_srgb(gltf.accessor(own["attributes"]["COLOR_0"])[:, :3])
    elif kind == "ply":
        trimesh = pytest.importorskip("trimesh")
        (folder,) = (path for path in paths if path.name == "body_1")
        meshes = [trimesh.load(folder / f"{frame:04d}.ply", process=False) for frame in range(3)]
        positions, triangles = np.stack([mesh.vertices for mesh in meshes]), meshes[0].faces
        painted = meshes[0].visual.vertex_colors[:, :3]
    else:
        from pxr import Usd, UsdGeom

        stage = Usd.Stage.Open(str(paths[0]))
        mesh = UsdGeom.Mesh(stage.GetPrimAtPath("/film/body_1"))
        positions = np.stack([mesh.GetPointsAttr().Get(frame) for frame in range(3)])
        triangles = np.reshape(mesh.GetFaceVertexIndicesAttr().Get(), (-1, 3))
        painted = 255.0 * linear_to_srgb(np.array(mesh.GetDisplayColorAttr().Get(0)))
    np.testing.assert_allclose(positions, places, atol=1e-5)
    np.testing.assert_array_equal(triangles, faces)
    np.testing.assert_allclose(painted, colors, atol=0.6)
    assert len(np.unique(colors, axis=0)) == 2


def test_usd_has_the_cloth_of_every_state(make_env, tmp_path):
    """Check that garments of a recording are at the places that the simulation had, in the order of the outfit."""
    usd = pytest.importorskip("pxr.Usd", reason="needs the extra usd")
    from pxr import UsdGeom

    outfit = [{"kind": "skirt", "length": 0.4, "edge": 0.07}, {"kind": "scarf", "edge": 0.07}]
    env = make_env(REACH, garments=outfit)
    env.reset(seed=0)
    recording, cloth = Recording(env, tmp_path / "film", "usd"), env.batch.simulation.garments
    states = []
    for _ in range(6):
        env.step(env.action_space.sample())
        recording.add()
        states.append(env.batch.get_state()["cloth.x"][0].astype(np.float64))
    assert np.ptp(states, axis=0).max() > 0.02
    stage = usd.Stage.Open(str(recording.finish()[0]))
    first = 0
    for number, garment in enumerate(cloth.garments):
        drawn = GarmentMesh.of(garment, cloth.garments[number + 1 :])
        prim = UsdGeom.Mesh(stage.GetPrimAtPath(f"/film/body_{number + 1}"))
        faces = np.reshape(prim.GetFaceVertexIndicesAttr().Get(), (-1, 3))
        np.testing.assert_array_equal(faces, drawn.faces)
        own = sparse.csr_array(tuple(reversed(drawn.rows)))
        for frame, state in enumerate(states):
            x = state[first : first + garment.mesh.num_vertices]
            outer, inner = np.array(prim.GetPointsAttr().Get(frame), np.float64).reshape(2, -1, 3)
            sunk = np.linalg.norm(0.5 * (outer + inner) - own @ x, axis=1)  # beneath what is worn over it
            np.testing.assert_allclose(sunk, drawn.depth, atol=1e-5)
            assert (sunk < 1e-5).mean() > 0.7
            assert cKDTree(0.5 * (outer + inner)).query(x)[0].max() < 0.05  # smooth, but within an edge of the cloth
        first += garment.mesh.num_vertices


def test_names_are_of_the_wearer_and_the_kind():
    worn = [tube(0.5, 0.9, 0.2, wearer=wearer, kind=kind) for wearer, kind in
            ((0, "skirt"), (1, "skirt"), (0, "skirt"), (-1, "sheet"))]  # fmt: skip
    assert garment_names(worn, ["a", "b"]) == ["a.skirt", "b.skirt", "a.skirt_1", "sheet"]
    assert COLORS.front != COLORS.back
