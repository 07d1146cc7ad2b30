"""The grid pass: momentum to velocity, gravity, contact; clears what it reads."""

from __future__ import annotations

import warp as wp

from piavatar_envs.mpm.colliders import CONTACT_GATE, NEAR_SLAB, boundary_contact, nearest_boundary
from piavatar_envs.mpm.contact import touch_all
from piavatar_envs.mpm.masks import end_of_fields, has_field, lowest_field
from piavatar_envs.mpm.normals import GROWN_TOGETHER, MASS_MIN
from piavatar_envs.mpm.stencil import BLOCK, block_corner, node_index, node_position
from piavatar_envs.mpm.types import NO_STRESS, SPLIT, Boundaries, Contact, Grid, Sensors, Step, vec8

wp.set_module_options({"enable_backward": False})


def threads_per_block(device: str) -> int:
    """Threads that share the four slabs of a block: on a CPU an idle thread costs as much as a slab of nodes."""
    return BLOCK if wp.get_device(device).is_cuda else 1


@wp.func
def total_velocity(step: Step, split: bool, s: vec8):
    """Mass, velocity that contact acts on, and kinematic velocity of a node, from its sums."""
    m = s[0]
    if m <= MASS_MIN:
        return vec8(m, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    vk = wp.vec3(s[4], s[5], s[6]) / m
    v = wp.vec3(s[1], s[2], s[3]) / m + step.dt * step.gravity
    if split:
        v += vk
    return vec8(m, v[0], v[1], v[2], vk[0], vk[1], vk[2], 0.0)


@wp.func
def meet_boundaries(
    boundaries: Boundaries,
    contact: Contact,
    e: int,
    f: int,
    matter: wp.vec3,
    gate: float,
    total: vec8,
    sensors: Sensors,
):
    """Total velocity of a field's matter at ``matter`` after contact with the boundaries; their impulse is sensed."""
    v = wp.vec3(total[1], total[2], total[3])
    dv = boundary_contact(boundaries, e, f, matter, v, gate) - v
    if wp.length_sq(dv) > 0.0:
        wp.atomic_add(sensors.boundary_impulse, e, contact.subject[f], total[0] * dv)
    return total + vec8(0.0, dv[0], dv[1], dv[2], 0.0, 0.0, 0.0, 0.0)


@wp.func
def physical_velocity(split: bool, near: bool, total: vec8):
    """Mass, physical and kinematic velocity from mass, total and kinematic velocity; whether a boundary is near."""
    if total[0] <= MASS_MIN:
        return vec8()
    flag = wp.where(near, 1.0, 0.0)
    if split:
        return total - vec8(0.0, total[4], total[5], total[6], 0.0, 0.0, 0.0, -flag)
    return total + vec8(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, flag)


@wp.func
def solve_shared_node(
    grid: Grid,
    step: Step,
    boundaries: Boundaries,
    contact: Contact,
    mask: int,
    e: int,
    n: int,
    split: bool,
    near: bool,
    at: wp.vec3,
    gate: float,
    active: wp.array2d(dtype=int),
    node_facing: wp.array2d(dtype=wp.vec3),
    node_sum: wp.array2d(dtype=vec8),
    node_offset: wp.array2d(dtype=wp.vec3),
    node_velocity: wp.array2d(dtype=vec8),
    sensors: Sensors,
):
    """A node of a block with several fields: bodies touch, boundaries are met."""
    num_nodes = grid.num_nodes
    first = lowest_field(mask, contact.num_fields)
    end = end_of_fields(mask, contact.num_fields)
    for f in range(first, end):
        r = f * num_nodes + n
        if has_field(mask, f):
            node_velocity[e, r] = total_velocity(step, split, node_sum[e, r])
            sensors.node[e, r] = wp.vec4(0.0)
    touch_all(grid, contact, mask, e, n, active, node_facing, node_offset, node_velocity, sensors)
    for f in range(first, end):
        r = f * num_nodes + n
        if has_field(mask, f):
            total = node_velocity[e, r]
            if total[0] == GROWN_TOGETHER:
                # the trunk comes first: its velocity is final
                t = contact.trunk[f] * num_nodes + n
                v = node_velocity[e, t]
                node_velocity[e, r] = vec8(0.0, v[1], v[2], v[3], v[4], v[5], v[6], v[7])
                sensors.node[e, r] = sensors.node[e, t]
            else:
                if near and total[0] > MASS_MIN:
                    matter = at - node_offset[e, r] / total[0]
                    total = meet_boundaries(boundaries, contact, e, f, matter, gate, total, sensors)
                node_velocity[e, r] = physical_velocity(split, near, total)
            node_sum[e, r] = vec8()
            node_offset[e, r] = wp.vec3(0.0)


@wp.kernel
def update_grid(
    grid: Grid,
    step: Step,
    boundaries: Boundaries,
    contact: Contact,
    slabs: int,
    active: wp.array2d(dtype=int),
    node_facing: wp.array2d(dtype=wp.vec3),
    # in and out: read, then cleared
    node_sum: wp.array2d(dtype=vec8),
    node_offset: wp.array2d(dtype=wp.vec3),
    # out
    node_velocity: wp.array2d(dtype=vec8),
    next_active: wp.array2d(dtype=int),
    sensors: Sensors,
):
    """Velocity of every node with mass. Contact acts on the total velocity ``v = u + vk``; the rest is physical.

    ``slabs`` threads share a block; each takes every ``slabs``-th slab of 4 x 4 nodes. Only the fields that have mass
    in a block cost anything there.
    """
    e, block, slab = wp.tid()
    if slab == 0:
        next_active[e, block] = 0
    mask = active[e, block]
    if mask == 0:
        return
    f = lowest_field(mask, contact.num_fields)
    shared = mask != (1 << f)
    of_field = f * grid.num_nodes
    corner = block_corner(grid, block)
    split = step.decoupling == SPLIT or step.decoupling == NO_STRESS
    gate = CONTACT_GATE * grid.dx
    for i in range(corner[0] + slab, wp.min(corner[0] + 4, grid.nodes[0]), slabs):
        center = node_position(grid, i, corner[1], corner[2]) + grid.dx * wp.vec3(0.0, 1.5, 1.5)
        # most slabs are far from any boundary, and skip all of its work
        near = nearest_boundary(boundaries, e, center) < NEAR_SLAB * grid.dx
        for j in range(corner[1], wp.min(corner[1] + 4, grid.nodes[1])):
            for k in range(corner[2], wp.min(corner[2] + 4, grid.nodes[2])):
                n = node_index(grid, i, j, k)
                at = node_position(grid, i, j, k)
                if shared:
                    solve_shared_node(
                        grid, step, boundaries, contact, mask, e, n, split, near, at, gate,
                        active, node_facing, node_sum, node_offset, node_velocity, sensors,
                    )  # fmt: skip
                else:
                    r = of_field + n
                    total = total_velocity(step, split, node_sum[e, r])
                    if near and total[0] > MASS_MIN:
                        matter = at - node_offset[e, r] / total[0]
                        total = meet_boundaries(boundaries, contact, e, f, matter, gate, total, sensors)
                    node_velocity[e, r] = physical_velocity(split, near, total)
                    node_sum[e, r] = vec8()
                    # particles next to another field's block have left their offsets here, too
                    if near or contact.num_fields > 1:
                        node_offset[e, r] = wp.vec3(0.0)
