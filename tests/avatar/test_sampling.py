"""Interior particles: inside, no mass twice, weights that stay in their limb, bones that Kabsch can track."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from piavatar_envs.avatar.body import sampling as harmonic
from piavatar_envs.avatar.body.asset import AvatarAsset, dense_weights, mesh_volume
from piavatar_envs.avatar.body.sampling import ClosedSurface, morph, sample_particles, spacing_for
from piavatar_envs.avatar.body.skeleton import JOINT_NAMES, NUM_JOINTS, joint_index
from piavatar_envs.avatar.body.sources import load_asset

SIDE = np.array([name.startswith("left") * 1 - name.startswith("right") * 1 for name in JOINT_NAMES])


@pytest.fixture(scope="module")
def asset():
    return load_asset()


@pytest.fixture(scope="module")
def coarse_spacing(asset):
    return spacing_for(np.ptp(asset.vertices[:, 2]) / 32)


@pytest.fixture(scope="module")
def coarse(asset, coarse_spacing):
    return sample_particles(asset, coarse_spacing)


def people(asset):
    """The mean, every end of a parameter that changes the girth, and random people."""
    ends = [asset.parameters(**{name: end}) for name in ("sex", "weight", "height", "age") for end in (-1, 1)]
    return [np.zeros(len(asset.shape_names)), *ends, *asset.sample_parameters(np.random.default_rng(3), 5)]


def condition_number(points):
    """Of the centred points: how much worse the worst axis of a rotation is known than the best."""
    values = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return values[0] / values[2]


def test_surface_distance_of_a_cube():
    """Against the closed form for a unit cube about the origin, inside and outside."""
    corners = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
    quads = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
    faces = np.array([[q[0], q[k], q[k + 1]] for q in quads for k in (1, 2)])
    assert mesh_volume(corners, faces) == pytest.approx(1.0)
    cube = ClosedSurface(corners.astype(np.float32), faces)
    points = np.random.default_rng(0).uniform(-1.0, 1.0, (500, 3))
    excess = np.abs(points) - 0.5
    expected = np.linalg.norm(np.maximum(excess, 0), axis=1) + np.minimum(excess.max(axis=1), 0)
    distance, face, coordinates = cube.query(points)
    assert np.allclose(distance, expected, atol=1e-5)
    nearest = np.einsum("pc,pci->pi", coordinates, corners[faces[face]])
    assert np.allclose(np.linalg.norm(nearest - points, axis=1), np.abs(expected), atol=1e-5)


def test_particles_of_few_bones_come_first(coarse):
    """Bones' own before all; those of the same bones together, with what is their own: links still join neighbours."""
    assert (np.diff((coarse.bone < 0).astype(int)) >= 0).all()
    bones = (coarse.skin_weights > 0.0).sum(axis=1)
    assert set(bones) == {1, 2, 3, 4}
    assert (np.diff(bones) >= 0).all()
    moved_by = [tuple(sorted(j[w > 0.0])) for j, w in zip(coarse.skin_joints, coarse.skin_weights, strict=True)]
    flesh = np.array(moved_by, dtype=object)[coarse.bone < 0]
    assert (1 + sum(a != b for a, b in itertools.pairwise(flesh))) == len(set(flesh))
    a, b = coarse.rest_positions[coarse.links].transpose(1, 0, 2)
    assert np.linalg.norm(a - b, axis=1).max() < 2.0 * coarse.spacing
    corners = load_asset().vertices[coarse.anchor_vertices]
    on_skin = np.einsum("pc,pci->pi", coarse.anchor_weights, corners)
    gap = np.linalg.norm(on_skin - coarse.rest_positions, axis=1)
    np.testing.assert_allclose(gap[coarse.depth > 0.0], coarse.depth[coarse.depth > 0.0], atol=1e-5)


def test_coarse_count(coarse):
    assert 2500 <= len(coarse) <= 3000


def test_particles_are_inside_and_apart(asset, coarse, coarse_spacing):
    assert ClosedSurface(asset.vertices, asset.faces).distance(coarse.rest_positions).max() < 0.0
    unique = np.unique(coarse.rest_positions, axis=0)
    assert len(unique) == len(coarse)


def test_particles_fill_the_body(asset, coarse, coarse_spacing):
    """No point of the interior is further than a cell's diagonal from a particle: hands and feet included."""
    rng = np.random.default_rng(0)
    low, high = asset.vertices.min(axis=0), asset.vertices.max(axis=0)
    points = rng.uniform(low, high, (40000, 3))
    points = points[ClosedSurface(asset.vertices, asset.faces).distance(points) < 0.0]
    nearest = np.min(np.linalg.norm(points[:, None] - coarse.rest_positions[None], axis=-1), axis=1)
    assert len(points) > 1000 and nearest.max() < np.sqrt(3.0) * coarse_spacing


def test_volumes_add_up_to_the_skin(asset, coarse, coarse_spacing):
    exact = mesh_volume(asset.vertices, asset.faces)
    assert coarse.volumes.sum() == pytest.approx(exact, rel=0.01)
    assert coarse.volumes.min() > 0.0 and coarse.volumes.max() < 4.0 * coarse_spacing**3


def test_mass_is_where_the_body_is(asset, coarse):
    """The particles' centre of mass and inertia are those of the solid, from a fine Monte Carlo sample."""
    rng = np.random.default_rng(1)
    low, high = asset.vertices.min(axis=0), asset.vertices.max(axis=0)
    points = rng.uniform(low, high, (60000, 3))
    points = points[ClosedSurface(asset.vertices, asset.faces).distance(points) < 0.0]
    share = (coarse.volumes / coarse.volumes.sum()).astype(np.float64)
    centre = share @ coarse.rest_positions
    assert np.abs(centre - points.mean(axis=0)).max() < 0.01
    spread = np.sqrt(share @ (coarse.rest_positions - centre) ** 2)
    assert np.allclose(spread, points.std(axis=0), rtol=0.04)
    assert abs(centre[0]) < 1e-3  # a symmetric body has symmetric particles


def test_skin_weights(coarse):
    weights = coarse.skin_weights
    assert weights.shape == coarse.skin_joints.shape == (len(coarse), 4)
    assert weights.dtype == np.float32 and coarse.skin_joints.dtype == np.int32
    assert np.allclose(weights.sum(axis=1), 1.0, atol=1e-6) and (weights >= 0).all()
    assert (np.diff(weights, axis=1) <= 0).all()


def test_weights_stay_in_their_limb(asset, coarse):
    """No particle of a left limb follows a right one, none of a lower leg or forearm follows the trunk."""
    dense = dense_weights(coarse.skin_joints, coarse.skin_weights)
    owner = dense.argmax(axis=1)
    other = SIDE[owner][:, None] * SIDE[None, :] < 0
    assert dense[other].max() == 0.0
    trunk = [joint_index(name) for name in ("pelvis", "spine1", "spine2", "spine3", "neck", "head")]
    for side in ("left", "right"):
        for limb in ("knee", "ankle", "foot", "elbow", "wrist"):
            assert dense[owner == joint_index(f"{side}_{limb}")][:, trunk].max() == 0.0
    legs = [joint_index(f"{side}_{name}") for side in ("left", "right") for name in ("hip", "knee", "ankle", "foot")]
    arms = [joint_index(f"{side}_{name}") for side in ("left", "right") for name in ("shoulder", "elbow", "wrist")]
    assert (np.minimum(dense[:, legs].sum(axis=1), dense[:, arms].sum(axis=1))).max() == 0.0


def test_left_particles_are_on_the_left(coarse):
    owner = coarse.skin_joints[:, 0]
    side = SIDE[owner]
    assert (coarse.rest_positions[side > 0, 0] > 0).all() and (coarse.rest_positions[side < 0, 0] < 0).all()


def test_links_do_not_cross_air_gaps(asset, coarse):
    middle = coarse.rest_positions[coarse.links].mean(axis=1)
    assert ClosedSurface(asset.vertices, asset.faces).distance(middle).max() < 0.0
    left_leg, right_leg = (
        np.isin(coarse.skin_joints[:, 0], [joint_index(f"{side}_{n}") for n in ("knee", "ankle", "foot")])
        for side in ("left", "right")
    )
    first, second = coarse.links.T
    assert not (left_leg[first] & right_leg[second]).any() and not (right_leg[first] & left_leg[second]).any()


def test_bone_particles(coarse):
    """At least 18 a joint, rigid, and spread in all three directions."""
    for joint, name in enumerate(JOINT_NAMES):
        own = coarse.bone == joint
        assert own.sum() >= 18, name
        assert (coarse.skin_joints[own, 0] == joint).all() and (coarse.skin_weights[own, 0] == 1.0).all(), name
        assert condition_number(coarse.rest_positions[own]) <= 20.0, name
    assert coarse.bone.min() == -1 and coarse.bone.max() == NUM_JOINTS - 1


def test_more_rings_make_more_bone_particles(asset):
    particles = sample_particles(asset, 0.05, bone_rings=8)
    assert (np.bincount(particles.bone[particles.bone >= 0]) == 40).all()


def test_sampling_is_deterministic_and_seeded(asset, coarse, coarse_spacing):
    again = sample_particles.__wrapped__(asset, coarse_spacing)
    for name in ("rest_positions", "volumes", "skin_joints", "skin_weights", "bone", "links"):
        assert np.array_equal(getattr(again, name), getattr(coarse, name)), name
    assert sample_particles(asset, coarse_spacing) is coarse  # cached
    other = sample_particles(asset, coarse_spacing, seed=1)
    assert not np.array_equal(other.rest_positions[other.bone < 0][:50], coarse.rest_positions[coarse.bone < 0][:50])
    with pytest.raises(ValueError, match="read-only"):
        coarse.volumes[0] = 1.0


def test_morphing_every_shape(asset, coarse):
    """Same count, inside the new skin, its volume, and bones still well spread."""
    for parameters in people(asset):
        body = asset.shape(parameters)
        positions, volumes = morph(asset, coarse, body)
        assert positions.shape == (len(coarse), 3) and volumes.shape == (len(coarse),)
        assert positions.dtype == volumes.dtype == np.float32
        assert ClosedSurface(body.vertices, asset.faces).distance(positions).max() < 0.002
        assert volumes.sum() == pytest.approx(mesh_volume(body.vertices, asset.faces), rel=0.01)
        assert volumes.min() > 0.0
        assert max(condition_number(positions[coarse.bone == joint]) for joint in range(NUM_JOINTS)) <= 20.0


def test_morphing_to_the_mean_changes_nothing(asset, coarse):
    positions, volumes = morph(asset, coarse, asset.mean_body())
    assert np.allclose(positions, coarse.rest_positions, atol=1e-6)
    assert np.allclose(volumes, coarse.volumes, rtol=1e-4)


def test_morphing_is_exact_for_an_affine_change(asset, coarse):
    """A body stretched as a whole stretches its interior alike, and every volume by the same factor."""
    stretch = np.array([1.1, 0.95, 1.2])
    wide = AvatarAsset(**{**vars(asset), "vertices": (asset.vertices * stretch).astype(np.float32)})
    body = wide.mean_body()
    positions, volumes = morph(asset, coarse, body)
    error = np.linalg.norm(positions - coarse.rest_positions * stretch, axis=1)
    assert np.median(error) < 0.004 and error.max() < 0.015
    ratio = volumes / coarse.volumes / np.prod(stretch)
    assert np.median(np.abs(ratio - 1.0)) < 0.05


def test_harmonic_fill_reproduces_linear_functions():
    """A linear function is harmonic: on a regular lattice it is recovered exactly from its boundary values."""
    side = 6
    points = np.stack(np.meshgrid(*[np.arange(side)] * 3, indexing="ij"), axis=-1).reshape(-1, 3).astype(float)
    index = np.arange(side**3).reshape((side,) * 3)
    links = np.concatenate(
        [
            np.stack([np.take(index, range(side - 1), a).ravel(), np.take(index, range(1, side), a).ravel()], axis=1)
            for a in range(3)
        ]
    )
    exact = points @ [[1.0, 0.0], [2.0, -1.0], [0.5, 3.0]]
    known = ((points == 0) | (points == side - 1)).any(axis=1)
    guess = np.where(known[:, None], exact, 0.0)
    assert np.allclose(harmonic.fill(links, points, guess, known), exact, atol=1e-4)


def test_volume_ratio_of_an_affine_map():
    rng = np.random.default_rng(0)
    points = rng.uniform(-1.0, 1.0, (60, 3))
    links = np.array([(i, j) for i in range(60) for j in range(i)])
    matrix = np.diag([1.2, 0.9, 1.1]) + 0.1 * rng.standard_normal((3, 3))
    assert np.allclose(harmonic.volume_ratios(links, points, points @ matrix.T), np.linalg.det(matrix), rtol=0.01)


@pytest.mark.parametrize("spacing", [0.0, -0.03, 0.09, np.nan])
def test_absurd_spacing_is_refused(asset, spacing):
    with pytest.raises(ValueError, match=r"outside \(0, 0\.08\]"):
        sample_particles(asset, spacing)


def test_too_few_rings_are_refused(asset):
    with pytest.raises(ValueError, match=r"bone_rings=3.*use 4 or more"):
        sample_particles(asset, 0.05, bone_rings=3)


def test_a_joint_outside_the_skin_is_refused(asset):
    joints = asset.joints.copy()
    joints[joint_index("left_knee")] += [1.0, 0.0, 0.0]
    joints[joint_index("left_ankle")] += [1.0, 0.0, 0.0]
    broken = AvatarAsset(**{**vars(asset), "joints": joints})
    with pytest.raises(ValueError, match="left_hip lies outside"):
        sample_particles(broken, 0.05)
