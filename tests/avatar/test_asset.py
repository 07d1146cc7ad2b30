"""The embedded body: closed, plausible and named as the rest of the world names it, in every shape."""

from __future__ import annotations

from importlib import resources

import numpy as np
import pytest

from piavatar_envs.avatar.body.asset import dense_weights, mesh_volume, top_weights
from piavatar_envs.avatar.body.skeleton import JOINT_NAMES, PARENTS, joint_index
from piavatar_envs.avatar.body.sources import load_asset

#: SMPL-H's joints after the 22 of the body, in its order.
HANDS = [
    f"{side}_{finger}{k}"
    for side in ("left", "right")
    for finger in ("index", "middle", "pinky", "ring", "thumb")
    for k in (1, 2, 3)
]


@pytest.fixture(scope="module")
def asset():
    return load_asset()


def body_file():
    return resources.files("piavatar_envs.data").joinpath("body.npz")


def shapes():
    """The mean, both ends of every parameter, all ends at once and 20 random people."""
    body = load_asset()
    count = len(body.shape_names)
    named = [("mean", np.zeros(count)), ("all at -1", -np.ones(count)), ("all at +1", np.ones(count))]
    for name in body.shape_names:
        named += [(f"{name} {end:+d}", body.parameters(**{name: end})) for end in (-1, 1)]
    people = body.sample_parameters(np.random.default_rng(0), 20)
    return named + [(f"random {i}", person) for i, person in enumerate(people)]


SHAPES = [pytest.param(parameters, id=name) for name, parameters in shapes()]


def mirrored(names):
    swap = {"left": "right", "right": "left"}
    return [names.index("_".join([swap.get(n.split("_")[0], n.split("_")[0]), *n.split("_")[1:]])) for n in names]


def test_skin_is_closed_and_consistently_oriented(asset):
    """Every edge belongs to exactly two triangles, which run along it in opposite directions.

    This holds for all shapes at once, for the shape moves only the vertices.
    """
    edges = np.concatenate([asset.faces[:, [0, 1]], asset.faces[:, [1, 2]], asset.faces[:, [2, 0]]])
    directed = {tuple(edge) for edge in edges.tolist()}
    assert len(directed) == len(edges)  # no directed edge twice
    assert directed == {(b, a) for a, b in directed}  # each with its reverse
    assert np.array_equal(np.unique(asset.faces), np.arange(len(asset.vertices)))  # no loose vertex


def test_skin_is_one_piece_without_handles(asset):
    """Euler's formula for a sphere: V - E + F = 2."""
    num_edges = 3 * len(asset.faces) // 2
    assert len(asset.vertices) - num_edges + len(asset.faces) == 2


@pytest.mark.parametrize("parameters", SHAPES)
def test_every_shape_is_a_plausible_solid(asset, parameters):
    body = asset.shape(parameters)
    assert np.isfinite(body.vertices).all() and np.isfinite(body.joints).all()
    height, volume = np.ptp(body.vertices[:, 2]), mesh_volume(body.vertices, asset.faces)
    assert 1.4 <= height <= 2.1
    # The bounds of the body mass index [kg/m^2] at 1000 kg/m^3: from starved to very obese, not beyond.
    assert 12.0 < 1000.0 * volume / height**2 < 40.0
    corners = body.vertices[asset.faces].astype(np.float64)
    areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2
    assert areas.min() > 0.0
    assert abs(body.vertices[:, 2].min()) < 1e-6
    assert np.abs(body.joints[0, :2]).max() < 1e-6


@pytest.mark.parametrize("parameters", SHAPES)
def test_joints_are_inside_and_legs_do_not_overlap(asset, parameters):
    """A joint outside the limb, or a left thigh right of the midplane, would wreck particles and contacts."""
    body = asset.shape(parameters)
    low, high = body.vertices.min(axis=0), body.vertices.max(axis=0)
    assert (body.joints > low).all() and (body.joints < high).all()
    left = np.char.startswith(np.array(JOINT_NAMES), "left")[asset.skin_joints[:, 0]]
    assert body.vertices[left, 0].min() > 0.0


def test_random_people_are_plausible(asset):
    people = asset.sample_parameters(np.random.default_rng(1), 100)
    heights = np.array([asset.height(person) for person in people])
    litres = 1e3 * np.array([asset.volume(person) for person in people])
    assert heights.min() > 1.45 and heights.max() < 2.0
    assert litres.min() > 40.0 and litres.max() < 130.0
    assert heights.std() > 0.05 and litres.std() > 5.0  # and not all the same


def test_volume_of_a_known_solid():
    """A tetrahedron with three unit legs has volume 1/6, wherever it is."""
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]])
    vertices += np.array([5.0, -3.0, 2.0])
    faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    assert mesh_volume(vertices, faces) == pytest.approx(1.0 / 6.0)


def test_names_and_parents_are_smplh(asset):
    with body_file().open("rb") as stream, np.load(stream, allow_pickle=False) as data:
        names, parents = data["joint_names"].tolist(), data["parents"].tolist()
    assert names == list(JOINT_NAMES) + HANDS
    assert tuple(parents[:22]) == PARENTS
    for finger, parent in zip(names[22:], parents[22:], strict=True):
        stem, segment = finger[:-1], int(finger[-1])
        expected = f"{stem}{segment - 1}" if segment > 1 else f"{finger.split('_')[0]}_wrist"
        assert names[parent] == expected


def test_file_is_small_and_needs_no_pickle():
    with resources.as_file(body_file()) as path:
        assert path.stat().st_size <= 1_000_000
    with body_file().open("rb") as stream, np.load(stream, allow_pickle=False) as data:
        assert not any(data[key].dtype.hasobject for key in data.files)


def test_licence_lies_beside_the_body():
    text = resources.files("piavatar_envs.data").joinpath("BODY_LICENSE.txt").read_text()
    assert "CC0" in text and "MakeHuman" in text and "Public License Fallback" in text


@pytest.mark.parametrize("parameters", SHAPES[:9])
def test_joints_are_mirror_symmetric(asset, parameters):
    joints = asset.shape(parameters).joints
    assert np.allclose(joints[mirrored(list(JOINT_NAMES))], joints * [-1, 1, 1], atol=1e-6)


def test_axes(asset):
    """Upright, facing -y, its left at +x."""
    at = {name: asset.joints[joint_index(name)] for name in JOINT_NAMES}
    assert at["left_wrist"][0] > at["left_shoulder"][0] > 0 > at["right_shoulder"][0] > at["right_wrist"][0]
    assert at["head"][2] > at["spine3"][2] > at["pelvis"][2] > at["left_knee"][2] > at["left_foot"][2] > 0
    assert at["left_foot"][1] < at["left_ankle"][1] - 0.05  # toes point to -y
    head = asset.vertices[asset.skin_joints[:, 0] == joint_index("head")]
    middle = head[np.abs(head[:, 0]) < 0.01]
    nose = middle[middle[:, 1].argmin()]  # the foremost point of the face is the nose, below the middle of the head
    assert nose[1] < at["head"][1] - 0.05 and nose[2] < head[:, 2].mean() + 0.03


def test_skin_weights(asset):
    assert asset.skin_weights.shape == asset.skin_joints.shape == (len(asset.vertices), 4)
    assert (asset.skin_weights >= 0).all() and np.allclose(asset.skin_weights.sum(axis=1), 1.0, atol=1e-6)
    assert (np.diff(asset.skin_weights, axis=1) <= 0).all()
    assert asset.skin_joints.min() >= 0 and asset.skin_joints.max() < 22
    dense = dense_weights(asset.skin_joints, asset.skin_weights)
    left = np.char.startswith(np.array(JOINT_NAMES), "left")
    right = np.char.startswith(np.array(JOINT_NAMES), "right")
    assert dense[left[dense.argmax(axis=1)]][:, right].max() == 0.0
    # Nothing of the fingers is lost: the outermost vertices belong to the wrists.
    assert asset.skin_joints[asset.vertices[:, 0].argmax(), 0] == joint_index("left_wrist")


def test_top_weights_keep_the_largest():
    joints, weights = top_weights(np.array([[0.1, 0.0, 0.5, 0.2, 0.2]]), count=2)
    assert joints.tolist() == [[2, 3]]
    assert weights[0] == pytest.approx([0.5 / 0.7, 0.2 / 0.7])


def test_parameters_do_what_they_say(asset):
    mean = np.zeros(len(asset.shape_names))
    assert len(asset.shape_names) >= 8
    assert asset.height(asset.parameters(height=1)) > asset.height(mean) + 0.1
    assert asset.height(asset.parameters(height=-1)) < asset.height(mean) - 0.1
    assert asset.volume(asset.parameters(weight=1)) > 1.2 * asset.volume(mean)
    assert asset.volume(asset.parameters(weight=-1)) < asset.volume(mean)
    shoulder, hip = joint_index("left_shoulder"), joint_index("left_hip")
    ratios = [
        (lambda joints: joints[shoulder, 0] / joints[hip, 0])(asset.shape(asset.parameters(sex=end)).joints)
        for end in (-1, 1)
    ]
    assert ratios[0] < ratios[1]  # -1 female, +1 male: broader shoulders over the hips
    leg = [np.ptp(asset.shape(asset.parameters(legs=e)).joints[[hip, joint_index("left_ankle")], 2]) for e in (-1, 1)]
    assert leg[1] > leg[0] + 0.05
    arm = [asset.shape(asset.parameters(arms=e)).joints[joint_index("left_wrist"), 0] for e in (-1, 1)]
    assert arm[1] > arm[0] + 0.02


def test_mean_shape_is_the_stored_one(asset):
    body = asset.mean_body()
    assert np.allclose(body.vertices, asset.vertices, atol=1e-6) and np.allclose(body.joints, asset.joints, atol=1e-6)


def test_sampler_is_seeded_and_bounded(asset):
    first = asset.sample_parameters(np.random.default_rng(7), 50)
    assert np.array_equal(first, asset.sample_parameters(np.random.default_rng(7), 50))
    assert not np.array_equal(first, asset.sample_parameters(np.random.default_rng(8), 50))
    assert first.shape == (50, len(asset.shape_names)) and np.abs(first).max() <= 1.0
    single = asset.sample_parameters(np.random.default_rng(7))
    assert single.shape == (len(asset.shape_names),)
    assert not asset.sample_parameters(np.random.default_rng(7), scale=0.0).any()
    with pytest.raises(ValueError, match=r"scale=1\.5.*\[0, 1\]"):
        asset.sample_parameters(np.random.default_rng(7), scale=1.5)


@pytest.mark.parametrize("value", [1.01, -3.0, np.nan, np.inf])
def test_bad_parameter_is_refused_by_index(asset, value):
    parameters = np.zeros(len(asset.shape_names))
    parameters[2] = value
    with pytest.raises(ValueError, match=rf"2 \({asset.shape_names[2]}\).*\[-1, 1\]"):
        asset.shape(parameters)


def test_wrong_number_of_parameters_is_refused(asset):
    with pytest.raises(ValueError, match=rf"pass {len(asset.shape_names)}: sex, age"):
        asset.shape(np.zeros(3))
    with pytest.raises(ValueError, match="unknown shape parameter 'nose'"):
        asset.parameters(nose=1.0)
