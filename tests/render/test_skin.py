"""Skin: exact under rigid motions and skinning, smooth, and local."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from piavatar_envs.avatar.body import skeleton
from piavatar_envs.avatar.body.asset import Look, PoseDisplacements
from piavatar_envs.avatar.body.pose_correctives import PoseCorrectives
from piavatar_envs.render import Skin

REST = np.tile(np.eye(3), (22, 1, 1))


def test_the_rest_pose_gives_the_rest_vertices(subject):
    vertices = subject.skin.deform(REST, subject.body.joints, subject.positions)
    assert vertices.dtype == np.float32
    np.testing.assert_allclose(vertices, subject.body.vertices, atol=1e-6)


def test_the_same_body_is_baked_once(subject):
    """Environments with equal bodies share a skin; another body, or other particles, have one of their own."""
    points, asset = subject.particles, subject.asset
    first, again = (
        Skin.baked(asset, subject.body, subject.positions.copy(), points.skin_joints.copy(), points.skin_weights)
        for _ in range(2)
    )
    assert first is again
    other = Skin.baked(asset, subject.body, subject.positions + 1e-3, points.skin_joints, points.skin_weights)
    assert other is not first
    rest = other.deform(REST, subject.body.joints, subject.positions + 1e-3)
    np.testing.assert_allclose(rest, subject.body.vertices, atol=1e-6)


def test_a_rigid_motion_is_exact(subject):
    rotation = Rotation.from_rotvec([0.7, -1.9, 0.4]).as_matrix()
    shift = np.array([1.5, -0.7, 2.0])
    vertices = subject.skin.deform(
        rotation @ REST, subject.body.joints @ rotation.T + shift, subject.positions @ rotation.T + shift
    )
    np.testing.assert_allclose(vertices, subject.body.vertices @ rotation.T + shift, atol=1e-6)


def test_particles_at_their_skinned_places_leave_plain_skinning(subject, bent_pose):
    joints = subject.body.joints
    rotations, positions = skeleton.forward_kinematics(bent_pose, joints[0], joints)
    particles = subject.particles
    skinned = skeleton.skin(
        subject.positions, particles.skin_joints, particles.skin_weights, rotations, positions, joints
    )
    expected = skeleton.skin(
        subject.body.vertices, subject.asset.skin_joints, subject.asset.skin_weights, rotations, positions, joints
    )
    assert np.abs(expected - subject.body.vertices).max() > 0.3
    np.testing.assert_allclose(subject.skin.deform(rotations, positions, skinned), expected, atol=1e-5)


def test_displacements_by_the_pose_stand_in_place_of_those_of_the_particles(subject, bent_pose):
    """A knee has both, in the mesh and in the particles: the drawn bulge is the mesh's, once."""
    joints, points, knee = subject.body.joints, subject.particles, skeleton.joint_index("left_knee")
    rng = np.random.default_rng(0)
    directions = np.zeros((len(subject.body.vertices), 3, 21, 9), np.float32)
    directions[:, :, knee - 1] = rng.normal(0.0, 0.02, (len(directions), 3, 9))
    turn = Rotation.from_rotvec([0.3, 0.2, -0.4]).as_matrix()
    pose = PoseDisplacements(directions, np.tile(turn, (22, 1, 1)))
    look = Look(subject.body.vertices, subject.asset.faces, subject.asset.skin_joints, subject.asset.skin_weights, None,
                subject.asset.shape_deltas, pose)  # fmt: skip
    count = len(points)
    linear = rng.normal(0.0, 0.02, (count, 3, 3))
    correctives = PoseCorrectives(np.arange(count + 1), np.full(count, knee), linear, np.zeros((count, 3, 3)))
    own = Skin(look, subject.body, subject.positions, points.skin_joints, points.skin_weights, correctives)
    rotations, positions = skeleton.forward_kinematics(bent_pose, joints[0], joints)
    quaternions = Rotation.from_matrix(bent_pose).as_quat()
    moved = subject.positions + correctives.displacement(quaternions)
    skinned = skeleton.skin(moved, points.skin_joints, points.skin_weights, rotations, positions, joints)
    # the mesh counts rotations from a pose that all bones are turned from: turn^T R turn of each joint
    change = turn.T @ bent_pose[knee] @ turn - np.eye(3)
    bulge = directions[:, :, knee - 1] @ change.ravel()
    assert np.linalg.norm(bulge, axis=1).max() > 0.02
    expected = skeleton.skin(
        subject.body.vertices + bulge, look.skin_joints, look.skin_weights, rotations, positions, joints
    )
    np.testing.assert_allclose(own.deform(rotations, positions, skinned), expected, atol=1e-5)
    np.testing.assert_allclose(own.deform(REST, joints, subject.positions), subject.body.vertices, atol=1e-6)


def test_a_uniform_displacement_moves_the_skin_by_it(subject, bent_pose):
    joints = subject.body.joints
    rotations, positions = skeleton.forward_kinematics(bent_pose, joints[0], joints)
    shift = np.array([0.03, -0.02, 0.05])
    moved = subject.skin.deform(rotations, positions, subject.positions + shift)
    still = subject.skin.deform(rotations, positions, subject.positions)
    np.testing.assert_allclose(moved - still, np.broadcast_to(shift, moved.shape), atol=1e-6)


def test_a_limb_takes_nothing_from_its_neighbour(subject):
    """Move the particles of one leg, which touches the other."""
    leg = [skeleton.joint_index(f"right_{name}") for name in ("hip", "knee", "ankle", "foot")]
    share = joint_share(subject.particles.skin_joints, subject.particles.skin_weights, leg)
    positions = subject.positions.astype(np.float64).copy()
    positions[share > 0.99] += [0.0, 0.0, 0.1]
    moved = np.linalg.norm(subject.skin.deform(REST, subject.body.joints, positions) - subject.body.vertices, axis=1)
    vertex_share = joint_share(subject.asset.skin_joints, subject.asset.skin_weights, leg)
    assert moved[vertex_share == 0.0].max() < 1e-6
    assert np.median(moved[vertex_share > 0.99]) == pytest.approx(0.1, abs=1e-3)


def test_interpolation_keeps_constants_and_bounds(subject):
    count = subject.skin.num_particles
    np.testing.assert_allclose(subject.skin.interpolate(np.full(count, 3.7)), 3.7, atol=1e-12)
    values = np.random.default_rng(0).uniform(-1.0, 2.0, count)
    carried = subject.skin.interpolate(values)
    assert carried.shape == (len(subject.body.vertices),)
    assert values.min() - 1e-12 <= carried.min() and carried.max() <= values.max() + 1e-12


def test_the_skin_follows_a_smooth_displacement(subject):
    """Reproduce a height field of the particles to a fraction of their spacing."""

    def height(points: np.ndarray) -> np.ndarray:
        return 0.1 * np.sin(2.0 * points[:, 2])

    error = subject.skin.interpolate(height(subject.positions)) - height(subject.body.vertices)
    # The steepest slope is 0.2; a vertex's particles lie within about two spacings of it.
    assert np.abs(error).max() < 0.2 * 2.0 * 0.035


def test_noise_of_particles_does_not_crumple_the_skin(subject):
    """Displace particles by 5 mm each, a seventh of their spacing: hardly any edge is stretched by much."""
    noise = 0.005 * np.random.default_rng(0).normal(size=(subject.skin.num_particles, 3))
    moved = subject.skin.interpolate(noise)
    faces, vertices = subject.asset.faces, subject.body.vertices
    a, b = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).T
    stretch = np.linalg.norm(moved[a] - moved[b], axis=1) / np.linalg.norm(vertices[a] - vertices[b], axis=1)
    assert np.median(stretch) < 0.05 and np.percentile(stretch, 99) < 0.25


def test_bad_particles_are_refused(subject):
    particles = subject.particles
    with pytest.raises(ValueError, match="one row per particle"):
        Skin(subject.asset, subject.body, subject.positions[1:], particles.skin_joints, particles.skin_weights)
    with pytest.raises(ValueError, match="at least one"):
        Skin(subject.asset, subject.body, np.zeros((0, 3)), particles.skin_joints[:0], particles.skin_weights[:0])
    with pytest.raises(ValueError, match="particle_positions"):
        subject.skin.deform(REST, subject.body.joints, subject.positions[1:])


def joint_share(joints: np.ndarray, weights: np.ndarray, wanted: list[int]) -> np.ndarray:
    """Return the sum of the weights that belong to the wanted joints, shape ``(N,)``."""
    return np.where(np.isin(joints, wanted), weights, 0.0).sum(axis=1)
