"""Correctives of a body's skinning: displacements in the rest pose by which bent joints keep the volume of flesh.

Linear blend skinning changes volume. Already to first order: a waist that bends about the spine, which lies behind its
middle, is squeezed in front. To second order: the mean of two turned images of a particle lies inside of the arc.
Animation adds displacements to the rest pose that depend on the pose (Lewis, Cordner & Fong, "Pose space deformation",
2000; Loper et al., "SMPL", 2015), fitted to scans. Here they follow from incompressibility. With the unit quaternion
``(v, w)`` of each joint, a particle at ``X`` is skinned from

    X + sum_c (A_c 2 w_c v_c + B_c 2 v_c * v_c),

where ``A_c`` and ``B_c`` are matrices 3 x 3 of the particle and ``*`` multiplies by components. Both features are
smooth in the rotation, also through half a turn, and do not depend on the sign of the quaternion.

For a joint bent about one axis, with ``J`` the determinant of the skinning's gradient, the displacement ``du`` of

    min sum_p |du_p|^2   so that   div du = 1 - J

is a gradient of a pressure that vanishes at the skin, as in a projection onto incompressible flow (Chorin 1968): the
skin yields, where that is least motion. A few such steps make ``J`` 1 at any angle; those at :data:`ANGLE` to either
side give ``A`` and ``B``. Divergence and ``J`` are fitted to the neighbours of a particle by moving least squares, as
in :mod:`piavatar_envs.mpm.measured_strain`. Only flesh that several bones move is displaced.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable
from dataclasses import dataclass, fields, replace
from functools import lru_cache

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import splu
from scipy.spatial.transform import Rotation

from piavatar_envs.avatar.body import interpolation, sampling, skeleton
from piavatar_envs.avatar.body.asset import AvatarAsset, dense_weights, turned_shares
from piavatar_envs.avatar.body.interpolation import interpolation_matrix, rest_gradient
from piavatar_envs.avatar.body.sampling import ParticleSet, sample_particles, spacing_for
from piavatar_envs.avatar.body.skeleton import BEYOND, NUM_JOINTS
from piavatar_envs.core.result_cache import digest_of, kept

#: Angle from which the coefficients are taken, to either side [rad].
ANGLE = np.radians(40.0)
#: Steps towards ``J = 1`` at this angle.
STEPS = 4
#: Largest change of volume that one step corrects: flesh that is folded has no displacement that unfolds it.
LARGEST_CHANGE = 0.3
#: Compressibility of the projection over the diagonal of its matrix: it damps what alternates between particles.
SOFTNESS = 1.0
#: A joint whose displacements of a particle stay below this is left out [m].
LEAST = 0.0005
#: Particles from which a coefficient of another spacing is interpolated.
NEIGHBOURS = 8
#: Coefficients of other spacings are interpolated from particles of a grid with so many cells over the height.
CELLS_PER_HEIGHT = 32
#: Largest spacing of particles over the body's height that resolves how flesh makes way; coarser bodies get none.
COARSEST = 0.03
#: Arrays of an asset and of its particles on which the correctives depend.
_GIVEN = (
    "vertices", "faces", "joints", "skin_joints", "skin_weights", "skeleton", "spacing", "rest_positions", "bone",
    "links",
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class PoseCorrectives:
    """Coefficients of the particles of a body: those of particle ``p`` are ``[start[p] : start[p + 1]]``.

    Attributes:
        start: shape ``(P + 1,)`` int32.
        joint: joint that an entry belongs to, shape ``(N,)`` int32.
        linear: the matrices ``A``, shape ``(N, 3, 3)`` float32 [m].
        quadratic: the matrices ``B``, likewise.
    """

    start: np.ndarray
    joint: np.ndarray
    linear: np.ndarray
    quadratic: np.ndarray

    def displacement(self, local_rotations: np.ndarray) -> np.ndarray:
        """Return the displacements in the rest pose [m], shape ``(P, 3)``.

        Args:
            local_rotations: quaternions of the joints relative to their parents, ``xyzw``, shape ``(22, 4)``.
        """
        first, second = features(np.asarray(local_rotations, float))
        each = np.einsum("nij,nj->ni", self.linear, first[self.joint])
        each += np.einsum("nij,nj->ni", self.quadratic, second[self.joint])
        owner = np.repeat(np.arange(len(self.start) - 1), np.diff(self.start))
        return np.stack([np.bincount(owner, column, len(self.start) - 1) for column in each.T], axis=1)


def features(quaternions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return ``2 w v`` and ``2 v * v`` of unit quaternions ``xyzw``, both ``(..., 3)``."""
    v, w = quaternions[..., :3], quaternions[..., 3:]
    return 2.0 * w * v, 2.0 * v * v


@lru_cache(maxsize=8)
def pose_correctives(asset: AvatarAsset, particles: ParticleSet) -> PoseCorrectives:
    """Return the correctives of an asset's particles in its mean shape; other shapes use the same."""
    of_both = [getattr(one, field.name) for one in (asset, particles) for field in fields(one) if field.name in _GIVEN]
    digest = digest_of(of_both, [sys.modules[__name__], interpolation, sampling, skeleton])
    doing = f"fitting how the flesh of {asset.name} makes way at bent joints"
    correctives = PoseCorrectives(**kept("correctives", digest, lambda: vars(_fitted(asset, particles)), doing))
    for field in fields(correctives):
        getattr(correctives, field.name).setflags(write=False)
    return correctives


def _fitted(asset: AvatarAsset, particles: ParticleSet) -> PoseCorrectives:
    """Fit the correctives, or interpolate those of other particles."""
    spacing = spacing_for(float(np.ptp(asset.vertices[:, 2])) / CELLS_PER_HEIGHT)
    if np.isclose(particles.spacing, spacing, rtol=0.01) and asset.surface_points is None:
        every = np.arange(len(particles))
        return _listed(((every, own) for own in fit_correctives(particles, asset.joints.astype(float))), len(every))
    plain = asset if asset.surface_points is None else replace(asset, surface_points=None)
    coarse = sample_particles(plain, spacing)
    fitted = fit_correctives(coarse, asset.joints.astype(float))
    yields = np.flatnonzero(_yields(particles))
    others = dense_weights(particles.skin_joints[yields], particles.skin_weights[yields])
    weights = dense_weights(coarse.skin_joints, coarse.skin_weights)
    places = particles.rest_positions[yields].astype(float), coarse.rest_positions.astype(float)
    matrix = interpolation_matrix(places[0], others, places[1], weights, NEIGHBOURS)
    return _listed((_interpolated(matrix, yields, own) for own in fitted), len(particles))


def _interpolated(
    matrix: sparse.csr_array, particles: np.ndarray, coefficients: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the particles to which the rows of an interpolation bring coefficients ``(P, 3, 6)``, and those."""
    rows = np.flatnonzero(matrix @ coefficients.any(axis=(1, 2)).astype(float))
    return particles[rows], (matrix[rows] @ coefficients.reshape(-1, 18)).reshape(-1, 3, 6)


def _yields(particles: ParticleSet) -> np.ndarray:
    """Return the flags of flesh that several bones move, shape ``(P,)`` bool."""
    return (particles.skin_weights[:, 1] > 0.0) & (particles.bone < 0)


def fit_correctives(particles: ParticleSet, joints: np.ndarray) -> np.ndarray:
    """Fit ``A`` and ``B``, side by side, of every joint and particle, shape ``(22, P, 3, 6)`` [m].

    Args:
        particles: a body in its mean shape.
        joints: rest joint positions [m], shape ``(22, 3)``.
    """
    rest, weights = particles.rest_positions.astype(float), particles.skin_weights.astype(float)
    weights /= weights.sum(axis=1, keepdims=True)
    along, known = rest_gradient(rest, particles.links)
    project = _projection(along, _yields(particles))
    share = turned_shares(particles.skin_joints, particles.skin_weights)
    fitted = np.zeros((NUM_JOINTS, len(rest), 3, 6))
    for joint in range(1, NUM_JOINTS):
        # elsewhere this joint moves a particle with all its neighbours rigidly
        varies = sum(np.abs(own @ share[:, joint]) for own in along) > 1e-6
        zone = np.flatnonzero(varies & known)
        rows = [own[zone] for own in along]
        turns = [np.eye(3)[axis] * angle for axis in range(3) for angle in (ANGLE, -ANGLE)]
        moves = np.zeros((6, len(rest), 3))
        for _ in range(STEPS):
            change = np.zeros((len(rest), 6))
            for column, turn in enumerate(turns):
                change[zone, column] = _volume_ratio(
                    rest + moves[column], particles, weights, joints, joint, turn, rows
                )
            change[zone] = np.clip(change[zone] - 1.0, -LARGEST_CHANGE, LARGEST_CHANGE)
            moves += project(change)
        for axis in range(3):
            ahead, back = moves[2 * axis], moves[2 * axis + 1]
            fitted[joint, :, :, axis] = (ahead - back) / (2.0 * np.sin(ANGLE))
            fitted[joint, :, :, 3 + axis] = (ahead + back) / (2.0 * (1.0 - np.cos(ANGLE)))
    return fitted


def _volume_ratio(
    rest: np.ndarray,
    particles: ParticleSet,
    weights: np.ndarray,
    joints: np.ndarray,
    joint: int,
    turn: np.ndarray,
    rows: list[sparse.csr_matrix],
) -> np.ndarray:
    """Return ``J`` of the skinning with one ``joint`` turned by a rotation vector, at the particles of ``rows``."""
    moved = BEYOND[joint, particles.skin_joints]
    share = (weights * moved).sum(axis=1)[:, None]
    matrix = Rotation.from_rotvec(turn).as_matrix()
    place = rest + share * ((rest - joints[joint]) @ (matrix - np.eye(3)).T)
    return np.linalg.det(np.stack([own @ place for own in rows], axis=-1))


def _projection(along: list[sparse.csr_matrix], free: np.ndarray):
    """Return the function that takes changes of volume ``(P, K)`` to displacements that undo them, ``(K, P, 3)``."""
    mask = sparse.diags(free.astype(float))
    onto = [own @ mask for own in along]
    matrix = sum(own @ own.T for own in onto)
    diagonal = matrix.diagonal()
    factor = splu((matrix + sparse.diags(np.where(diagonal > 0.0, SOFTNESS * diagonal, 1.0))).tocsc())

    def project(change: np.ndarray) -> np.ndarray:
        pressure = factor.solve(-change)
        return np.stack([own.T @ pressure for own in onto], axis=-1).transpose(1, 0, 2)

    return project


def _listed(fitted: Iterable[tuple[np.ndarray, np.ndarray]], count: int) -> PoseCorrectives:
    """Return the coefficients of each of ``count`` particles in a list, without the negligible.

    Args:
        fitted: of each joint some particles, in order, and their coefficients ``(n, 3, 6)``.
        count: particles of the body.
    """
    particles, joints, found = [], [], []
    for joint, (which, both) in enumerate(fitted):
        size = np.linalg.norm(both, axis=1)
        kept = np.flatnonzero(size[:, :3].max(axis=1) + size[:, 3:].max(axis=1) > LEAST)
        particles.append(which[kept])
        joints.append(np.full(len(kept), joint))
        found.append(both[kept])
    particle = np.concatenate(particles)
    order = np.argsort(particle, kind="stable")
    both = np.concatenate(found)[order].astype(np.float32)
    start = np.searchsorted(particle[order], np.arange(count + 1)).astype(np.int32)
    joint = np.concatenate(joints)[order].astype(np.int32)
    return PoseCorrectives(start, joint, both[..., :3].copy(), both[..., 3:].copy())
