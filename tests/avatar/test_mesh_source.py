"""Surfaces without a skeleton: joints and weights by registration, units and axes, and what is refused."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from piavatar_envs.avatar.body.character import Character
from piavatar_envs.avatar.body.registration import Registered
from piavatar_envs.avatar.body.sampling import sample_particles
from piavatar_envs.avatar.body.skeleton import joint_index
from piavatar_envs.avatar.body.sources import load_asset, mesh, source_of
from scripts.gltf_files import rig_of
from tests.avatar.characters import in_t_pose
from tests.avatar.test_rigs import named

trimesh = pytest.importorskip("trimesh")

COLOR = (10, 200, 30)


@pytest.fixture(scope="module")
def person() -> Character:
    """A body of another shape in a T-pose."""
    asset = load_asset()
    body = asset.shape(asset.parameters(sex=0.6, weight=0.4, height=-0.5, legs=0.4, age=0.3))
    return in_t_pose(dataclasses.replace(asset, vertices=body.vertices, joints=body.joints))


@pytest.fixture(scope="module")
def file(person, tmp_path_factory):
    """The same in centimetres, y up, facing +z, with colours and without anything else."""
    path = tmp_path_factory.mktemp("mesh") / "person.ply"
    vertices = 100.0 * person.vertices[:, [0, 2, 1]] * [1.0, 1.0, -1.0]
    colors = np.tile(np.array([[*COLOR, 255]], np.uint8), (len(vertices), 1))
    trimesh.Trimesh(vertices, person.faces, vertex_colors=colors, process=False).export(path)
    return path


@pytest.fixture(scope="module")
def read(file) -> Character:
    return mesh.read_character(str(file))


def test_joints_of_a_registered_body_are_within_centimetres(person, read):
    np.testing.assert_allclose(read.vertices, person.vertices, atol=0.01)  # it faces -y again
    error = 100.0 * np.linalg.norm(read.joints - person.joints, axis=1)
    assert error.mean() < 1.0 and error.max() < 2.5, f"{error.mean():.2f} cm, at most {error.max():.2f} cm"


def test_weights_are_those_of_the_nearest_points(person, read):
    np.testing.assert_allclose(read.weights.sum(axis=1), 1.0, atol=1e-6)
    assert 0.5 * np.abs(read.weights - person.weights).sum(axis=1).mean() < 0.03
    assert (read.weights.argmax(axis=1) == person.weights.argmax(axis=1)).mean() > 0.95


def test_unit_axis_and_fit_are_noted(read):
    assert [note for note in read.notes if "centimetres" in note] and "y points up" in read.notes
    assert any("registered body" in note for note in read.notes)


def test_the_body_of_a_mesh_has_particles_and_its_colours(file, person):
    body = load_asset("mesh", file)
    volume = trimesh.Trimesh(person.vertices, person.faces, process=False).volume
    assert body.volume([]) == pytest.approx(volume, rel=0.02)
    assert (body.look.colors == COLOR).all()
    assert len(sample_particles(body, 0.05)) > 300
    assert source_of(file) == "mesh"


def test_a_height_wins_over_the_unit_of_the_file():
    column = np.array([[0.0, 0.0, 0.0], [0.1, 0.1, 17.0]])
    scaled, notes = mesh.in_metres("x", column, 1.7)
    assert scaled[1, 2] == pytest.approx(1.7) and "1.7 m" in notes[0]
    for tall, unit in ((1.7, "metres"), (170.0, "centimetres"), (1700.0, "millimetres")):
        scaled, notes = mesh.in_metres("x", column * (tall / 17.0), None)
        assert scaled[1, 2] == pytest.approx(1.7) and unit in notes[0]
    with pytest.raises(ValueError, match=r"17 units tall.*height"):
        mesh.in_metres("x", column, None)
    with pytest.raises(ValueError, match=r"height=9 .*0.3, 3"):
        mesh.in_metres("x", column, 9.0)


def test_a_surface_that_the_body_does_not_fit_to_is_refused(file, monkeypatch):
    bad = Registered(np.zeros(3), np.zeros(11), np.zeros((22, 3)), np.zeros((1, 22)), residual=0.04)
    monkeypatch.setattr(mesh, "_registered", lambda *_: bad)
    with pytest.raises(ValueError, match=r"person.ply: the body does not fit.* 6\.\d cm away.*A- or T-pose.*, -x\)"):
        mesh.read_character(str(file))
    with pytest.raises(ValueError, match=r"up='w' is not an axis.*z, y, x, -z, -y, -x"):
        mesh.read_character(str(file), up="w")


@pytest.mark.parametrize("up", mesh.UPS)
@pytest.mark.parametrize("ahead", range(2))
def test_any_axis_may_point_up(person, tmp_path, monkeypatch, up, ahead):
    def registered(name, vertices, faces):  # in place of the fit, which takes seconds
        rises = vertices[person.vertices[:, 2].argmax(), 2] - vertices[person.vertices[:, 2].argmin(), 2]
        residual = 0.004 if rises > 0.99 * np.ptp(vertices[:, 2]) else 0.04
        return Registered(np.zeros(3), np.zeros(11), person.joints, person.weights, residual)

    monkeypatch.setattr(mesh, "_registered", registered)
    turned = (
        person.vertices @ np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]) if ahead else person.vertices
    )
    trimesh.Trimesh(100.0 * turned @ mesh.UPS[up], person.faces, process=False).export(tmp_path / "a.ply")
    for given in ({}, {"up": up}):
        read = mesh.read_character(str(tmp_path / "a.ply"), **given)
        assert f"{up} points up" in read.notes
        np.testing.assert_allclose(read.vertices[:, 2], turned[:, 2], atol=1e-5)
        assert np.linalg.det(read.placement[0]) == pytest.approx(1e-6)  # turned, not mirrored


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.obj", b"v 0 0 0\nv 1 0 0\n", "a.obj"),
        ("a.ply", b"ply\nformat binary_little_endian 1.0\nelement vertex 4000000000\n", "a.ply is not a readable"),
        ("a.stl", b"solid nonsense", "a.stl"),
        ("a.off", b"OFF\n1 1 0\nnan nan nan\n3 0 0 0\n", "a.off"),
        ("a.fbx", b"Kaydara", "unknown mesh format.*use one of .obj"),
    ],
)
def test_files_that_are_no_surface_are_refused(tmp_path, name, content, message):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(ValueError, match=message):
        mesh.build(str(tmp_path / name))
    with pytest.raises(FileNotFoundError):
        mesh.build(str(tmp_path / "none.obj"))


def test_a_skeleton_is_in_the_coordinates_of_the_file(person, file, read, tmp_path):
    names = {"left_hip": "left_knee", "right_knee": "right_ankle", "left_shoulder": "left_elbow"}
    for bone, end in names.items():
        ends = 100.0 * person.joints[[joint_index(bone), joint_index(end)]][:, [0, 2, 1]] * [1.0, 1.0, -1.0]
        trimesh.creation.cylinder(0.8, segment=ends).export(tmp_path / f"{bone}.ply")
    body = load_asset("mesh", path=str(file), skeleton=str(tmp_path))
    for bone, end in names.items():
        start, stop = body.joints[joint_index(bone)], body.joints[joint_index(end)]
        axis = (stop - start) / np.linalg.norm(stop - start)
        own = body.skeleton.points[body.skeleton.bone == joint_index(bone)]
        assert np.linalg.norm(np.cross(own - start, axis), axis=1).max() < 0.03  # as the registered joints


def test_a_quantised_glb_without_its_skin_is_a_surface(tmp_path):
    rig = rig_of(load_asset(), named("mixamo"), storage="quantized", material={"name": "skin"})
    path = rig.write().save(tmp_path / "a.glb")
    vertices, faces, colors, textures = mesh.load_surface(path)
    assert np.ptp(vertices[:, 1]) == pytest.approx(np.ptp(rig.vertices[:, 2]), abs=1e-4)
    assert len(faces) == len(rig.faces) and (colors == 255).all() and textures is None
