"""Contact between velocity fields: bodies that meet at a grid node push each other, and slide with friction.

Every subject has a velocity field of its own (an avatar may have one for each limb), so that what meets at a node can
separate again. Fields are compared in pairs, in a fixed order. A pair has *one* normal ``n``, which
:mod:`piavatar_envs.mpm.normals` finds, and exchanges one impulse along it (free slip, no tension) and one against the
sliding (Coulomb)::

    j = m_a m_b / (m_a + m_b) max(0, (v_a - v_b) . n),    friction at most mu j

What ``a`` loses, ``b`` gains, at the same point: linear and angular momentum are kept to round-off. After Bardenhagen
et al., "The Material-Point Method for Granular Materials" (2000) and, for the common normal, Huang et al., "Contact
Algorithms for the Material Point Method in Impact and Penetration Simulation" (2011).

PIAvatar (Han et al., arXiv 2606.21162) projects each field with a normal of its own towards the common velocity; the
impulses of a node then do not add up to zero, and momentum is lost. It can be selected for comparison
(``own_normals``); the sensors of pairs then stay empty.

Fields meet long before their matter does, a grid spacing apart. A gate on the gap between their surfaces lets bodies
come closer.
"""

from __future__ import annotations

import warp as wp

from piavatar_envs.mpm.blocks import end_of_fields, first_record, has_field, lowest_field, lowest_other
from piavatar_envs.mpm.impulses import add_impulse, pair_entry, read_change, write_change
from piavatar_envs.mpm.normals import MASS_MIN, shared_normal, surface_gap, volume_at
from piavatar_envs.mpm.records import read_record, write_record
from piavatar_envs.mpm.stencil import BLOCK_NODES, block_corner, node_of_block
from piavatar_envs.mpm.sums import offset_at
from piavatar_envs.mpm.types import Blocks, Contact, Grid, Sensors, Sums, row, vec8

wp.set_module_options({"enable_backward": False})


@wp.func
def coulomb(m_a: float, m_b: float, approach: wp.vec3, n: wp.vec3, friction: float):
    """Impulse [N s] that stops the approach ``v_a - v_b`` of two masses along ``n`` and slows their sliding."""
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
def book_contact(contact: Contact, e: int, r: int, other: int, change: wp.vec3, mark: int, sensors: Sensors):
    """Add a change of velocity [m/s] to a node's record, and keep the subject that has done most of it.

    What ``touched`` says of the slot then is ``mark``.
    """
    sensors.touched[e, r // BLOCK_NODES] = mark
    before = read_change(sensors.node, e, r)
    so_far = wp.vec3(before[0], before[1], before[2])
    subject = wp.where(wp.length_sq(change) >= wp.length_sq(so_far), float(contact.subject[other]), before[3])
    after = so_far + change
    write_change(sensors.node, e, r, wp.vec4(after[0], after[1], after[2], subject))


@wp.func
def impulse_between(
    grid: Grid,
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
    """Impulse [N s] that field ``a`` gives ``b`` at a node, from records and offsets of both; zero without contact."""
    apart = offset_a / va[0] - offset_b / vb[0]
    distance = wp.dot(n_ab, wp.vec3(apart[0], apart[1], apart[2]))
    V_a = volume_at(grid, contact, e, a, va[0])
    V_b = volume_at(grid, contact, e, b, vb[0])
    if surface_gap(grid, V_a, V_b, distance) >= contact.gate:
        return wp.vec3()
    approach = wp.vec3(va[1] - vb[1], va[2] - vb[2], va[3] - vb[3])
    pairs = row(e, contact.friction.shape[0])
    return coulomb(va[0], vb[0], approach, n_ab, contact.friction[pairs, a * contact.num_fields + b])


@wp.func
def book_pair(contact: Contact, e: int, a: int, b: int, J: wp.vec3, sensors: Sensors):
    """Add the impulse that field ``a`` gives ``b`` to what is known of their subjects, if they have two."""
    first = contact.subject[a]
    second = contact.subject[b]
    if first != second:
        add_impulse(sensors, e, pair_entry(sensors, first * contact.num_subjects + second), -J)


@wp.func
def touch(
    grid: Grid,
    contact: Contact,
    blocks: Blocks,
    sums: Sums,
    e: int,
    block: int,
    local: int,
    a: int,
    b: int,
    node_facing: wp.array2d(dtype=wp.vec4),
    node_velocity: wp.array2d(dtype=wp.vec4),
    sensors: Sensors,
):
    """Contact of the fields ``a < b`` at a node: equal and opposite impulses along one normal."""
    ra = first_record(grid, blocks, e, a, block) + local
    rb = first_record(grid, blocks, e, b, block) + local
    va = read_record(node_velocity, e, ra)
    vb = read_record(node_velocity, e, rb)
    if va[0] <= MASS_MIN or vb[0] <= MASS_MIN:
        return
    n_ab = shared_normal(grid, blocks, e, node_of_block(block_corner(grid, block), local), a, b, node_facing)
    offset_a = offset_at(grid, sums, e, a, ra)
    offset_b = offset_at(grid, sums, e, b, rb)
    J = impulse_between(grid, contact, e, a, b, va, vb, offset_a, offset_b, n_ab)
    if wp.length_sq(J) <= 0.0:
        return
    write_record(node_velocity, e, ra, va - vec8(0.0, J[0], J[1], J[2], 0.0, 0.0, 0.0, 0.0) / va[0])
    write_record(node_velocity, e, rb, vb + vec8(0.0, J[0], J[1], J[2], 0.0, 0.0, 0.0, 0.0) / vb[0])
    book_contact(contact, e, ra, b, -J / va[0], 1, sensors)
    book_contact(contact, e, rb, a, J / vb[0], 1, sensors)
    book_pair(contact, e, a, b, J, sensors)


@wp.func
def project_alone(
    grid: Grid,
    contact: Contact,
    blocks: Blocks,
    sums: Sums,
    mask: int,
    e: int,
    block: int,
    local: int,
    node_velocity: wp.array2d(dtype=wp.vec4),
    sensors: Sensors,
):
    """The paper's rule: each field loses its approach to the common velocity, of a ``mask``, along its own normal."""
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
                offset = offset_at(grid, sums, e, f, r)
                out = wp.normalize(wp.vec3(offset[0], offset[1], offset[2]))
                other = wp.where(f == heaviest, lowest_other(mask, f, contact.num_fields), heaviest)
                mu = contact.friction[row(e, contact.friction.shape[0]), f * contact.num_fields + other]
                # against a wall that moves with the common velocity
                J = coulomb(1.0, 1.0, 2.0 * (wp.vec3(v[1], v[2], v[3]) - common), out, mu)
                write_record(node_velocity, e, r, v - vec8(0.0, J[0], J[1], J[2], 0.0, 0.0, 0.0, 0.0))
                book_contact(contact, e, r, other, -J, 1, sensors)


@wp.func
def touch_all(
    grid: Grid,
    contact: Contact,
    blocks: Blocks,
    sums: Sums,
    mask: int,
    e: int,
    block: int,
    local: int,
    node_facing: wp.array2d(dtype=wp.vec4),
    node_velocity: wp.array2d(dtype=wp.vec4),
    sensors: Sensors,
):
    """Contact of the fields of a ``mask`` at a node, of those that have told it where they are."""
    if contact.own_normals != 0:
        project_alone(grid, contact, blocks, sums, mask, e, block, local, node_velocity, sensors)
        return
    end = end_of_fields(mask)
    for a in range(lowest_field(mask, contact.num_fields), end - 1):
        if has_field(mask, a):
            for b in range(a + 1, end):
                if has_field(mask, b):
                    touch(grid, contact, blocks, sums, e, block, local, a, b, node_facing, node_velocity, sensors)
