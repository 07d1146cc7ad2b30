"""The body an avatar starts from: closed skin mesh, skeleton, skinning weights and shape parameters (NumPy)."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from piavatar_envs.avatar.body.skeleton import NUM_JOINTS, PARENTS, local_rotations
from piavatar_envs.avatar.body.splats import SkinnedSplats
from piavatar_envs.avatar.body.textures import Textures

NUM_SKIN_JOINTS = 4
SAMPLE_DEVIATION = 0.4  # standard deviation of a sampled shape parameter, before the clip to [-1, 1]


@dataclass(frozen=True, eq=False)
class ShapedBody:
    """One shape of an asset in its rest pose: soles on z = 0, the pelvis joint above the origin.

    Attributes:
        vertices: skin vertices [m], shape ``(V, 3)`` float32.
        joints: joint positions [m], shape ``(22, 3)`` float32.
    """

    vertices: np.ndarray
    joints: np.ndarray


@dataclass(frozen=True, eq=False)
class PoseDisplacements:
    """Displacements of vertices in the reference pose, linear in the matrices of the joints' local rotations.

    The file that they come from counts rotations from a pose of its own, in which all of its bones have the identity.

    Attributes:
        directions: displacement by each element of the matrix of each joint but the root [m], shape
            ``(V, 3, 21, 9)`` float32.
        reference: world rotations of the bones from the file's pose to the reference pose, shape ``(22, 3, 3)``.
    """

    directions: np.ndarray
    reference: np.ndarray

    def displacement(self, rotations: np.ndarray) -> np.ndarray:
        """Return the displacements [m], shape ``(V, 3)``; none in the reference pose.

        Args:
            rotations: world rotations of the bones, identity in the reference pose, shape ``(22, 3, 3)``.
        """
        change = (local_rotations(rotations @ self.reference) - local_rotations(self.reference))[1:]
        return (self.directions.reshape(-1, change.size) @ change.astype(np.float32).ravel()).reshape(-1, 3)


@dataclass(frozen=True, eq=False)
class Look:
    """A surface that is drawn in place of the skin, such as a clothed character; it has no part in the simulation.

    Attributes:
        vertices: of the mean shape, in the frame of the skin's [m], shape ``(W, 3)`` float32.
        faces: triangles, shape ``(U, 3)`` int32; only their fronts are drawn.
        skin_joints: joints that move each vertex, shape ``(W, 4)`` int32.
        skin_weights: their weights, descending, rows sum to one, shape ``(W, 4)`` float32.
        colors: sRGB of the vertices, shape ``(W, 3)`` uint8, or ``(K, W, 3)`` for ``K`` colourings that the avatars of
            a scene have in turn; None for the one colour of the avatar.
        shape_deltas: displacements as those of the skin [m], shape ``(S, 2, W, 3)`` float32.
        pose: displacements that depend on the pose, if the file has such.
        splats: what is drawn in place of the triangles; they have the mean shape only.
        textures: of the base colour, whose colours at the vertices are ``colors``, for views without textures.
    """

    vertices: np.ndarray
    faces: np.ndarray
    skin_joints: np.ndarray
    skin_weights: np.ndarray
    colors: np.ndarray | None
    shape_deltas: np.ndarray
    pose: PoseDisplacements | None = None
    splats: SkinnedSplats | None = None
    textures: Textures | None = None

    def colors_of(self, avatar: int) -> np.ndarray | None:
        """Return the colours of the avatar of an index in its scene, ``(W, 3)``; on each call the same array."""
        return None if self.colors is None else self._colorings[avatar % len(self._colorings)]

    @cached_property
    def _colorings(self) -> tuple[np.ndarray, ...]:
        if self.colors is None:
            return ()
        return (self.colors,) if self.colors.ndim == 2 else tuple(self.colors)


@dataclass(frozen=True, eq=False)
class SkeletonPoints:
    """Points of a skeleton's surface.

    Attributes:
        points: in the reference pose of the mean shape [m], shape ``(K, 3)``.
        bone: the joint that each moves with, shape ``(K,)`` int32.
    """

    points: np.ndarray
    bone: np.ndarray


@dataclass(frozen=True, eq=False)
class SurfacePoints:
    """Points at the skin, each of which is a particle.

    Attributes:
        points: in the reference pose of the mean shape [m], shape ``(K, 3)``.
        skin_joints: joints that move each, shape ``(K, 4)`` int32.
        skin_weights: their weights, descending, rows sum to one, shape ``(K, 4)`` float32.
    """

    points: np.ndarray
    skin_joints: np.ndarray
    skin_weights: np.ndarray


@dataclass(frozen=True, eq=False)
class WornSurface:
    """A surface of a character's file that is not a body, such as a skirt; a garment can be made of it.

    Attributes:
        vertices: in the reference pose of the mean shape [m], shape ``(W, 3)`` float32.
        faces: triangles, shape ``(U, 3)`` int32.
        colors: sRGB of the vertices, shape ``(W, 3)`` uint8, or None for the one colour of the avatar.
        drawn: triangles of the look that draw it, as indices into its faces, shape ``(K,)`` int32.
    """

    vertices: np.ndarray
    faces: np.ndarray
    colors: np.ndarray | None
    drawn: np.ndarray


@dataclass(frozen=True, eq=False)
class AvatarAsset:
    """A skinned, shapeable body. Axes: metres, z up, facing -y, its left is +x; joints as in ``skeleton.py``.

    Shape parameters are in [-1, 1], all zero for the mean shape. Each has one displacement field for its negative
    and one for its positive half, because a thin person is not a heavy one mirrored; different parameters add up.

    Attributes:
        name: where the body comes from, for messages and metadata.
        vertices: skin of the mean shape [m], shape ``(V, 3)`` float32.
        faces: triangles of the closed, outward oriented skin, shape ``(T, 3)`` int32.
        joints: joint positions of the mean shape [m], shape ``(22, 3)`` float32.
        skin_joints: joints that move each vertex, shape ``(V, 4)`` int32.
        skin_weights: their weights, descending, rows sum to one, shape ``(V, 4)`` float32.
        shape_names: names of the ``S`` shape parameters.
        shape_deltas: vertex displacements at -1 and at +1 of each parameter [m], shape ``(S, 2, V, 3)`` float32.
        shape_joints: joint displacements, the same way [m], shape ``(S, 2, 22, 3)`` float32.
        look: the surface to draw; None draws the skin.
        outfit: makes the look from the asset when that is first drawn, where ``look`` is None.
        skeleton: where bone particles are put; None puts them around the bones' axes.
        groups: weights in [0, 1] of the vertices in groups that the file names, each shape ``(V,)`` float32.
        surface_points: particles at the skin besides those that fill the body; None for none.
        worn: surfaces of the file that are worn, by their names and those of their materials.
    """

    name: str
    vertices: np.ndarray
    faces: np.ndarray
    joints: np.ndarray
    skin_joints: np.ndarray
    skin_weights: np.ndarray
    shape_names: tuple[str, ...]
    shape_deltas: np.ndarray
    shape_joints: np.ndarray
    look: Look | None = None
    outfit: Callable[[AvatarAsset], Look] | None = None
    skeleton: SkeletonPoints | None = None
    groups: Mapping[str, np.ndarray] = field(default_factory=dict)
    surface_points: SurfacePoints | None = None
    worn: Mapping[str, WornSurface] = field(default_factory=dict)

    def shape(self, parameters: Sequence[float] | np.ndarray) -> ShapedBody:
        """Return the body of shape parameters ``(S,)``, standing on z = 0 with the pelvis over x = y = 0.

        Raises:
            ValueError: a wrong number of parameters, or one that is not finite or outside [-1, 1].
        """
        vertices, joints, origin = self._shaped(parameters)
        return ShapedBody((vertices - origin).astype(np.float32), (joints - origin).astype(np.float32))

    @cached_property
    def drawn(self) -> Look:
        """The surface to draw: the look, that of the outfit, or the skin in one colour."""
        if self.look is not None:
            return self.look
        if self.outfit is not None:
            return self.outfit(self)
        return Look(self.vertices, self.faces, self.skin_joints, self.skin_weights, None, self.shape_deltas)

    def shape_drawn(self, parameters: Sequence[float] | np.ndarray) -> ShapedBody:
        """Return the vertices of the surface to draw and the joints, where :meth:`shape` has put the body.

        Raises:
            ValueError: as :meth:`shape`.
        """
        _, joints, origin = self._shaped(parameters)
        drawn = self.drawn
        vertices = drawn.vertices + np.tensordot(self._halves(parameters), drawn.shape_deltas, axes=2)
        return ShapedBody((vertices - origin).astype(np.float32), (joints - origin).astype(np.float32))

    def shape_splats(self, parameters: Sequence[float] | np.ndarray) -> ShapedBody:
        """Return the centres of the look's splats and the joints, where :meth:`shape` has put the body.

        Raises:
            ValueError: as :meth:`shape`, or the look has no splats.
        """
        splats = self.drawn.splats
        if splats is None:
            raise ValueError(f"{self.name} has no splats; use an avatar of the source gaussian")
        _, joints, origin = self._shaped(parameters)
        return ShapedBody((splats.cloud.means - origin).astype(np.float32), (joints - origin).astype(np.float32))

    def mean_body(self) -> ShapedBody:
        """Return the shape of all parameters zero."""
        return self.shape(np.zeros(len(self.shape_names)))

    def height(self, parameters: Sequence[float] | np.ndarray) -> float:
        """Return the standing height of a shape [m]."""
        return float(np.ptp(self.shape(parameters).vertices[:, 2]))

    def volume(self, parameters: Sequence[float] | np.ndarray) -> float:
        """Return the volume enclosed by the skin of a shape [m^3]."""
        return mesh_volume(self.shape(parameters).vertices, self.faces)

    def parameters(self, **values: float) -> np.ndarray:
        """Return shape parameters by name, the others zero: ``parameters(sex=-1, weight=0.5)``; shape ``(S,)``.

        Raises:
            ValueError: an unknown name.
        """
        parameters = np.zeros(len(self.shape_names))
        for name, value in values.items():
            if name not in self.shape_names:
                there = f"use one of {', '.join(self.shape_names)}" if self.shape_names else "this body has none"
                raise ValueError(f"unknown shape parameter {name!r}; {there}")
            parameters[self.shape_names.index(name)] = value
        return parameters

    def sample_parameters(self, rng: np.random.Generator, size: int | None = None, scale: float = 1.0) -> np.ndarray:
        """Draw random people: every parameter normal about the mean, clipped to [-1, 1]; ``sex`` is uniform.

        Args:
            rng: the only source of randomness.
            size: number of shapes, or None for one without the leading dimension.
            scale: 0 gives the mean shape, 1 the population; at most 1.

        Returns:
            Parameters, shape ``(S,)`` or ``(size, S)`` float64.

        Raises:
            ValueError: ``scale`` outside [0, 1].
        """
        if not 0.0 <= scale <= 1.0:
            raise ValueError(f"scale={scale} is outside [0, 1]; 1 samples the whole population")
        rows = 1 if size is None else size
        parameters = np.clip(SAMPLE_DEVIATION * rng.standard_normal((rows, len(self.shape_names))), -1.0, 1.0)
        uniform = rng.uniform(-1.0, 1.0, rows)
        if "sex" in self.shape_names:
            parameters[:, self.shape_names.index("sex")] = uniform
        parameters *= scale
        return parameters[0] if size is None else parameters

    def _shaped(self, parameters: Sequence[float] | np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return skin and joints of a shape where the mean shape is, and the ground below its pelvis joint."""
        halves = self._halves(parameters)
        vertices = self.vertices + np.tensordot(halves, self.shape_deltas, axes=2)
        joints = self.joints + np.tensordot(halves, self.shape_joints, axes=2)
        return vertices, joints, np.array([joints[0, 0], joints[0, 1], vertices[:, 2].min()])

    def _halves(self, parameters: Sequence[float] | np.ndarray) -> np.ndarray:
        """Return factors of the negative and positive displacement fields, ``(S, 2)``; check the parameters."""
        values = np.asarray(parameters, dtype=np.float64)
        if values.shape != (len(self.shape_names),):
            names = ", ".join(self.shape_names)
            raise ValueError(f"shape parameters have shape {values.shape}; pass {len(self.shape_names)}: {names}")
        bad = np.flatnonzero(~(np.abs(values) <= 1.0))  # also catches NaN
        if bad.size:
            index = int(bad[0])
            raise ValueError(
                f"shape parameter {index} ({self.shape_names[index]}) is {values[index]:g}; keep it within [-1, 1]"
            )
        return np.stack([np.maximum(-values, 0.0), np.maximum(values, 0.0)], axis=1)


def area_vectors(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return the normals of triangles, as long as their areas [m^2], shape ``(T, 3)`` float64."""
    a, b, c = (vertices[faces[:, corner]].astype(np.float64) for corner in range(3))
    return 0.5 * np.cross(b - a, c - a)


def vertex_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return unit normals of vertices, the mean of their triangles' by area, shape ``(V, 3)``."""
    area = area_vectors(vertices, faces)
    normals = np.zeros((len(vertices), 3))
    for corner, axis in np.ndindex(3, 3):
        normals[:, axis] += np.bincount(faces[:, corner], area[:, axis], len(vertices))
    return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-20)


def mesh_volume(vertices: np.ndarray, faces: np.ndarray) -> float:
    """Return the volume of a closed, outward oriented triangle mesh [m^3]: signed tetrahedra to the origin."""
    a, b, c = (vertices[faces[:, corner]].astype(np.float64) for corner in range(3))
    return float(np.einsum("ti,ti->", a, np.cross(b, c)) / 6.0)


def top_weights(weights: np.ndarray, count: int = NUM_SKIN_JOINTS) -> tuple[np.ndarray, np.ndarray]:
    """Return the ``count`` largest weights of every row, descending and normalised.

    Args:
        weights: non-negative weights of every joint, shape ``(N, J)``.
        count: how many to keep.

    Returns:
        Joints ``(N, count)`` int32 and weights ``(N, count)`` float32 whose rows sum to one.
    """
    joints = np.argsort(-weights, axis=1, kind="stable")[:, :count]
    kept = np.take_along_axis(weights, joints, axis=1)
    kept = kept / kept.sum(axis=1, keepdims=True)
    return joints.astype(np.int32), kept.astype(np.float32)


def dense_weights(skin_joints: np.ndarray, skin_weights: np.ndarray, num_joints: int = NUM_JOINTS) -> np.ndarray:
    """Return the inverse of :func:`top_weights`: shape ``(N, num_joints)`` float64."""
    dense = np.zeros((len(skin_joints), num_joints))
    np.add.at(dense, (np.arange(len(skin_joints))[:, None], skin_joints), skin_weights)
    return dense


def turned_shares(skin_joints: np.ndarray, skin_weights: np.ndarray) -> np.ndarray:
    """Return the sum of the weights of all bones that a joint turns, shape ``(N, 22)`` float64."""
    shares = dense_weights(skin_joints, skin_weights)
    for bone in range(NUM_JOINTS - 1, 0, -1):  # children come after their parents
        shares[:, PARENTS[bone]] += shares[:, bone]
    return shares
