"""One body, its particles and its skin for all rendering tests."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from piavatar_envs.avatar.body.asset import AvatarAsset, ShapedBody
from piavatar_envs.avatar.body.sampling import ParticleSet, morph, sample_particles
from piavatar_envs.avatar.body.skeleton import joint_index
from piavatar_envs.avatar.body.sources import load_asset
from piavatar_envs.render import Skin


@dataclass(frozen=True)
class Subject:
    """A shaped body with its particles and skin."""

    asset: AvatarAsset
    body: ShapedBody
    particles: ParticleSet
    positions: np.ndarray
    skin: Skin


@pytest.fixture(scope="session")
def subject() -> Subject:
    asset = load_asset()
    body = asset.shape(asset.parameters(sex=0.4, weight=0.3))
    particles = sample_particles(asset, spacing=0.035)
    positions, _ = morph(asset, particles, body)
    skin = Skin(asset, body, positions, particles.skin_joints, particles.skin_weights)
    return Subject(asset, body, particles, positions, skin)


@pytest.fixture(scope="session")
def bent_pose() -> np.ndarray:
    """Local rotations of a kick with a raised arm, shape ``(22, 3, 3)``."""
    from scipy.spatial.transform import Rotation

    rotations = np.tile(np.eye(3), (22, 1, 1))
    for joint, angles in {"left_hip": (-70, 0, 0), "left_knee": (60, 0, 0), "right_shoulder": (0, 50, 30)}.items():
        rotations[joint_index(joint)] = Rotation.from_euler("xyz", angles, degrees=True).as_matrix()
    return rotations
