"""Which way two fields face each other at a node, and how far their surfaces are apart.

A normal from the gradients of two volumes at a *single* node tilts at edges, where a body's volume ends to the side as
well: the front edge of a sliding block then ploughs through what it lies on, and brakes it like a friction of 0.15.
Gradients are therefore summed over the neighbours ``k`` of a node at which the bodies meet, too, and most where most
matter of both is, by the square of the reduced volume::

    n_ab ~ sum_k c_k r_k^2 (V_a g_a - V_b g_b)_k,    r = V_a V_b / (V_a + V_b),    c = 1 / (1 + distance^2)

with volumes ``V`` and their outward gradients ``g`` in grid units. The gradients' own weights ``V`` let the body that
fills more of a node say more about the direction.
"""

from __future__ import annotations

import warp as wp

from piavatar_envs.mpm.masks import end_of_fields, has_field, lowest_field
from piavatar_envs.mpm.stencil import block_corner, block_index, node_index
from piavatar_envs.mpm.types import Contact, Grid, row, vec8

wp.set_module_options({"enable_backward": False})

#: Nodes lighter than this [kg] carry nothing but round-off.
MASS_MIN = wp.constant(1.0e-15)
#: Mass of a record whose field has grown together with its subject's trunk at a node.
GROWN_TOGETHER = wp.constant(-1.0)

#: Distance of the matter of two half-spaces that touch, as a node at any distance from their common surface sees it:
#: ``TOUCHING - SLOPE (4 V_a V_b / (V_a + V_b)^2)^(1/4)`` grid spacings, to 0.011, from 0.81 at the surface to 1.5.
TOUCHING = wp.constant(1.544)
SLOPE = wp.constant(0.74)
#: Distance that the matter at a node gains with a gap: the spline sees less of what goes away.
PER_GAP = wp.constant(0.65)


@wp.func
def merge_limbs(
    contact: Contact,
    num_nodes: int,
    mask: int,
    e: int,
    n: int,
    node_sum: wp.array2d(dtype=vec8),
    node_offset: wp.array2d(dtype=wp.vec3),
):
    """Join limbs to their trunk at a node where both have seam particles, those that are skinned to both.

    Mass, momentum *and* kinematic momentum are summed, or the shoulders would tear. Without the condition a hand
    would grow to the belly.
    """
    for f in range(contact.num_fields):
        t = contact.trunk[f]
        if t != f and has_field(mask, f) and has_field(mask, t):
            limb = node_sum[e, f * num_nodes + n]
            trunk = node_sum[e, t * num_nodes + n]
            if limb[7] > 0.0 and trunk[7] > 0.0:
                node_sum[e, t * num_nodes + n] = trunk + limb
                node_offset[e, t * num_nodes + n] += node_offset[e, f * num_nodes + n]
                node_sum[e, f * num_nodes + n] = vec8(GROWN_TOGETHER, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


@wp.func
def volume_at(grid: Grid, contact: Contact, e: int, f: int, m: float):
    """Volume of mass ``m`` of a field in its reference state, in cells; 0 if there is none."""
    cells = grid.inv_dx * grid.inv_dx * grid.inv_dx / contact.density[row(e, contact.density.shape[0]), f]
    return wp.where(m > MASS_MIN, m * cells, 0.0)


@wp.func
def weighted_gradient(grid: Grid, V: float, m: float, offset: wp.vec3):
    """Outward gradient of a volume at a node, times the volume; up to a factor common to all."""
    return (V * V * grid.inv_dx / m) * offset


@wp.kernel
def find_facing(
    grid: Grid,
    contact: Contact,
    slabs: int,
    active: wp.array2d(dtype=int),
    # in and out: limbs grow together with their trunks
    node_sum: wp.array2d(dtype=vec8),
    node_offset: wp.array2d(dtype=wp.vec3),
    # out
    node_facing: wp.array2d(dtype=wp.vec3),
):
    """What every node of a block with several fields says about the normals around it, a vector a field.

    It is the summand of the module's formula, with all other fields of the node as ``b``; zero where there is none.
    """
    e, block, slab = wp.tid()
    mask = active[e, block]
    first = lowest_field(mask, contact.num_fields)
    end = end_of_fields(mask, contact.num_fields)
    if end - first < 2:
        return
    corner = block_corner(grid, block)
    for i in range(corner[0] + slab, wp.min(corner[0] + 4, grid.nodes[0]), slabs):
        for j in range(corner[1], wp.min(corner[1] + 4, grid.nodes[1])):
            for k in range(corner[2], wp.min(corner[2] + 4, grid.nodes[2])):
                n = node_index(grid, i, j, k)
                merge_limbs(contact, grid.num_nodes, mask, e, n, node_sum, node_offset)
                volume = float(0.0)
                outward = wp.vec3()
                for f in range(first, end):
                    if has_field(mask, f):
                        m = node_sum[e, f * grid.num_nodes + n][0]
                        V = volume_at(grid, contact, e, f, m)
                        if V > 0.0:
                            volume += V
                            outward += weighted_gradient(grid, V, m, node_offset[e, f * grid.num_nodes + n])
                for f in range(first, end):
                    if has_field(mask, f):
                        r = f * grid.num_nodes + n
                        m = node_sum[e, r][0]
                        V = volume_at(grid, contact, e, f, m)
                        facing = wp.vec3()
                        if V > 0.0 and volume > V:
                            reduced = V * (volume - V) / volume
                            own = weighted_gradient(grid, V, m, node_offset[e, r])
                            facing = (reduced * reduced) * (2.0 * own - outward)
                        node_facing[e, r] = facing


@wp.func
def shared_normal(
    grid: Grid,
    e: int,
    node: wp.vec3i,
    a: int,
    b: int,
    active: wp.array2d(dtype=int),
    node_facing: wp.array2d(dtype=wp.vec3),
):
    """Unit normal from field ``a`` to field ``b`` at a node; zero if there is no telling."""
    both = (1 << a) | (1 << b)
    facing = wp.vec3()
    for i in range(wp.max(node[0] - 1, 0), wp.min(node[0] + 2, grid.nodes[0])):
        for j in range(wp.max(node[1] - 1, 0), wp.min(node[1] + 2, grid.nodes[1])):
            for k in range(wp.max(node[2] - 1, 0), wp.min(node[2] + 2, grid.nodes[2])):
                # a block without one of the two holds nothing that was written in this substep
                if (active[e, block_index(grid, i, j, k)] & both) == both:
                    n = node_index(grid, i, j, k)
                    d = wp.vec3i(i - node[0], j - node[1], k - node[2])
                    c = 1.0 / float(1 + wp.dot(d, d))
                    facing += c * (node_facing[e, a * grid.num_nodes + n] - node_facing[e, b * grid.num_nodes + n])
    # summands of nearly empty nodes are so small that their squares are not
    largest = wp.max(wp.abs(facing))
    if largest <= 0.0:
        return wp.vec3()
    return wp.normalize(facing / largest)


@wp.func
def surface_gap(grid: Grid, V_a: float, V_b: float, distance: float):
    """Gap of two surfaces [m], from their volumes at a node and the distance of their matter there along the normal.

    Right to a tenth of a grid spacing from touch to a gap of 0.6; overlaps are underestimated.
    """
    share = 4.0 * V_a * V_b / ((V_a + V_b) * (V_a + V_b))
    return (distance - grid.dx * (TOUCHING - SLOPE * wp.sqrt(wp.sqrt(share)))) / PER_GAP
