"""Contact normals of a pair of fields at a node, and the gap between their surfaces.

A normal from the gradients of two volumes at a *single* node tilts at edges, where a body's volume also ends sideways:
the front edge of a sliding block then ploughs through its support, which adds a friction of 0.15. Gradients are
therefore summed over the neighbours ``k`` of a node that both bodies share, weighted by the square of the reduced
volume::

    n_ab ~ sum_k c_k r_k^2 (V_a g_a - V_b g_b)_k,    r = V_a V_b / (V_a + V_b),    c = 1 / (1 + distance^2)

with volumes ``V`` and their outward gradients ``g`` in grid units. The weights ``V`` give the body that fills more of a
node more influence on the direction.
"""

from __future__ import annotations

import warp as wp

from piavatar_envs.core.arrays import read_vec4, vec8, vec8i, write_vec4
from piavatar_envs.core.cuda_intrinsics import environment_of
from piavatar_envs.mpm.bspline import BLOCK_NODES, block_index, node_in_block
from piavatar_envs.mpm.grid_arrays import (
    MASS_MIN,
    mass_of,
    move_offset,
    offset_at,
    read_record,
    take_accumulator,
    write_record,
)
from piavatar_envs.mpm.sparse_grid import (
    THREADS,
    Sweep,
    contact_block_of,
    exceeds_active_blocks,
    first_record,
    has_all_candidates,
    has_field,
    num_contact_nodes,
)
from piavatar_envs.mpm.types import Accumulators, Blocks, Contact, Grid, Sensors, row

# on a GPU, divisions and roots to two units in the last place, in a few instructions instead of calls
wp.set_module_options({"enable_backward": False, "default_grid_stride": False, "fast_math": True})

#: Volume of two fields at a node [cells] below which it is empty: less than that of the smallest mass.
EMPTY = wp.constant(1.0e-30)
#: Mass of a record whose field is merged with its subject's trunk at a node.
MERGED = wp.constant(-1.0)
#: Distance of the matter of two half-spaces in touch, seen from a node: ``TOUCHING - SLOPE (4 V_a V_b / (V_a +
#: V_b)^2)^(1/4)`` grid spacings, to 0.011, from 0.81 at the surface to 1.5.
TOUCHING = wp.constant(1.544)
SLOPE = wp.constant(0.74)
#: Growth of that distance with a gap: the spline weighs receding matter less.
PER_GAP = wp.constant(0.65)


@wp.func
def merge_limbs(
    grid: Grid,
    contact: Contact,
    blocks: Blocks,
    accumulators: Accumulators,
    mask: int,
    e: int,
    block: int,
    local: int,
    # out
    node_velocity: wp.array2d(dtype=wp.vec4),
):
    """Move the sums of a node to where its velocities will be, and merge limbs with their trunk.

    They merge where both have seam particles (skinned to both), whose offsets are complete. Mass, momentum *and*
    kinematic momentum are summed, or the shoulders would tear. Without the condition a hand would merge with the belly.
    """
    for f in range(contact.num_fields):
        if has_field(mask, f):
            r = first_record(grid, blocks, e, f, block) + local
            s = take_accumulator(accumulators, e, f, r)
            write_record(node_velocity, e, r, s)
            t = contact.trunk[f]
            if t != f and has_field(mask, t):
                into = first_record(grid, blocks, e, t, block) + local
                candidates = has_all_candidates(blocks, e, r) and has_all_candidates(blocks, e, into)
                if (
                    candidates
                    and offset_at(grid, accumulators, e, f, r)[3] > 0.0
                    and offset_at(grid, accumulators, e, t, into)[3] > 0.0
                ):
                    write_record(node_velocity, e, into, read_record(node_velocity, e, into) + s)
                    move_offset(accumulators, e, r, into)
                    write_record(node_velocity, e, r, vec8(MERGED, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0))


@wp.func
def volume_at(grid: Grid, contact: Contact, e: int, f: int, m: float):
    """Return the volume of mass ``m`` of a field in its reference state [cells]; 0 without mass."""
    cells = grid.inv_dx * grid.inv_dx * grid.inv_dx / contact.density[row(e, contact.density.shape[0]), f]
    return wp.where(m > MASS_MIN, m * cells, 0.0)


@wp.func
def weighted_gradient(grid: Grid, V: float, m: float, offset: wp.vec4):
    """Return the outward gradient of a volume at a node times the volume, up to a common factor."""
    return (V * V * grid.inv_dx / m) * wp.vec3(offset[0], offset[1], offset[2])


@wp.func
def volume_gradient_from(grid: Grid, V: float, m: float, offset: wp.vec4):
    """Return weighted outward gradient and volume [cells] of a field from its volume, mass and ``offset``."""
    outward = weighted_gradient(grid, V, m, offset)
    return wp.vec4(outward[0], outward[1], outward[2], V)


@wp.func
def volume_gradient_of(grid: Grid, contact: Contact, accumulators: Accumulators, e: int, f: int, r: int, m: float):
    """Return weighted outward gradient and volume [cells] of field ``f`` at record ``r``; zero without mass."""
    V = volume_at(grid, contact, e, f, m)
    facing = wp.vec4()
    if V > 0.0:
        facing = volume_gradient_from(grid, V, m, offset_at(grid, accumulators, e, f, r))
    return facing


@wp.func
def store_volume_gradients(
    grid: Grid,
    contact: Contact,
    blocks: Blocks,
    accumulators: Accumulators,
    mask: int,
    e: int,
    block: int,
    local: int,
    node_velocity: wp.array2d(dtype=wp.vec4),
    # out
    volume_gradient: wp.array2d(dtype=wp.vec4),
    sensors: Sensors,
):
    """Write the weighted outward gradient and volume of every field of a node, and reset its ``touched`` flag."""
    for f in range(contact.num_fields):
        if has_field(mask, f):
            r = first_record(grid, blocks, e, f, block) + local
            m = mass_of(node_velocity, e, r)
            facing = wp.vec4()
            if has_all_candidates(blocks, e, r):
                facing = volume_gradient_of(grid, contact, accumulators, e, f, r, m)
            write_vec4(volume_gradient, e, r, facing)
            if local == 0:
                sensors.touched[e, r // BLOCK_NODES] = 0


@wp.kernel(launch_bounds=(THREADS, 6))
def find_volume_gradients(
    grid: Grid,
    contact: Contact,
    sweep: Sweep,
    blocks: Blocks,
    failure: wp.array(dtype=int),
    # in and out: taken where several fields are
    accumulators: Accumulators,
    # out
    node_velocity: wp.array2d(dtype=wp.vec4),
    volume_gradient: wp.array2d(dtype=wp.vec4),
    sensors: Sensors,
):
    """Take the sums of the nodes in contact blocks, merge limbs with trunks, and write volume gradients.

    Each pair forms its own term of a normal from them, so a third body does not affect it. The sums move to
    ``node_velocity``.
    """
    at = environment_of(wp.tid(), sweep.threads)
    e = at[0]
    end = wp.where(exceeds_active_blocks(failure, e), 0, num_contact_nodes(blocks, e))  # else the sums are incomplete
    for visit in range(sweep.visits):
        first = at[1] * sweep.nodes + visit * sweep.stride
        block = contact_block_of(blocks, e, first)
        if first >= end:
            break
        mask = blocks.fields[e, block]
        for n in range(first, first + sweep.nodes):
            merge_limbs(grid, contact, blocks, accumulators, mask, e, block, n % BLOCK_NODES, node_velocity)
            store_volume_gradients(
                grid,
                contact,
                blocks,
                accumulators,
                mask,
                e,
                block,
                n % BLOCK_NODES,
                node_velocity,
                volume_gradient,
                sensors,
            )


@wp.func
def records_around(grid: Grid, blocks: Blocks, e: int, node: wp.vec3i, a: int, b: int):
    """Return the first records of two fields in the blocks of a node and its neighbours, two along each axis.

    Lower neighbours come first; entries repeat where blocks coincide. -1 where a block is not active for both fields
    and thus holds nothing written in this substep.
    """
    both = (1 << a) | (1 << b)
    of_a = vec8i()
    of_b = vec8i()
    for n in range(8):
        i = wp.clamp(node[0] - 1 + 2 * (n >> 2), 0, grid.nodes[0] - 1)
        j = wp.clamp(node[1] - 1 + 2 * ((n >> 1) & 1), 0, grid.nodes[1] - 1)
        k = wp.clamp(node[2] - 1 + 2 * (n & 1), 0, grid.nodes[2] - 1)
        block = block_index(grid, i, j, k)
        has_both = (blocks.fields[e, block] & both) == both
        of_a[n] = wp.where(has_both, first_record(grid, blocks, e, a, block), -1)
        of_b[n] = wp.where(has_both, first_record(grid, blocks, e, b, block), -1)
    return of_a, of_b


@wp.func
def component(of: vec8i, x: int, y: int, z: int):
    """Return ``of[4 x + 2 y + z]`` without dynamic indexing, which would move ``of`` from registers to memory."""
    lower = wp.where(y == 0, wp.where(z == 0, of[0], of[1]), wp.where(z == 0, of[2], of[3]))
    upper = wp.where(y == 0, wp.where(z == 0, of[4], of[5]), wp.where(z == 0, of[6], of[7]))
    return wp.where(x == 0, lower, upper)


@wp.func
def in_grid(grid: Grid, node: wp.vec3i):
    """Return whether a node exists."""
    low = wp.min(node[0], wp.min(node[1], node[2]))
    return low >= 0 and node[0] < grid.nodes[0] and node[1] < grid.nodes[1] and node[2] < grid.nodes[2]


@wp.func
def normal_term(c: float, of_a: wp.vec4, of_b: wp.vec4):
    """Return the term that a node adds to a normal, from both fields' gradients and the weight ``c``."""
    reduced = of_a[3] * of_b[3] / wp.max(of_a[3] + of_b[3], EMPTY)
    return (c * reduced * reduced) * (of_a - of_b)


@wp.func
def normal_along(facing: wp.vec4):
    """Return the unit vector along a sum of :func:`normal_term`, zero if it vanishes.

    It is scaled first, because squares of the terms of nearly empty nodes underflow.
    """
    n_ab = wp.vec3(facing[0], facing[1], facing[2])
    largest = wp.max(wp.abs(n_ab))
    if largest <= 0.0:
        return wp.vec3()
    return wp.normalize(n_ab / largest)


@wp.func
def neighbour_weight(distance_sq: float):
    """Return the weight of a neighbouring node in a normal, from its squared distance [grid spacings squared]."""
    return 1.0 / (1.0 + distance_sq)


@wp.func
def normal_from(
    grid: Grid, e: int, node: wp.vec3i, first_a: vec8i, first_b: vec8i, volume_gradient: wp.array2d(dtype=wp.vec4)
):
    """Return the normal of :func:`shared_normal` from the :func:`records_around` a node."""
    # along an axis the node's own block is the lower of the two, unless the node is its first
    x = wp.where((node[0] & 3) == 0, 1, 0)
    y = wp.where((node[1] & 3) == 0, 1, 0)
    z = wp.where((node[2] & 3) == 0, 1, 0)
    own = node_in_block(node[0], node[1], node[2])
    ra = component(first_a, x, y, z) + own
    rb = component(first_b, x, y, z) + own
    facing = wp.vec4()
    planes = int(3)  # not a constant: a GPU has too few registers for the loads of all three at once
    for i in range(planes):
        for j in range(3):
            for k in range(3):
                at = node + wp.vec3i(i - 1, j - 1, k - 1)
                bx = wp.where(i == 1, x, i // 2)
                by = wp.where(j == 1, y, j // 2)
                bz = wp.where(k == 1, z, k // 2)
                n = node_in_block(at[0], at[1], at[2])
                to_a = component(first_a, bx, by, bz)
                to_b = component(first_b, bx, by, bz)
                counts = to_a >= 0 and in_grid(grid, at)
                across = float((j - 1) * (j - 1) + (k - 1) * (k - 1))
                c = wp.where(i == 1, neighbour_weight(across), neighbour_weight(1.0 + across))
                # excluded neighbours read the node itself with weight 0: no branch delays the loads
                of_a = read_vec4(volume_gradient, e, wp.where(counts, to_a + n, ra))
                of_b = read_vec4(volume_gradient, e, wp.where(counts, to_b + n, rb))
                facing += normal_term(wp.where(counts, c, 0.0), of_a, of_b)
    return normal_along(facing)


@wp.func
def shared_normal(
    grid: Grid, blocks: Blocks, e: int, node: wp.vec3i, a: int, b: int, volume_gradient: wp.array2d(dtype=wp.vec4)
):
    """Return the unit normal from field ``a`` to field ``b`` at a node; zero if it is undefined."""
    first_a, first_b = records_around(grid, blocks, e, node, a, b)
    return normal_from(grid, e, node, first_a, first_b, volume_gradient)


@wp.func
def surface_gap(grid: Grid, V_a: float, V_b: float, distance: float):
    """Return the gap between two surfaces [m], from volumes and distance of matter along the normal at a node.

    Accurate to a tenth of a grid spacing from touch to a gap of 0.6; overlaps are underestimated.
    """
    share = 4.0 * V_a * V_b / ((V_a + V_b) * (V_a + V_b))
    return (distance - grid.dx * (TOUCHING - SLOPE * wp.sqrt(wp.sqrt(share)))) / PER_GAP
