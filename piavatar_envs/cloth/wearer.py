"""The body that a garment is cut for: one shape of an asset in its rest pose, measured as a tailor does."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from piavatar_envs.avatar.body.asset import AvatarAsset, turned_shares, vertex_normals
from piavatar_envs.avatar.body.sampling import ClosedSurface
from piavatar_envs.avatar.body.skeleton import joint_index

#: Usual number of steps and the largest step [m] in which points are brought out of the skin.
_STEPS, _LONGEST = 12, 0.03


@dataclass(frozen=True, eq=False)
class Wearer:
    """A shaped body, soles on z = 0, facing -y, its left is +x, arms lowered by some 45 degrees.

    Attributes:
        asset: the body's topology and skinning.
        vertices: of the skin [m], shape ``(V, 3)`` float64.
        joints: positions [m], shape ``(22, 3)`` float64.
    """

    asset: AvatarAsset
    vertices: np.ndarray
    joints: np.ndarray

    @staticmethod
    def of(asset: AvatarAsset, parameters: Sequence[float] | np.ndarray) -> Wearer:
        """Return the body of shape parameters ``(S,)``."""
        body = asset.shape(parameters)
        return Wearer(asset, body.vertices.astype(np.float64), body.joints.astype(np.float64))

    @property
    def faces(self) -> np.ndarray:
        """Triangles of the skin, shape ``(T, 3)``."""
        return self.asset.faces

    @cached_property
    def normals(self) -> np.ndarray:
        """Unit normals of the skin's vertices, shape ``(V, 3)``."""
        return vertex_normals(self.vertices, self.faces)

    @cached_property
    def surface(self) -> ClosedSurface:
        """The skin, for queries of nearest points."""
        return ClosedSurface(self.vertices, self.faces)

    @cached_property
    def _shares(self) -> np.ndarray:
        return turned_shares(self.asset.skin_joints, self.asset.skin_weights)

    def at(self, joint: str) -> np.ndarray:
        """Return the position of a joint [m], shape ``(3,)``."""
        return self.joints[joint_index(joint)]

    def turned_by(self, joint: str) -> np.ndarray:
        """Return the share of each vertex that a joint turns, shape ``(V,)`` in [0, 1]."""
        return self._shares[:, joint_index(joint)]

    @cached_property
    def arms(self) -> np.ndarray:
        """Whether each vertex is of an arm, shape ``(V,)`` bool."""
        return np.maximum(self.turned_by("left_shoulder"), self.turned_by("right_shoulder")) > 0.5

    def section(self, height: float) -> np.ndarray:
        """Return points of the skin without arms at a height [m], shape ``(K, 3)``.

        Raises:
            ValueError: trunk and legs do not reach to it.
        """
        corners = self.vertices[self.faces[~self.arms[self.faces].any(axis=1)]]
        points = []
        for first, second in ((0, 1), (1, 2), (2, 0)):
            below, above = corners[:, first, 2] - height, corners[:, second, 2] - height
            crosses = below * above < 0.0
            share = (below[crosses] / (below[crosses] - above[crosses]))[:, None]
            points.append(corners[crosses, first] * (1.0 - share) + corners[crosses, second] * share)
        found = np.concatenate(points)
        if len(found) < 3:
            top = self.vertices[~self.arms, 2].max()
            raise ValueError(f"no section of the body at {height:.3g} m; it is from 0 to {top:.3g} m tall")
        return found

    def anchors(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the nearest triangles ``(N,)`` of the skin to points, and barycentric coordinates ``(N, 3)``."""
        _, face, coordinates = self.surface.query(points)
        return face, coordinates.astype(np.float64)

    def outside(
        self, points: np.ndarray, gap: float | np.ndarray, longest: float = _LONGEST, steps: int = _STEPS
    ) -> np.ndarray:
        """Return points moved out of the skin to a least distance from it.

        Args:
            points: shape ``(N, 3)`` [m].
            gap: the distance, of all or of each [m].
            longest: step [m].
            steps: at most so many.
        """
        points, low = np.array(points, np.float64), np.arange(len(points))
        gap = np.broadcast_to(gap, len(points))
        for _ in range(steps):
            distance, face, coordinates = self.surface.query(points[low])
            near = distance < gap[low] - 1.0e-5
            if not near.any():
                break
            low, short = low[near], (gap[low] - distance)[near]
            normals = np.einsum("nc,ncd->nd", coordinates[near], self.normals[self.faces[face[near]]])
            normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1.0e-12)
            points[low] += np.minimum(short, longest)[:, None] * normals
        return points
