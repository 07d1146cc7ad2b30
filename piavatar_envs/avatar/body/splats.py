"""Clouds of Gaussian splats (NumPy): the static data of an avatar that is drawn as splats.

A splat is a Gaussian density with an opacity and a colour that depends on the direction in which it is seen (Kerbl et
al., "3D Gaussian splatting for real-time radiance field rendering", ACM Trans. Graph. 42 (2023)). The colour is
``0.5 + sum_k Y_k(d) c_k`` with real spherical harmonics ``Y_k`` of the unit direction ``d`` from the eye to the splat,
in the order and with the signs of that paper's files.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

#: Coefficients of a colour by the degree of its harmonics.
COEFFICIENTS = (1, 4, 9, 16)
#: Factors of the harmonics, in their order.
FACTORS = np.array([
    0.28209479177387814, -0.4886025119029199, 0.4886025119029199, -0.4886025119029199, 1.0925484305920792,
    -1.0925484305920792, 0.31539156525252005, -1.0925484305920792, 0.5462742152960396, -0.5900435899266435,
    2.890611442640554, -0.4570457994644658, 0.3731763325901154, -0.4570457994644658, 1.445305721320277,
    -0.5900435899266435,
])  # fmt: skip
#: Splats that are turned together, which bounds memory.
_TOGETHER = 512
#: Least variance of a splat along any axis, over the largest.
_THINNEST = 1e-8


@dataclass(frozen=True, eq=False)
class SplatCloud:
    """Gaussian splats.

    Attributes:
        means: centres [m], shape ``(S, 3)`` float32.
        rotations: unit quaternions xyzw of the axes, shape ``(S, 4)`` float32.
        scales: standard deviations along the axes [m], shape ``(S, 3)`` float32.
        opacities: in [0, 1], shape ``(S,)`` float32.
        sh: coefficients of red, green and blue, shape ``(S, K, 3)`` float32, ``K`` one of 1, 4, 9 and 16.
    """

    means: np.ndarray
    rotations: np.ndarray
    scales: np.ndarray
    opacities: np.ndarray
    sh: np.ndarray

    def __len__(self) -> int:
        return len(self.means)

    @property
    def degree(self) -> int:
        """Degree of the harmonics, 0 to 3."""
        return COEFFICIENTS.index(self.sh.shape[1])

    @staticmethod
    def of(
        means: np.ndarray, rotations: np.ndarray, scales: np.ndarray, opacities: np.ndarray, sh: np.ndarray
    ) -> SplatCloud:
        """Return a cloud of arrays of any float type; quaternions are normalised.

        Raises:
            ValueError: their shapes do not fit together, or a value is not finite or out of its range.
        """
        count = len(means)
        shapes = {"rotations": (count, 4), "scales": (count, 3), "opacities": (count,), "means": (count, 3)}
        arrays = {"means": means, "rotations": rotations, "scales": scales, "opacities": opacities}
        for name, shape in shapes.items():
            if np.shape(arrays[name]) != shape:
                raise ValueError(f"{name} have shape {np.shape(arrays[name])}, not {shape}")
        if sh.ndim != 3 or len(sh) != count or sh.shape[1] not in COEFFICIENTS or sh.shape[2] != 3:
            raise ValueError(f"colours have shape {sh.shape}, not ({count}, 1, 4, 9 or 16, 3)")
        arrays["sh"] = sh
        for name, array in arrays.items():
            arrays[name] = array = np.ascontiguousarray(array, np.float32)
            bad = np.flatnonzero(~np.isfinite(array.reshape(count, -1)).all(axis=1))
            if len(bad):
                raise ValueError(f"{name} of splat {bad[0]} are not finite; delete {len(bad)} such splats")
        norm = np.linalg.norm(arrays["rotations"].astype(np.float64), axis=1, keepdims=True)
        if count and not norm.min() > 1e-9:
            raise ValueError(f"the quaternion of splat {int(norm.argmin())} is zero; delete that splat")
        arrays["rotations"] = (arrays["rotations"] / norm).astype(np.float32)
        if count and not arrays["scales"].min() >= 0.0:
            raise ValueError(f"a scale is {arrays['scales'].min():g}, and must not be negative")
        if count and not 0.0 <= arrays["opacities"].min() <= arrays["opacities"].max() <= 1.0:
            low, high = arrays["opacities"].min(), arrays["opacities"].max()
            raise ValueError(f"opacities are {low:g} to {high:g}, and must be within [0, 1]")
        return SplatCloud(**arrays)

    @staticmethod
    def deformed(
        cloud: SplatCloud, means: np.ndarray, covariances: np.ndarray, turns: np.ndarray | None = None
    ) -> SplatCloud:
        """Return a cloud with other centres and covariances.

        Args:
            cloud: gives opacities and colours.
            means: centres [m], shape ``(S, 3)``.
            covariances: symmetric [m^2], shape ``(S, 3, 3)``.
            turns: rotations by which colours turn with the splats, shape ``(S, 3, 3)`` or ``(3, 3)``; None for none.
        """
        variances, axes = np.linalg.eigh(np.asarray(covariances, np.float64))
        axes[np.linalg.det(axes) < 0.0, :, 0] *= -1.0
        variances = np.maximum(variances, np.maximum(_THINNEST * variances[:, 2:], 1e-18))
        rotations = Rotation.from_matrix(axes).as_quat()
        sh = cloud.sh if turns is None else turned_colors(cloud.sh, turns)
        return SplatCloud.of(means, rotations, np.sqrt(variances), cloud.opacities, sh)

    def covariances(self) -> np.ndarray:
        """Return the covariances [m^2], shape ``(S, 3, 3)`` float64."""
        axes = Rotation.from_quat(self.rotations.astype(np.float64)).as_matrix() * self.scales[:, None, :]
        return axes @ axes.transpose(0, 2, 1)

    def packed_covariances(self) -> np.ndarray:
        """Return the covariances as xx, xy, xz, yy, yz, zz [m^2], shape ``(S, 6)`` float32."""
        return self.covariances().reshape(-1, 9)[:, [0, 1, 2, 4, 5, 8]].astype(np.float32)

    def placed(self, turn: np.ndarray, size: float, shift: np.ndarray) -> SplatCloud:
        """Return the cloud after a similarity ``x -> size turn x + shift``.

        Args:
            turn: rotation matrix, shape ``(3, 3)``.
            size: factor of all lengths.
            shift: shape ``(3,)``.
        """
        rotations = (Rotation.from_matrix(turn) * Rotation.from_quat(self.rotations)).as_quat()
        return SplatCloud.of(
            size * self.means @ np.asarray(turn).T + shift,
            rotations,
            size * self.scales,
            self.opacities,
            turned_colors(self.sh, turn),
        )

    def chosen(self, rows: np.ndarray) -> SplatCloud:
        """Return some of the splats, by their indices or by a mask."""
        return SplatCloud(
            self.means[rows], self.rotations[rows], self.scales[rows], self.opacities[rows], self.sh[rows]
        )

    def colors(self, directions: np.ndarray) -> np.ndarray:
        """Return colours in [0, 1] as seen along unit directions ``(S, 3)`` or ``(3,)``, shape ``(S, 3)``."""
        basis = np.broadcast_to(harmonics(directions, self.degree), (len(self), self.sh.shape[1]))
        return np.clip(0.5 + np.einsum("sk,skc->sc", basis, self.sh), 0.0, 1.0)


@dataclass(frozen=True, eq=False)
class SkinnedSplats:
    """Splats that bones move.

    Attributes:
        cloud: the splats in the rest pose.
        skin_joints: joints that move each splat, shape ``(S, 4)`` int32.
        skin_weights: their weights, descending, rows sum to one, shape ``(S, 4)`` float32.
    """

    cloud: SplatCloud
    skin_joints: np.ndarray
    skin_weights: np.ndarray


def joined_colors(coefficients: Sequence[np.ndarray]) -> np.ndarray:
    """Return the coefficients of the colours of several clouds, shape ``(S, K, 3)``, ``K`` the largest of theirs."""
    most = max((sh.shape[1] for sh in coefficients), default=1)
    joined, first = np.zeros((sum(map(len, coefficients)), most, 3), np.float32), 0
    for sh in coefficients:
        joined[first : first + len(sh), : sh.shape[1]] = sh
        first += len(sh)
    return joined


def mean_colors(sh: np.ndarray) -> np.ndarray:
    """Return the means of colours over all directions, of coefficients ``(S, K, 3)``, shape ``(S, 3)``."""
    return 0.5 + FACTORS[0] * sh[:, 0]


def constant_colors(colors: np.ndarray) -> np.ndarray:
    """Return the coefficients of colours ``(S, 3)`` that are the same from all sides, shape ``(S, 1, 3)`` float32."""
    return ((np.asarray(colors) - 0.5) / FACTORS[0]).astype(np.float32)[:, None]


def harmonics(directions: np.ndarray, degree: int) -> np.ndarray:
    """Return the real spherical harmonics up to a degree of unit directions, shapes ``(..., 3)`` to ``(..., K)``."""
    x, y, z = np.moveaxis(np.asarray(directions, np.float64), -1, 0)
    xx, yy, zz = x * x, y * y, z * z
    terms = [np.ones_like(x), y, z, x]
    if degree > 1:
        terms += [x * y, y * z, 2.0 * zz - xx - yy, x * z, xx - yy]
    if degree > 2:
        terms += [y * (3.0 * xx - yy), x * y * z, y * (4.0 * zz - xx - yy), z * (2.0 * zz - 3.0 * xx - 3.0 * yy)]
        terms += [x * (4.0 * zz - xx - yy), z * (xx - yy), x * (xx - 3.0 * yy)]
    count = COEFFICIENTS[degree]
    return np.stack(terms[:count], axis=-1) * FACTORS[:count]


def turned_colors(sh: np.ndarray, turns: np.ndarray) -> np.ndarray:
    """Return coefficients of colours that turn with their splats, shape ``(S, K, 3)``.

    The harmonics of a degree turn among themselves. Their matrix follows from as many directions ``D`` as there are
    harmonics: ``Y(D) c' = Y(D R) c`` with the turned directions ``R^T d`` in the rows of ``D R``.

    Args:
        sh: coefficients, shape ``(S, K, 3)``.
        turns: rotations, shape ``(S, 3, 3)`` or one for all ``(3, 3)``.
    """
    result = np.array(sh, np.float32)
    turns = np.broadcast_to(np.asarray(turns, np.float64), (len(sh), 3, 3))
    for degree in range(1, COEFFICIENTS.index(sh.shape[1]) + 1):
        own = slice(degree**2, (degree + 1) ** 2)
        directions = _spread(2 * degree + 1)
        inverse = np.linalg.inv(harmonics(directions, degree)[:, own])
        for first in range(0, len(sh), _TOGETHER):
            rows = slice(first, first + _TOGETHER)
            seen = harmonics(directions @ turns[rows], degree)[..., own]
            result[rows, own] = inverse @ (seen @ sh[rows, own])
    return result


def _spread(count: int) -> np.ndarray:
    """Return unit directions at which the harmonics of a degree are independent, shape ``(count, 3)``."""
    index = np.arange(count) + 0.5
    height, angle = 1.0 - 1.3 * index / count, 2.399963229728653 * index
    across = np.sqrt(1.0 - height**2)
    return np.stack([across * np.cos(angle), across * np.sin(angle), height], axis=1)
