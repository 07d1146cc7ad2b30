"""Quadratic B-spline, and the layout of nodes in blocks: the only module that depends on either.

A particle touches the 3 x 3 x 3 nodes ``base + (0..2)``, its stencil. With ``f = (x - x_base) / dx`` in [0.5, 1.5) the
weights along one axis are those of Jiang et al., "The Material Point Method for Simulating Continuum Materials"
(SIGGRAPH 2016 course), eq. 123.
"""

from __future__ import annotations

import warp as wp

from piavatar_envs.mpm.types import Grid

wp.set_module_options({"enable_backward": False})

#: Nodes along an edge of a block, the unit in which the grid is stored and updated.
BLOCK = 4
#: Nodes of a block.
BLOCK_NODES = wp.constant(64)


@wp.struct
class Stencil:
    """Nodes around a particle and their weights along each axis."""

    base: wp.vec3i  # lowest node
    f: wp.vec3  # position from there, in grid spacings
    wx: wp.vec3
    wy: wp.vec3
    wz: wp.vec3


# Without fused multiply-add, so that every kernel assigns a particle to the same cell
@wp.func_native("""
#if defined(__CUDA_ARCH__)
return wp::vec3(
    __fmul_rn(x[0] - grid.origin[0], grid.inv_dx),
    __fmul_rn(x[1] - grid.origin[1], grid.inv_dx),
    __fmul_rn(x[2] - grid.origin[2], grid.inv_dx));
#else
return (x - grid.origin) * grid.inv_dx;
#endif
""")
def grid_position(grid: Grid, x: wp.vec3) -> wp.vec3:
    """Return a position in grid spacings from the first node."""
    ...


@wp.func
def base_node(xg: wp.vec3):
    """Return the lowest node of the stencil around a grid position."""
    return wp.vec3i(int(wp.floor(xg[0] - 0.5)), int(wp.floor(xg[1] - 0.5)), int(wp.floor(xg[2] - 0.5)))


@wp.func
def stencil_inside(grid: Grid, base: wp.vec3i):
    """Return whether all 27 nodes of a stencil exist; safe for any ``base``, also the largest integer."""
    return (
        base[0] >= 0
        and base[1] >= 0
        and base[2] >= 0
        and base[0] <= grid.nodes[0] - 3
        and base[1] <= grid.nodes[1] - 3
        and base[2] <= grid.nodes[2] - 3
    )


@wp.func
def spline(f: float):
    """Return the weights of the three nodes along one axis, for a position ``f`` in [0.5, 1.5) from the first."""
    a = 1.5 - f
    b = f - 1.0
    c = f - 0.5
    return wp.vec3(0.5 * a * a, 0.75 - b * b, 0.5 * c * c)


@wp.func
def stencil_at(xg: wp.vec3):
    """Return the stencil around a grid position."""
    s = Stencil()
    s.base = base_node(xg)
    s.f = xg - wp.vec3(float(s.base[0]), float(s.base[1]), float(s.base[2]))
    s.wx = spline(s.f[0])
    s.wy = spline(s.f[1])
    s.wz = spline(s.f[2])
    return s


@wp.func
def node_in_block(i: int, j: int, k: int):
    """Return the index of node ``(i, j, k)`` among the 64 of its block."""
    return (((i & 3) * 4) + (j & 3)) * 4 + (k & 3)


@wp.func
def node_position(grid: Grid, i: int, j: int, k: int):
    """Return the world position of node ``(i, j, k)`` [m]."""
    return grid.origin + grid.dx * wp.vec3(float(i), float(j), float(k))


@wp.func
def block_index(grid: Grid, i: int, j: int, k: int):
    """Return the linear index of the block that holds node ``(i, j, k)``."""
    return ((i >> 2) * grid.blocks[1] + (j >> 2)) * grid.blocks[2] + (k >> 2)


@wp.func
def blocks_touched(base: wp.vec3i):
    """Return how many blocks a stencil overlaps along each axis, 1 or 2; the second holds ``base + 2``."""
    return wp.vec3i(1 + ((base[0] & 3) >> 1), 1 + ((base[1] & 3) >> 1), 1 + ((base[2] & 3) >> 1))


@wp.func
def in_same_subblock(a: wp.vec3i, b: wp.vec3i):
    """Return whether two nodes lie in the same subblock of 2 x 2 x 2 nodes: their stencils overlap the same blocks."""
    return (((a[0] ^ b[0]) | (a[1] ^ b[1]) | (a[2] ^ b[2])) >> 1) == 0


@wp.func
def node_of_block(corner: wp.vec3i, local: int):
    """Return node ``local`` of the block whose lowest node is ``corner``."""
    return wp.vec3i(corner[0] + (local >> 4), corner[1] + ((local >> 2) & 3), corner[2] + (local & 3))


@wp.func
def block_corner(grid: Grid, block: int):
    """Return the lowest node of a block."""
    bk = block % grid.blocks[2]
    bj = (block // grid.blocks[2]) % grid.blocks[1]
    bi = block // (grid.blocks[2] * grid.blocks[1])
    return wp.vec3i(4 * bi, 4 * bj, 4 * bk)
