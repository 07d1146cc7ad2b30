"""Registration of the embedded body to a surface without a skeleton: joints and skinning weights by closest points.

The body's shape parameters, the pose of its limbs and a similarity are fitted by iterated closest points: each point of
the one surface is pulled to the tangent plane of the nearest point of the other whose normal agrees (Chen & Medioni,
"Object modelling by registration of multiple range images", Image and Vision Computing 10 (1992)), and one
Gauss-Newton step solves for all unknowns. Robust weights, whose width shrinks, let clothes and hair be far away (Geman
& McClure, Bull. Int. Stat. Inst. 52 (1987)). Left and right limbs have mirrored poses, as in A- and T-poses.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from piavatar_envs.avatar.body.asset import AvatarAsset, area_vectors, dense_weights, vertex_normals
from piavatar_envs.avatar.body.sampling import ClosedSurface
from piavatar_envs.avatar.body.skeleton import NUM_JOINTS, blended_maps, bone_maps, forward_kinematics, joint_index

#: Joints whose rotation is fitted: both sides mirrored, and about the left axis alone.
_MIRRORED = ("collar", "shoulder", "elbow", "wrist", "hip", "knee", "ankle")
_SAGITTAL = ("spine1", "spine3", "neck", "head")
#: Points of either surface that are compared, in search of a start and in the fit.
_COARSE, _FINE = 400, 1500
#: Widths of the robust weights from the first step to the last, over the height.
_WIDTHS = (0.10, 0.015)
_COARSE_STEPS, _FINE_STEPS = 12, 30
#: Starts that are fitted to the end, of those that were the closest after few steps.
_FINALISTS = 2
#: Pull of shape parameters and rotations to their rest, over the weight of a point at the final width.
_SHAPE_PULL, _POSE_PULL = 0.02, 0.01
#: Poses that a search starts from: the rest pose, and the same with level arms.
POSES = ("A", "T")
#: Cosine between normals of points that may be a pair.
_AGREE = 0.3


@dataclass(frozen=True)
class Fit:
    """The embedded body in the place, size, shape and pose of a surface.

    Attributes:
        scale: metres of the surface a metre of the body.
        turn: rotation vector [rad], shape ``(3,)``.
        shift: [m], shape ``(3,)``.
        shape: shape parameters, shape ``(S,)``.
        pose: rotation vectors of the mirrored joints, three each, and angles of the others [rad].
    """

    scale: float
    turn: np.ndarray
    shift: np.ndarray
    shape: np.ndarray
    pose: np.ndarray

    @property
    def vector(self) -> np.ndarray:
        """All unknowns."""
        return np.concatenate([[np.log(self.scale)], self.turn, self.shift, self.shape, self.pose])

    @staticmethod
    def of(vector: np.ndarray, num_shapes: int) -> Fit:
        """Return the fit of a vector of unknowns."""
        shape = np.clip(vector[7 : 7 + num_shapes], -1.0, 1.0)
        return Fit(float(np.exp(vector[0])), vector[1:4], vector[4:7], shape, vector[7 + num_shapes :])

    def local_rotations(self) -> np.ndarray:
        """Return local rotations of the joints from the pose of the model, shape ``(22, 3, 3)``."""
        vectors = np.zeros((NUM_JOINTS, 3))
        for index, name in enumerate(_MIRRORED):
            own = self.pose[3 * index : 3 * index + 3]
            vectors[joint_index(f"left_{name}")] = own
            vectors[joint_index(f"right_{name}")] = own * [1.0, -1.0, -1.0]
        for index, name in enumerate(_SAGITTAL):
            vectors[joint_index(name), 0] = self.pose[3 * len(_MIRRORED) + index]
        return Rotation.from_rotvec(vectors).as_matrix()


@dataclass(frozen=True, eq=False)
class Registered:
    """A fit, and what it says about the surface.

    Attributes:
        turn: rotation vector of the body, which faces -y without one [rad], shape ``(3,)``.
        shape: its shape parameters, shape ``(S,)``.
        joints: [m], shape ``(22, 3)``.
        weights: of the joints at every vertex of the surface, shape ``(V, 22)``.
        residual: mean distance between the surfaces, both ways, over the height.
    """

    turn: np.ndarray
    shape: np.ndarray
    joints: np.ndarray
    weights: np.ndarray
    residual: float


class Model:
    """Some vertices of a body, which move with all unknowns."""

    def __init__(self, asset: AvatarAsset, rows: np.ndarray, pose: np.ndarray | None = None) -> None:
        """Prepare the vertices.

        Args:
            asset: the body.
            rows: indices of the vertices.
            pose: local rotations that those of a fit are added to, shape ``(22, 3, 3)``; by default its own pose.
        """
        self.asset, self.rows = asset, rows
        self._pose = np.tile(np.eye(3), (NUM_JOINTS, 1, 1)) if pose is None else pose
        self._vertices = asset.vertices[rows].astype(np.float64)
        self._deltas = asset.shape_deltas[:, :, rows].astype(np.float64)
        self._weights = dense_weights(asset.skin_joints[rows], asset.skin_weights[rows])
        normals = vertex_normals(asset.vertices.astype(np.float64), asset.faces)
        self._normals = normals[rows]

    @cached_property
    def height(self) -> float:
        """Of the mean shape [m]."""
        return float(np.ptp(self.asset.vertices[:, 2]))

    def points(self, fit: Fit) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return vertices ``(N, 3)`` [m], normals ``(N, 3)`` and joints ``(22, 3)`` [m] of a fit."""
        rest, joints = self.shaped(fit)
        rotations, positions = self.placed(fit, joints)
        blended = blended_maps(self._weights, bone_maps(rotations, positions, joints))
        posed = np.einsum("nij,nj->ni", blended[..., :3], rest) + blended[..., 3]
        turn = Rotation.from_rotvec(fit.turn)
        normals = turn.apply(np.einsum("nij,nj->ni", blended[..., :3], self._normals))
        place = fit.scale * turn.as_matrix().T
        return posed @ place + fit.shift, _unit(normals), positions @ place + fit.shift

    def shaped(self, fit: Fit) -> tuple[np.ndarray, np.ndarray]:
        """Return vertices ``(N, 3)`` and joints ``(22, 3)`` [m] of the body in the shape of a fit, as it rests."""
        halves = np.stack([np.maximum(-fit.shape, 0.0), np.maximum(fit.shape, 0.0)], axis=1)
        rest = self._vertices + np.tensordot(halves, self._deltas, axes=2)
        return rest, self.asset.joints + np.tensordot(halves, self.asset.shape_joints.astype(np.float64), axes=2)

    def placed(self, fit: Fit, joints: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return rotations ``(22, 3, 3)`` and joints ``(22, 3)`` [m] in the pose of a fit, from those at rest."""
        return forward_kinematics(self._pose @ fit.local_rotations(), joints[0], joints)

    def maps(self, fit: Fit) -> np.ndarray:
        """Return the affine maps ``(22, 3, 4)`` by which the bones take the body at rest to its place in a fit."""
        joints = self.shaped(fit)[1]
        maps = bone_maps(*self.placed(fit, joints), joints)
        maps = fit.scale * Rotation.from_rotvec(fit.turn).as_matrix() @ maps
        maps[..., 3] += fit.shift
        return maps


@dataclass(frozen=True, eq=False)
class Cloud:
    """Points of a surface, shape ``(N, 3)`` [m], with unit normals, and the search for the nearest of them."""

    points: np.ndarray
    normals: np.ndarray

    @cached_property
    def _stretch(self) -> float:
        return 0.02 * float(np.ptp(self.points[:, 2]))

    @cached_property
    def _tree(self) -> cKDTree:
        # normals are further coordinates, so that a near point of the other side of a limb is far away
        return cKDTree(np.concatenate([self.points, self._stretch * self.normals], axis=1))

    def query(self, points: np.ndarray, normals: np.ndarray, count: int = 1) -> tuple[np.ndarray, np.ndarray]:
        """Return distances to the nearest points and their indices, shape ``(N,)``, or ``(N, count)`` of several."""
        return self._tree.query(np.concatenate([points, self._stretch * normals], axis=1), k=count)

    def nearest(self, points: np.ndarray, normals: np.ndarray) -> np.ndarray:
        """Return the index of the nearest point to each of ``points`` ``(N, 3)``."""
        return self.query(points, normals)[1]


def register(asset: AvatarAsset, vertices: np.ndarray, faces: np.ndarray, body: np.ndarray) -> Registered:
    """Fit the body to a surface that stands on its feet, in metres, z up; it may face any horizontal axis.

    The same on every call.

    Args:
        asset: the embedded body.
        vertices: of the surface [m], shape ``(V, 3)``.
        faces: its triangles, outward oriented, shape ``(T, 3)``.
        body: triangles that are not worn, shape ``(T,)`` bool.
    """
    rng = np.random.default_rng(0)
    coarse_cloud, cloud = (_sample(vertices, faces[body], 4 * count, rng) for count in (_COARSE, _FINE))
    fit = fit_body(asset, coarse_cloud, cloud, (vertices.min(axis=0), vertices.max(axis=0)))
    whole = Model(asset, np.arange(len(asset.vertices)))
    points, normals, joints = whole.points(fit)
    apart = _distance(points[:: len(points) // _FINE], vertices, faces[body])
    apart = 0.5 * (apart + _distance(cloud.points[::4], points, asset.faces))
    weights = _weights_at(asset, Cloud(points, normals), vertices, faces)
    return Registered(fit.turn, fit.shape, joints, weights, apart / float(np.ptp(vertices[:, 2])))


def fit_body(
    asset: AvatarAsset,
    coarse_cloud: Cloud,
    cloud: Cloud,
    box: tuple[np.ndarray, np.ndarray],
    poses: Sequence[str] = POSES,
    pose: np.ndarray | None = None,
) -> Fit:
    """Fit a body to points, which may face any horizontal axis.

    Args:
        asset: the body.
        coarse_cloud: points for the search of a start.
        cloud: points for the fit.
        box: lowest and highest corner of all of them [m].
        poses: of :data:`POSES`, that the search starts from.
        pose: local rotations that these are added to, shape ``(22, 3, 3)``.
    """
    coarse, fine = (Model(asset, _spread(asset, count), pose) for count in (_COARSE, _FINE))
    starts = _starts(coarse, box, poses)
    starts = [_refine(coarse, coarse_cloud, start, _COARSE_STEPS, _COARSE) for start in starts]
    starts = sorted(starts, key=lambda fit: _residual(coarse, coarse_cloud, fit))[:_FINALISTS]
    fits = [_refine(fine, cloud, start, _FINE_STEPS, _FINE) for start in starts]
    return min(fits, key=lambda one: _residual(fine, cloud, one))


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-20)


def _sample(vertices: np.ndarray, faces: np.ndarray, count: int, rng: np.random.Generator) -> Cloud:
    """Return points that are spread evenly over the area of a surface."""
    a, b, c = (vertices[faces[:, corner]] for corner in range(3))
    normal = area_vectors(vertices, faces)
    area = np.linalg.norm(normal, axis=1)
    chosen = np.searchsorted(np.cumsum(area), (np.arange(count) + 0.5) / count * area.sum()).clip(0, len(faces) - 1)
    u, v = rng.random((2, count))
    u, v = np.where(u + v > 1.0, 1.0 - u, u), np.where(u + v > 1.0, 1.0 - v, v)
    points = a[chosen] + u[:, None] * (b - a)[chosen] + v[:, None] * (c - a)[chosen]
    return Cloud(points, _unit(normal[chosen]))


def _spread(asset: AvatarAsset, count: int) -> np.ndarray:
    """Return some vertices of the body, more where it is finer, as it is at hands and feet."""
    return np.linspace(0, len(asset.vertices) - 1, min(count, len(asset.vertices))).astype(int)


def _starts(model: Model, box: tuple[np.ndarray, np.ndarray], poses: Sequence[str]) -> list[Fit]:
    """Return the body upright on the ground, facing the four horizontal axes, in its rest pose and a T-pose."""
    low, high = box
    scale = float(high[2] - low[2]) / model.height
    none = np.zeros(len(model.asset.shape_names))
    rest, straight = np.zeros((2, 3 * len(_MIRRORED) + len(_SAGITTAL)))
    for index, name in enumerate(_MIRRORED):
        straight[3 * index : 3 * index + 3] = {"shoulder": (0.0, -0.75, 0.0), "elbow": (0.0, 0.0, -0.5)}.get(name, 0.0)
    fits = []
    for quarter in range(4):
        turn = np.array([0.0, 0.0, 0.5 * np.pi * quarter])
        for pose in (straight if name == "T" else rest for name in poses):
            start = Fit(scale, turn, np.zeros(3), none, pose)
            points = model.points(start)[0]
            shift = 0.5 * (low + high) - 0.5 * (points.min(axis=0) + points.max(axis=0))
            fits.append(replace(start, shift=shift))
    return fits


def _refine(model: Model, cloud: Cloud, fit: Fit, steps: int, count: int) -> Fit:
    """Return the fit after some Gauss-Newton steps."""
    height = float(np.ptp(cloud.points[:, 2]))
    chosen = np.linspace(0, len(cloud.points) - 1, count).astype(int)
    shapes = len(fit.shape)
    for step in range(steps):
        width = height * _WIDTHS[0] * (_WIDTHS[1] / _WIDTHS[0]) ** (step / (steps - 1))
        vector = fit.vector
        points, normals, _ = model.points(fit)
        jacobian = np.empty((*points.shape, len(vector)))
        for index in range(len(vector)):
            moved = vector.copy()
            nudge = -1e-4 if 7 <= index < 7 + shapes and vector[index] > 0.99 else 1e-4
            moved[index] += nudge
            jacobian[..., index] = (model.points(Fit.of(moved, shapes))[0] - points) / nudge
        found = cloud.nearest(points, normals)
        own = Cloud(points, normals).nearest(cloud.points[chosen], cloud.normals[chosen])
        rows = np.concatenate([np.arange(len(points)), own])
        others = np.concatenate([found, chosen])
        offset = points[rows] - cloud.points[others]
        plane = np.einsum("ni,ni->n", offset, cloud.normals[others])
        agree = np.einsum("ni,ni->n", normals[rows], cloud.normals[others]) > _AGREE
        # far along the plane a pair says little about the place of either
        robust = agree * (width**2 / (width**2 + (offset**2).sum(axis=1))) ** 2
        slope = np.einsum("ni,nik->nk", cloud.normals[others], jacobian[rows])
        pull = np.concatenate(
            [np.zeros(7), np.full(shapes, _SHAPE_PULL), np.full(len(vector) - 7 - shapes, _POSE_PULL)]
        )
        pull *= len(rows) * (_WIDTHS[1] * height) ** 2
        # a little of the whole offset keeps points from sliding along planes
        along = 0.05
        matrix = np.einsum("n,nk,nl->kl", robust, slope, slope, optimize=True)
        right = -(robust * plane) @ slope
        full = jacobian[rows]
        matrix += along * np.einsum("n,nik,nil->kl", robust, full, full, optimize=True)
        right -= along * np.einsum("n,ni,nik->k", robust, offset, full, optimize=True)
        matrix += np.diag(pull + 1e-6 * np.trace(matrix) / len(vector))
        rest = np.concatenate([np.zeros(7), vector[7 : 7 + shapes], np.zeros(len(vector) - 7 - shapes)])
        change = np.linalg.solve(matrix, right - pull * rest)
        fit = Fit.of(vector + change * min(1.0, 0.5 / max(np.abs(change).max(), 1e-9)), shapes)
    return fit


def _residual(model: Model, cloud: Cloud, fit: Fit) -> float:
    """Return the mean distance between points of the surfaces, both ways, over the height: for comparing fits."""
    points, normals, _ = model.points(fit)
    there = np.linalg.norm(points - cloud.points[cloud.nearest(points, normals)], axis=1).mean()
    back = np.linalg.norm(cloud.points - points[Cloud(points, normals).nearest(cloud.points, cloud.normals)], axis=1)
    return float(there + back.mean()) / 2.0 / float(np.ptp(cloud.points[:, 2]))


def _distance(points: np.ndarray, vertices: np.ndarray, faces: np.ndarray) -> float:
    """Return the mean distance of points to a surface [m]."""
    return float(np.abs(ClosedSurface(vertices.astype(np.float32), faces.astype(np.int32)).distance(points)).mean())


def _weights_at(asset: AvatarAsset, body: Cloud, vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return the skinning weights of the nearest points of the fitted body ``(V, 22)``, the mean of a few of them."""
    distance, near = body.query(vertices, vertex_normals(vertices, faces), count=4)
    share = 1.0 / np.maximum(distance, 1e-4) ** 2
    share /= share.sum(axis=1, keepdims=True)
    dense = dense_weights(asset.skin_joints, asset.skin_weights)
    return np.einsum("vk,vkj->vj", share, dense[near])
