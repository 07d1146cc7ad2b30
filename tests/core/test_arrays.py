"""Matrices of particles by components: there and back, padded rows, copies."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp

from piavatar_envs.core.arrays import LINE, allocate_matrices, components_of, matrices_of, matrix_at, store_matrix

wp.set_module_options({"enable_backward": False})


@wp.kernel
def transpose_all(source: wp.array3d(dtype=float), out: wp.array3d(dtype=float)):
    e, p = wp.tid()
    store_matrix(out, e, p, wp.transpose(matrix_at(source, e, p)))


@pytest.mark.parametrize("count", [1, LINE, 3 * LINE + 5])
def test_kernels_and_numpy_see_the_same_matrices(device, count):
    matrices = np.random.default_rng(0).normal(size=(3, count, 3, 3)).astype(np.float32)
    source, out = (allocate_matrices(3, count, device) for _ in range(2))
    source.assign(components_of(matrices))
    wp.launch(transpose_all, (3, count), [source], [out], device=device)
    assert np.array_equal(matrices_of(source), matrices)
    assert np.array_equal(matrices_of(out), matrices.swapaxes(2, 3))
    assert source.strides[1] == 4 * LINE * -(-count // LINE)


def test_what_is_read_is_a_copy(device):
    components = allocate_matrices(2, 5, device)
    matrices = matrices_of(components)
    components.fill_(1.0)
    assert not matrices.any()
    matrices[:] = 2.0
    assert (components.numpy() == 1.0).all()
