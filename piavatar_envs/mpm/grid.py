"""The grid pass: momentum to velocity, gravity, contact; clears what it reads."""

from __future__ import annotations

import warp as wp

from piavatar_envs.mpm.blocks import end_of_fields, first_record, has_field, held_by, shared_by, slots_used
from piavatar_envs.mpm.colliders import CONTACT_GATE, NEAR_SLAB, boundary_contact, nearest_boundary
from piavatar_envs.mpm.contact import touch_all
from piavatar_envs.mpm.impulses import add_impulse, boundary_entry
from piavatar_envs.mpm.normals import GROWN_TOGETHER, MASS_MIN
from piavatar_envs.mpm.stencil import BLOCK_NODES, block_corner, node_of_block, node_position
from piavatar_envs.mpm.sums import clear_offset, offset_at, take_sum, write_record
from piavatar_envs.mpm.types import NO_STRESS, SPLIT, Blocks, Boundaries, Contact, Grid, Sensors, Step, Sums, vec8

wp.set_module_options({"enable_backward": False})

#: Nodes of a slab of a block, the unit in which boundaries are looked for.
SLAB_NODES = wp.constant(16)


def threads_per_block(device: str) -> int:
    """Threads that share the nodes of a block: on a CPU an idle thread costs as much as a slab of nodes."""
    return int(BLOCK_NODES) if wp.get_device(device).is_cuda else 1


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
    grid: Grid,
    boundaries: Boundaries,
    contact: Contact,
    sums: Sums,
    e: int,
    f: int,
    r: int,
    at: wp.vec3,
    total: vec8,
    sensors: Sensors,
):
    """Total velocity of a field's matter at node ``at`` after contact with the boundaries; their impulse is sensed."""
    if total[0] <= MASS_MIN:
        return total
    offset = offset_at(grid, sums, e, f, r)
    matter = at - wp.vec3(offset[0], offset[1], offset[2]) / total[0]
    v = wp.vec3(total[1], total[2], total[3])
    dv = boundary_contact(boundaries, e, f, matter, v, CONTACT_GATE * grid.dx) - v
    if wp.length_sq(dv) > 0.0:
        add_impulse(sensors, e, boundary_entry(sensors, contact.subject[f]), total[0] * dv)
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
def near_slab(grid: Grid, boundaries: Boundaries, e: int, corner: wp.vec3i, local: int):
    """Whether a boundary is near the slab of 4 x 4 nodes that node ``local`` of a block is in."""
    i = corner[0] + local // SLAB_NODES
    center = node_position(grid, i, corner[1], corner[2]) + grid.dx * wp.vec3(0.0, 1.5, 1.5)
    return nearest_boundary(boundaries, e, center) < NEAR_SLAB * grid.dx


@wp.kernel
def update_grid(
    grid: Grid,
    step: Step,
    boundaries: Boundaries,
    contact: Contact,
    threads: int,
    failure: wp.array(dtype=int),
    # in and out: sums are read, then cleared
    blocks: Blocks,
    sums: Sums,
    # out
    node_velocity: wp.array2d(dtype=vec8),
    sensors: Sensors,
):
    """Velocity of every node with mass in blocks of one field. ``threads`` threads share a slot's block.

    Contact acts on the total velocity ``v = u + vk``; the rest is physical.
    """
    e, slot, thread = wp.tid()
    if slot == 0 and thread == 0:
        blocks.swept[e] = slots_used(blocks, e)
        blocks.frozen[e] = failure[e]  # the scatter has ended
    held = held_by(grid, blocks, e, slot)
    f = held[0]
    if f < 0 or blocks.fields[e, held[1]] != (1 << f):
        return
    corner = block_corner(grid, held[1])
    split = step.decoupling == SPLIT or step.decoupling == NO_STRESS
    share = BLOCK_NODES // threads
    near = bool(False)
    for local in range(thread * share, (thread + 1) * share):
        if local == thread * share or local % SLAB_NODES == 0:
            near = near_slab(grid, boundaries, e, corner, local)  # most skip all of that work
        r = BLOCK_NODES * slot + local
        total = total_velocity(step, split, take_sum(sums, e, f, r))
        if near:
            node = node_of_block(corner, local)
            at = node_position(grid, node[0], node[1], node[2])
            total = meet_boundaries(grid, boundaries, contact, sums, e, f, r, at, total, sensors)
        write_record(node_velocity, e, r, physical_velocity(split, near, total))
        # particles next to another field's block have left their offsets here, too
        if near or contact.num_fields > 1:
            clear_offset(sums, e, r)


@wp.kernel
def solve_contact(
    grid: Grid,
    step: Step,
    boundaries: Boundaries,
    contact: Contact,
    threads: int,
    blocks: Blocks,
    node_facing: wp.array2d(dtype=wp.vec3),
    # in and out: offsets are read, then cleared; sums become velocities
    sums: Sums,
    node_velocity: wp.array2d(dtype=vec8),
    sensors: Sensors,
):
    """The same in blocks with several fields, whose sums have been taken: bodies touch, boundaries are met."""
    e, slot, thread = wp.tid()
    held = shared_by(grid, blocks, e, slot, contact.num_fields)
    if held[0] < 0:
        return
    block = held[1]
    mask = blocks.fields[e, block]
    corner = block_corner(grid, block)
    end = end_of_fields(mask, contact.num_fields)
    split = step.decoupling == SPLIT or step.decoupling == NO_STRESS
    share = BLOCK_NODES // threads
    near = bool(False)
    for local in range(thread * share, (thread + 1) * share):
        if local == thread * share or local % SLAB_NODES == 0:
            near = near_slab(grid, boundaries, e, corner, local)
        node = node_of_block(corner, local)
        at = node_position(grid, node[0], node[1], node[2])
        for f in range(held[0], end):
            if has_field(mask, f):
                r = first_record(grid, blocks, e, f, block) + local
                node_velocity[e, r] = total_velocity(step, split, node_velocity[e, r])
                sensors.node[e, r] = wp.vec4(0.0)
        touch_all(grid, contact, blocks, sums, mask, e, block, local, node_facing, node_velocity, sensors)
        for f in range(held[0], end):
            if has_field(mask, f):
                r = first_record(grid, blocks, e, f, block) + local
                total = node_velocity[e, r]
                if total[0] == GROWN_TOGETHER:
                    # the trunk comes first: its velocity is final
                    t = first_record(grid, blocks, e, contact.trunk[f], block) + local
                    v = node_velocity[e, t]
                    node_velocity[e, r] = vec8(0.0, v[1], v[2], v[3], v[4], v[5], v[6], v[7])
                    sensors.node[e, r] = sensors.node[e, t]
                else:
                    if near:
                        total = meet_boundaries(grid, boundaries, contact, sums, e, f, r, at, total, sensors)
                    node_velocity[e, r] = physical_velocity(split, near, total)
                clear_offset(sums, e, r)
