"""The embedded body: closed, plausible and named as the rest of the world names it, in every shape."""

from __future__ import annotations

from importlib import resources

import numpy as np
import pytest

from piavatar_envs.avatar.body.asset import mesh_volume
from piavatar_envs.avatar.body.skeleton import JOINT_NAMES, joint_index
from piavatar_envs.avatar.body.sources import load_asset


@pytest.fixture(scope="module")
def asset():
    return load_asset()


def body_file():
    return resources.files("piavatar_envs.data").joinpath("body.npz")


def shapes(body):
    """Return the mean, all ends at once, both ends of every parameter, and 50 random people."""
    count = len(body.shape_names)
    ends = [body.parameters(**{name: end}) for name in body.shape_names for end in (-1, 1)]
    return np.array([np.zeros(count), -np.ones(count), np.ones(count), *ends, *people(body)])


def people(body):
    return body.sample_parameters(np.random.default_rng(0), 50)


def mirrored(names):
    swap = {"left": "right", "right": "left"}
    return [names.index("_".join([swap.get(n.split("_")[0], n.split("_")[0]), *n.split("_")[1:]])) for n in names]


def test_skin_is_closed_and_consistently_oriented(asset):
    # Every edge belongs to exactly two triangles, which run along it in opposite directions. This holds for all shapes
    # at once, for the shape moves only the vertices.
    edges = np.concatenate([asset.faces[:, [0, 1]], asset.faces[:, [1, 2]], asset.faces[:, [2, 0]]])
    directed = {tuple(edge) for edge in edges.tolist()}
    assert len(directed) == len(edges)  # no directed edge twice
    assert directed == {(b, a) for a, b in directed}  # each with its reverse
    assert np.array_equal(np.unique(asset.faces), np.arange(len(asset.vertices)))  # no loose vertex


def test_skin_is_one_piece_without_handles(asset):
    # Euler's formula for a sphere: V - E + F = 2.
    num_edges = 3 * len(asset.faces) // 2
    assert len(asset.vertices) - num_edges + len(asset.faces) == 2


def test_every_shape_is_a_plausible_body(asset):
    # Solid, joints inside, mirror-symmetric, legs apart: a left thigh right of the midplane would wreck contacts.
    left = np.char.startswith(np.array(JOINT_NAMES), "left")[asset.skin_joints[:, 0]]
    for parameters in shapes(asset):
        body = asset.shape(parameters)
        assert np.isfinite(body.vertices).all() and np.isfinite(body.joints).all()
        height, volume = np.ptp(body.vertices[:, 2]), mesh_volume(body.vertices, asset.faces)
        assert 1.4 <= height <= 2.1
        # The bounds of the body mass index [kg/m^2] at 1000 kg/m^3: from starved to very obese, not beyond.
        assert 12.0 < 1000.0 * volume / height**2 < 40.0
        corners = body.vertices[asset.faces].astype(np.float64)
        areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2
        assert areas.min() > 0.0
        assert abs(body.vertices[:, 2].min()) < 1e-6 and np.abs(body.joints[0, :2]).max() < 1e-6
        low, high = body.vertices.min(axis=0), body.vertices.max(axis=0)
        assert (body.joints > low).all() and (body.joints < high).all()
        assert body.vertices[left, 0].min() > 0.0
        assert np.allclose(body.joints[mirrored(list(JOINT_NAMES))], body.joints * [-1, 1, 1], atol=1e-6)


def test_random_people_differ(asset):
    heights, litres = (np.array([size(p) for p in people(asset)]) for size in (asset.height, asset.volume))
    assert heights.std() > 0.05 and litres.std() > 0.005


def test_file_is_small_and_needs_no_pickle():
    with resources.as_file(body_file()) as path:
        assert path.stat().st_size <= 1_000_000
    with body_file().open("rb") as stream, np.load(stream, allow_pickle=False) as data:
        assert not any(data[key].dtype.hasobject for key in data.files)


def test_licence_lies_beside_the_body():
    text = resources.files("piavatar_envs.data").joinpath("BODY_LICENSE.txt").read_text()
    assert "CC0" in text and "MakeHuman" in text and "Public License Fallback" in text


def test_axes(asset):
    # Upright, facing -y, its left at +x.
    at = {name: asset.joints[joint_index(name)] for name in JOINT_NAMES}
    assert at["left_wrist"][0] > at["left_shoulder"][0] > 0 > at["right_shoulder"][0] > at["right_wrist"][0]
    assert at["head"][2] > at["spine3"][2] > at["pelvis"][2] > at["left_knee"][2] > at["left_foot"][2] > 0
    assert at["left_foot"][1] < at["left_ankle"][1] - 0.05  # toes point to -y
    head = asset.vertices[asset.skin_joints[:, 0] == joint_index("head")]
    middle = head[np.abs(head[:, 0]) < 0.01]
    nose = middle[middle[:, 1].argmin()]  # the foremost point of the face is the nose, below the middle of the head
    assert nose[1] < at["head"][1] - 0.05 and nose[2] < head[:, 2].mean() + 0.03


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
