"""Particles inside a body: no mass twice, weights that stay in their limb, bones that Kabsch can track; limb groups."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy.spatial import cKDTree

from piavatar_envs.avatar.body import sampling
from piavatar_envs.avatar.body.asset import dense_weights, mesh_volume
from piavatar_envs.avatar.body.sampling import (
    LIMB_GROUPS,
    LINK_LENGTH,
    ClosedSurface,
    limb_group_of_joint,
    limb_groups,
    morph,
    sample_particles,
    spacing_for,
)
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


@pytest.fixture(scope="module")
def surface(asset):
    return ClosedSurface(asset.vertices, asset.faces)


@pytest.fixture(scope="module")
def inside(asset, surface):
    """Return points drawn evenly in the body."""
    low, high = asset.vertices.min(axis=0), asset.vertices.max(axis=0)
    points = np.random.default_rng(0).uniform(low, high, (40000, 3))
    return points[surface.distance(points) < 0.0]


def people(asset):
    """Return the mean, ends of parameters that change the girth, and random people."""
    ends = [asset.parameters(**end) for end in ({"sex": -1}, {"weight": -1}, {"weight": 1}, {"height": -1})]
    return [np.zeros(len(asset.shape_names)), *ends, *asset.sample_parameters(np.random.default_rng(3), 3)]


def condition_number(points):
    """Return the ratio of the largest to the smallest singular value of the centred points."""
    values = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return values[0] / values[2]


def cube():
    """Return corners and outward oriented triangles of a unit cube about the origin."""
    corners = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
    quads = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
    return corners.astype(np.float32), np.array([[q[0], q[k], q[k + 1]] for q in quads for k in (1, 2)])


def test_surface_distance_of_a_cube():
    # Against the closed form, inside and outside; most lattice points lie below or above an edge or a vertex.
    corners, faces = cube()
    assert mesh_volume(corners, faces) == pytest.approx(1.0)
    surface = ClosedSurface(corners, faces)
    lattice = np.stack(np.meshgrid(*[np.linspace(-1.0, 1.0, 9)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    points = np.concatenate([np.random.default_rng(0).uniform(-1.0, 1.0, (500, 3)), lattice])
    excess = np.abs(points) - 0.5
    expected = np.linalg.norm(np.maximum(excess, 0), axis=1) + np.minimum(excess.max(axis=1), 0)
    distance, face, coordinates = surface.query(points)
    assert np.allclose(distance, expected, atol=1e-5)
    nearest = np.einsum("pc,pci->pi", coordinates, corners[faces[face]])
    assert np.allclose(np.linalg.norm(nearest - points, axis=1), np.abs(expected), atol=1e-5)


def test_points_in_two_limbs_are_inside():
    # Two cubes that overlap by a half: the middle is enclosed twice, and a bubble in a cube is outside.
    corners, faces = cube()
    two = ClosedSurface(np.concatenate([corners, corners + [0.0, 0.0, 0.5]]), np.concatenate([faces, 8 + faces]))
    heights = np.array([-0.6, -0.2, 0.2, 0.8, 1.2])
    points = np.stack([np.full(5, 0.1), np.full(5, 0.2), heights], axis=1)
    assert (two.distance(points) < 0.0).tolist() == [False, True, True, True, False]
    hollow = ClosedSurface(np.concatenate([corners, 0.5 * corners]), np.concatenate([faces, 8 + faces[:, ::-1]]))
    assert (hollow.distance(points) < 0.0).tolist() == [False, False, False, False, False]
    assert hollow.distance(points[:1] + [0.0, 0.0, 0.2])[0] == pytest.approx(-0.1)


def test_distance_near_the_surface(asset, surface):
    low, high = asset.vertices.min(axis=0) - 0.1, asset.vertices.max(axis=0) + 0.1
    points = np.random.default_rng(1).uniform(low, high, (20000, 3))
    exact, near = surface.distance(points), surface.distance_near(points, 0.02)
    within = np.abs(exact) <= 0.02
    assert np.array_equal(near[within], exact[within])
    assert np.array_equal(near < 0.0, exact < 0.0)
    assert np.all(np.isinf(near) | (near == exact)) and np.isinf(near).mean() > 0.5


def test_particles_are_inside_and_apart(surface, coarse):
    assert surface.distance(coarse.rest_positions).max() < 0.0
    unique = np.unique(coarse.rest_positions, axis=0)
    assert len(unique) == len(coarse)


def test_particles_fill_the_body(inside, coarse, coarse_spacing):
    # No point of the interior is further than a cell's diagonal from a particle: hands and feet included.
    nearest = cKDTree(coarse.rest_positions).query(inside)[0]
    assert len(inside) > 1000 and nearest.max() < np.sqrt(3.0) * coarse_spacing


def test_volumes_add_up_to_the_skin(asset, coarse, coarse_spacing):
    exact = mesh_volume(asset.vertices, asset.faces)
    assert coarse.volumes.sum() == pytest.approx(exact, rel=0.01)
    assert coarse.volumes.min() > 0.0 and coarse.volumes.max() < 4.0 * coarse_spacing**3


def test_mass_is_where_the_body_is(inside, coarse):
    # The particles' centre of mass and inertia are those of the solid, from a fine Monte Carlo sample.
    share = (coarse.volumes / coarse.volumes.sum()).astype(np.float64)
    centre = share @ coarse.rest_positions
    assert np.abs(centre - inside.mean(axis=0)).max() < 0.01
    spread = np.sqrt(share @ (coarse.rest_positions - centre) ** 2)
    assert np.allclose(spread, inside.std(axis=0), rtol=0.04)
    assert abs(centre[0]) < 1e-3  # a symmetric body has symmetric particles


def test_skin_weights(coarse):
    weights = coarse.skin_weights
    assert weights.shape == coarse.skin_joints.shape == (len(coarse), 4)
    assert weights.dtype == np.float32 and coarse.skin_joints.dtype == np.int32
    assert np.allclose(weights.sum(axis=1), 1.0, atol=1e-6) and (weights >= 0).all()
    assert (np.diff(weights, axis=1) <= 0).all()


def test_weights_stay_in_their_limb(asset, coarse):
    # No particle of a left limb follows a right one, none of a lower leg or forearm follows the trunk.
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


def test_links_do_not_cross_air_gaps(surface, coarse):
    middle = coarse.rest_positions[coarse.links].mean(axis=1)
    assert surface.distance(middle).max() < 0.0
    left_leg, right_leg = (
        np.isin(coarse.skin_joints[:, 0], [joint_index(f"{side}_{n}") for n in ("knee", "ankle", "foot")])
        for side in ("left", "right")
    )
    first, second = coarse.links.T
    assert not (left_leg[first] & right_leg[second]).any() and not (right_leg[first] & left_leg[second]).any()


def test_bone_particles(coarse):
    # At least 18 per joint, rigid, and spread in all three directions.
    for joint, name in enumerate(JOINT_NAMES):
        own = coarse.bone == joint
        assert own.sum() >= 18, name
        assert (coarse.skin_joints[own, 0] == joint).all() and (coarse.skin_weights[own, 0] == 1.0).all(), name
        assert condition_number(coarse.rest_positions[own]) <= 20.0, name
    assert coarse.bone.min() == -1 and coarse.bone.max() == NUM_JOINTS - 1


def test_feet_bear_on_their_heels(asset, coarse):
    # The centre of mass lies 12 mm ahead of the ankles: without bone behind them, it is beyond what feet support.
    for name in ("left_ankle", "right_ankle"):
        joint = joint_index(name)
        ahead = asset.joints[joint, 1] - coarse.rest_positions[coarse.bone == joint, 1]
        assert ahead.min() < -0.012 and ahead.max() > 0.08


def test_sampling_is_deterministic_and_seeded(asset):
    one, again, other = (sample_particles.__wrapped__(asset, 0.07, seed=seed) for seed in (0, 0, 1))
    for name in ("rest_positions", "volumes", "skin_joints", "skin_weights", "bone", "links"):
        assert np.array_equal(getattr(again, name), getattr(one, name)), name
    assert sample_particles(asset, 0.07) is sample_particles(asset, 0.07)  # cached
    assert not np.array_equal(other.rest_positions[other.bone < 0][:50], one.rest_positions[one.bone < 0][:50])
    with pytest.raises(ValueError, match="read-only"):
        one.volumes[0] = 1.0


def test_morphing_every_shape(asset, coarse):
    # Same count, inside the new skin, its volume, and bones still well spread.
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
    # A body stretched as a whole stretches its interior alike, and every volume by the same factor.
    stretch = np.array([1.1, 0.95, 1.2])
    wide = dataclasses.replace(asset, vertices=(asset.vertices * stretch).astype(np.float32))
    body = wide.mean_body()
    positions, volumes = morph(asset, coarse, body)
    error = np.linalg.norm(positions - coarse.rest_positions * stretch, axis=1)
    assert np.median(error) < 0.004 and error.max() < 0.015
    ratio = volumes / coarse.volumes / np.prod(stretch)
    assert np.median(np.abs(ratio - 1.0)) < 0.05


def test_fewer_points_are_searched_than_a_body_has(asset, coarse, coarse_spacing, monkeypatch):
    # Counted instead of timed: queries of the skin, and searches of the particle that is nearest to an interior point.
    counts = {"skin": 0, "nearest": 0}

    class Surface(ClosedSurface):
        def query(self, points):
            counts["skin"] += len(points)
            return super().query(points)

    class Tree(cKDTree):
        def query(self, x, **options):
            counts["nearest"] += len(x) * ("k" not in options)
            return super().query(x, **options)

    monkeypatch.setattr(sampling, "ClosedSurface", Surface)
    monkeypatch.setattr(sampling, "cKDTree", Tree)
    work = {}
    for spacing in (coarse_spacing, coarse_spacing / 1.6):
        counts.update(skin=0, nearest=0)
        found = sampling._sample(asset, spacing, 0, 4, 1.0)
        work[spacing] = {name: count / len(found["volumes"]) for name, count in counts.items()}
        if spacing == coarse_spacing:  # the searches that are left out change no bit
            np.testing.assert_array_equal(found["volumes"], coarse.volumes)
    once, finer = work.values()
    assert finer["nearest"] < once["nearest"] < 15.0  # of 27 in each cell
    assert finer["skin"] < 0.9 * once["skin"]


def test_the_mean_shape_is_not_solved_for(asset, coarse, monkeypatch):
    monkeypatch.setattr(sampling, "fill", lambda *arguments: pytest.fail("a harmonic function of no displacement"))
    rest, volumes = morph(asset, coarse, asset.mean_body())
    np.testing.assert_array_equal(rest, coarse.rest_positions)
    np.testing.assert_allclose(volumes, coarse.volumes, rtol=1e-6)


def test_the_threads_of_a_solution_do_not_matter(asset, coarse, monkeypatch):
    monkeypatch.setattr(sampling, "ROWS_AT_ONCE", 100)  # several blocks of rows
    known, values = coarse.shell | (coarse.bone >= 0), dense_weights(coarse.skin_joints, coarse.skin_weights)
    found = []
    for threads in (1, 5):
        monkeypatch.setattr(sampling, "available_cores", lambda threads=threads: threads)
        found.append(sampling.fill(coarse.links, coarse.rest_positions.astype(float), values, known))
    np.testing.assert_array_equal(*found)
    whole = np.where(known[:, None], values, found[0])
    assert np.abs(found[0] - whole).max() == 0.0 and np.abs(found[0].sum(axis=1) - 1.0).max() < 1e-4


@pytest.mark.parametrize(("spacing", "rings", "message"), [(0.0, 4, "0.0"), (np.nan, 4, "nan"), (0.05, 3, "=3")])
def test_absurd_samplings_are_refused(asset, spacing, rings, message):
    with pytest.raises(ValueError, match=message):
        sample_particles(asset, spacing, bone_rings=rings)


def test_a_joint_outside_the_skin_is_refused(asset):
    joints = asset.joints.copy()
    joints[joint_index("left_knee")] += [1.0, 0.0, 0.0]
    joints[joint_index("left_ankle")] += [1.0, 0.0, 0.0]
    broken = dataclasses.replace(asset, joints=joints)
    with pytest.raises(ValueError, match="left_hip lies outside"):
        sample_particles(broken, 0.05)


TORSO = LIMB_GROUPS.index("torso")


@pytest.fixture(scope="module")
def body(coarse):
    """Return particles, their limb groups and seams."""
    return coarse, *limb_groups(coarse.skin_joints, coarse.skin_weights)


def test_particles_lie_where_their_group_is(body):
    # A rigid bone particle is in its joint's group; the left limbs are on the left (+x).
    particles, group, _ = body
    bone = particles.bone >= 0
    assert np.array_equal(group[bone], limb_group_of_joint()[particles.bone[bone]])
    x, z = particles.rest_positions[:, 0], particles.rest_positions[:, 2]
    pelvis, neck = (load_asset().joints[joint_index(name), 2] for name in ("pelvis", "neck"))
    for index, name in enumerate(LIMB_GROUPS):
        if name.startswith("left"):
            assert x[group == index].min() > 0.0
        if name.startswith("right"):
            assert x[group == index].max() < 0.0
        if name.endswith("leg"):
            assert z[group == index].max() < pelvis + 0.12
    assert np.all(group[z > neck + 0.05] == TORSO)


def test_a_limb_hangs_on_the_torso_by_its_seam(body):
    # Wherever a limb and the torso are neighbours inside the body, seam particles of both are near.
    particles, group, seam = body
    for index in range(1, len(LIMB_GROUPS)):
        links = particles.links[(group[particles.links] == index).sum(axis=1) == 1]
        assert len(links) > 10
        for side in (index, TORSO):
            near = cKDTree(particles.rest_positions[(group == side) & (seam > 0)])
            assert near.query(particles.rest_positions[links].mean(axis=1))[0].max() < LINK_LENGTH * particles.spacing


def test_hands_feet_and_head_are_no_seam(body):
    # Parts that touch other parts of the body must be free of it.
    particles, _, seam = body
    for name in ("left_wrist", "right_wrist", "left_ankle", "right_foot", "left_elbow", "left_knee", "head"):
        assert not seam[particles.skin_joints[:, 0] == joint_index(name)].any(), name
    assert 0.05 < seam.mean() < 0.4
