"""Random bodies and poses for the tracking benchmark."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from piavatar_envs.avatar.body.asset import AvatarAsset
from piavatar_envs.avatar.body.skeleton import NUM_JOINTS, joint_limits

#: Share of every joint's range that random poses use. The paper does not say how large its poses are; half the range
#: is a large pose in every joint at once, and limbs seldom pass through each other.
JOINT_RANGE = 0.5
ROOT_TURN = 0.3  # standard deviation of each component of the root's rotation vector [rad]
ROOT_SHIFT = 0.05  # standard deviation of each component of the root's displacement [m]


def random_pose(rng: np.random.Generator, joint_range: float = JOINT_RANGE) -> tuple[np.ndarray, np.ndarray]:
    """Draw rotation vectors ``(22, 3)`` [rad], uniform in the joints' ranges, and the root's shift ``(3,)`` [m]."""
    lower, upper = joint_limits()
    rotation = joint_range * rng.uniform(lower, upper)
    rotation[0] = ROOT_TURN * rng.standard_normal(3)
    return rotation, ROOT_SHIFT * rng.standard_normal(3)


def random_poses(
    rng: np.random.Generator, count: int, joint_range: float = JOINT_RANGE
) -> tuple[np.ndarray, np.ndarray]:
    """Draw ``count`` independent poses: rotation vectors ``(count, 22, 3)`` [rad], root shifts ``(count, 3)`` [m]."""
    poses = [random_pose(rng, joint_range) for _ in range(count)]
    rotations = np.array([rotation for rotation, _ in poses]).reshape(count, NUM_JOINTS, 3)
    return rotations, np.array([shift for _, shift in poses]).reshape(count, 3)


def passing_through(rotations: np.ndarray, shifts: np.ndarray, steps: int) -> tuple[np.ndarray, np.ndarray]:
    """Interpolate poses along arcs from the rest pose on, ``steps`` steps each.

    Args:
        rotations: poses as rotation vectors [rad], shape ``(count, 22, 3)``.
        shifts: of the root [m], shape ``(count, 3)``.
        steps: from one pose to the next.

    Returns:
        Rotation vectors ``(count * steps, 22, 3)`` and shifts ``(count * steps, 3)``; every ``steps``-th is a pose.
    """
    share = np.arange(1, steps + 1) / steps
    turned, moved = [], []
    before, start = np.zeros_like(rotations[0]), np.zeros(3)
    for pose, shift in zip(rotations, shifts, strict=True):
        first = Rotation.from_rotvec(before)
        turn = (first.inv() * Rotation.from_rotvec(pose)).as_rotvec()
        turned += [(first * Rotation.from_rotvec(part * turn)).as_rotvec() for part in share]
        moved += [start + part * (shift - start) for part in share]
        before, start = pose, shift
    return np.array(turned), np.array(moved)


def random_shapes(asset: AvatarAsset, rng: np.random.Generator, count: int) -> np.ndarray:
    """Draw shape parameters of ``count`` bodies, the sexes alternating if that is one, shape ``(count, S)``."""
    shapes = asset.sample_parameters(rng, count)
    if "sex" not in asset.shape_names:
        return shapes
    shapes[:, asset.shape_names.index("sex")] = np.where(np.arange(count) % 2 == 0, -1.0, 1.0)
    return shapes


def random_directions(rng: np.random.Generator, count: int) -> np.ndarray:
    """Draw random unit vectors, shape ``(count, 3)``."""
    vectors = rng.standard_normal((count, 3))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
