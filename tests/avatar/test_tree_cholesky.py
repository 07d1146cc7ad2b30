"""Factors of mass matrices against LAPACK's solutions."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp

from piavatar_envs.avatar.torque_control.mass_matrix import NUM_DOF
from piavatar_envs.avatar.torque_control.tree_cholesky import (
    Pattern,
    factor_size,
    factorize,
    find_pattern,
    load_factor,
    lower_entries,
    pack,
    solve,
    store_factor,
)
from piavatar_envs.avatar.torque_control.workspace import warp_arena
from piavatar_envs.core.cuda_intrinsics import warp_threads


@wp.kernel(enable_backward=False)
def factorize_and_solve(
    pattern: Pattern,
    matrix: wp.array2d(dtype=float),
    diagonal: wp.array2d(dtype=float),
    right: wp.array2d(dtype=float),
    threads: int,
    factor: wp.array2d(dtype=float),
    x: wp.array2d(dtype=float),
):
    """Two diagonals of every matrix, over ``(num_envs, threads)``; all is solved after both factors have been found."""
    e, thread = wp.tid()
    n, room = matrix.shape[0], warp_arena()
    for which in range(2):
        system = which * n + e
        factorize(pattern, matrix, diagonal, e, system, room, system, factor)
        store_factor(room, system, factor)
    for which in range(2):
        system = which * n + e
        load_factor(factor, system, room)
        solve(pattern, factor, system, right, system, system, thread, threads, room, x)


@pytest.mark.parametrize("sparse", [False, True])
def test_factors_solve(device, sparse):
    """Two of each environment; the dense one has more rows than two warps have lanes."""
    rng, size, n, threads = np.random.default_rng(0), 39 if sparse else NUM_DOF, 3, warp_threads(device)
    root = rng.normal(size=(n, size, size))
    filled = np.ones((size, size), bool)
    if sparse:  # two limbs on a trunk, of which the first is entered by what the elimination of a finger fills
        filled[9:21, 21:] = filled[21:, 9:21] = False
        filled[3:6, 12:15] = filled[12:15, 3:6] = False
    matrix = np.where(filled, root @ root.transpose(0, 2, 1), 0.0)
    matrix = (matrix + (2.0 + np.abs(matrix).sum(2).max()) * np.eye(size)).astype(np.float32)
    diagonal, right = rng.uniform(0.0, 3.0, (2 * n, size)), rng.normal(size=(2 * n, size))
    pattern = find_pattern(filled, device)
    rows, columns, numbers = lower_entries(pattern)
    given = pack(pattern, matrix), diagonal, right
    arrays = [wp.array(a.astype(np.float32), dtype=float, device=device) for a in given]
    factor, x = (wp.zeros((2 * n, rows), dtype=float, device=device) for rows in (factor_size(pattern), size))
    inputs = [pattern, *arrays, threads]
    wp.launch(factorize_and_solve, (n, threads), inputs, [factor, x], block_dim=threads, device=device)
    whole = np.tile(matrix, (2, 1, 1)) + diagonal[:, :, None] * np.eye(size)
    L = np.zeros((2 * n, size, size))
    L[:, rows, columns] = factor.numpy()[:, numbers]
    for k in range(0, size, 3):  # of a block of the diagonal the inverse is kept
        L[:, k : k + 3, k : k + 3] = np.linalg.inv(L[:, k : k + 3, k : k + 3])
    np.testing.assert_allclose(L.transpose(0, 2, 1) @ L, whole, atol=1e-5 * np.abs(whole).max())
    joints = np.arange(size // 3)
    reached = pattern.reach.numpy() >> joints[:, None] & 1 == 1
    half = np.abs(np.linalg.inv(L[0].T)).reshape(2 * (size // 3, 3)).max(axis=(1, 3)) > 1e-9
    np.testing.assert_array_equal(half, reached)  # what is in a joint comes there on the way down, and nowhere else
    solved = np.linalg.solve(whole, right[..., None])[..., 0]
    np.testing.assert_allclose(x.numpy(), solved, atol=1e-5 * np.abs(solved).max())


def test_factors_of_odd_patterns_are_refused():
    filled = np.ones((6, 6), bool)
    filled[1, 4] = filled[4, 1] = False
    for wrong in (filled, np.ones((72, 72), bool)):
        with pytest.raises(ValueError, match="at most 69 rows, in blocks of 3 x 3"):
            find_pattern(wrong, "cpu")
