"""Cholesky factors of small sparse matrices, one an environment, and what is solved with them.

The matrix is ``L^T L`` with a lower triangle ``L``: rows are eliminated from the last one up. Where rows are joints
in an order that has children after their parents, limbs go before what they hang on, and of two limbs neither fills
the rows of the other (Featherstone, "Rigid Body Dynamics Algorithms", 2008, ch. 6.5). Which entries are not zero is
found once, on the host; rows come in threes, the axes of a joint.

A factor's rows lie one after the other, row ``k`` from entry ``k (k + 1) / 2`` on. On a CPU one thread has a matrix to
itself (``threads = 1``). On a GPU a warp has it, in a ``room`` in shared memory
(:mod:`piavatar_envs.avatar.warp_cholesky`): each row needs the one before, and would wait for global memory every time.
"""

from __future__ import annotations

import numpy as np
import warp as wp

from piavatar_envs.avatar.lanes import meet_threads
from piavatar_envs.avatar.warp_cholesky import (
    MOST_ROWS,
    eliminate_together,
    factorize_together,
    load_factor,
    solve_three_together,
    solve_together,
    store_factor,
)

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})


@wp.struct
class Pattern:
    """Entries of ``L`` before the diagonal that need not be zero: row ``k`` has ``column[start[k] : start[k + 1]]``."""

    start: wp.array(dtype=int)  # (rows + 1,)
    column: wp.array(dtype=int)  # in a row from the first to the last
    # for a warp
    entry: wp.array(dtype=int)  # all entries, those of the diagonal, too: 256 row + column
    # entries that change when joint c is eliminated, three of a row at a time: pair[pair_start[c] : pair_start[c + 1]],
    # place of the first in the factor times 2^16, and which of the joint's columns are its row, times 2^8, and its own
    pair_start: wp.array(dtype=int)
    pair: wp.array(dtype=int)


def find_pattern(filled: np.ndarray, device: str) -> Pattern:
    """Where ``L`` has entries, by elimination, from where the matrix has: ``filled``, shape ``(N, N)`` bool.

    Raises:
        ValueError: it is not made of filled and empty blocks of 3 x 3, or has too many rows.
    """
    filled = filled | filled.T
    joints = filled[::3, ::3]
    if len(filled) > MOST_ROWS or not np.array_equal(np.kron(joints, np.ones((3, 3), bool)), filled):
        raise ValueError(f"filled has shape {filled.shape}, expected at most {MOST_ROWS} rows, in blocks of 3 x 3")
    columns = []
    for k in reversed(range(len(filled))):
        found = np.flatnonzero(filled[k, :k])
        filled[np.ix_(found, found)] = True
        columns.append(found)
    columns.reverse()
    pairs = []
    for own in columns[::3]:
        i, j = np.nonzero(np.tri(len(own), dtype=bool))
        i, j = i[j % 3 == 0], j[j % 3 == 0]
        pairs.append((own[i] * (own[i] + 1) // 2 + own[j]) << 16 | i << 8 | j)
    lists = {
        "start": np.cumsum([0, *map(len, columns)]),
        "column": np.concatenate(columns),
        "entry": np.concatenate([k << 8 | np.r_[own, k] for k, own in enumerate(columns)]),
        "pair_start": np.cumsum([0, *map(len, pairs)]),
        "pair": np.concatenate(pairs),
    }
    pattern = Pattern()
    for name, numbers in lists.items():
        setattr(pattern, name, wp.array(numbers.astype(np.int32), dtype=int, device=device))
    return pattern


def factor_size(rows: int) -> int:
    """Numbers of a factor, in whole records of four."""
    return -(-rows * (rows + 1) // 2 // 4) * 4


@wp.func
def start_of_row(k: int):
    """First entry of row ``k`` of a factor."""
    return k * (k + 1) // 2


# Rows as plain pointers: on a CPU, finding an entry's address costs more than what is done with it.
_ROW = """
const int* const at = column.data;
const float* const row = &wp::index(factor, f, k * (k + 1) / 2);
"""


@wp.func_native(
    _ROW + "float* const to = &wp::index(factor, f, i * (i + 1) / 2);\n"
    "for (int n = first; n < last; ++n) to[at[n]] -= share * row[at[n]];"
)
def subtract_row(
    column: wp.array(dtype=int),
    first: int,
    last: int,
    factor: wp.array2d(dtype=float),
    f: int,
    k: int,
    i: int,
    share: float,
):
    """Take ``share`` of row ``k`` of a factor from row ``i``, in columns ``first`` to ``last`` of the pattern."""
    ...


@wp.func_native(
    _ROW + "float* const to = &wp::index(x, e, 0);\nfor (int n = first; n < last; ++n) to[at[n]] -= row[at[n]] * y;"
)
def subtract_column(
    column: wp.array(dtype=int),
    first: int,
    last: int,
    factor: wp.array2d(dtype=float),
    f: int,
    k: int,
    y: float,
    e: int,
    x: wp.array2d(dtype=float),
):
    """Take ``y`` times row ``k`` of a factor from a vector."""
    ...


@wp.func_native(
    _ROW + "const float* const from = &wp::index(x, e, 0);\nfloat sum = 0.0f;\n"
    "for (int n = first; n < last; ++n) sum += row[at[n]] * from[at[n]];\nreturn sum;"
)
def dot_row(
    column: wp.array(dtype=int),
    first: int,
    last: int,
    factor: wp.array2d(dtype=float),
    f: int,
    k: int,
    e: int,
    x: wp.array2d(dtype=float),
) -> float:
    """Product of row ``k`` of a factor and a vector."""
    ...


@wp.func
def factorize_alone(
    pattern: Pattern,
    matrix: wp.array3d(dtype=float),
    diagonal: wp.array2d(dtype=float),
    source: int,
    e: int,
    f: int,
    factor: wp.array2d(dtype=float),
):
    """:func:`factorize` for one thread."""
    size = matrix.shape[1]
    for k in range(size):
        at = start_of_row(k)
        for n in range(pattern.start[k], pattern.start[k + 1]):
            factor[f, at + pattern.column[n]] = matrix[source, k, pattern.column[n]]
        factor[f, at + k] = matrix[source, k, k] + diagonal[e, k]
    for row in range(size):
        k = size - 1 - row
        at = start_of_row(k)
        first = pattern.start[k]
        last = pattern.start[k + 1]
        pivot = wp.sqrt(factor[f, at + k])
        factor[f, at + k] = pivot
        for n in range(first, last):
            i = pattern.column[n]
            share = factor[f, at + i] / pivot
            factor[f, at + i] = share
            subtract_row(pattern.column, first, n, factor, f, k, i, share)
            own = start_of_row(i) + i
            factor[f, own] = factor[f, own] - share * share


@wp.func
def solve_alone(pattern: Pattern, factor: wp.array2d(dtype=float), f: int, e: int, x: wp.array2d(dtype=float)):
    """:func:`solve` for one thread, ``x[e]`` with factor ``f``; ``x`` has the right-hand side at first."""
    size = x.shape[1]
    for row in range(size):
        k = size - 1 - row
        y = x[e, k] / factor[f, start_of_row(k) + k]
        x[e, k] = y
        subtract_column(pattern.column, pattern.start[k], pattern.start[k + 1], factor, f, k, y, e, x)
    for k in range(size):
        part = dot_row(pattern.column, pattern.start[k], pattern.start[k + 1], factor, f, k, e, x)
        x[e, k] = (x[e, k] - part) / factor[f, start_of_row(k) + k]


@wp.func
def factorize(
    pattern: Pattern,
    matrix: wp.array3d(dtype=float),
    diagonal: wp.array2d(dtype=float),
    source: int,
    e: int,
    threads: int,
    room: wp.uint64,
    f: int,
    # out
    factor: wp.array2d(dtype=float),
):
    """``L`` of ``L^T L = matrix + diag(diagonal)``, of matrix ``source`` and row ``e`` of the ``diagonal``.

    Only the lower triangle of ``matrix`` ``(num_envs, N, N)`` is read, zero where the pattern has nothing. A thread
    that is alone writes factor ``f``, ``(systems, factor_size(N))``, where the pattern says; a warp has it in its room,
    from where :func:`keep_factor` writes it.
    """
    if threads == 1:
        factorize_alone(pattern, matrix, diagonal, source, e, f, factor)
    else:
        p = pattern
        factorize_together(p.start, p.column, p.entry, p.pair_start, p.pair, matrix, diagonal, source, e, room)


@wp.func
def factorize_in_room(pattern: Pattern, diagonal: wp.array2d(dtype=float), e: int, room: wp.uint64):
    """:func:`factorize` for a warp that has the matrix in its room."""
    p = pattern
    eliminate_together(p.start, p.column, p.pair_start, p.pair, diagonal, e, room)


@wp.func
def keep_factor(threads: int, room: wp.uint64, f: int, factor: wp.array2d(dtype=float)):
    """Write factor ``f``, which :func:`factorize` has just found, where it has not done so itself."""
    if threads > 1:
        store_factor(room, f, factor)


@wp.func
def fetch_factor(factor: wp.array2d(dtype=float), f: int, threads: int, room: wp.uint64):
    """Let a warp solve with factor ``f`` from here on."""
    if threads > 1:
        load_factor(factor, f, room)


@wp.func
def solve(
    pattern: Pattern,
    factor: wp.array2d(dtype=float),
    f: int,
    right: wp.array2d(dtype=float),
    e: int,
    row: int,
    thread: int,
    threads: int,
    room: wp.uint64,
    # out
    x: wp.array2d(dtype=float),
):
    """``x[row]`` with ``L^T L x = right[e]``, ``L`` factor ``f``: of a warp the one in its room."""
    copy_row(right, e, row, thread, threads, x)
    if threads == 1:
        solve_alone(pattern, factor, f, row, x)
    else:
        solve_together(room, row, 0, x)
        meet_threads(threads)


@wp.func
def solve_in_place(
    pattern: Pattern,
    factor: wp.array2d(dtype=float),
    f: int,
    first: int,
    step: int,
    rows: int,
    threads: int,
    room: wp.uint64,
    # in and out
    x: wp.array2d(dtype=float),
):
    """:func:`solve` of so many ``rows`` of right-hand sides in ``x``, the ``first`` and others ``step`` rows apart.

    A warp solves three at once, whatever is in those that nobody asks for.
    """
    meet_threads(threads)
    if threads == 1:
        for n in range(rows):
            solve_alone(pattern, factor, f, first + n * step, x)
    else:
        solve_three_together(room, first, step, x)
        meet_threads(threads)


@wp.func
def copy_row(right: wp.array2d(dtype=float), e: int, row: int, thread: int, threads: int, x: wp.array2d(dtype=float)):
    """``x[row] = right[e]``, when all threads have come."""
    meet_threads(threads)
    for i in range(thread, x.shape[1], threads):
        x[row, i] = right[e, i]
    meet_threads(threads)
