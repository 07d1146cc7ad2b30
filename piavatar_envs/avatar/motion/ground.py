"""Height of a clip's skin above the ground."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy.sparse import csr_array

from piavatar_envs.avatar.body.skeleton import NUM_JOINTS

if TYPE_CHECKING:
    from piavatar_envs.avatar.body.asset import AvatarAsset, ShapedBody

_CHUNK = 128  # frames skinned at once, bounds the memory of long clips


class Clip(Protocol):
    """Poses in frames, such as a :class:`~piavatar_envs.avatar.motion.motion.Motion`."""

    @property
    def num_frames(self) -> int:
        """Return the number of frames."""

    def joint_frames(self, rest_joints: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return world rotations ``(num_frames, 22, 3, 3)`` and joint positions [m] ``(num_frames, 22, 3)``."""


def lowest_heights(
    motion: Clip, asset: AvatarAsset, body: ShapedBody | None = None, ignored: tuple[int, ...] = ()
) -> np.ndarray:
    """Return the height of the lowest skin point in each frame [m].

    Args:
        motion: the clip.
        asset: the avatar whose skinning weights are used.
        body: one of its shapes; without it the mean shape.
        ignored: joints whose skin is left out (the vertices they move most).

    Returns:
        Heights, shape ``(num_frames,)``.
    """
    shape = asset if body is None else body
    joints = np.asarray(shape.joints, dtype=np.float64)
    rotations, positions = motion.joint_frames(joints)
    # Only heights are wanted, so the skinning sum is one sparse product: z = sum_k w_k (row_z(R_k) . v + t_k,z).
    rows = rotations[:, :, 2, :]
    offsets = positions[:, :, 2] - np.einsum("fbj,bj->fb", rows, joints)
    coefficients = np.concatenate([rows, offsets[..., None]], axis=-1).reshape(motion.num_frames, 4 * NUM_JOINTS)
    main = np.take_along_axis(asset.skin_joints, asset.skin_weights.argmax(axis=1)[:, None], axis=1)[:, 0]
    kept = ~np.isin(main, ignored)
    basis = _skinning_basis(shape.vertices[kept], asset.skin_joints[kept], asset.skin_weights[kept])
    chunks = [coefficients[i : i + _CHUNK] for i in range(0, motion.num_frames, _CHUNK)]
    return np.concatenate([(basis @ chunk.T).min(axis=0) for chunk in chunks])


def ground_level(heights: np.ndarray, fps: float, window: float, loop: bool) -> np.ndarray:
    """Return a smooth floor under a clip that drifts up and down: the lowest height within a window, then averaged.

    The average reaches no farther than the minimum does, so the level is never above ``heights``, and a flight shorter
    than the window stays a flight.

    Args:
        heights: lowest skin point of each frame [m], shape ``(num_frames,)``.
        fps: frames per second [1/s].
        window: width of the window [s].
        loop: the last frame is the first of the next round.

    Returns:
        The level of each frame [m], shape ``(num_frames,)``.
    """
    radius = int(np.ceil(0.5 * window * fps))
    minimum = sliding_window_view(padded(heights, 2 * radius, loop), 2 * radius + 1).min(axis=1)
    kernel = np.hanning(2 * radius + 3)[1:-1]
    return np.convolve(minimum, kernel / kernel.sum(), mode="valid")


def padded(values: np.ndarray, radius: int, loop: bool) -> np.ndarray:
    """Return values of the frames with ``radius`` more at both ends: other rounds of a loop, or the end values held.

    Args:
        values: shape ``(num_frames,)``; in a loop the last is the first of the next round.
        radius: number of frames.
        loop: whether it is one.
    """
    if not loop:
        return np.pad(values, radius, mode="edge")
    return values[np.arange(-radius, len(values) + radius) % (len(values) - 1)]


def _skinning_basis(vertices: np.ndarray, skin_joints: np.ndarray, skin_weights: np.ndarray) -> csr_array:
    """Return the sparse ``(V, 4 * 22)`` matrix that turns each bone's affine height row into vertex heights."""
    count, influences = skin_joints.shape
    homogeneous = np.concatenate([vertices, np.ones((count, 1))], axis=1).astype(np.float64)
    values = skin_weights[:, :, None] * homogeneous[:, None, :]
    columns = 4 * skin_joints[:, :, None].astype(np.int64) + np.arange(4)
    starts = np.arange(count + 1) * influences * 4
    return csr_array((values.ravel(), columns.ravel(), starts), shape=(count, 4 * NUM_JOINTS))
