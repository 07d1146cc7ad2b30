"""The B-spline stencil: its moments are what the transfers rest on, its edge is what keeps them inside memory."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import warp as wp

from piavatar_envs.mpm.bspline import (
    BLOCK,
    base_node,
    block_corner,
    block_index,
    grid_position,
    node_in_block,
    node_position,
    spline,
    stencil_inside,
)
from piavatar_envs.mpm.model import make_grid
from piavatar_envs.mpm.types import Grid

wp.set_module_options({"enable_backward": False})

DX = 0.05
LOWER, UPPER = np.array([-0.2, 0.1, -0.3]), np.array([0.3, 0.5, 0.05])


@wp.kernel
def probe_stencil(
    grid: Grid,
    x: wp.array(dtype=wp.vec3),
    base: wp.array(dtype=wp.vec3i),
    inside: wp.array(dtype=wp.bool),
    weights: wp.array2d(dtype=wp.vec3),
):
    p = wp.tid()
    xg = grid_position(grid, x[p])
    b = base_node(xg)
    base[p] = b
    inside[p] = stencil_inside(grid, b)
    for axis in range(3):
        weights[p, axis] = spline(xg[axis] - float(b[axis]))


@wp.kernel
def probe_nodes(
    grid: Grid,
    node: wp.array3d(dtype=int),
    block: wp.array3d(dtype=int),
    corner: wp.array3d(dtype=wp.vec3i),
    position: wp.array3d(dtype=wp.vec3),
):
    i, j, k = wp.tid()
    node[i, j, k] = node_in_block(i, j, k)
    block[i, j, k] = block_index(grid, i, j, k)
    corner[i, j, k] = block_corner(grid, block_index(grid, i, j, k))
    position[i, j, k] = node_position(grid, i, j, k)


@pytest.fixture(scope="module")
def grid():
    return make_grid(LOWER, UPPER, DX)


def stencil(grid, positions, device):
    """Base nodes (P, 3), whether inside (P,), weights along each axis (P, 3, 3)."""
    x = wp.array(np.asarray(positions, np.float32), dtype=wp.vec3, device=device)
    base = wp.zeros(len(x), dtype=wp.vec3i, device=device)
    inside = wp.zeros(len(x), dtype=wp.bool, device=device)
    weights = wp.zeros((len(x), 3), dtype=wp.vec3, device=device)
    wp.launch(probe_stencil, len(x), inputs=[grid, x], outputs=[base, inside, weights], device=device)
    return base.numpy(), inside.numpy(), weights.numpy().astype(float)


def random_positions(count):
    """Anywhere in the domain, with some exactly on nodes and between them, where the stencil changes."""
    rng = np.random.default_rng(0)
    positions = rng.uniform(LOWER, UPPER, (count, 3))
    steps = np.round((positions[: count // 2] - LOWER) / DX * 2.0) / 2.0
    positions[: count // 2] = LOWER + steps * DX
    return positions


@pytest.fixture(scope="module")
def moments(grid, device):
    """Sums over the stencil of w, w d and w d d^T with d = x_i - x_p in grid spacings."""
    positions = random_positions(1000).astype(np.float32).astype(float)
    base, inside, weights = stencil(grid, positions, device)
    assert inside.all()
    origin = np.asarray(grid.origin, float)
    assert np.all(weights >= 0.0)
    zeroth, first, second = np.zeros(len(base)), np.zeros((len(base), 3)), np.zeros((len(base), 3, 3))
    for offset in itertools.product(range(3), repeat=3):
        w = np.prod([weights[:, axis, o] for axis, o in enumerate(offset)], axis=0)
        d = base + np.array(offset) - (positions - origin) / DX
        zeroth += w
        first += w[:, None] * d
        second += w[:, None, None] * d[:, :, None] * d[:, None, :]
    return zeroth, first, second


def test_partition_of_unity(moments):
    assert np.abs(moments[0] - 1.0).max() < 5e-7


def test_linear_reproduction(moments):
    assert np.abs(moments[1]).max() < 2e-5  # in cells; float32 positions are good to 1e-6 of 20 cells


def test_second_moment_is_the_apic_inertia(moments):
    """D = dx^2/4 I (Jiang et al. 2015): the factor 4/dx^2 of the transfers."""
    assert np.abs(moments[2] - 0.25 * np.eye(3)).max() < 2e-5


def test_weights_are_continuous_across_cells(grid, device):
    """Half way between nodes the stencil moves on by one; the node that drops out has no weight."""
    step = 1e-6
    edge = np.array(LOWER) + DX * np.array([3.5, 2.5, 1.5])
    base, _, weights = stencil(grid, [edge - step, edge + step], device)
    assert np.array_equal(base[1] - base[0], [1, 1, 1])
    assert np.abs(weights[0, :, 1:] - weights[1, :, :2]).max() < 3.0 * step / DX
    assert weights[0, :, 0].max() < 1e-6 and weights[1, :, 2].max() < 1e-6


def test_nodes_and_blocks_are_numbered_once(grid, device):
    nodes, blocks = np.asarray(grid.nodes), np.asarray(grid.blocks)
    arrays = [wp.zeros(tuple(nodes), dtype=t, device=device) for t in (int, int, wp.vec3i, wp.vec3)]
    wp.launch(probe_nodes, tuple(nodes), inputs=[grid], outputs=arrays, device=device)
    node, block, corner, position = (array.numpy() for array in arrays)
    number = 64 * block + node
    assert len(np.unique(number)) == nodes.prod() and node.min() == 0 and node.max() == 63
    assert np.array_equal(np.unique(block), np.arange(blocks.prod()))
    indices = np.stack(np.indices(nodes), axis=-1)
    assert np.array_equal(corner, indices // BLOCK * BLOCK)
    assert np.allclose(position, LOWER - 2.0 * DX + DX * indices, atol=1e-6)


def test_domain_is_inside(grid, device):
    corners = np.array(list(itertools.product(*zip(LOWER, UPPER, strict=True))))
    _, inside, _ = stencil(grid, corners, device)
    assert inside.all()


@pytest.mark.parametrize("axis", range(3))
def test_edge_is_refused(grid, device, axis):
    """The outermost cell and a half cannot hold a stencil; nor can places whose cell is no 32-bit integer."""
    center, low, high = 0.5 * (LOWER + UPPER), np.asarray(grid.origin, float), np.asarray(grid.nodes) - 1
    places = [low[axis] + 0.5 * DX, low[axis] + (high[axis] - 0.5) * DX]
    outward = (-1.0, 1.0)
    expected, positions = [], []
    for place, sign in zip(places, outward, strict=True):
        for shift, is_inside in ((-1e-3, True), (1e-3, False), (10.0, False), (1e10, False), (3e38, False)):
            positions.append(np.where(np.arange(3) == axis, place + sign * shift, center))
            expected.append(is_inside)
    base, inside, _ = stencil(grid, positions, device)
    assert inside.tolist() == expected
    assert np.all(base[inside] >= 0) and np.all(base[inside] + 2 < np.asarray(grid.nodes))
