"""Contact between velocity fields: bodies that share a grid node push each other, and slide with friction.

Every subject has a velocity field of its own (an avatar may have one for each limb), so that bodies which share a node
can separate again. Fields are paired in a fixed order. A pair has *one* normal ``n``, from
:mod:`piavatar_envs.mpm.contact_normals`, and exchanges one impulse along it (free slip, no tension) and one against
the sliding (Coulomb)::

    j = m_a m_b / (m_a + m_b) max(0, (v_a - v_b) . n),    friction at most mu j

The impulses are equal and opposite and act at the same point: linear and angular momentum are kept to round-off. After
Bardenhagen et al., "The Material-Point Method for Granular Materials" (2000) and, for the common normal, Huang et al.,
"Contact Algorithms for the Material Point Method in Impact and Penetration Simulation" (2011).

PIAvatar (Han et al., arXiv 2606.21162) projects each field with a normal of its own towards the common velocity; the
impulses of a node then do not add up to zero, and momentum is lost. It can be selected for comparison
(``own_normals``); the sensors of pairs then stay empty.

Fields share nodes while their matter is still a grid spacing apart. A gate on the gap between their surfaces lets
bodies come closer.

Contact of subjects acts on the gap as well (:func:`closing_speed`). Those that would close far past the gate within a
substep are slowed before: a constraint on the gap at its end (Stewart & Trinkle, "An Implicit Time-Stepping Scheme for
Rigid Body Dynamics with Inelastic Collisions and Coulomb Friction", 1996). Those that are deep in each other part
(Baumgarte, "Stabilization of Constraints and Integrals of Motion in Dynamical Systems", 1972).

The kernel here updates the nodes of contact blocks: contact, then colliders, then physical velocities. Such blocks are
few, and the kernel is bound by memory latency. Nearly all nodes have two fields: :func:`solve_pair` loads all of their
data at once and keeps it in registers.
"""

from __future__ import annotations

import warp as wp

from piavatar_envs.core.arrays import read_vec4, vec8, write_vec4
from piavatar_envs.core.cuda_intrinsics import environment_of
from piavatar_envs.mpm.bspline import BLOCK_NODES, block_corner, node_of_block
from piavatar_envs.mpm.colliders import GATED_SLAB
from piavatar_envs.mpm.contact_normals import (
    MERGED,
    normal_from,
    records_around,
    shared_normal,
    surface_gap,
    volume_at,
)
from piavatar_envs.mpm.contact_sensors import add_impulse, pair_entry
from piavatar_envs.mpm.grid_arrays import MASS_MIN, clear_offset, offset_at, read_record, write_record
from piavatar_envs.mpm.grid_update import (
    collide_with_boundaries,
    node_position_in_block,
    physical_velocity,
    slab_is_near,
    total_velocity,
)
from piavatar_envs.mpm.sparse_grid import (
    THREADS,
    Sweep,
    contact_block_of,
    end_of_fields,
    exceeds_active_blocks,
    first_record,
    has_all_candidates,
    has_field,
    lowest_field,
    lowest_other,
    num_contact_nodes,
    store_contact_node,
)
from piavatar_envs.mpm.types import (
    NO_STRESS,
    SPLIT,
    Accumulators,
    Blocks,
    Boundaries,
    Contact,
    Grid,
    Sensors,
    Step,
    row,
)

# on a GPU, divisions and roots to two units in the last place, in a few instructions instead of calls
wp.set_module_options({"enable_backward": False, "default_grid_stride": False, "fast_math": True})

#: How far subjects may close past the gate in a substep, twice the error of :func:`surface_gap` [grid spacings].
OVERSHOOT = wp.constant(0.2)
#: Depth from which subjects part [grid spacings], beyond the error of gaps; the share of the rest by which they do so
#: in a substep; its limit [grid spacings], a tenth of the way of elastic waves at a Courant number of 0.5; and the
#: least volume of both at a node [cells], below which gaps are not reliable.
DEEP, PARTING, MOST_PARTING, FILLED = wp.constant(0.3), wp.constant(0.2), wp.constant(0.05), wp.constant(0.1)


@wp.func
def coulomb(m_a: float, m_b: float, approach: wp.vec3, n: wp.vec3, friction: float):
    """Return the impulse [N s] that stops the approach of two masses along ``n`` and slows their sliding.

    ``approach`` is ``v_a - v_b`` [m/s].
    """
    vn = wp.dot(approach, n)
    if vn <= 0.0:
        return wp.vec3(0.0)
    reduced = m_a * m_b / (m_a + m_b)
    vt = approach - vn * n
    speed = wp.length(vt)
    if speed <= friction * vn:
        return reduced * approach
    return (reduced * vn) * n + (reduced * friction * vn / speed) * vt


@wp.func
def store_contact(contact: Contact, e: int, r: int, other: int, change: wp.vec3, sensors: Sensors):
    """Add a change of velocity [m/s] to the sensor record of a node, with the subject that has contributed most."""
    sensors.touched[e, r // BLOCK_NODES] = 1
    before = read_vec4(sensors.node, e, r)
    so_far = wp.vec3(before[0], before[1], before[2])
    subject = wp.where(wp.length_sq(change) >= wp.length_sq(so_far), float(contact.subject[other]), before[3])
    after = so_far + change
    write_vec4(sensors.node, e, r, wp.vec4(after[0], after[1], after[2], subject))


@wp.func
def closing_speed(grid: Grid, step: Step, gap: float, gate: float, filled: float):
    """Return the greatest speed at which two subjects may close at a node [m/s]; negative where they part.

    It is zero in the usual contact: closer than the ``gate`` [m], and less than :data:`DEEP` in each other. ``filled``
    is the lesser of their volumes at the node [cells].
    """
    way = float(0.0)
    deep = -gap - DEEP * grid.dx
    if gap >= gate:
        way = gap - gate + OVERSHOOT * grid.dx
    elif deep > 0.0 and filled > FILLED:
        way = -wp.min(PARTING * deep, MOST_PARTING * grid.dx)
    return way / step.dt


@wp.func
def impulse_between(
    grid: Grid,
    step: Step,
    contact: Contact,
    e: int,
    a: int,
    b: int,
    va: vec8,
    vb: vec8,
    offset_a: wp.vec4,
    offset_b: wp.vec4,
    n_ab: wp.vec3,
):
    """Return the impulse [N s] that field ``a`` gives ``b`` at a node, zero for those that stay beyond the gate."""
    apart = offset_a / va[0] - offset_b / vb[0]
    distance = wp.dot(n_ab, wp.vec3(apart[0], apart[1], apart[2]))
    V_a = volume_at(grid, contact, e, a, va[0])
    V_b = volume_at(grid, contact, e, b, vb[0])
    gap = surface_gap(grid, V_a, V_b, distance)
    approach = wp.vec3(va[1] - vb[1], va[2] - vb[2], va[3] - vb[3])
    if contact.subject[a] != contact.subject[b]:
        approach -= closing_speed(grid, step, gap, contact.gate, wp.min(V_a, V_b)) * n_ab
    elif gap >= contact.gate:
        return wp.vec3()
    pairs = row(e, contact.friction.shape[0])
    return coulomb(va[0], vb[0], approach, n_ab, contact.friction[pairs, a * contact.num_fields + b])


@wp.func
def store_pair_impulse(contact: Contact, e: int, a: int, b: int, J: wp.vec3, sensors: Sensors):
    """Add the impulse that field ``a`` gives ``b`` to the sensor of their subjects, unless they are the same."""
    first = contact.subject[a]
    second = contact.subject[b]
    if first != second:
        add_impulse(sensors, e, pair_entry(sensors, first * contact.num_subjects + second), -J)


@wp.func
def collide_pair(
    grid: Grid,
    step: Step,
    contact: Contact,
    blocks: Blocks,
    accumulators: Accumulators,
    e: int,
    block: int,
    local: int,
    a: int,
    b: int,
    volume_gradient: wp.array2d(dtype=wp.vec4),
    node_velocity: wp.array2d(dtype=wp.vec4),
    sensors: Sensors,
):
    """Apply contact of the fields ``a < b`` at a node: equal and opposite impulses along one normal."""
    ra = first_record(grid, blocks, e, a, block) + local
    rb = first_record(grid, blocks, e, b, block) + local
    va = read_record(node_velocity, e, ra)
    vb = read_record(node_velocity, e, rb)
    if va[0] <= MASS_MIN or vb[0] <= MASS_MIN:
        return
    n_ab = shared_normal(grid, blocks, e, node_of_block(block_corner(grid, block), local), a, b, volume_gradient)
    offset_a = offset_at(grid, accumulators, e, a, ra)
    offset_b = offset_at(grid, accumulators, e, b, rb)
    J = impulse_between(grid, step, contact, e, a, b, va, vb, offset_a, offset_b, n_ab)
    if wp.length_sq(J) <= 0.0:
        return
    write_record(node_velocity, e, ra, va - vec8(0.0, J[0], J[1], J[2], 0.0, 0.0, 0.0, 0.0) / va[0])
    write_record(node_velocity, e, rb, vb + vec8(0.0, J[0], J[1], J[2], 0.0, 0.0, 0.0, 0.0) / vb[0])
    store_contact(contact, e, ra, b, -J / va[0], sensors)
    store_contact(contact, e, rb, a, J / vb[0], sensors)
    store_pair_impulse(contact, e, a, b, J, sensors)


@wp.func
def project_own_normals(
    grid: Grid,
    contact: Contact,
    blocks: Blocks,
    accumulators: Accumulators,
    mask: int,
    e: int,
    block: int,
    local: int,
    node_velocity: wp.array2d(dtype=wp.vec4),
    sensors: Sensors,
):
    """Apply the paper's rule: each field loses its approach to the common velocity along its own normal."""
    m = float(0.0)
    p = wp.vec3()
    heaviest = int(0)
    most = float(0.0)
    for f in range(contact.num_fields):
        if has_field(mask, f):
            v = read_record(node_velocity, e, first_record(grid, blocks, e, f, block) + local)
            if v[0] > MASS_MIN:
                m += v[0]
                p += v[0] * wp.vec3(v[1], v[2], v[3])
                if v[0] > most:
                    most = v[0]
                    heaviest = f
    if m - most <= MASS_MIN:
        return
    common = p / m
    for f in range(contact.num_fields):
        if has_field(mask, f):
            r = first_record(grid, blocks, e, f, block) + local
            v = read_record(node_velocity, e, r)
            if v[0] > MASS_MIN:
                offset = offset_at(grid, accumulators, e, f, r)
                out = wp.normalize(wp.vec3(offset[0], offset[1], offset[2]))
                other = wp.where(f == heaviest, lowest_other(mask, f, contact.num_fields), heaviest)
                mu = contact.friction[row(e, contact.friction.shape[0]), f * contact.num_fields + other]
                # contact with a wall that moves with the common velocity
                J = coulomb(1.0, 1.0, 2.0 * (wp.vec3(v[1], v[2], v[3]) - common), out, mu)
                write_record(node_velocity, e, r, v - vec8(0.0, J[0], J[1], J[2], 0.0, 0.0, 0.0, 0.0))
                store_contact(contact, e, r, other, -J, sensors)


@wp.func
def solve_node(
    grid: Grid,
    step: Step,
    boundaries: Boundaries,
    contact: Contact,
    blocks: Blocks,
    volume_gradient: wp.array2d(dtype=wp.vec4),
    accumulators: Accumulators,
    node_velocity: wp.array2d(dtype=wp.vec4),
    sensors: Sensors,
    e: int,
    block: int,
    local: int,
    mask: int,
):
    """Update a node with any number of fields, those of ``mask``.

    Fields collide with each other where all their offsets have been summed, then with colliders. Limbs merged with a
    trunk copy its velocity.
    """
    split = step.decoupling == SPLIT or step.decoupling == NO_STRESS
    present = int(0)
    candidates = int(0)
    near = slab_is_near(grid, boundaries, e, block_corner(grid, block), local, GATED_SLAB)
    for f in range(contact.num_fields):
        if has_field(mask, f):
            r = first_record(grid, blocks, e, f, block) + local
            v = read_record(node_velocity, e, r)
            if v[0] != 0.0:
                present = present | (1 << f)
            if has_all_candidates(blocks, e, r):
                candidates = candidates | (1 << f)
            v = total_velocity(step, split, v)
            write_record(node_velocity, e, r, v)
            write_vec4(sensors.node, e, r, wp.vec4(0.0))
    if contact.own_normals != 0:
        project_own_normals(grid, contact, blocks, accumulators, candidates, e, block, local, node_velocity, sensors)
    else:
        end = end_of_fields(candidates)
        for a in range(lowest_field(candidates, contact.num_fields), end - 1):
            if has_field(candidates, a):
                for b in range(a + 1, end):
                    if has_field(candidates, b):
                        collide_pair(
                            grid, step, contact, blocks, accumulators, e, block, local, a, b, volume_gradient,
                            node_velocity, sensors,
                        )  # fmt: skip
    for f in range(contact.num_fields):
        if has_field(mask, f):
            r = first_record(grid, blocks, e, f, block) + local
            total = read_record(node_velocity, e, r)
            if total[0] == MERGED:
                # the trunk precedes its limbs: its velocity is final
                t = first_record(grid, blocks, e, contact.trunk[f], block) + local
                v = read_record(node_velocity, e, t)
                write_record(node_velocity, e, r, vec8(0.0, v[1], v[2], v[3], v[4], v[5], v[6], 0.0))
                change = read_vec4(sensors.node, e, t)
                write_vec4(sensors.node, e, r, change)
                if wp.length_sq(wp.vec3(change[0], change[1], change[2])) > 0.0:
                    sensors.touched[e, r // BLOCK_NODES] = 1
            else:
                if near:
                    at = node_position_in_block(grid, block_corner(grid, block), local)
                    total = collide_with_boundaries(
                        grid, boundaries, contact, accumulators, e, f, r, at, total, sensors
                    )
                write_record(node_velocity, e, r, physical_velocity(split, total))
            clear_offset(accumulators, e, r)
    for f in range(contact.num_fields):
        if has_field(mask, f):
            r = first_record(grid, blocks, e, f, block) + local
            store_contact_node(blocks, e, r, (present & ~(1 << f)) != 0)


@wp.func
def solve_pair(
    grid: Grid,
    step: Step,
    boundaries: Boundaries,
    contact: Contact,
    blocks: Blocks,
    volume_gradient: wp.array2d(dtype=wp.vec4),
    accumulators: Accumulators,
    node_velocity: wp.array2d(dtype=wp.vec4),
    sensors: Sensors,
    e: int,
    block: int,
    local: int,
    a: int,
    b: int,
):
    """Update a node with the two fields ``a < b``; see :func:`solve_node`."""
    split = step.decoupling == SPLIT or step.decoupling == NO_STRESS
    corner = block_corner(grid, block)
    node = node_of_block(corner, local)
    ra = first_record(grid, blocks, e, a, block) + local
    rb = first_record(grid, blocks, e, b, block) + local
    around_a, around_b = records_around(grid, blocks, e, node, a, b)  # loaded early, to hide the latency
    va = read_record(node_velocity, e, ra)
    vb = read_record(node_velocity, e, rb)
    offset_a = offset_at(grid, accumulators, e, a, ra)
    offset_b = offset_at(grid, accumulators, e, b, rb)
    near = slab_is_near(grid, boundaries, e, corner, local, GATED_SLAB)
    candidates = has_all_candidates(blocks, e, ra) and has_all_candidates(blocks, e, rb)
    here_a = va[0] != 0.0
    here_b = vb[0] != 0.0
    merged = vb[0] == MERGED  # with a trunk, which precedes its limbs
    va = total_velocity(step, split, va)
    vb = total_velocity(step, split, vb)
    change_a = wp.vec4()
    change_b = wp.vec4()
    if candidates and va[0] > MASS_MIN and vb[0] > MASS_MIN:
        n_ab = normal_from(grid, e, node, around_a, around_b, volume_gradient)
        J = impulse_between(grid, step, contact, e, a, b, va, vb, offset_a, offset_b, n_ab)
        if wp.length_sq(J) > 0.0:
            dv = J / va[0]
            change_a = wp.vec4(-dv[0], -dv[1], -dv[2], float(contact.subject[b]))
            va = va - vec8(0.0, dv[0], dv[1], dv[2], 0.0, 0.0, 0.0, 0.0)
            dv = J / vb[0]
            change_b = wp.vec4(dv[0], dv[1], dv[2], float(contact.subject[a]))
            vb = vb + vec8(0.0, dv[0], dv[1], dv[2], 0.0, 0.0, 0.0, 0.0)
            sensors.touched[e, ra // BLOCK_NODES] = 1
            sensors.touched[e, rb // BLOCK_NODES] = 1
            store_pair_impulse(contact, e, a, b, J, sensors)
    if near:
        at = node_position_in_block(grid, corner, local)
        va = collide_with_boundaries(grid, boundaries, contact, accumulators, e, a, ra, at, va, sensors)
        vb = collide_with_boundaries(grid, boundaries, contact, accumulators, e, b, rb, at, vb, sensors)
    va = physical_velocity(split, va)
    vb = physical_velocity(split, vb)
    if merged:
        vb = vec8(0.0, va[1], va[2], va[3], va[4], va[5], va[6], 0.0)
    write_record(node_velocity, e, ra, va)
    write_record(node_velocity, e, rb, vb)
    write_vec4(sensors.node, e, ra, change_a)
    write_vec4(sensors.node, e, rb, change_b)
    clear_offset(accumulators, e, ra)
    clear_offset(accumulators, e, rb)
    store_contact_node(blocks, e, ra, here_b)
    store_contact_node(blocks, e, rb, here_a)


@wp.kernel(launch_bounds=(THREADS, 2))
def solve_contact(
    grid: Grid,
    step: Step,
    boundaries: Boundaries,
    contact: Contact,
    sweep: Sweep,
    blocks: Blocks,
    failure: wp.array(dtype=int),
    volume_gradient: wp.array2d(dtype=wp.vec4),
    # in and out: offsets are read, then cleared; sums become velocities
    accumulators: Accumulators,
    node_velocity: wp.array2d(dtype=wp.vec4),
    sensors: Sensors,
):
    """Update every node of the contact blocks, whose sums :mod:`piavatar_envs.mpm.contact_normals` has taken.

    Bodies collide with each other, then with colliders; the written velocities are physical.
    """
    at = environment_of(wp.tid(), sweep.threads)
    e = at[0]
    thread = at[1]
    end = wp.where(exceeds_active_blocks(failure, e), 0, num_contact_nodes(blocks, e))  # else the sums are incomplete
    for visit in range(sweep.visits):
        first = thread * sweep.nodes + visit * sweep.stride
        block = contact_block_of(blocks, e, first)
        if first >= end:
            break
        mask = blocks.fields[e, block]
        b = end_of_fields(mask) - 1
        last = 1 << wp.max(b, 0)
        for n in range(first, first + sweep.nodes):
            local = n % BLOCK_NODES
            if (mask & (mask - 1)) == last and contact.own_normals == 0:
                solve_pair(
                    grid, step, boundaries, contact, blocks, volume_gradient, accumulators, node_velocity, sensors, e,
                    block, local, lowest_field(mask, contact.num_fields), b,
                )  # fmt: skip
            else:
                solve_node(
                    grid, step, boundaries, contact, blocks, volume_gradient, accumulators, node_velocity, sensors, e,
                    block, local, mask,
                )  # fmt: skip
