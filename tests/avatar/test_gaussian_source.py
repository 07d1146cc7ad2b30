"""Avatars of Gaussian splats: fitted bodies, poses, weights, axes and units, and what is refused."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest

from piavatar_envs.avatar.body.asset import AvatarAsset, dense_weights
from piavatar_envs.avatar.body.sampling import ClosedSurface, sample_particles
from piavatar_envs.avatar.body.skeleton import JOINT_NAMES, joint_index
from piavatar_envs.avatar.body.sources import check_settings, gaussian, load_asset, source_of
from piavatar_envs.avatar.body.sources.mesh import UPS
from piavatar_envs.avatar.body.splat_files import write_ply
from piavatar_envs.avatar.body.splat_registration import FittedBody
from piavatar_envs.config import ConfigError, load_config
from piavatar_envs.inspection import examine
from piavatar_envs.tasks import load_task
from scripts.synthetic_splats import on_body
from tests.avatar.characters import in_t_pose

COUNT = 3000
#: Rows: x, y, z of a file in which y points down, in our axes.
Y_DOWN = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])


@pytest.fixture(scope="module")
def person() -> AvatarAsset:
    """The body whose splats are in the file, as it rests."""
    asset = load_asset()
    shaped = asset.shape(asset.parameters(sex=0.6, weight=0.4, height=-0.5, legs=0.4, age=0.3))
    return dataclasses.replace(asset, vertices=shaped.vertices, joints=shaped.joints)


@pytest.fixture(scope="module")
def file(person, tmp_path_factory):
    """The person in a T-pose, in centimetres, y down."""
    path = tmp_path_factory.mktemp("splats") / "person.ply"
    cloud = on_body(person, COUNT, vertices=in_t_pose(person).vertices)
    write_ply(path, cloud.placed(Y_DOWN, 100.0, np.array([30.0, -20.0, 10.0])))
    return str(path)


@pytest.fixture(scope="module")
def body(file) -> AvatarAsset:
    return load_asset("gaussian", file, pose="T", up="-y")


def test_the_body_is_the_persons_as_it_rests(person, body):
    shift = body.joints[0] - person.joints[0]
    error = 100.0 * np.linalg.norm(body.joints - person.joints - shift, axis=1)
    assert error.mean() < 1.5 and error.max() < 3.0, f"{error.mean():.2f} cm, at most {error.max():.2f} cm"
    assert abs(np.ptp(body.vertices[:, 2]) - np.ptp(person.vertices[:, 2])) < 0.03


def test_the_splats_are_on_its_skin_at_rest(person, body):
    splats = body.look.splats
    away = 100.0 * np.abs(ClosedSurface(body.vertices, body.faces).distance(splats.cloud.means))
    assert away.mean() < 0.5 and away.max() < 2.5
    shift = (body.joints[0] - person.joints[0]).astype(np.float32)
    away = 100.0 * np.abs(ClosedSurface(person.vertices + shift, person.faces).distance(splats.cloud.means))
    assert away.mean() < 1.0
    # flat as they were, with their flat side along the skin
    _, face, _ = ClosedSurface(body.vertices, body.faces).query(splats.cloud.means)
    a, b, c = (body.vertices[body.faces[face, corner]] for corner in range(3))
    normals = np.cross(b - a, c - a)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    flat = np.linalg.eigh(splats.cloud.covariances())[1][:, :, 0]
    assert np.median(np.abs((flat * normals).sum(axis=1))) > 0.97


def test_weights_are_those_of_the_nearest_points(person, body):
    splats = body.look.splats
    np.testing.assert_allclose(splats.skin_weights.sum(axis=1), 1.0, atol=1e-6)
    shift = (body.joints[0] - person.joints[0]).astype(np.float32)
    _, face, at = ClosedSurface(person.vertices + shift, person.faces).query(splats.cloud.means)
    dense = dense_weights(person.skin_joints, person.skin_weights)[person.faces[face]]
    expected = np.einsum("sc,scj->sj", at, dense)
    found = dense_weights(splats.skin_joints, splats.skin_weights)
    assert 0.5 * np.abs(found - expected).sum(axis=1).mean() < 0.05


def test_particles_fill_it_and_its_skin_has_the_colours(body):
    assert len(sample_particles(body, 0.05)) > 300
    trousers = body.look.colors[(body.vertices[:, 2] > 0.4) & (body.vertices[:, 2] < 0.6)].mean(axis=0)
    np.testing.assert_allclose(trousers, [46, 64, 115], atol=20)


def test_the_source_is_found_by_the_file(file, tmp_path):
    assert source_of("x.spz") == source_of(file) == "gaussian"
    (tmp_path / "a.ply").write_bytes(b"ply\nformat ascii 1.0\nelement vertex 0\nproperty float x\nend_header\n")
    (tmp_path / "a.gltf").write_text('{"extensionsUsed": ["KHR_gaussian_splatting"]}')
    assert source_of(tmp_path / "a.ply") == source_of("none.ply") == "mesh"
    assert source_of(tmp_path / "a.gltf") == "gaussian" and source_of("none.gltf") == "glb"


def test_settings_of_another_body_are_settings(file, body):
    given = {"pose": "T", "up": "-y", "body": {"source": "embedded", "appearance": "skin"}}
    found = load_asset("gaussian", file, **given)
    assert found is load_asset("gaussian", file, **given)
    np.testing.assert_array_equal(found.vertices, body.vertices)
    task = load_task("PIAvatar/Reach-v0")
    settings = {f"avatar.{name}": value for name, value in {"source": "gaussian", "path": file, **given}.items()}
    config = load_config(task.Config, None, settings)
    assert config.avatar.settings["body"] == given["body"]
    for value in ({"source": "a"}, {"other": {"source": "embedded"}}, "embedded"):
        with pytest.raises(ConfigError, match=r"body|unknown avatar source 'a'"):
            load_config(task.Config, None, settings | {"avatar.body": value})


def test_a_report_names_the_splats(file, tmp_path):
    pytest.importorskip("PIL")
    found = examine(Path(file), {"pose": "T", "up": "-y"}, tmp_path / "a.png")
    assert found["source"] == "gaussian" and found["splats"] == f"{COUNT}, with colours of degree 1"
    assert (tmp_path / "a.png").is_file()


@pytest.fixture
def fitted(person, body, monkeypatch):
    """Replaces the fit, which takes seconds, by the body as it rests."""
    maps = np.tile(np.eye(3, 4), (22, 1, 1))
    found = FittedBody(np.zeros(3), 1.0, body.vertices, body.joints, body.vertices, maps, 0.005)
    calls = []
    monkeypatch.setattr(gaussian, "_fitted", lambda *given: calls.append(given) or found)
    return calls


def test_axes_units_and_poses_reach_the_fit(person, fitted, tmp_path):
    cloud = on_body(person, COUNT)
    write_ply(tmp_path / "a.ply", cloud.placed(Y_DOWN, 1000.0, np.zeros(3)))
    (tmp_path / "p.json").write_text(json.dumps({"left_shoulder": [0.0, 0.5, 0.0]}))
    gaussian.build(str(tmp_path / "a.ply"), pose=str(tmp_path / "p.json"))
    clouds = [call[1] for call in fitted]
    assert len(clouds) == 2  # both ways up
    heights = [np.abs(cloud.means[:, 2] - 1.0).mean() for cloud in clouds]
    assert min(heights) < 1.0 and all(1.5 < np.ptp(cloud.means[:, 2]) < 2.1 for cloud in clouds)
    _, _, starts, pose, _ = fitted[0]
    assert starts == ("A",)
    np.testing.assert_allclose(pose[joint_index("left_shoulder")] @ [0, 0, 1], [np.sin(0.5), 0, np.cos(0.5)])


def test_axes_that_seldom_point_up_are_tried_when_no_other_fits(person, fitted, tmp_path, monkeypatch):
    cloud = on_body(person, COUNT)
    write_ply(tmp_path / "a.ply", cloud.placed(UPS["-x"].T, 1.0, np.zeros(3)))
    near, top, tried = gaussian._fitted(), cloud.means[:, 2].argmax(), []

    def fit(asset, placed, *others):
        tried.append(bool(placed.means[top, 2] > 0.99 * placed.means[:, 2].max()))
        return near if tried[-1] else dataclasses.replace(near, residual=0.04)

    monkeypatch.setattr(gaussian, "_fitted", fit)
    gaussian.build(str(tmp_path / "a.ply"))
    assert sum(tried) == 1 and not tried[0]


def test_weights_of_a_file_are_those_of_our_joints(person, fitted, tmp_path):
    cloud = on_body(person, COUNT)
    write_ply(tmp_path / "a.ply", cloud)
    weights = np.zeros((COUNT, 55))
    weights[:, 30] = 3.0  # a finger of the left hand
    weights[1] = np.eye(55)[23]  # an eye
    weights[2] = np.eye(55)[54]
    np.savez(tmp_path / "w.npz", weights=weights)
    asset = gaussian.build(str(tmp_path / "a.ply"), up="z", weights=str(tmp_path / "w.npz"))
    first = asset.look.splats.skin_joints[:4, 0]
    assert [JOINT_NAMES[joint] for joint in first] == ["left_wrist", "head", "right_wrist", "left_wrist"]
    for bad, message in ((weights[:5], r"shape \(5, 55\), not \(3000, J\)"), (weights - 1.0, "not negative")):
        np.savez(tmp_path / "w.npz", weights=bad)
        with pytest.raises(ValueError, match=message):
            gaussian.build(str(tmp_path / "a.ply"), up="z", weights=str(tmp_path / "w.npz"))


def test_splats_as_particles(body):
    splats = body.look.splats
    points = gaussian.SurfacePoints(splats.cloud.means, splats.skin_joints, splats.skin_weights)
    own = sample_particles(dataclasses.replace(body, surface_points=points), 0.05)
    plain = sample_particles(body, 0.05)
    assert COUNT + 200 < len(own) < COUNT + len(plain)
    assert own.volumes.sum() == pytest.approx(plain.volumes.sum(), rel=1e-5) and own.volumes.min() > 0.0
    order = np.lexsort(own.rest_positions.T)
    found = own.rest_positions[order]
    for point in splats.cloud.means[:5]:
        assert np.abs(found - point).max(axis=1).min() < 1e-6
    assert (own.bone >= 0).sum() == (plain.bone >= 0).sum()


@pytest.mark.parametrize(
    ("name", "rows", "value", "message"),
    [
        ("means", [7], 1e20, r"^a.ply: 1 splats are farther away .* 16\.\d+ .* 10 times the body's height; delete"),
        ("scales", [3, 7], 5e34, r"^a.ply: 2 splats are larger than 1\.6\d+ .* 1 times the body's height; delete"),
    ],
)
@pytest.mark.filterwarnings("error")
def test_splats_of_absurd_place_or_size_are_refused(person, tmp_path, name, rows, value, message):
    cloud = on_body(person, COUNT)
    getattr(cloud, name)[rows] = value
    write_ply(tmp_path / "a.ply", cloud)
    with pytest.raises(ValueError, match=message):
        load_asset("gaussian", tmp_path / "a.ply", up="z")


def test_what_does_not_fit_is_refused(person, tmp_path, monkeypatch):
    cloud = on_body(person, COUNT)
    write_ply(tmp_path / "few.ply", cloud.chosen(np.arange(50)))
    write_ply(tmp_path / "big.ply", cloud.placed(np.eye(3), 17.0, np.zeros(3)))
    write_ply(tmp_path / "a.ply", cloud)
    bad = FittedBody(*(np.zeros((1, 3)),), 1.0, *(np.eye(3),) * 3, np.zeros((22, 3, 4)), 0.04)
    monkeypatch.setattr(gaussian, "_fitted", lambda *_: bad)
    for name, given, message in (
        ("few.ply", {}, "50 splats are more opaque than 0.5"),
        ("big.ply", {}, "give its height in metres"),
        ("a.ply", {"up": "w"}, "up='w' is not an axis.*z, y, x, -z, -y, -x"),
        ("a.ply", {"pose": "B"}, "pose='B' is none of A, T and no .json"),
        ("a.ply", {"height": 9.0}, r"height=9 is outside \[0.3, 3\]"),
        ("a.ply", {"body": {"source": "no"}}, "unknown avatar source 'no'"),
        ("a.ply", {}, "a.ply: the body does not fit to the splats.*remove the background"),
    ):
        with pytest.raises(ValueError, match=message):
            load_asset("gaussian", tmp_path / name, **{"up": "z", **given})
    with pytest.raises(ValueError, match="body='smplx'"):
        check_settings("gaussian", {"path": "a.ply", "body": "smplx"})
