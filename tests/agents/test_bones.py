"""The tree of rigid bones against mechanics: energy, virtual work, pendulums and springs in chains."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from agents.pid.bones import NUM_DOF, Bones, Posture, force_moments, in_bones
from piavatar_envs.avatar.body.skeleton import NUM_JOINTS, joint_index

GRAVITY = 9.81
STEP = 1e-6


@pytest.fixture(scope="module")
def bones() -> Bones:
    """A body of random bones."""
    rng = np.random.default_rng(0)
    joints = rng.normal(scale=0.3, size=(NUM_JOINTS, 3))
    spread = rng.normal(scale=0.1, size=(NUM_JOINTS, 3, 3))
    mass = rng.uniform(0.5, 8.0, NUM_JOINTS)
    inertia = mass[:, None, None] * (spread @ np.swapaxes(spread, 1, 2) + 1e-3 * np.eye(3))
    return Bones(mass, joints, joints + rng.normal(scale=0.1, size=(NUM_JOINTS, 3)), inertia)


@pytest.fixture(scope="module")
def local() -> np.ndarray:
    """Two random poses."""
    rng = np.random.default_rng(1)
    turns = Rotation.from_rotvec(rng.normal(scale=0.5, size=(2 * NUM_JOINTS, 3)))
    return turns.as_matrix().reshape(2, NUM_JOINTS, 3, 3)


def moved(bones: Bones, local: np.ndarray, velocity: np.ndarray, time: float) -> Posture:
    """The posture after ``time`` of a generalised velocity, about the bones' own axes."""
    turns = Rotation.from_rotvec(time * velocity[3:].reshape(-1, 3)).as_matrix()
    now = bones.posture(local @ turns)
    shift = time * velocity[:3]
    return Posture(now.rotation, now.joints + shift, now.centres + shift)


def rates(bones: Bones, local: np.ndarray, velocity: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Velocities of the centres and spins of all bones, by differences."""
    before, after = (moved(bones, local, velocity, sign * STEP) for sign in (-0.5, 0.5))
    turn = after.rotation @ np.swapaxes(before.rotation, -1, -2)
    spin = Rotation.from_matrix(turn.reshape(-1, 3, 3)).as_rotvec().reshape(turn.shape[:2] + (3,))
    return (after.centres - before.centres) / STEP, spin / STEP


def test_the_mass_matrix_gives_the_kinetic_energy(bones, local):
    velocity = np.random.default_rng(2).normal(size=NUM_DOF)
    linear, spin = rates(bones, local, velocity)
    rotation = bones.posture(local).rotation
    inertia = rotation @ bones.inertia @ np.swapaxes(rotation, -1, -2)
    wanted = 0.5 * np.einsum("b,nbi,nbi->n", bones.mass, linear, linear)
    wanted += 0.5 * np.einsum("nbi,nbij,nbj->n", spin, inertia, spin)
    matrix = bones.mass_matrix(bones.posture(local))
    np.testing.assert_allclose(0.5 * np.einsum("i,nij,j->n", velocity, matrix, velocity), wanted, rtol=1e-6)
    np.testing.assert_allclose(matrix, np.swapaxes(matrix, 1, 2), atol=1e-12)


def test_moments_of_weight_and_of_forces_do_the_work_that_they_do(bones, local):
    """Power of a moment about the bone's own axes is that of the force at what moves: virtual work."""
    velocity = np.random.default_rng(3).normal(size=NUM_DOF)
    velocity[:6] = 0.0  # the pelvis is held
    linear, spin = rates(bones, local, velocity)
    now = bones.posture(local)
    own = velocity[6:].reshape(-1, 3)

    weight = in_bones(now, bones.weight_moments(now, GRAVITY))[:, 1:]
    power = -GRAVITY * np.einsum("b,nb->n", bones.mass, linear[..., 2])
    np.testing.assert_allclose(np.einsum("nbi,bi->n", weight, own), power, rtol=1e-6)

    foot, force = joint_index("left_ankle"), np.array([[30.0, -20.0, 400.0], [-3.0, 5.0, 7.0]])
    place = now.centres[:, foot] + [0.02, -0.1, -0.03]
    speed = linear[:, foot] + np.cross(spin[:, foot], place - now.centres[:, foot])
    moments = in_bones(now, force_moments(now, foot, place, force))[:, 1:]
    np.testing.assert_allclose(np.einsum("nbi,bi->n", moments, own), (force * speed).sum(1), rtol=1e-6)
