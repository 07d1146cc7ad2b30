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

from piavatar_envs.mpm.blocks import first_record, has_field, shared_by, slots_used
from piavatar_envs.mpm.stencil import BLOCK, BLOCK_NODES, block_index, node_in_block
from piavatar_envs.mpm.sums import move_offset, offset_at, read_record, take_sum, write_record
from piavatar_envs.mpm.sweep import THREADS, Sweep, first_node, from_lane, lane_of_thread
from piavatar_envs.mpm.types import Blocks, Contact, Grid, Sums, row, vec8

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})

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
def take_sums(
    grid: Grid,
    contact: Contact,
    blocks: Blocks,
    sums: Sums,
    mask: int,
    e: int,
    block: int,
    local: int,
    # out
    node_velocity: wp.array2d(dtype=vec8),
):
    """Move the sums of a node to where its velocities will be, and join limbs to their trunk.

    They grow together where both have seam particles, those that are skinned to both. Mass, momentum *and* kinematic
    momentum are summed, or the shoulders would tear. Without the condition a hand would grow to the belly.
    """
    for f in range(contact.num_fields):
        if has_field(mask, f):
            r = first_record(grid, blocks, e, f, block) + local
            s = take_sum(sums, e, f, r)
            write_record(node_velocity, e, r, s)
            t = contact.trunk[f]
            if t != f and has_field(mask, t):
                into = first_record(grid, blocks, e, t, block) + local
                if offset_at(grid, sums, e, f, r)[3] > 0.0 and offset_at(grid, sums, e, t, into)[3] > 0.0:
                    write_record(node_velocity, e, into, read_record(node_velocity, e, into) + s)
                    move_offset(sums, e, r, into)
                    write_record(node_velocity, e, r, vec8(GROWN_TOGETHER, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0))


@wp.func
def volume_at(grid: Grid, contact: Contact, e: int, f: int, m: float):
    """Volume of mass ``m`` of a field in its reference state, in cells; 0 if there is none."""
    cells = grid.inv_dx * grid.inv_dx * grid.inv_dx / contact.density[row(e, contact.density.shape[0]), f]
    return wp.where(m > MASS_MIN, m * cells, 0.0)


@wp.func
def weighted_gradient(grid: Grid, V: float, m: float, offset: wp.vec4):
    """Outward gradient of a volume at a node, times the volume; up to a factor common to all."""
    return (V * V * grid.inv_dx / m) * wp.vec3(offset[0], offset[1], offset[2])


@wp.func
def face_node(
    grid: Grid,
    contact: Contact,
    blocks: Blocks,
    sums: Sums,
    mask: int,
    e: int,
    block: int,
    local: int,
    node_velocity: wp.array2d(dtype=vec8),
    # out
    node_facing: wp.array2d(dtype=wp.vec3),
):
    """Summands of a node, a vector a field."""
    volume = float(0.0)
    outward = wp.vec3()
    for f in range(contact.num_fields):
        if has_field(mask, f):
            r = first_record(grid, blocks, e, f, block) + local
            m = node_velocity[e, r][0]
            V = volume_at(grid, contact, e, f, m)
            if V > 0.0:
                volume += V
                outward += weighted_gradient(grid, V, m, offset_at(grid, sums, e, f, r))
    for f in range(contact.num_fields):
        if has_field(mask, f):
            r = first_record(grid, blocks, e, f, block) + local
            m = node_velocity[e, r][0]
            V = volume_at(grid, contact, e, f, m)
            facing = wp.vec3()
            if V > 0.0 and volume > V:
                reduced = V * (volume - V) / volume
                own = weighted_gradient(grid, V, m, offset_at(grid, sums, e, f, r))
                facing = (reduced * reduced) * (2.0 * own - outward)
            node_facing[e, r] = facing


@wp.kernel(launch_bounds=(THREADS, 6))
def find_facing(
    grid: Grid,
    contact: Contact,
    sweep: Sweep,
    blocks: Blocks,
    # in and out: taken where several fields are
    sums: Sums,
    # out
    node_velocity: wp.array2d(dtype=vec8),
    node_facing: wp.array2d(dtype=wp.vec3),
):
    """What every node of a block with several fields says about the normals around it.

    It is the summand of the module's formula, with all other fields of the node as ``b``; zero where there is none.
    Limbs grow together with their trunks first. The nodes' sums then stand in ``node_velocity``.
    """
    e, thread = wp.tid()
    lane = lane_of_thread()
    end = BLOCK_NODES * slots_used(blocks, e)
    begin = first_node(sweep, thread)
    if begin >= end:
        return
    held = shared_by(grid, blocks, e, (begin + lane * sweep.stride) // BLOCK_NODES, contact.num_fields)
    for turn in range(sweep.turns):
        first = begin + turn * sweep.stride
        if first >= end:
            break
        if from_lane(held[0], turn) < 0:
            continue
        block = from_lane(held[1], turn)
        mask = blocks.fields[e, block]
        for n in range(first + lane, first + lane + sweep.share):
            take_sums(grid, contact, blocks, sums, mask, e, block, n % BLOCK_NODES, node_velocity)
            face_node(grid, contact, blocks, sums, mask, e, block, n % BLOCK_NODES, node_velocity, node_facing)


@wp.func
def shared_normal(
    grid: Grid, blocks: Blocks, e: int, node: wp.vec3i, a: int, b: int, node_facing: wp.array2d(dtype=wp.vec3)
):
    """Unit normal from field ``a`` to field ``b`` at a node; zero if there is no telling."""
    both = (1 << a) | (1 << b)
    facing = wp.vec3()
    start = wp.max(node[2] - 1, 0)
    has_both = bool(False)
    ra = int(0)
    rb = int(0)
    for i in range(wp.max(node[0] - 1, 0), wp.min(node[0] + 2, grid.nodes[0])):
        for j in range(wp.max(node[1] - 1, 0), wp.min(node[1] + 2, grid.nodes[1])):
            for k in range(start, wp.min(node[2] + 2, grid.nodes[2])):
                if k == start or k % BLOCK == 0:  # another block
                    block = block_index(grid, i, j, k)
                    # one without one of the two holds nothing that was written in this substep
                    has_both = (blocks.fields[e, block] & both) == both
                    if has_both:
                        ra = first_record(grid, blocks, e, a, block)
                        rb = first_record(grid, blocks, e, b, block)
                if has_both:
                    n = node_in_block(i, j, k)
                    d = wp.vec3i(i - node[0], j - node[1], k - node[2])
                    c = 1.0 / float(1 + wp.dot(d, d))
                    facing += c * (node_facing[e, ra + n] - node_facing[e, rb + n])
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
