"""Cholesky factors of small sparse matrices, one an environment, and what is solved with them.

The matrix is ``L^T L`` with a lower triangle ``L``: rows are eliminated from the last one up. Where rows are joints
in an order that has children after their parents, limbs go before what they hang on, and of two limbs neither fills
the rows of the other (Featherstone, "Rigid Body Dynamics Algorithms", 2008, ch. 6.5). Which entries are not zero is
found once, on the host. The threads of a warp share a matrix on a GPU; on a CPU one thread has it to itself
(``threads = 1``). What is not ``wanted`` ``(num_envs,)`` stays as it is.
"""

from __future__ import annotations

import numpy as np
import warp as wp

from piavatar_envs.avatar.lanes import meet_threads, sum_threads

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})


@wp.struct
class Pattern:
    """Entries of ``L`` before the diagonal that need not be zero: row ``k`` has ``column[start[k] : start[k + 1]]``."""

    start: wp.array(dtype=int)  # (rows + 1,)
    column: wp.array(dtype=int)  # in a row from the first to the last


def find_pattern(filled: np.ndarray, device: str) -> Pattern:
    """Where ``L`` has entries, by elimination, from where the matrix has: ``filled``, shape ``(N, N)`` bool."""
    filled = filled | filled.T
    columns = []
    for k in reversed(range(len(filled))):
        found = np.flatnonzero(filled[k, :k])
        filled[np.ix_(found, found)] = True
        columns.append(found)
    columns.reverse()
    pattern = Pattern()
    start = np.cumsum([0, *map(len, columns)])
    pattern.start = wp.array(start.astype(np.int32), dtype=int, device=device)
    pattern.column = wp.array(np.concatenate(columns).astype(np.int32), dtype=int, device=device)
    return pattern


# Rows as plain pointers: on a CPU, finding an entry's address costs more than what is done with it.
_ROW = """
const int* const at = column.data;
const float* const row = &wp::index(factor, e, k, 0);
"""


@wp.func_native(
    _ROW + "float* const to = &wp::index(factor, e, i, 0);\n"
    "for (int n = first; n < last; ++n) to[at[n]] -= share * row[at[n]];"
)
def subtract_row(
    column: wp.array(dtype=int),
    first: int,
    last: int,
    factor: wp.array3d(dtype=float),
    e: int,
    k: int,
    i: int,
    share: float,
):
    """Take ``share`` of row ``k`` of a factor from row ``i``, in columns ``first`` to ``last`` of the pattern."""
    ...


@wp.func_native(
    _ROW + "float* const to = &wp::index(x, e, 0);\n"
    "for (int n = first; n < last; n += threads) to[at[n]] -= row[at[n]] * y;"
)
def subtract_column(
    column: wp.array(dtype=int),
    first: int,
    last: int,
    threads: int,
    factor: wp.array3d(dtype=float),
    e: int,
    k: int,
    y: float,
    x: wp.array2d(dtype=float),
):
    """Take ``y`` times row ``k`` of a factor from a vector, every ``threads``-th of its columns."""
    ...


@wp.func_native(
    _ROW + "const float* const from = &wp::index(x, e, 0);\nfloat sum = 0.0f;\n"
    "for (int n = first; n < last; n += threads) sum += row[at[n]] * from[at[n]];\nreturn sum;"
)
def dot_row(
    column: wp.array(dtype=int),
    first: int,
    last: int,
    threads: int,
    factor: wp.array3d(dtype=float),
    e: int,
    k: int,
    x: wp.array2d(dtype=float),
) -> float:
    """Product of row ``k`` of a factor, every ``threads``-th of its columns, and a vector."""
    ...


@wp.kernel
def factorize(
    pattern: Pattern,
    matrix: wp.array3d(dtype=float),
    diagonal: wp.array2d(dtype=float),
    wanted: wp.array(dtype=int),
    threads: int,
    # out
    factor: wp.array3d(dtype=float),
):
    """``L`` of ``L^T L = matrix + diag(diagonal)``; launched over ``(num_envs, threads)``.

    Only the lower triangle of ``matrix`` ``(num_envs, N, N)`` is read, and only that of ``factor`` is written, both
    where the pattern says. ``diagonal`` is ``(1 or num_envs, N)``.
    """
    e, thread = wp.tid()
    if wanted[e] == 0:
        return
    size = matrix.shape[1]
    r = wp.min(e, diagonal.shape[0] - 1)
    for k in range(thread, size, threads):
        for n in range(pattern.start[k], pattern.start[k + 1]):
            factor[e, k, pattern.column[n]] = matrix[e, k, pattern.column[n]]
        factor[e, k, k] = matrix[e, k, k] + diagonal[r, k]
    meet_threads(threads)
    for row in range(size):
        k = size - 1 - row
        first = pattern.start[k]
        last = pattern.start[k + 1]
        pivot = wp.sqrt(factor[e, k, k])
        meet_threads(threads)
        for n in range(first + thread, last, threads):
            i = pattern.column[n]
            factor[e, k, i] = factor[e, k, i] / pivot
        if thread == 0:
            factor[e, k, k] = pivot
        meet_threads(threads)
        for n in range(first + thread, last, threads):
            i = pattern.column[n]
            share = factor[e, k, i]
            subtract_row(pattern.column, first, n, factor, e, k, i, share)
            factor[e, i, i] = factor[e, i, i] - share * share
        meet_threads(threads)


@wp.kernel
def solve(
    pattern: Pattern,
    factor: wp.array3d(dtype=float),
    right: wp.array2d(dtype=float),
    wanted: wp.array(dtype=int),
    threads: int,
    # out
    x: wp.array2d(dtype=float),
):
    """``x`` with ``L^T L x = right``, ``L`` the ``factor``; launched over ``(num_envs, threads)``."""
    e, thread = wp.tid()
    if wanted[e] == 0:
        return
    size = factor.shape[1]
    for i in range(thread, size, threads):
        x[e, i] = right[e, i]
    meet_threads(threads)
    for row in range(size):
        k = size - 1 - row
        y = x[e, k] / factor[e, k, k]
        meet_threads(threads)
        if thread == 0:
            x[e, k] = y
        first = pattern.start[k] + thread
        subtract_column(pattern.column, first, pattern.start[k + 1], threads, factor, e, k, y, x)
        meet_threads(threads)
    for k in range(size):
        first = pattern.start[k] + thread
        part = dot_row(pattern.column, first, pattern.start[k + 1], threads, factor, e, k, x)
        part = sum_threads(part, threads)
        if thread == 0:
            x[e, k] = (x[e, k] - part) / factor[e, k, k]
        meet_threads(threads)
