"""Stage: the surfaces of many environments at once are those of each alone, and stand where theory puts them."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp
from scipy.spatial.transform import Rotation

from piavatar_envs.avatar.body import skeleton
from piavatar_envs.avatar.body.sources import load_asset, register_source
from piavatar_envs.config import load_config
from piavatar_envs.core.launch_graph import LaunchGraph
from piavatar_envs.envs.batch_env import BatchEnv
from piavatar_envs.render.markers import unit_mesh
from piavatar_envs.render.scene import Ring, Sphere
from piavatar_envs.render.stage import MARKERS, Stage
from piavatar_envs.sim.markers import MarkerSpec, turn_to
from piavatar_envs.tasks.games import load_game_task
from scripts.synthetic_splats import drawn_as, on_body
from tests.render.batches import act, seen

KICK = "PIAvatar/KickBall-v0"
SOLIDS = {"scene.colliders": [
    {"name": "floor", "kind": "plane", "position": [0.0, 0.0, -0.2]},
    {"name": "wall", "kind": "box", "size": [0.2, 0.1, 0.3], "position": [1.0, 0.2, 0.4], "rotation": [0.8, 0.6, 0, 0]},
    {"name": "post", "kind": "capsule", "size": [0.1, 0.2], "position": [-1.0, 0.0, 0.4]},
]}  # fmt: skip


@pytest.fixture
def kicking(make_batch):
    """Three environments with a ball and a gate in motion."""
    batch = make_batch(KICK, 3)
    batch.reset(seeds=[7, 8, 9])
    act(batch, 3)
    return batch


def test_a_row_of_a_batch_is_the_environment_alone(kicking, make_batch, equal):
    every = seen(kicking)
    some = Stage(kicking.simulation, kicking.task.marker_specs(), envs=[2, 0])
    assert equal(seen(kicking, some), every[[2, 0]])
    some.select([1, 1])
    assert equal(seen(kicking, some), every[[1, 1]])
    alone = make_batch(KICK)
    alone.reset(seeds=[8])
    act(alone, 3, rows=slice(1, 2))
    assert equal(seen(alone)[0], every[1])
    assert equal(seen(kicking), every)


@pytest.mark.parametrize("look", [{}, {"avatar.source": "splats_of_tests"}])
def test_pictures_that_do_not_change_keep_their_vertices(make_batch, equal, look):
    register_source("splats_of_tests", lambda: drawn_as(load_asset(), on_body(load_asset(), 300)))
    batch = make_batch(KICK, 3, **SOLIDS, **look)
    batch.reset(seeds=[7, 8, 9])
    stage, graph = Stage(batch.simulation, batch.task.marker_specs()), LaunchGraph(batch.device)
    drawn = wp.array([True, False, True], dtype=wp.bool, device=batch.device)
    batch.task.record_markers(batch, graph, stage.markers)
    stage.record(graph, drawn)
    written = [stage.vertices, *((stage.splats.means, stage.splats.covariances, stage.splats.turns) if look else ())]
    before = [seen(batch, stage), *(array.numpy().copy() for array in written[1:])]
    act(batch, 1)
    graph.run()
    masked = [array.numpy().copy() for array in written]
    after = [seen(batch, stage), *(array.numpy() for array in written[1:])]
    for old, some, new in zip(before, masked, after, strict=True):
        assert equal(some[1], old[1]) and not equal(old[1], new[1]) and equal(some[[0, 2]], new[[0, 2]])


def test_parts_follow_one_another_and_have_labels(kicking):
    stage = Stage(kicking.simulation, kicking.task.marker_specs())
    assert stage.subjects == ("ground", "agent_0", "ball", MARKERS)
    assert [(part.name, part.kind, part.subject) for part in stage.parts] == [
        ("agent_0", "avatar", 1), ("ball", "prop", 2), (MARKERS, "ring", 3),
    ]  # fmt: skip
    assert [part.vertices.start for part in stage.parts][1:] == [part.vertices.stop for part in stage.parts][:-1]
    assert stage.vertices.shape == (3, stage.parts[-1].vertices.stop)
    labels = stage.surfaces.subject.numpy()
    assert [(labels == part.subject).sum() for part in stage.parts] == [len(part.faces) for part in stage.parts]


def test_a_prop_called_as_the_markers_has_a_label_of_its_own(make_batch):
    prop = {"name": MARKERS, "shape": "sphere", "size": [0.15], "position": [1.0, 0.0, 0.5]}
    batch = make_batch("PIAvatar/Reach-v0", **{"scene.props": [prop]})
    stage = Stage(batch.simulation, batch.task.marker_specs())
    assert stage.subjects == ("ground", "agent_0", MARKERS, MARKERS)
    assert [(part.kind, part.subject) for part in stage.parts[:2]] == [("avatar", 1), ("prop", 2)]
    assert {part.subject for part in stage.parts[2:]} == {3}


def placed(batch, env: int = 0) -> np.ndarray:
    """Return the drawn vertices of a body whose particles are where the skinning puts them, by theory [m]."""
    flesh, avatar = batch.simulation.flesh[0], batch.simulation.avatars[0]
    body, look = flesh.asset.shape_drawn(flesh.shape_parameters[env]), flesh.asset.drawn
    turns = Rotation.from_quat(avatar.placed.rotation.numpy()[env]).as_matrix()
    joints = avatar.placed.position.numpy()[env]
    return skeleton.skin(body.vertices, look.skin_joints, look.skin_weights, turns, joints, body.joints)


@pytest.mark.parametrize(
    "shape",
    [
        {},
        {"shape.parameters": {"weight": 0.8, "height": -0.5}},
        {"shape.randomize": True},
        {"shape.randomize": True, "shape.pool": 2, "shape.parameters": {"belly": 1.0}},
    ],
)
def test_an_unstrained_body_of_any_shape_is_where_its_bones_put_it(make_batch, shape):
    """Bodies at rest in their first pose, two shapes a batch where they are random, drawn anew by the second reset."""
    batch = make_batch("PIAvatar/Stand-v0", 2, **shape)
    stage = Stage(batch.simulation)
    shapes, flesh = set(), batch.simulation.flesh[0]
    for _ in range(2):
        batch.reset()
        vertices = seen(batch, stage)
        for env in range(2):
            np.testing.assert_allclose(vertices[env], placed(batch, env), atol=2e-3)
            shapes.add(tuple(flesh.shape_parameters[env]))
    assert (len(shapes) > 1) == ("shape.randomize" in shape)


def test_colliders_are_drawn_but_planes_and_walls(make_batch):
    batch = make_batch("PIAvatar/Stand-v0", 2, **SOLIDS)
    batch.reset()
    stage = Stage(batch.simulation)
    vertices = seen(batch, stage)[1]
    wall, post = stage.parts[1:]
    assert (wall.name, wall.kind, post.name, post.kind) == ("wall", "box", "post", "capsule")
    turn = Rotation.from_quat([0.6, 0.0, 0.0, 0.8]).as_matrix()
    expected = (unit_mesh("box")[0] * [0.2, 0.1, 0.3]) @ turn.T + [1.0, 0.2, 0.4]
    np.testing.assert_allclose(vertices[wall.vertices], expected, atol=1e-6)
    assert vertices[post.vertices].min(axis=0) == pytest.approx([-1.1, -0.1, 0.1], abs=1e-2)


@wp.kernel
def hide_odd(visible: wp.array2d(dtype=wp.bool)):
    e, m = wp.tid()
    visible[e, m] = (e + m) % 2 == 0


def test_hidden_markers_are_nan(make_batch):
    batch = make_batch("PIAvatar/Stand-v0", 2)
    batch.reset()
    specs = [MarkerSpec("sphere", (0.1,), position=(0.0, 0.0, z)) for z in (0.5, 1.0)]
    stage, graph = Stage(batch.simulation, specs), LaunchGraph(batch.device)
    graph.launch(hide_odd, stage.markers.visible.shape, [stage.markers.visible])
    stage.record(graph)
    graph.run()
    vertices = stage.vertices.numpy()
    for env in range(2):
        for index, part in enumerate(stage.parts[1:]):
            own = vertices[env, part.vertices]
            if (env + index) % 2:
                assert np.isnan(own).all()
            else:
                np.testing.assert_allclose(own, Sphere((0.0, 0.0, 0.5 + 0.5 * index), 0.1).mesh()[0], atol=1e-6)
    assert np.isfinite(vertices[:, stage.parts[0].vertices]).all()


def test_games_have_all_their_avatars_and_markers(device):
    task = load_game_task("sumo_v0")
    batch = BatchEnv(task(load_config(task.Config, None, {"fidelity": "tiny"})), 2, device)
    batch.reset()
    stage = Stage(batch.simulation, batch.task.marker_specs())
    assert stage.subjects[:3] == ("ground", *batch.task.agent_names)
    vertices = seen(batch, stage)
    assert np.isfinite(vertices).all()
    rim = np.array([vertices[0, part.vertices].mean(axis=0) for part in stage.parts if part.name == MARKERS])
    assert np.linalg.norm(rim[:, :2], axis=1) == pytest.approx(batch.config.ring_radius, abs=1e-5)


@wp.kernel
def turn_all(direction: wp.array(dtype=wp.vec3), turn: wp.array(dtype=wp.quat)):
    i = wp.tid()
    turn[i] = turn_to(direction[i])


def test_a_marker_turns_to_any_direction(device):
    directions = np.random.default_rng(0).normal(size=(50, 3))
    directions[:2] = [0.0, 0.0, 1.0], [0.0, 0.0, -1.0]
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    turns = wp.zeros(len(directions), dtype=wp.quat, device=device)
    wp.launch(turn_all, len(directions), [wp.array(directions, dtype=wp.vec3, device=device)], [turns], device=device)
    np.testing.assert_allclose(Rotation.from_quat(turns.numpy()).apply([0.0, 0.0, 1.0]), directions, atol=1e-6)


def test_the_gate_is_the_ring_of_its_centre_and_direction(kicking):
    stage = Stage(kicking.simulation, kicking.task.marker_specs())
    vertices, course = seen(kicking, stage), kicking.task.course
    for env in range(3):
        center, normal = (array.numpy()[env] for array in (course.center, course.forward))
        ring = Ring(center, normal, kicking.config.target_radius).mesh()[0]
        np.testing.assert_allclose(vertices[env, stage.parts[-1].vertices], ring, atol=1e-5)


@pytest.mark.parametrize(
    ("settings", "message"), [(("cone", (0.1,)), "use one of sphere, box"), (("ring", (0.1,)), "give 2 numbers")]
)
def test_bad_markers_are_refused(settings, message):
    with pytest.raises(ValueError, match=message):
        MarkerSpec(*settings)
