"""Tracking: rotations from point sets, against closed forms and double-precision NumPy."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp
from scipy.spatial.transform import Rotation

from piavatar_envs.avatar.tracking import kabsch_rotation

#: What single precision leaves of a rotation fitted to well-spread points [rad].
ROUND_OFF = 1.0e-6


@wp.kernel
def fit_rotations(H: wp.array(dtype=wp.mat33), R: wp.array(dtype=wp.mat33)):
    i = wp.tid()
    R[i] = kabsch_rotation(H[i])


def fit(H: np.ndarray, device: str) -> np.ndarray:
    """Return rotations of correlations ``(N, 3, 3)``, by the code under test."""
    source = wp.array(np.ascontiguousarray(H, np.float32), dtype=wp.mat33, device=device)
    out = wp.zeros(len(H), dtype=wp.mat33, device=device)
    wp.launch(fit_rotations, len(H), [source], [out], device=device)
    return out.numpy().astype(float)


def reference(H: np.ndarray) -> np.ndarray:
    """Return the fit of Kabsch 1978 in double precision, with the explicit reflection fix."""
    U, _, Vt = np.linalg.svd(H.astype(np.float32).astype(float))
    flip = np.tile(np.eye(3), (len(H), 1, 1))
    flip[:, 2, 2] = np.sign(np.linalg.det(U @ Vt))
    return U @ flip @ Vt


def correlation(moved: np.ndarray, rest: np.ndarray) -> np.ndarray:
    moved, rest = (p - p.mean(-2, keepdims=True) for p in (moved, rest))
    return np.einsum("...pi,...pj->...ij", moved, rest)


def angle(A: np.ndarray, B: np.ndarray) -> np.ndarray:
    """Return the angle between rotations [rad]."""
    return Rotation.from_matrix(np.swapaxes(A, -1, -2) @ B).magnitude()


def assert_proper(R: np.ndarray) -> None:
    np.testing.assert_allclose(R @ np.swapaxes(R, -1, -2), np.broadcast_to(np.eye(3), R.shape), atol=1e-5)
    np.testing.assert_allclose(np.linalg.det(R), 1.0, atol=1e-5)


def random_motions(rng: np.random.Generator, count: int = 200, points: int = 20, flat: float = 1.0):
    """Return rest points, rotations and moved points."""
    rest = rng.normal(size=(count, points, 3)) * [1.0, 1.0, flat]
    R = Rotation.random(count, random_state=rng).as_matrix()
    return rest, R, rest @ np.swapaxes(R, -1, -2) + rng.normal(size=(count, 1, 3))


def test_rigid_motion_is_recovered(device):
    # thousands, because wp.svd3 errs by up to 6e-3 rad in the few whose singular values are close together
    rest, R, moved = random_motions(np.random.default_rng(0), count=5000)
    assert angle(fit(correlation(moved, rest), device), R).max() < ROUND_OFF


@pytest.mark.parametrize("scale", [1e-12, 2e-5, 1e9])
def test_size_of_the_correlation_does_not_matter(device, scale):
    # wp.svd3 itself errs by tens of degrees at traces near 2e-5
    rest, R, moved = random_motions(np.random.default_rng(1))
    H = correlation(moved, rest)
    H *= scale / np.linalg.norm(H, axis=(1, 2), keepdims=True)
    assert angle(fit(H, device), R).max() < ROUND_OFF


def test_planar_and_collinear_points_have_proper_rotations(device):
    rest, R, moved = random_motions(np.random.default_rng(2), flat=0.0)
    fitted = fit(correlation(moved, rest), device)
    assert_proper(fitted)
    assert angle(fitted, R).max() < 10 * ROUND_OFF
    rng = np.random.default_rng(3)
    rest, R, _ = random_motions(rng)
    rest = rest * [1.0, 0.0, 0.0]
    fitted = fit(correlation(rest @ np.swapaxes(R, -1, -2), rest), device)
    assert_proper(fitted)
    np.testing.assert_allclose(fitted[:, :, 0], R[:, :, 0], atol=1e-5)
    assert_proper(fit(np.zeros((1, 3, 3)), device))  # of no points at all


def test_reflected_points_get_the_best_proper_rotation(device):
    # flat sets whose noise turns them inside out: the correlation has a negative determinant
    rng = np.random.default_rng(4)
    rest, _, moved = random_motions(rng, count=2000, points=18, flat=0.05)
    H = correlation(moved + rng.normal(size=moved.shape) * 0.3, rest)
    reflected = np.linalg.det(H) < 0.0
    assert reflected.sum() > 100
    fitted, best = fit(H, device), reference(H)
    assert_proper(fitted)
    gain, most = (np.einsum("nij,nij->n", R, H) for R in (fitted, best))
    assert np.all(gain > most - 1e-5 * np.abs(most))
    # the two smallest singular values nearly cancel in some: there the rotation itself is not determined
    singular = np.linalg.svd(H, compute_uv=False)
    clear = reflected & (singular[:, 1] - singular[:, 2] > 0.05 * singular[:, 0])
    assert clear.sum() > 100
    assert angle(fitted[clear], best[clear]).max() < 10 * ROUND_OFF


def test_noise_in_the_points_becomes_noise_in_the_rotation(device):
    # To first order the error's variance is ``3 sigma^2 / (2 n)`` for ``n`` isotropic points of unit spread.
    rng, sigma = np.random.default_rng(5), 1e-2
    for points in (18, 72):
        rest, R, moved = random_motions(rng, count=1500, points=points)
        H = correlation(moved + sigma * rng.normal(size=moved.shape), rest)
        error = np.sqrt((angle(fit(H, device), R) ** 2).mean())
        assert error == pytest.approx(sigma * np.sqrt(3.0 / (2.0 * points)), rel=0.15)


def test_all_bones_of_a_moved_body_report_that_motion(make_rig):
    rig = make_rig()
    rng = np.random.default_rng(6)
    R, t = Rotation.random(random_state=rng).as_matrix(), rng.normal(size=3)
    rig.state.x.assign((rig.points.rest[0] @ R.T + t)[None].astype(np.float32))
    rig.track()
    rotation, position = rig.tracked_world()
    assert angle(rotation, R).max() < 5 * ROUND_OFF
    np.testing.assert_allclose(position, rig.points.joints[0] @ R.T + t, atol=2e-6)
    local = rig.avatar.tracked.local.numpy()[0]
    assert Rotation.from_quat(local[1:]).magnitude().max() < 10 * ROUND_OFF


def test_tracked_velocity_is_that_of_the_bones_particles(make_rig):
    rig = make_rig()
    rng = np.random.default_rng(7)
    u, vk = (rng.normal(size=(1, rig.points.num_points, 3)).astype(np.float32) for _ in range(2))
    rig.state.u.assign(u)
    rig.state.vk.assign(vk)
    rig.track()
    expected = [(u + vk)[0, rig.points.bone == bone].mean(0) for bone in range(22)]
    np.testing.assert_allclose(rig.avatar.tracked.velocity.numpy()[0], expected, atol=1e-6)


def test_tracked_pose_equals_the_commanded_pose_after_a_reset(make_rig, wild_pose):
    rng = np.random.default_rng(9)
    rig = make_rig()
    for _ in range(5):
        pose = wild_pose(rng, 0.9)
        rig.reset(pose, root=(0.1, -0.2, 1.0))
        command = Rotation.from_rotvec(pose)
        assert (command.inv() * Rotation.from_matrix(rig.tracked_local())).magnitude().max() < 1e-5
        np.testing.assert_allclose(rig.tracked_world()[1][0], (0.1, -0.2, 1.0), atol=1e-6)
