"""Matrices of particles, an array a component: ``(num_envs, 9, num_particles)``, row by row.

Of matrices that lie one after the other, 36 bytes each, the threads of a warp read nine words, and touch nine lines of
the cache with each of them. Component by component, neighbouring threads read and write neighbouring words. Each
component begins where a line does, or what a warp writes would begin and end amid the sectors that memory takes.
"""

from __future__ import annotations

import numpy as np
import warp as wp

wp.set_module_options({"enable_backward": False})

#: Components begin at multiples of so many numbers: a line of a GPU's cache.
LINE = 32

_COMPONENTS = """
char* const first = reinterpret_cast<char*>(rows.data) + wp::int64(rows.strides[0]) * e;
wp::float32* const at = reinterpret_cast<wp::float32*>(first) + p;
const int n = rows.strides[1] / 4;
"""


@wp.func_native(
    _COMPONENTS
    + "return wp::mat33(at[0], at[n], at[2 * n], at[3 * n], at[4 * n], at[5 * n], at[6 * n], at[7 * n], at[8 * n]);"
)
def matrix_at(rows: wp.array3d(dtype=float), e: int, p: int) -> wp.mat33:
    """Matrix of particle ``p`` in environment ``e``."""
    ...


@wp.func_native(
    _COMPONENTS
    + """
#pragma unroll
for (int c = 0; c < 9; ++c) at[c * n] = value.data[c / 3][c % 3];
"""
)
def store_matrix(rows: wp.array3d(dtype=float), e: int, p: int, value: wp.mat33):
    """Write the matrix of particle ``p`` in environment ``e``."""
    ...


def whole_lines(num_particles: int) -> int:
    """Numbers that a component of so many particles takes."""
    return -(-num_particles // LINE) * LINE


def allocate_matrices(num_envs: int, num_particles: int, device: str) -> wp.array:
    """Zeros."""
    return wp.zeros((num_envs, 9, whole_lines(num_particles)), dtype=float, device=device)[:, :, :num_particles]


def matrices_of(components: wp.array | np.ndarray) -> np.ndarray:
    """A copy as matrices, ``(..., 9, num_particles)`` to ``(..., num_particles, 3, 3)``."""
    values = components if isinstance(components, np.ndarray) else components.numpy()
    matrices = np.ascontiguousarray(np.moveaxis(values, -2, -1))  # on a CPU the values are the array's own memory
    return matrices.reshape(*values.shape[:-2], values.shape[-1], 3, 3)


def components_of(matrices: np.ndarray) -> np.ndarray:
    """The inverse of :func:`matrices_of`, in single precision."""
    values = np.asarray(matrices, np.float32)
    return np.ascontiguousarray(np.moveaxis(values.reshape(*values.shape[:-2], 9), -1, -2))
