"""Cholesky factors of small sparse matrices, one an environment, and what is solved with them.

The matrix is ``L^T L`` with a lower triangle ``L``: rows are eliminated from the last one up. Where rows are joints
in an order that has children after their parents, limbs go before what they hang on, and of two limbs neither fills
the rows of the other (Featherstone, "Rigid Body Dynamics Algorithms", 2008, ch. 6.5). Which blocks of 3 x 3, the axes
of two joints, are not zero is found once, on the host.

Matrices and factors are kept as these blocks alone, one after the other, row by row, in a row the diagonal's last; of a
matrix that one is whole. In a factor it is its inverse, ``L_kk^-1``, lower, which is all that solutions ask for. On a
GPU a warp works on a factor in a ``room`` in shared memory, on a CPU one thread does where factors are kept: the same
program, :mod:`piavatar_envs.avatar.warp_cholesky`.
"""

from __future__ import annotations

import numpy as np
import warp as wp

from piavatar_envs.avatar.lanes import lane_of_warp, meet_threads
from piavatar_envs.avatar.warp_cholesky import (
    MOST_ROWS,
    add_diagonal,
    ascend_one,
    descend_three,
    eliminate,
    load_room,
    place_of_factor,
    solve_one,
    solve_three,
    store_room,
)

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})


@wp.struct
class Pattern:
    """Blocks of ``L`` that need not be zero, and what the lanes of a warp do with them, in rounds.

    All rounds of a kind are followed by two of nothing, for they are asked for ahead. A lane's word is -1 where it does
    nothing.
    """

    block: wp.array(dtype=int)  # (joints * joints,) of two joints, -1 where there is none
    entry: wp.array(dtype=int)  # (rows,) numbers of the diagonal's entries
    # (rounds,) of the elimination of a row: bytes to its first block, bytes to that of the diagonal, columns before
    # that, and 1 where the round goes on with the row before it
    step: wp.array(dtype=wp.vec4i)
    # (rounds * 32,) a block that changes by the product of two of the row: 2^16 times the bytes to it, 2^8 times the
    # numbers from the row's first block to the first, those to the second
    pair: wp.array(dtype=int)
    # (rounds,) of a solution: 2^10 times the bytes to the diagonal's block, and to the joint's part of a vector that
    # has sixteen a joint; -1 where the round goes on with the joint before it
    head: wp.array(dtype=int)
    # (rounds * 32,) which part of the vector changes, in bytes, and 2^10 times those to the first of three numbers
    word: wp.array(dtype=int)
    turn: int  # rounds on the way down, an even number; those on the way up are as well
    reach: wp.array(dtype=int)  # (joints,) bits of the joints to which what is in one comes on the way down


#: Lanes of a warp, which a round has work for, and the bytes of a number and of a block.
LANES, NUMBER, BLOCK = 32, 4, 36


def in_rounds(words: np.ndarray) -> np.ndarray:
    """The same in whole rounds, one at least."""
    return np.pad(words, (0, max(LANES, -(-len(words) // LANES) * LANES) - len(words)), constant_values=-1)


def find_pattern(filled: np.ndarray, device: str) -> Pattern:
    """Where ``L`` has entries, by elimination, from where the matrix has: ``filled``, shape ``(N, N)`` bool.

    Raises:
        ValueError: it is not made of filled and empty blocks of 3 x 3, or has too many rows.
    """
    filled = filled | filled.T
    joints = filled[::3, ::3].copy()
    if len(filled) > MOST_ROWS or not np.array_equal(np.kron(joints, np.ones((3, 3), bool)), filled):
        raise ValueError(f"filled has shape {filled.shape}, expected at most {MOST_ROWS} rows, in blocks of 3 x 3")
    for k in reversed(range(len(joints))):
        found = np.flatnonzero(joints[k, :k])
        joints[np.ix_(found, found)] = True
    row, column = np.nonzero(np.tril(joints))
    block = np.full(joints.shape, -1)
    block[row, column] = np.arange(len(row))
    steps, pairs = plan_elimination(block)
    heads, words, turn = plan_solution(block)
    entries = 9 * np.diag(block)[:, None] + np.array([0, 4, 8])
    lists = {"block": block.ravel(), "entry": entries.ravel(), "pair": pairs, "head": heads, "word": words}
    lists["reach"] = plan_reach(block)
    pattern = Pattern()
    for name, numbers in lists.items():
        setattr(pattern, name, wp.array(numbers.astype(np.int32), dtype=int, device=device))
    pattern.step, pattern.turn = wp.array(steps.astype(np.int32), dtype=wp.vec4i, device=device), turn
    return pattern


def plan_elimination(block: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Steps and pairs of :class:`Pattern`, from the ``block`` of every two joints."""
    steps, pairs = [], []
    for k in reversed(range(len(block))):
        own = np.flatnonzero(block[k, :k] >= 0)
        i, j = np.nonzero(np.tri(len(own), dtype=bool))
        pairs.append(in_rounds(BLOCK * block[own[i], own[j]] << 16 | 9 * i << 8 | 9 * j))
        first = BLOCK * (block[k, k] - len(own))
        steps += [(first, BLOCK * block[k, k], 3 * len(own), n > 0) for n in range(len(pairs[-1]) // LANES)]
    return np.array(steps + 2 * [(0, 0, 0, 1)]), np.concatenate([*pairs, np.full(2 * LANES, -1)])


def plan_solution(block: np.ndarray) -> tuple[np.ndarray, np.ndarray, int]:
    """Heads, words and turn of :class:`Pattern`, from the ``block`` of every two joints."""
    count, axis, heads, words, turn = len(block), np.arange(3), [], [], 0
    for up in (False, True):
        turn = len(heads)  # even
        for k in range(count) if up else reversed(range(count)):
            blocks = block[:, k] if up else block[k]
            others = np.flatnonzero((blocks >= 0) & (np.arange(count) != k))
            numbers = BLOCK * blocks[others][:, None] + NUMBER * (3 if up else 1) * axis
            words.append(in_rounds((numbers << 10 | 16 * others[:, None] + NUMBER * axis).ravel()))
            heads += [BLOCK * block[k, k] << 10 | 16 * k] + [-1] * (len(words[-1]) // LANES - 1)
        nothing = (2 if up else 0) + len(heads) % 2
        heads += nothing * [-1]
        words.append(np.full(nothing * LANES, -1))
    return np.array(heads), np.concatenate(words), turn


def plan_reach(block: np.ndarray) -> np.ndarray:
    """``reach`` of :class:`Pattern`, from the ``block`` of every two joints."""
    reach = 1 << np.arange(len(block))
    for k, own in enumerate(block):
        reach[k] |= np.bitwise_or.reduce(reach[:k][own[:k] >= 0], initial=0)
    return reach


def factor_size(pattern: Pattern) -> int:
    """Numbers of a matrix or a factor, in whole records of four."""
    return -(-9 * (1 + int(pattern.block.numpy().max())) // 4) * 4


def lower_entries(pattern: Pattern) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rows and columns of the entries of the lower triangle that are kept, and which numbers they are."""
    row, column = np.nonzero(np.tril(pattern.block.numpy().reshape(2 * [pattern.entry.shape[0] // 3]) >= 0))
    axis = np.arange(9)
    i, j = (3 * row[:, None] + axis // 3).ravel(), (3 * column[:, None] + axis % 3).ravel()
    return i[i >= j], j[i >= j], np.flatnonzero(i >= j)


def pack(pattern: Pattern, matrices: np.ndarray) -> np.ndarray:
    """Symmetric matrices ``(n, N, N)`` as they are kept, ``(n, factor_size)`` float32."""
    rows, columns, numbers = lower_entries(pattern)
    packed = np.zeros((len(matrices), factor_size(pattern)), np.float32)
    packed[:, numbers] = matrices[:, rows, columns]
    return packed


@wp.func
def factorize(
    pattern: Pattern,
    matrix: wp.array2d(dtype=float),
    diagonal: wp.array2d(dtype=float),
    source: int,
    e: int,
    room: wp.uint64,
    f: int,
    # out
    factor: wp.array2d(dtype=float),
):
    """``L`` of ``L^T L = matrix + diag(diagonal)``, of matrix ``source`` and row ``e`` of the ``diagonal``.

    ``matrix`` is ``(num_envs, factor_size)``. A thread that is alone writes factor ``f`` of as many numbers; a warp has
    it in its room, from where :func:`keep_factor` writes it.
    """
    at = place_of_factor(factor, f, room)
    load_room(matrix, source, at)
    factorize_in_room(pattern, diagonal, e, at)


@wp.func
def factorize_in_room(pattern: Pattern, diagonal: wp.array2d(dtype=float), e: int, at: wp.uint64):
    """:func:`factorize` of the matrix that is there."""
    add_diagonal(pattern.entry, diagonal, e, at)
    eliminate(pattern.step, pattern.pair, at)


@wp.func
def keep_factor(room: wp.uint64, f: int, factor: wp.array2d(dtype=float)):
    """Write factor ``f``, which :func:`factorize` has just found, where it has not done so itself."""
    lane = lane_of_warp()
    store_room(room, f, lane[0], lane[1], factor)
    meet_threads(lane[1])  # the room is free


@wp.func
def fetch_factor(factor: wp.array2d(dtype=float), f: int, room: wp.uint64):
    """Let a warp solve with factor ``f`` from here on."""
    load_room(factor, f, place_of_factor(factor, f, room))


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
    meet_threads(threads)
    for i in range(thread, x.shape[1], threads):
        x[row, i] = right[e, i]
    meet_threads(threads)
    solve_one(pattern.head, pattern.word, pattern.turn, place_of_factor(factor, f, room), row, 0, x)


@wp.func
def solve_three_in_place(
    pattern: Pattern,
    factor: wp.array2d(dtype=float),
    f: int,
    first: int,
    step: int,
    threads: int,
    room: wp.uint64,
    # in and out
    x: wp.array2d(dtype=float),
):
    """:func:`solve` of three right-hand sides in ``x``, the ``first`` and others ``step`` rows apart."""
    meet_threads(threads)
    solve_three(pattern.head, pattern.word, pattern.turn, place_of_factor(factor, f, room), first, step, x)


@wp.func
def begin_solution(
    pattern: Pattern,
    factor: wp.array2d(dtype=float),
    f: int,
    wanted: int,
    first: int,
    step: int,
    threads: int,
    room: wp.uint64,
    # in and out
    x: wp.array2d(dtype=float),
):
    """``Y = L^-T B`` of three right-hand sides ``B`` in ``x``, with which ``B^T M^-1 B = Y^T Y``.

    Both have something in joints whose bits are ``wanted`` alone, which is what ``Pattern.reach`` tells; elsewhere
    nothing is read or written. A warp has them in its room, see :func:`piavatar_envs.avatar.joint_bench.see_columns`.
    """
    meet_threads(threads)
    at = place_of_factor(factor, f, room)
    descend_three(pattern.head, pattern.word, pattern.turn, at, first, step, wanted, x)


@wp.func
def end_solution(
    pattern: Pattern,
    factor: wp.array2d(dtype=float),
    f: int,
    first: int,
    threads: int,
    room: wp.uint64,
    # in and out
    x: wp.array2d(dtype=float),
):
    """``L^-1`` times the first of the columns of :func:`begin_solution`."""
    meet_threads(threads)
    ascend_one(pattern.head, pattern.word, pattern.turn, place_of_factor(factor, f, room), first, x)
