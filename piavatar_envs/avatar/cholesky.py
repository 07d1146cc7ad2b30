"""Cholesky factors of small dense matrices, one an environment, and what is solved with them.

The threads of a warp share a matrix on a GPU; on a CPU one thread has it to itself (``threads = 1``).
What is not ``wanted`` ``(num_envs,)`` stays as it is.
"""

from __future__ import annotations

import warp as wp

from piavatar_envs.avatar.lanes import meet_threads

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})


@wp.kernel
def factorize(
    matrix: wp.array3d(dtype=float),
    diagonal: wp.array2d(dtype=float),
    wanted: wp.array(dtype=int),
    threads: int,
    # out
    factor: wp.array3d(dtype=float),
):
    """Lower triangular ``L`` with ``L L^T = matrix + diag(diagonal)``; launched over ``(num_envs, threads)``.

    Only the lower triangle of ``matrix`` ``(num_envs, N, N)`` is read, and only that of ``factor`` is written.
    ``diagonal`` is ``(1 or num_envs, N)``. Columns are taken off the rest one after the other (right-looking).
    """
    e, thread = wp.tid()
    if wanted[e] == 0:
        return
    size = matrix.shape[1]
    r = wp.min(e, diagonal.shape[0] - 1)
    for i in range(thread, size, threads):
        for j in range(i):
            factor[e, i, j] = matrix[e, i, j]
        factor[e, i, i] = matrix[e, i, i] + diagonal[r, i]
    meet_threads(threads)
    for j in range(size):
        pivot = wp.sqrt(factor[e, j, j])
        meet_threads(threads)
        for i in range(j + thread, size, threads):
            factor[e, i, j] = factor[e, i, j] / pivot
        meet_threads(threads)
        for i in range(j + 1 + thread, size, threads):
            share = factor[e, i, j]
            for k in range(j + 1, i + 1):
                factor[e, i, k] = factor[e, i, k] - share * factor[e, k, j]
        meet_threads(threads)


@wp.kernel
def solve(
    factor: wp.array3d(dtype=float),
    right: wp.array2d(dtype=float),
    wanted: wp.array(dtype=int),
    threads: int,
    # out
    x: wp.array2d(dtype=float),
):
    """``x`` with ``L L^T x = right``, ``L`` the ``factor``; launched over ``(num_envs, threads)``."""
    e, thread = wp.tid()
    if wanted[e] == 0:
        return
    size = factor.shape[1]
    for i in range(thread, size, threads):
        x[e, i] = right[e, i]
    meet_threads(threads)
    for j in range(size):
        y = x[e, j] / factor[e, j, j]
        meet_threads(threads)
        if thread == 0:
            x[e, j] = y
        for i in range(j + 1 + thread, size, threads):
            x[e, i] = x[e, i] - factor[e, i, j] * y
        meet_threads(threads)
    for n in range(size):
        j = size - 1 - n
        y = x[e, j] / factor[e, j, j]
        meet_threads(threads)
        if thread == 0:
            x[e, j] = y
        for i in range(thread, j, threads):
            x[e, i] = x[e, i] - factor[e, j, i] * y
        meet_threads(threads)
