"""Surfaces for pictures: the skin of an avatar, by linear blend skinning plus the particles' displacement, and props.

The particles fill the body; the skin mesh is not simulated. Each skin vertex therefore follows its bones, and adds
the displacement ``x - LBS`` of the particles beneath it. Which particles, and with which weights, is baked once.

A surface may have displacements of its own that depend on the pose. They then stand in place of those that particles
are skinned with, see :mod:`piavatar_envs.avatar.body.pose_correctives`, which would count the same bulge twice.
"""

from __future__ import annotations

import hashlib
from collections import OrderedDict
from typing import TYPE_CHECKING, Protocol

import numpy as np
from scipy import sparse
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from piavatar_envs.avatar.body.interpolation import interpolation_matrix
from piavatar_envs.avatar.body.skeleton import NUM_JOINTS, bone_maps, local_rotations

if TYPE_CHECKING:
    from piavatar_envs.avatar.body.asset import PoseDisplacements
    from piavatar_envs.avatar.body.pose_correctives import PoseCorrectives

#: Particles that move a vertex. With few, what neighbours differ by crumples the skin where it is finer than they are:
#: toes on the ground, between bones that are put into their places and flesh that is not.
NUM_NEIGHBOURS = 24
#: Skins that :meth:`Skin.baked` keeps in a process.
_MOST_BAKED = 8
#: Particles that move a vertex of a prop.
_PROP_NEIGHBOURS = 6


class SkinnedSurface(Protocol):
    """Skinning of an asset's vertices."""

    skin_joints: np.ndarray
    skin_weights: np.ndarray


class RestShape(Protocol):
    """Rest pose of a shaped body."""

    vertices: np.ndarray
    joints: np.ndarray


class Skin:
    """Deforms one body's skin mesh with its bones and particles."""

    def __init__(
        self,
        asset: SkinnedSurface,
        body: RestShape,
        rest_positions: np.ndarray,
        skin_joints: np.ndarray,
        skin_weights: np.ndarray,
        correctives: PoseCorrectives | None = None,
    ) -> None:
        """Bake the weights.

        Args:
            asset: the skinning of the vertices, ``skin_joints (V, K)`` and ``skin_weights (V, K)``.
            body: the rest pose of one shape, ``vertices (V, 3)`` [m] and ``joints (22, 3)`` [m].
            rest_positions: the particles in the rest pose of that same shape [m], shape ``(P, 3)``.
            skin_joints: joints that move each particle, shape ``(P, K)`` int.
            skin_weights: their weights, rows sum to one, shape ``(P, K)``.
            correctives: displacements of the particles' rest pose by the pose, if they have such.

        Raises:
            ValueError: there are no particles, or their arrays differ in length.
        """
        counts = {len(rest_positions), len(skin_joints), len(skin_weights)}
        if len(counts) != 1 or 0 in counts:
            raise ValueError(
                f"rest_positions, skin_joints and skin_weights have {len(rest_positions)}, {len(skin_joints)} and "
                f"{len(skin_weights)} rows; give one row a particle, and at least one particle"
            )
        vertices = np.asarray(body.vertices, dtype=np.float64)
        particles = np.asarray(rest_positions, dtype=np.float64)
        self._rest_joints = np.asarray(body.joints, dtype=np.float64)
        self._vertex_skinning = _skinning_matrix(vertices, asset.skin_joints, asset.skin_weights)
        self._particle_skinning = _skinning_matrix(particles, skin_joints, skin_weights)
        own, others = (_joint_weights(asset.skin_joints, asset.skin_weights), _joint_weights(skin_joints, skin_weights))
        self._interpolation = interpolation_matrix(vertices, own, particles, others, NUM_NEIGHBOURS)
        self._pose = getattr(asset, "pose", None)
        self._correctives = correctives
        if self._pose is not None:
            self._vertex_weights, self._particle_weights = sparse.csr_array(own), sparse.csr_array(others)

    @classmethod
    def baked(
        cls,
        asset: SkinnedSurface,
        body: RestShape,
        rest_positions: np.ndarray,
        skin_joints: np.ndarray,
        skin_weights: np.ndarray,
        correctives: PoseCorrectives | None = None,
    ) -> Skin:
        """Return the skin of these arrays, baked once a process for all environments; arguments as for the class."""
        digest = hashlib.blake2b()
        surface = (asset.skin_joints, asset.skin_weights, body.vertices, body.joints)
        pose: PoseDisplacements | None = getattr(asset, "pose", None)
        moved = () if pose is None else (pose.directions, pose.reference)
        for array in (*surface, rest_positions, skin_joints, skin_weights, *moved):
            digest.update(f"{np.shape(array)} {np.asarray(array).dtype}".encode())
            digest.update(np.ascontiguousarray(array))
        key = digest.digest()
        skin = _baked.pop(key, None) or cls(asset, body, rest_positions, skin_joints, skin_weights, correctives)
        _baked[key] = skin
        while len(_baked) > _MOST_BAKED:
            _baked.popitem(last=False)
        return skin

    @property
    def num_vertices(self) -> int:
        """Vertices of the skin mesh."""
        return self._interpolation.shape[0]

    @property
    def num_particles(self) -> int:
        """Particles that move it."""
        return self._interpolation.shape[1]

    def deform(self, rotations: np.ndarray, positions: np.ndarray, particle_positions: np.ndarray) -> np.ndarray:
        """Compute the skin vertices of one simulated state.

        Args:
            rotations: world rotations of the bones, identity in the rest pose, shape ``(22, 3, 3)``.
            positions: world positions of the joints [m], shape ``(22, 3)``.
            particle_positions: the simulated particles [m], shape ``(P, 3)``.

        Returns:
            World positions of the skin vertices [m], shape ``(V, 3)`` float32.

        Raises:
            ValueError: another number of particles than were baked.
        """
        particle_positions = np.asarray(particle_positions, dtype=np.float64)
        if particle_positions.shape != (self.num_particles, 3):
            raise ValueError(f"particle_positions has shape {particle_positions.shape}, not ({self.num_particles}, 3)")
        transforms = self._transforms(rotations, positions)
        displacement = particle_positions - self._particle_skinning @ transforms
        vertices = self._vertex_skinning @ transforms
        if self._pose is not None:
            rotations = np.asarray(rotations, dtype=np.float64)
            vertices += _turned(self._vertex_weights, rotations, self._pose.displacement(rotations))
            if self._correctives is not None:
                local = Rotation.from_matrix(local_rotations(rotations))
                own = self._correctives.displacement(local.as_quat())
                displacement -= _turned(self._particle_weights, rotations, own)
        return (vertices + self._interpolation @ displacement).astype(np.float32)

    def interpolate(self, per_particle: np.ndarray) -> np.ndarray:
        """Interpolate a quantity of the particles on the skin, shape ``(P, ...)`` to ``(V, ...)``."""
        return self._interpolation @ np.asarray(per_particle, dtype=np.float64)

    def _transforms(self, rotations: np.ndarray, positions: np.ndarray) -> np.ndarray:
        """Return rest-to-world transforms stacked for the skinning matrices, shape ``(88, 3)``."""
        rotations, positions = (np.asarray(values, dtype=np.float64) for values in (rotations, positions))
        maps = bone_maps(rotations, positions, self._rest_joints)
        return maps.transpose(0, 2, 1).reshape(4 * NUM_JOINTS, 3)


#: Skins by the digest of what they were baked from, the one that was used last at the end.
_baked: OrderedDict[bytes, Skin] = OrderedDict()


def _skinning_matrix(points: np.ndarray, joints: np.ndarray, weights: np.ndarray) -> sparse.csr_array:
    """Build linear blend skinning as one sparse matrix: rows ``w_b (x, y, z, 1)``, shape ``(N, 88)``."""
    homogeneous = np.concatenate([points, np.ones((len(points), 1))], axis=1)
    joints = np.asarray(joints, dtype=np.int64)
    values = np.asarray(weights, dtype=np.float64)[:, :, None] * homogeneous[:, None, :]
    columns = 4 * joints[:, :, None] + np.arange(4)
    rows = np.broadcast_to(np.arange(len(points))[:, None, None], columns.shape)
    matrix = sparse.csr_array((values.ravel(), (rows.ravel(), columns.ravel())), shape=(len(points), 4 * NUM_JOINTS))
    matrix.eliminate_zeros()
    return matrix


def _turned(weights: sparse.csr_array, rotations: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """Return vectors of points ``(N, 3)`` turned as their skinning turns them."""
    return np.einsum("nij,nj->ni", (weights @ rotations.reshape(NUM_JOINTS, 9)).reshape(-1, 3, 3), vectors)


def _joint_weights(joints: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return skinning weights as one dense row a point, shape ``(N, 22)``."""
    dense = np.zeros((len(joints), NUM_JOINTS))
    np.add.at(dense, (np.arange(len(joints))[:, None], np.asarray(joints, dtype=np.int64)), weights)
    return dense


class SolidSurface:
    """Deforms the surface mesh of one prop with its particles."""

    def __init__(self, rest: np.ndarray, vertices: np.ndarray, faces: np.ndarray) -> None:
        """Bake the weights: a vertex moves with its nearest particles, the nearer the more.

        Args:
            rest: particles in the rest frame [m], shape ``(P, 3)``.
            vertices: surface in the same frame [m], shape ``(V, 3)``.
            faces: its triangles, shape ``(T, 3)``.
        """
        self.vertices, self.faces = np.asarray(vertices, np.float64), np.ascontiguousarray(faces, np.int32)
        self._rest = np.asarray(rest, np.float64)
        distance, self._near = cKDTree(self._rest).query(self.vertices, k=min(_PROP_NEIGHBOURS, len(rest)))
        weight = 1.0 / np.maximum(distance, 1e-6) ** 2
        self._weight = weight / weight.sum(axis=1, keepdims=True)

    def deform(self, rotation: np.ndarray, position: np.ndarray, x: np.ndarray) -> np.ndarray:
        """Return world vertices [m], shape ``(V, 3)``.

        Args:
            rotation: rest frame to world, shape ``(3, 3)``.
            position: centre of mass [m].
            x: particles in the world [m], shape ``(P, 3)``.
        """
        dent = x - (self._rest @ rotation.T + position)
        return self.vertices @ rotation.T + position + (self._weight[..., None] * dent[self._near]).sum(1)
