"""The grid pass over blocks with several fields: bodies touch, boundaries are met, velocities become physical.

Such blocks are few, so what the pass takes is the time that its threads wait for memory. Nearly all of them have two
fields: :func:`solve_pair` keeps what it knows of those in registers, and asks for all of it at once.
"""

from __future__ import annotations

import warp as wp

from piavatar_envs.mpm.blocks import (
    end_of_fields,
    first_record,
    has_field,
    lacks_slots,
    lowest_field,
    nodes_shared,
    shared_block,
)
from piavatar_envs.mpm.colliders import GATED_SLAB
from piavatar_envs.mpm.contact import book_pair, impulse_between, touch_all
from piavatar_envs.mpm.grid import meet_boundaries, physical_velocity, place_of, slab_is_near, total_velocity
from piavatar_envs.mpm.impulses import read_change, write_change
from piavatar_envs.mpm.normals import GROWN_TOGETHER, MASS_MIN, normal_from, records_around
from piavatar_envs.mpm.others import has_told, note_others
from piavatar_envs.mpm.records import read_record, write_record
from piavatar_envs.mpm.stencil import BLOCK_NODES, block_corner, node_of_block
from piavatar_envs.mpm.sums import clear_offset, offset_at
from piavatar_envs.mpm.sweep import THREADS, Sweep
from piavatar_envs.mpm.threads import environment_of
from piavatar_envs.mpm.types import NO_STRESS, SPLIT, Blocks, Boundaries, Contact, Grid, Sensors, Step, Sums, vec8

# on a GPU, divisions and roots to two units in the last place, in a few instructions instead of calls
wp.set_module_options({"enable_backward": False, "default_grid_stride": False, "fast_math": True})


@wp.func
def settle_node(
    grid: Grid,
    step: Step,
    boundaries: Boundaries,
    contact: Contact,
    blocks: Blocks,
    sums: Sums,
    mask: int,
    near: bool,
    e: int,
    block: int,
    local: int,
    node_velocity: wp.array2d(dtype=wp.vec4),
    sensors: Sensors,
):
    """What comes after the contact of the fields of a node: boundaries are met, and velocities become physical."""
    split = step.decoupling == SPLIT or step.decoupling == NO_STRESS
    for f in range(contact.num_fields):
        if has_field(mask, f):
            r = first_record(grid, blocks, e, f, block) + local
            total = read_record(node_velocity, e, r)
            if total[0] == GROWN_TOGETHER:
                # the trunk comes first: its velocity is final
                t = first_record(grid, blocks, e, contact.trunk[f], block) + local
                v = read_record(node_velocity, e, t)
                write_record(node_velocity, e, r, vec8(0.0, v[1], v[2], v[3], v[4], v[5], v[6], 0.0))
                change = read_change(sensors.node, e, t)
                write_change(sensors.node, e, r, change)
                if wp.length_sq(wp.vec3(change[0], change[1], change[2])) > 0.0:
                    sensors.touched[e, r // BLOCK_NODES] = 1
            else:
                if near:
                    at = place_of(grid, block_corner(grid, block), local)
                    total = meet_boundaries(grid, boundaries, contact, sums, e, f, r, at, total, sensors)
                write_record(node_velocity, e, r, physical_velocity(split, total))
            clear_offset(sums, e, r)


@wp.func
def solve_node(
    grid: Grid,
    step: Step,
    boundaries: Boundaries,
    contact: Contact,
    blocks: Blocks,
    node_facing: wp.array2d(dtype=wp.vec4),
    sums: Sums,
    node_velocity: wp.array2d(dtype=wp.vec4),
    sensors: Sensors,
    e: int,
    block: int,
    local: int,
    mask: int,
):
    """A node with any number of fields, those of ``mask``."""
    split = step.decoupling == SPLIT or step.decoupling == NO_STRESS
    present = int(0)
    told = int(0)
    near = slab_is_near(grid, boundaries, e, block_corner(grid, block), local, GATED_SLAB)
    for f in range(contact.num_fields):
        if has_field(mask, f):
            r = first_record(grid, blocks, e, f, block) + local
            v = read_record(node_velocity, e, r)
            if v[0] != 0.0:
                present = present | (1 << f)
            if has_told(blocks, e, r):
                told = told | (1 << f)
            v = total_velocity(step, split, v)
            write_record(node_velocity, e, r, v)
            write_change(sensors.node, e, r, wp.vec4(0.0))
    touch_all(grid, contact, blocks, sums, told, e, block, local, node_facing, node_velocity, sensors)
    settle_node(
        grid, step, boundaries, contact, blocks, sums, mask, near, e, block, local, node_velocity, sensors
    )  # fmt: skip
    for f in range(contact.num_fields):
        if has_field(mask, f):
            r = first_record(grid, blocks, e, f, block) + local
            note_others(blocks, e, r, (present & ~(1 << f)) != 0)


@wp.func
def solve_pair(
    grid: Grid,
    step: Step,
    boundaries: Boundaries,
    contact: Contact,
    blocks: Blocks,
    node_facing: wp.array2d(dtype=wp.vec4),
    sums: Sums,
    node_velocity: wp.array2d(dtype=wp.vec4),
    sensors: Sensors,
    e: int,
    block: int,
    local: int,
    a: int,
    b: int,
):
    """:func:`solve_node` for a node with the two fields ``a < b``."""
    split = step.decoupling == SPLIT or step.decoupling == NO_STRESS
    corner = block_corner(grid, block)
    node = node_of_block(corner, local)
    ra = first_record(grid, blocks, e, a, block) + local
    rb = first_record(grid, blocks, e, b, block) + local
    around_a, around_b = records_around(grid, blocks, e, node, a, b)  # asked for before it is known who needs them
    va = read_record(node_velocity, e, ra)
    vb = read_record(node_velocity, e, rb)
    offset_a = offset_at(grid, sums, e, a, ra)
    offset_b = offset_at(grid, sums, e, b, rb)
    near = slab_is_near(grid, boundaries, e, corner, local, GATED_SLAB)
    told = has_told(blocks, e, ra) and has_told(blocks, e, rb)
    here_a = va[0] != 0.0
    here_b = vb[0] != 0.0
    grown = vb[0] == GROWN_TOGETHER  # only to a trunk, which comes first
    va = total_velocity(step, split, va)
    vb = total_velocity(step, split, vb)
    change_a = wp.vec4()
    change_b = wp.vec4()
    if told and va[0] > MASS_MIN and vb[0] > MASS_MIN:
        n_ab = normal_from(grid, e, node, around_a, around_b, node_facing)
        J = impulse_between(grid, contact, e, a, b, va, vb, offset_a, offset_b, n_ab)
        if wp.length_sq(J) > 0.0:
            dv = J / va[0]
            change_a = wp.vec4(-dv[0], -dv[1], -dv[2], float(contact.subject[b]))
            va = va - vec8(0.0, dv[0], dv[1], dv[2], 0.0, 0.0, 0.0, 0.0)
            dv = J / vb[0]
            change_b = wp.vec4(dv[0], dv[1], dv[2], float(contact.subject[a]))
            vb = vb + vec8(0.0, dv[0], dv[1], dv[2], 0.0, 0.0, 0.0, 0.0)
            sensors.touched[e, ra // BLOCK_NODES] = 1
            sensors.touched[e, rb // BLOCK_NODES] = 1
            book_pair(contact, e, a, b, J, sensors)
    if near:
        at = place_of(grid, corner, local)
        va = meet_boundaries(grid, boundaries, contact, sums, e, a, ra, at, va, sensors)
        vb = meet_boundaries(grid, boundaries, contact, sums, e, b, rb, at, vb, sensors)
    va = physical_velocity(split, va)
    vb = physical_velocity(split, vb)
    if grown:
        vb = vec8(0.0, va[1], va[2], va[3], va[4], va[5], va[6], 0.0)
    write_record(node_velocity, e, ra, va)
    write_record(node_velocity, e, rb, vb)
    write_change(sensors.node, e, ra, change_a)
    write_change(sensors.node, e, rb, change_b)
    clear_offset(sums, e, ra)
    clear_offset(sums, e, rb)
    note_others(blocks, e, ra, here_b)
    note_others(blocks, e, rb, here_a)


@wp.kernel(launch_bounds=(THREADS, 2))
def solve_contact(
    grid: Grid,
    step: Step,
    boundaries: Boundaries,
    contact: Contact,
    sweep: Sweep,
    blocks: Blocks,
    failure: wp.array(dtype=int),
    node_facing: wp.array2d(dtype=wp.vec4),
    # in and out: offsets are read, then cleared; sums become velocities
    sums: Sums,
    node_velocity: wp.array2d(dtype=wp.vec4),
    sensors: Sensors,
):
    """Velocity of every node in blocks with several fields, whose sums have been taken.

    Bodies touch, boundaries are met; the rest is physical.
    """
    at = environment_of(wp.tid(), sweep.threads)
    e = at[0]
    thread = at[1]
    end = wp.where(lacks_slots(failure, e), 0, nodes_shared(blocks, e))  # else nobody has added up all particles
    for turn in range(sweep.turns):
        first = thread * sweep.share + turn * sweep.stride
        block = shared_block(blocks, e, first)
        if first >= end:
            break
        mask = blocks.fields[e, block]
        b = end_of_fields(mask) - 1
        last = 1 << wp.max(b, 0)
        for n in range(first, first + sweep.share):
            local = n % BLOCK_NODES
            if (mask & (mask - 1)) == last and contact.own_normals == 0:
                solve_pair(
                    grid, step, boundaries, contact, blocks, node_facing, sums, node_velocity, sensors, e, block, local,
                    lowest_field(mask, contact.num_fields), b,
                )  # fmt: skip
            else:
                solve_node(
                    grid, step, boundaries, contact, blocks, node_facing, sums, node_velocity, sensors, e, block, local,
                    mask,
                )  # fmt: skip
